"""
Contents of a bag: its topics, and its messages in blocks.

There are thousands of messages per second of recording: work for a whole block is fast.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import zstandard

CLOUD = 'sensor_msgs/msg/PointCloud2'
POSE = 'geometry_msgs/msg/PoseStamped'
JOINTS = 'sensor_msgs/msg/JointState'
TF = 'tf2_msgs/msg/TFMessage'
STRING = 'std_msgs/msg/String'

ZSTD = b'\x28\xb5\x2f\xfd'
LARGEST = 1 << 28  # bytes of one record or message, compressed or not: no recorder writes more
BLOCK = 1 << 20  # bytes of single messages that become blocks


class Raw(NamedTuple):
    """A message as it was recorded; log_time: ns."""

    topic: str
    log_time: int
    data: bytes


@dataclass
class Contents:
    """
    Topics and messages of a bag.

    topics: their types by name; messages: of the requested topics, in the order of recording, if
    they were requested; warnings: on unreadable data; files: that were read; position: byte in the
    current file.
    """

    topics: dict[str, str] = field(default_factory=dict)
    messages: list[Raw] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    position: int = 0


@dataclass(frozen=True, eq=False)
class Block:
    """
    Messages of one topic, in the order of recording.

    data: holds them as stored, message i from starts[i] to ends[i]; log_times: ns. reread: returns
    a message by its position in the file, so that it need not be kept; empty if the file has
    changed.
    """

    topic: str
    data: bytes | memoryview
    starts: Sequence[int]
    ends: Sequence[int]
    log_times: Sequence[int]
    positions: Sequence[Any]
    reread: Callable[[Any], bytes]

    def __len__(self) -> int:
        """Return how many messages there are."""
        return len(self.starts)

    def message(self, index: int) -> bytes:
        """Return a message."""
        return message_of(bytes(self.data[self.starts[index]:self.ends[index]]))


def block_of(topic: str, log_times: Sequence[int], messages: Sequence[bytes],
             positions: Sequence[Any], reread: Callable[[Any], bytes]) -> Block:
    """Return messages as one block."""
    ends = list(accumulate(map(len, messages)))
    return Block(topic, b''.join(messages), [0, *ends[:-1]], ends, log_times, positions, reread)


class BlockBuilder:
    """Collects single messages into blocks."""

    def __init__(self, reread: Callable[[Any], bytes]) -> None:
        """Start with none; reread: see Block."""
        self._reread = reread
        self._rows: dict[str, list[tuple[int, bytes, Any]]] = {}
        self._bytes = 0

    @property
    def is_full(self) -> bool:
        """Return whether there are enough messages for blocks."""
        return self._bytes >= BLOCK

    def add(self, topic: str, log_time: int, data: bytes, position: Any) -> None:
        """Add the next message."""
        self._rows.setdefault(topic, []).append((log_time, data, position))
        self._bytes += len(data)

    def take_blocks(self) -> list[Block]:
        """Return the blocks and start again with none."""
        columns = {topic: list(zip(*rows, strict=True)) for topic, rows in self._rows.items()}
        self._rows, self._bytes = {}, 0
        return [block_of(topic, log_times, messages, positions, self._reread)
                for topic, (log_times, messages, positions) in columns.items()]


def full_name(topic: str) -> str:
    """Return a topic with its leading slash."""
    return '/' + topic.lstrip('/')


def message_of(data: bytes) -> bytes:
    """Return a message, decompressed if the recorder compressed each one; CDR starts with 0."""
    if data[:4] != ZSTD:
        return data
    try:
        return unpacked(data)
    except zstandard.ZstdError:
        return b''  # no message of any type


def unpacked(data: bytes | memoryview) -> bytes:
    """Return decompressed zstd data, also if cut; never more than LARGEST."""
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        return stream.read(LARGEST)


def type_of(name: str, encoding: str) -> str:
    """Return the type of a topic, with its serialization if ROS does not use it."""
    package, _, kind = name.partition('/')
    full = name if not kind or '/' in kind else f'{package}/msg/{kind}'
    return full if encoding == 'cdr' else f'{full} in {encoding}'
