# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads profiles and poses from a rosbag2 recording; bag_write.py writes them.

The recording may be larger than the memory: of a profile its stamp is kept, and its place in the
file, from which it is read again when a stop uses it.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
import math
from pathlib import Path

from handeye_ros import se3
from handeye_ros.arm import Arm, read_arm
from handeye_ros.bags.messages import (
    joints_from_cdr,
    pose_from_cdr,
    ProfileReader,
    returns_of,
    split,
    transforms_from_cdr,
)
from handeye_ros.bags.reader import CLOUD, full_name, JOINTS, POSE, Raw, Reader, TF
from handeye_ros.bags.transforms import FlangeTracker
from handeye_ros.config import Config
from handeye_ros.data import Array, Profile, RawProfile, TimedPose
from handeye_ros.errors import BagError, DataError, InputError, UnusableMessageError
from handeye_ros.results.calibration_file import input_values
from handeye_ros.sampling.stream import FEW, FEW_SHARE, in_order, LARGEST_STEP, two_frames
import numpy as np

MOST_MALFORMED = 0.5  # largest fraction of malformed messages in a scan
LAST = 2 ** 63 - 1  # ns; largest stamp


@dataclass(frozen=True, eq=False)
class Recording:
    """
    The contents of a bag for a calibration.

    profiles, poses: in the order of their stamps. joints: the joint values (n, joints) of the
    poses, where these are of an arm. warnings: sentences on lost or repaired data. files: those
    that were read.
    """

    profiles: tuple[RawProfile, ...]
    poses: Sequence[TimedPose]
    joints: Array | None = None
    warnings: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @cached_property
    def inputs(self) -> tuple[dict[str, str], ...]:
        """Return path and sha256 of all files read, for the provenance of results."""
        return tuple(input_values(file) for file in self.files)


def read(path: Path, config: Config, progress: Callable[[float], None] = lambda share: None,
         arm: Arm | None = None) -> Recording:
    """
    Return the profiles and flange poses in a rosbag2 folder or an .mcap or .db3 file.

    A damaged file is read up to the damage, with a warning. progress: receives the fraction of the
    bytes that were read. arm: gives the poses from the joint values, as with the key kinematics.
    Raises InputError when the bag or its topics cannot be read, and DataError when its stamps mix
    two runs, or profiles and poses do not overlap in time.
    """
    received: list[RawProfile] = []
    converter = ProfileReader(config.profile)

    def take(raw: Raw) -> int:
        received.append(converter.take(raw.data, raw.fetch))
        return received[-1].stamp

    clouds = _Topic('profile_topic', config.profile_topic, CLOUD, take)
    source = _PoseSource(config, arm)
    reader = _read_topics(path, (clouds, *source.topics), progress)
    clouds.require(reader)
    profiles: list[RawProfile] = []
    previous = None
    for index, stamp in zip(*clouds.ordered(reader.warnings), strict=True):
        item = received[index]
        profiles += split(item if item.stamp == stamp else replace(item, stamp=stamp), previous,
                          config.profile)
        previous = stamp
    poses, joints = source.poses(reader)
    if config.time_offset:
        offset = round(config.time_offset * 1e9)
        profiles = [replace(p, stamp=p.stamp + offset) for p in profiles]
    profiles = _most_frequent_frame(profiles, reader.warnings)
    gap = max(profiles[0].stamp - poses[-1].stamp, poses[0].stamp - profiles[-1].stamp)
    if gap > 0:
        raise DataError(f'profiles and poses share no time: {gap * 1e-9:.1f} s are between them; '
                        'the clocks of sensor and robot differ, or they were not recorded '
                        'together')
    return Recording(tuple(profiles), poses, joints, tuple(reader.warnings), tuple(reader.files))


def read_poses(path: Path, config: Config, arm: Arm | None = None) -> Recording:
    """Return only the flange poses of a bag; see read."""
    source = _PoseSource(config, arm)
    reader = _read_topics(path, source.topics)
    poses, joints = source.poses(reader)
    return Recording((), poses, joints, tuple(reader.warnings), tuple(reader.files))


def _most_frequent_frame(profiles: list[RawProfile], warnings: list[str]) -> list[RawProfile]:
    """Return the profiles of the most frequent frame; InputError unless others are strays."""
    frames = Counter(profile.frame_id for profile in profiles)
    (frame, count), *other_frames = frames.most_common(2)
    strays = len(profiles) - count
    if not other_frames:
        return profiles
    if strays > max(FEW, FEW_SHARE * len(profiles)) or strays >= count:
        raise two_frames('profile', *list(frames)[:2])
    warnings.append(f'left out {strays} profiles of other frames than "{frame}"')
    return [profile for profile in profiles if profile.frame_id == frame]


def _read_topics(path: Path, topics: Sequence[_Topic],
                 progress: Callable[[float], None] = lambda share: None) -> Reader:
    """Pass every message to its topic; return the reader of the bag."""
    # if two settings name one topic, the first gets its messages; its type refuses the second
    by_name = {topic.name: topic for topic in reversed(topics)}
    reader = Reader(path, by_name, progress)
    for raw in reader.messages():
        by_name[raw.topic].add(raw)
    return reader


class _Topic:
    """Receives the messages of a topic in recording order; tells which are valid, in order."""

    def __init__(self, key: str, name: str, kind: str, take: Callable[[Raw], int]) -> None:
        """
        Start with none.

        key: of the configuration, that names the topic; kind: the type it must have; take: keeps
        a message and returns its stamp, or raises UnusableMessageError.
        """
        self.name = full_name(name)
        self._key, self._kind, self._take = key, kind, take
        self._stamps: list[int] = []
        self._log_times: list[int] = []
        self._malformed = 0
        self._first_reason = ''

    def add(self, raw: Raw) -> None:
        """Add the next message; malformed ones are counted."""
        try:
            self._stamps.append(self._take(raw))
        except UnusableMessageError as error:
            self._malformed += 1
            self._first_reason = self._first_reason or str(error)
        else:
            self._log_times.append(min(raw.log_time, LAST))

    def require(self, reader: Reader, may_be_empty: bool = False) -> None:
        """Raise InputError for a missing topic, and if most of its messages are invalid."""
        require_topic(reader, self._key, self.name, self._kind)
        good, bad = len(self._stamps), self._malformed
        if not good + bad and not may_be_empty:
            raise BagError(reader.path, f'no messages on {self.name} ({self._kind}): check that '
                           f'it was published while recording, or set {self._key}')
        if bad > good:
            raise _all_malformed(self.name, bad, good + bad, self._first_reason)
        if bad:
            reader.warnings.append(f'{bad} of {good + bad} messages on {self.name} were left '
                                   f'out; the first: {self._first_reason}')

    def ordered(self, warnings: list[str]) -> tuple[list[int], list[int]]:
        """
        Return the indices of the usable messages in the order of their stamps, and these stamps.

        Left out and repaired messages are added to the warnings. Raises DataError for stamps of
        two runs.
        """
        order, stamps = self._as_received(warnings), self._stamps
        stamped = [index for index in order if stamps[index] != 0]
        if order and not stamped:
            warnings.append(f'the messages on {self.name} have no stamps; the times at which they '
                            'were recorded are used')
            stamped, stamps = order, self._log_times
        elif len(stamped) < len(order):
            warnings.append(f'{len(order) - len(stamped)} messages on {self.name} without a stamp '
                            'were left out')
        fits = _fitting(self.name, [stamps[index] for index in stamped], warnings)
        order = sorted((stamped[place] for place in fits), key=stamps.__getitem__)
        return order, [stamps[index] for index in order]

    def _as_received(self, warnings: list[str]) -> list[int]:
        """
        Return messages in the order received, if they are stored in another order.

        The order in the file has priority: two consecutive runs of a simulated clock have the same
        times of receipt, and must not be merged into one.
        """
        stamps = self._stamps
        stored_order = list(range(len(stamps)))
        received_order = sorted(stored_order, key=self._log_times.__getitem__)
        if (received_order == stored_order or in_order(stamps)
                or not in_order([stamps[i] for i in received_order])
                or len(set(stamps)) < len(stamps)):
            return stored_order
        warnings.append(f'the messages on {self.name} do not lie in the order in which they were '
                        'received, and were sorted')
        return received_order


def _fitting(topic: str, stamps: Sequence[int], warnings: list[str]) -> list[int]:
    """Return the indices of stamps that fit the order of the others; DataError for two runs."""
    fits = in_order(stamps)
    if fits is None:
        for index, latest in enumerate(accumulate(stamps, max)):
            if latest - stamps[index] > LARGEST_STEP:
                raise DataError(
                    f'the stamps on {topic} jump back by {(latest - stamps[index]) * 1e-9:.1f} s '
                    f'at message {index + 1}: two runs seem to be mixed (a bag recorded in a '
                    'loop?); record one run', reason='two runs')
        raise ValueError('the stamps never jump back')
    wrong = [index for index, fitting in enumerate(fits) if not fitting]
    if wrong:
        warnings.append(
            f'{len(wrong)} of {len(stamps)} messages on {topic} were left out: their stamps are '
            f'far from those around them (first message {wrong[0] + 1}, of '
            f'{stamps[wrong[0]] * 1e-9:.3f} s)')
    return [index for index, fitting in enumerate(fits) if fitting]


def _all_malformed(topic: str, count: int, total: int, reason: str) -> InputError:
    usable = 'none' if count == total else f'only {total - count}'
    return InputError(f'{usable} of the {total} messages on {topic} can be used; the first '
                      f'reason: {reason}')


def require_topic(reader: Reader, key: str, name: str, kind: str) -> None:
    """Raise InputError for a bag without a topic of this name and type; key: that names it."""
    types = reader.types
    if types.get(name) == kind:
        return
    ordered = sorted(types.items(), key=lambda item: (item[1] != kind, item[0]))
    names = [f'{other} ({type_of_it})' for other, type_of_it in ordered[:12]]
    names += [f'{len(ordered) - 12} more'] if len(ordered) > 12 else []
    fitting = [other for other, type_of_it in ordered if type_of_it == kind]
    if key == 'pose_source':  # there is only one place for transforms
        advice = '; record /tf, or set pose_source to topic'
    elif fitting:
        advice = f': set {key}, as in --set {key}={fitting[0]}'
    elif key == 'pose_topic' and types.get('/tf') == TF:
        advice = ': take the poses from /tf, as in --set pose_source=tf'
    else:
        advice = f'; none of them is a {kind}: publish and record one'
    start = (f'{name} carries {types[name]}, but only {kind} can be read there' if name in types
             else f'{reader.path} has no topic {name}')
    raise InputError(f'{start}. It holds {", ".join(names)}{advice}')


class _PoseSource:
    """The topics with the flange poses: reported, of an arm at its joint values, or of /tf."""

    def __init__(self, config: Config, arm: Arm | None) -> None:
        """config: names the source; arm: see read."""
        self._config = config
        self._arm = read_arm(Path(config.kinematics)) if config.kinematics and not arm else arm
        self._poses: list[TimedPose] = []
        self._joints: list[list[float]] = []
        self._moving: list[list[tuple[str, TimedPose]]] = []
        self._static: list[list[tuple[str, TimedPose]]] = []
        if self._arm:
            self.topics = [_Topic('joint_topic', config.joint_topic, JOINTS, self._take_joints)]
        elif config.pose_source == 'tf':
            self.topics = [_Topic('pose_source', '/tf', TF, self._take_moving),
                           _Topic('pose_source', '/tf_static', TF, self._take_static)]
        else:
            self.topics = [_Topic('pose_topic', config.pose_topic, POSE, self._take_pose)]

    def _take_pose(self, raw: Raw) -> int:
        self._poses.append(pose_from_cdr(raw.data))
        return self._poses[-1].stamp

    def _take_joints(self, raw: Raw) -> int:
        assert self._arm
        stamp, values = _joint_values(self._arm, raw.data)
        self._joints.append(values)
        return stamp

    def _take_moving(self, raw: Raw) -> int:
        self._moving.append(transforms_from_cdr(raw.data))
        return raw.log_time

    def _take_static(self, raw: Raw) -> int:
        self._static.append(transforms_from_cdr(raw.data))
        return raw.log_time

    def poses(self, reader: Reader) -> tuple[Sequence[TimedPose], Array | None]:
        """Return the poses, in one frame, and the joint values (n, joints) of an arm."""
        if not self._arm and self._config.pose_source == 'tf':
            return self._of_tree(reader), None
        topic, = self.topics
        topic.require(reader)
        order, stamps = topic.ordered(reader.warnings)
        if self._arm:
            joints, T = _forward(self._arm, np.array(self._joints)[order])
            base = self._arm.base
            return [TimedPose(*one, base) for one in zip(
                stamps, T[:, :3, 3], se3.quaternion(T), strict=True)], joints
        frames = dict.fromkeys(pose.parent_frame for pose in self._poses)
        if len(frames) > 1:
            raise two_frames('pose', *list(frames)[:2])
        return [pose if pose.stamp == stamp else replace(pose, stamp=stamp) for pose, stamp in zip(
            map(self._poses.__getitem__, order), stamps, strict=True)], None

    def _of_tree(self, reader: Reader) -> list[TimedPose]:
        tracker = FlangeTracker(self._config.base_frame, self._config.robot_effector_frame)
        moving, static = self.topics
        if static.name in reader.types:
            # first: a node that starts late publishes them after the motion
            static.require(reader, may_be_empty=True)
            for transforms in self._static:
                tracker.add(transforms, static=True)
        moving.require(reader)
        of_frame: dict[str, list[TimedPose]] = {}
        for child, pose in (item for transforms in self._moving for item in transforms):
            of_frame.setdefault(child, []).append(pose)
        fitting = {id(poses[index]) for child, poses in of_frame.items()
                   for index in _fitting(f'/tf (frame {child})', [p.stamp for p in poses],
                                         reader.warnings)}
        found = [pose for transforms in self._moving for pose in tracker.add(
            [(child, pose) for child, pose in transforms if id(pose) in fitting], static=False)]
        if not found:
            raise BagError(reader.path, 'no flange poses in its transforms: '
                           + (tracker.missing() or 'they share no time')
                           + '; set robot_base_frame and robot_effector_frame')
        return found


def pose_from_joints(arm: Arm, data: bytes) -> TimedPose:
    """Return the flange pose of an arm at a serialised JointState; UnusableMessageError."""
    return joints_and_pose(arm, data)[1]


def joints_and_pose(arm: Arm, data: bytes) -> tuple[Array, TimedPose]:
    """Return the joint values (joints,) of a JointState, and the flange pose of an arm."""
    stamp, values = _joint_values(arm, data)
    joints, T = _forward(arm, np.array([values]))
    return joints[0], TimedPose(stamp, T[0, :3, 3], se3.quaternion(T[0]), arm.base)


def _forward(arm: Arm, values: Array) -> tuple[Array, Array]:
    """Return all joints (n, joints) and T_base_flange (n, 4, 4) by the measured joints (n, m)."""
    joints = arm.positions(dict(zip(arm.measured, values.T, strict=True)), JOINTS)
    return joints, arm.forward(joints)


def _joint_values(arm: Arm, data: bytes) -> tuple[int, list[float]]:
    """Return the stamp and the values of the measured joints; raises UnusableMessageError."""
    stamp, positions = joints_from_cdr(data)
    try:
        arm.positions(positions, 'the message')
    except InputError as cause:
        raise UnusableMessageError(f'JointState message not used: {cause}') from cause
    values = [positions[name] for name in arm.measured]
    if not all(map(math.isfinite, values)):
        raise UnusableMessageError('JointState message not used: it holds positions that are not '
                                   'finite')
    return stamp, values


@dataclass
class Flow:
    """
    The poses of a bag, and its profiles, which are read on demand.

    warnings: on left out messages, complete after the last profile. Raises InputError for missing
    topics.
    """

    path: Path
    config: Config
    poses: Sequence[TimedPose] = ()
    warnings: list[str] = field(default_factory=list)

    def profiles(self) -> Iterator[Profile]:
        """Yield the profiles in the order of recording: only returns, with intensity."""
        topic = full_name(self.config.profile_topic)
        reasons: Counter[str] = Counter()
        reader, count = Reader(self.path, [topic]), 0
        for raw in reader.messages():
            count += 1
            try:
                yield from returns_of(raw.data, self.config.profile)
            except UnusableMessageError as error:
                reasons[str(error)] += 1
        self.warnings += [w for w in reader.warnings if w not in self.warnings]
        malformed = reasons.total()
        if malformed and malformed > MOST_MALFORMED * count:
            raise _all_malformed(topic, malformed, count, reasons.most_common(1)[0][0])
        if malformed:
            self.warnings.append(f'{malformed} of {count} messages on {topic} were left out; the '
                                 f'most frequent reason: {reasons.most_common(1)[0][0]}')


def flow(path: Path, config: Config) -> Flow:
    """Return the stream of a bag with its poses; raises as read does."""
    source = _PoseSource(config, None)
    reader = _read_topics(path, source.topics)
    poses, _ = source.poses(reader)
    require_topic(reader, 'profile_topic', full_name(config.profile_topic), CLOUD)
    return Flow(path, config, poses, reader.warnings)
