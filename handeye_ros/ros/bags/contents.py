"""What a bag holds, before anything is made of it."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import zstandard

CLOUD = 'sensor_msgs/msg/PointCloud2'
POSE = 'geometry_msgs/msg/PoseStamped'
JOINTS = 'sensor_msgs/msg/JointState'
TF = 'tf2_msgs/msg/TFMessage'

ZSTD = b'\x28\xb5\x2f\xfd'
LARGEST = 1 << 28  # bytes of one record or message, packed or not: no recorder writes more


class Raw(NamedTuple):
    """A message as it was recorded; log_time: ns."""

    topic: str
    log_time: int
    data: bytes


# A message, and what reads it again from where it lies: nothing, where that is lost meanwhile.
Given: TypeAlias = tuple[Raw, Callable[[], bytes]]


@dataclass
class Contents:
    """
    What a bag holds.

    topics: the type by the name of each; messages: of the topics asked for, in the order of
    recording, where they were asked for; warnings: what could not be read; files: what was read;
    at: the byte of the present file that is being read.
    """

    topics: dict[str, str] = field(default_factory=dict)
    messages: list[Raw] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    at: int = 0


def full_name(topic: str) -> str:
    """Return a topic with its leading slash."""
    return '/' + topic.lstrip('/')


def message_of(data: bytes) -> bytes:
    """Return a message, unpacked where the recorder packed each one; CDR starts with 0."""
    if data[:4] != ZSTD:
        return data
    try:
        return unpacked(data)
    except zstandard.ZstdError:
        return b''  # which is no message of any type


def unpacked(data: bytes | memoryview) -> bytes:
    """Return what was packed with zstd, also the beginning of it; never more than LARGEST."""
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        return stream.read(LARGEST)


def type_of(name: str, encoding: str) -> str:
    """Return the type of a topic; a serialization that ROS does not use is part of it."""
    package, _, kind = name.partition('/')
    full = name if not kind or '/' in kind else f'{package}/msg/{kind}'
    return full if encoding == 'cdr' else f'{full} in {encoding}'
