# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads profiles and poses from a rosbag2 recording; writer.py writes them.

The profiles may be larger than the memory: of each its stamp is kept, and its place in the file,
from which it is read again when a stop uses it. Poses are kept, as is /tf while it is read.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Any

from handeye_ros.arm import Arm
from handeye_ros.bags.messages import ProfileReader, profiles_of, returns_of
from handeye_ros.bags.poses import ArmPose, OtherJointsError, pose_topics
from handeye_ros.bags.storage import CLOUD_TYPE, full_name, Reader, RecordedMessage, TF_TYPE
from handeye_ros.bags.transforms import FlangeFollower
from handeye_ros.config import Config, MAX_TIME_OFFSET
from handeye_ros.data import Array, Profile, RawProfile, TimedPose
from handeye_ros.errors import (
    DataError,
    InputError,
    path_of,
    require_type,
    UnusableMessageError,
)
from handeye_ros.results.file_values import input_provenance
from handeye_ros.sampling.stream import (
    by_stamp,
    FEW_SHARE,
    FEW_STRAYS,
    in_majority_order,
    LAST_STAMP,
    two_frames_error,
)
import numpy as np

MAX_MALFORMED_SHARE = 0.5  # largest share of messages of a topic that cannot be used
MAX_LISTED = 12  # topics in a sentence


@dataclass(frozen=True, eq=False)
class Recording:
    """
    The contents of a bag for a calibration.

    profiles, poses: in the order of their stamps
    joints: the joint values (n, joints) of the poses, where these are of an arm
    warnings: sentences on lost or repaired data
    files: those that were read
    """

    profiles: tuple[RawProfile, ...]
    poses: Sequence[TimedPose]
    joints: Array | None = None
    warnings: list[str] = field(default_factory=list)
    files: Sequence[Path] = ()

    @cached_property
    def inputs(self) -> tuple[dict[str, str], ...]:
        """Return path and sha256 of all files read, for the provenance of results."""
        return tuple(input_provenance(file) for file in self.files)

    def profiles_of_returns(self) -> Iterator[Profile]:
        """
        Yield the profiles: only returns, in message order, with intensity.

        What cannot be used is dropped, and is in the warnings after the last one. Raises
        InputError if most are dropped, as are all profiles of an unknown time.
        """
        reasons = []
        for raw in self.profiles:
            try:
                yield returns_of(raw)
            except UnusableMessageError as error:
                reasons.append(str(error))
        self.warnings.extend(
            _dropped_warning(reasons, len(self.profiles), 'profiles of the recording'))


def _dropped_warning(reasons: Sequence[str], total: int, what: str) -> list[str]:
    """
    Return a warning of what was dropped, none without a reason.

    reasons: one of each item dropped; total: number of all items; what: they are, in words.
    Raises InputError if most were dropped.
    """
    if not reasons:
        return []
    if len(reasons) > MAX_MALFORMED_SHARE * total:
        usable = 'none' if len(reasons) == total else f'only {total - len(reasons)}'
        raise InputError(f'{usable} of the {total} {what} can be used; the first reason: '
                         f'{reasons[0]}')
    return [f'{len(reasons)} of {total} {what} were dropped; the first: {reasons[0]}']


def read_bag(path: Path | str, config: Config,
             progress: Callable[[float], None] = lambda share: None, arm: Arm | None = None
             ) -> Recording:
    """
    Return the profiles and flange poses in a rosbag2 folder or an .mcap or .db3 file.

    A damaged file is read up to the damage, with a warning. progress: receives the fraction of the
    bytes that were read. arm: gives the poses from the joint values, as with the key kinematics.
    Raises InputError when the bag or its topics cannot be read, or one topic carries two frames,
    and DataError when its stamps mix two runs, or profiles and poses do not overlap in time.
    """
    path = path_of('path', path)
    require_type('config', config, Config)
    require_type('progress', progress, Callable)  # type: ignore[arg-type]
    profile_reader = ProfileReader(config.profile)
    follower = FlangeFollower(config.base_frame, config.robot_effector_frame,
                              config.sampling.max_pose_gap)
    sources = {full_name(source.name): source for source in pose_topics(config, follower, arm)}
    *_, required = sources.values()
    clouds = _RecordedTopic(config.profile_topic, 'profile_topic', CLOUD_TYPE,
                            lambda raw: [profile_reader.take(raw.data, raw.fetch)])
    pose_topic = _RecordedTopic(
        required.name, required.key or 'pose_source', required.message_type,
        lambda raw: sources[raw.topic].read(raw.data))
    reader = Reader(path, (clouds.name, *sources), progress)
    for raw in _tf_last(reader.messages()):
        # if two settings name one topic, that is the profiles'; its type refuses the poses
        (clouds if raw.topic == clouds.name else pose_topic).add(raw)
    profiles, previous_stamp = list[RawProfile](), None
    for message in _keep_majority_frame('profile', clouds.ordered(reader), 'frame_id', reader):
        profiles += profiles_of(message, previous_stamp)
        previous_stamp = message.stamp
    if not profiles:
        raise InputError(f'{path}: the only message on {clouds.name}, or each of one stamp, holds '
                         'several profiles, and does not say when each was taken: set '
                         'profile.period')
    poses = pose_topic.ordered(reader)
    reader.warnings += follower.warnings
    if not poses:
        reason = follower.missing_reason() or (
            'they share no time, or are further apart than sampling.max_pose_gap')
        raise InputError(f'{path}: no flange poses in its transforms: {reason}; set '
                         'robot_base_frame and robot_effector_frame')
    poses = _keep_majority_frame('pose', poses, 'parent_frame', reader)
    joints = np.array([pose.joints for pose in poses if isinstance(pose, ArmPose)])
    if offset := config.offset_ns:
        profiles = [replace(p, stamp=p.stamp + offset) for p in profiles]
    gap = max(profiles[0].stamp - poses[-1].stamp, poses[0].stamp - profiles[-1].stamp)
    if gap > 0:
        raise DataError(f'profiles and poses share no time: {gap * 1e-9:.1f} s are between them; '
                        'the clocks differ (synchronise them, or, if the difference is known and '
                        f'at most {MAX_TIME_OFFSET:g} s, set time_offset), a topic ended early, '
                        'or they were not recorded together')
    return Recording(tuple(profiles), poses, joints if len(joints) else None, reader.warnings,
                     reader.files)


def _tf_last(messages: Iterable[RecordedMessage]) -> Iterator[RecordedMessage]:
    """
    Yield messages, those of /tf after all others.

    Each moving transform then finds the static ones, which are recorded late where a node starts
    late. Until then those of /tf are in memory.
    """
    moving = []
    for raw in messages:
        if raw.topic == '/tf':
            moving.append(raw)
        else:
            yield raw
    yield from moving


class _RecordedTopic:
    """A topic of a recording, and the profiles or poses in its messages, in recording order."""

    def __init__(self, name: str, key: str, message_type: str,
                 items_of: Callable[[RecordedMessage], Sequence[Any]]) -> None:
        """
        Start without messages.

        key: of the configuration, that names the topic; message_type: that it must have; items_of:
        returns what a message holds, or raises UnusableMessageError.
        """
        self.name = full_name(name)
        self._key, self._message_type, self._items_of = key, message_type, items_of
        self._items: list[Any] = []
        self._usable = self._unstamped = 0
        self._refusals: list[UnusableMessageError] = []  # of messages that cannot be used

    def add(self, raw: RecordedMessage) -> None:
        """Add what a message holds; its time of recording is the stamp of what has none."""
        try:
            items = self._items_of(raw)
        except UnusableMessageError as error:
            self._refusals.append(error)
            return
        time = min(raw.log_time, LAST_STAMP)
        self._items += [item if item.stamp else replace(item, stamp=time) for item in items]
        self._usable += 1
        self._unstamped += not all(item.stamp for item in items)

    def _missing_topic_error(self, reader: Reader) -> InputError:
        """Return the refusal of a bag without a topic of this name and type."""
        key, types = self._key, reader.types
        listed = [f'{name} ({other_type})' for name, other_type in sorted(types.items())]
        same_type = [name for name in sorted(types) if types[name] == self._message_type]
        advice = ('record /tf too, or take the poses from a topic, as in --set pose_source=topic'
                  if key == 'pose_source' else
                  f'set {key}, as in --set {key}={same_type[0]}' if same_type else
                  'take the poses from /tf, as in --set pose_source=tf'
                  if key == 'pose_topic' and types.get('/tf') == TF_TYPE else
                  f'publish and record one, or set {key}')
        return InputError(f'{reader.path} has no topic {self.name} with {self._message_type}, '
                          f'but {", ".join(listed[:MAX_LISTED])}: {advice}')

    def ordered(self, reader: Reader) -> list[Any]:
        """
        Return the usable items in the order of their stamps.

        Dropped and repaired messages are added to the warnings. Raises InputError for a missing
        topic, and if most of its messages are invalid, and DataError for stamps of two runs.
        """
        if reader.types.get(self.name) != self._message_type:
            raise self._missing_topic_error(reader)
        # messages of other devices are no fault, where there are those of the arm
        malformed = [str(error) for error in self._refusals
                     if not (self._usable and isinstance(error, OtherJointsError))]
        total = self._usable + len(malformed)
        if not total:
            raise InputError(f'{reader.path}: no messages on {self.name} ({self._message_type}): '
                             f'check that it was published while recording, or set {self._key}')
        reader.warnings += _dropped_warning(malformed, total, f'messages on {self.name}')
        if self._unstamped:
            reader.warnings.append(f'{self._unstamped} messages on {self.name} have no stamps; '
                                   'the times at which they were recorded are used')
        stamps = np.array([item.stamp for item in self._items], np.int64)
        in_order = in_majority_order(stamps, f'on {self.name}')
        wrong = np.flatnonzero(~in_order)
        if len(wrong):
            reader.warnings.append(
                f'{len(wrong)} of {len(stamps)} messages on {self.name} were dropped: their '
                f'stamps are far from those around them (first message {wrong[0] + 1}, of '
                f'{stamps[wrong[0]] * 1e-9:.3f} s)')
        return sorted(compress(self._items, in_order), key=by_stamp)


def _keep_majority_frame(kind: str, items: list[Any], frame: str, reader: Reader) -> list[Any]:
    """
    Return the items of the frame of most; a few others are dropped, with a warning.

    kind: what they are, in words; frame: their attribute that names it. Raises InputError for two
    frames.
    """
    (name, count), *others = Counter(getattr(item, frame) for item in items).most_common()
    strays = len(items) - count
    if strays > max(FEW_STRAYS, FEW_SHARE * len(items)) or 2 * strays >= len(items):
        raise two_frames_error(kind, name, others[0][0])
    if strays:
        reader.warnings.append(f'{strays} of {len(items)} {kind}s were dropped: their frame is '
                               f'"{others[0][0]}", not "{name}"')
    return [item for item in items if getattr(item, frame) == name]
