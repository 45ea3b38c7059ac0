"""Profiles and poses out of a rosbag2 recording; writing one is in bag_write.py."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import RawProfile, TimedPose
from handeye_ros.errors import BagError
from handeye_ros.results.calibration_file import input_values
from handeye_ros.ros.bags.contents import CLOUD, Contents, full_name, POSE, Raw, TF
from handeye_ros.ros.bags.messages import pose_from_cdr, stamp_of
from handeye_ros.ros.bags.profile_reader import ProfileReader
from handeye_ros.ros.bags.storage import scan
from handeye_ros.ros.bags.transforms import FlangeTracker, well_formed
from handeye_ros.ros.errors import AllMalformedError, MessageError, NoTopicError, TopicTypeError
from handeye_ros.sampling.errors import ClocksApartError, TimeBackwardsError, TwoFramesError
from handeye_ros.sampling.stream import in_order, LARGEST_STEP
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)

T = TypeVar('T')
Stamped = TypeVar('Stamped', RawProfile, TimedPose)


@dataclass(frozen=True, eq=False)
class Recording:
    """
    What a bag holds for a calibration.

    profiles, poses: in the order of their stamps. warnings: a sentence for each thing that was
    lost or repaired. inputs: path and sha256 of every file read.
    """

    profiles: tuple[RawProfile, ...]
    poses: tuple[TimedPose, ...]
    warnings: tuple[str, ...] = ()
    inputs: tuple[dict[str, str], ...] = ()


def read(path: Path, config: Config) -> Recording:
    """
    Return the profiles and flange poses in a rosbag2 folder or an .mcap or .db3 file.

    A damaged file gives what can be read up to the damage, with a warning. Raises InputError
    when the bag or what is on its topics cannot be read, and DataError when its stamps mix
    two runs, or profiles and poses share no time.

    """
    contents = scan(path, (config.profile_topic, *pose_topics(config)))
    reader = _Reader(path, contents)
    profiles = reader.topic('profile_topic', config.profile_topic, CLOUD,
                            ProfileReader(config.profile).take)
    poses = _poses(reader, config)
    if config.time_offset:
        offset = round(config.time_offset * 1e9)
        profiles = [replace(p, stamp=p.stamp + offset) for p in profiles]
    _check_frames('profile', (p.frame_id for p in profiles))
    _check_clocks(profiles, poses)
    return Recording(tuple(profiles), tuple(poses), tuple(contents.warnings),
                     tuple(input_values(file) for file in contents.files))


def pose_topics(config: Config) -> tuple[str, ...]:
    """Return the topics that the flange poses come from."""
    return ('/tf', '/tf_static') if config.pose_source == 'tf' else (config.pose_topic,)


def poses_of(path: Path, contents: Contents, config: Config) -> list[TimedPose]:
    """Return the flange poses in the contents of a bag, in the order of their stamps; see read."""
    return _poses(_Reader(path, contents), config)


def _poses(reader: _Reader, config: Config) -> list[TimedPose]:
    poses = (reader.transforms(config) if config.pose_source == 'tf' else
             reader.topic('pose_topic', config.pose_topic, POSE, pose_from_cdr))
    _check_frames('pose', (p.parent_frame for p in poses))
    return poses


class _Reader:
    """Turns the raw messages of a bag into what they stand for."""

    def __init__(self, path: Path, contents: Contents) -> None:
        self._path = path
        self._contents = contents

    def topic(self, key: str, topic: str, kind: str,
              convert: Callable[[bytes], Stamped]) -> list[Stamped]:
        """Return what the messages of a topic, which the configuration key names, stand for."""
        topic = full_name(topic)
        decoded = self._decoded(key, topic, kind, convert)
        stamped = self._stamped(topic, self._as_received(topic, decoded))
        fitting = self._in_order(topic, [(item.stamp, item) for item in stamped])
        return sorted(fitting, key=lambda item: item.stamp)

    def _as_received(self, topic: str, decoded: Sequence[tuple[Stamped, Raw]]
                     ) -> Sequence[tuple[Stamped, Raw]]:
        """
        Return messages in the order in which they were received, if that is not how they lie.

        The order in the file is believed first: two runs of a simulated clock, one behind the
        other, have the same times of receipt, and must not be taken for one.
        """
        stamps = [item.stamp for item, _ in decoded]
        by_receipt = sorted(decoded, key=lambda pair: pair[1].log_time)
        if (in_order(stamps) or not in_order([item.stamp for item, _ in by_receipt])
                or len(set(stamps)) < len(stamps)):
            return decoded
        self._contents.warnings.append(f'the messages on {topic} do not lie in the order in which '
                                       'they were received, and were sorted')
        return by_receipt

    def transforms(self, config: Config) -> list[TimedPose]:
        """Return the poses that the transform tree of the bag holds."""
        tracker = FlangeTracker(config.robot_base_frame, config.robot_effector_frame)
        if '/tf_static' in self._contents.topics:
            # all at once: those of a late node must not come after the motion they belong to
            for messages, _ in self._decoded('pose_source', '/tf_static', TF, _transforms,
                                             may_be_empty=True):
                tracker.add(messages, static=True)
        moving = [transforms for transforms, _ in
                  self._decoded('pose_source', '/tf', TF, _transforms)]
        fitting = {id(t) for child in dict.fromkeys(t.child_frame_id for ts in moving for t in ts)
                   for t in self._in_order(f'/tf (frame {child})', [
                       (stamp_of(t.header), t) for ts in moving for t in ts
                       if t.child_frame_id == child])}
        poses = [pose for ts in moving
                 for pose in tracker.add([t for t in ts if id(t) in fitting], static=False)]
        if not poses:
            raise BagError(self._path, 'no flange poses in its transforms: '
                           + (tracker.missing() or 'they share no time')
                           + '; set robot_base_frame and robot_effector_frame')
        return poses

    def _decoded(self, key: str, topic: str, kind: str, convert: Callable[[bytes], T],
                 may_be_empty: bool = False) -> list[tuple[T, Raw]]:
        """Return the usable messages of a topic, with where they come from."""
        self._check_topic(key, topic, kind)
        raws = [raw for raw in self._contents.messages if raw.topic == topic]
        if not raws and not may_be_empty:
            raise BagError(self._path, f'no messages on {topic} ({kind}): check that it was '
                           f'published while recording, or set {key}')
        decoded, reasons = [], []
        for raw in raws:
            try:
                decoded.append((convert(raw.data), raw))
            except MessageError as error:
                reasons.append(str(error))
        if len(reasons) > len(decoded):
            raise AllMalformedError(topic, len(reasons), len(raws), reasons[0])
        if reasons:
            self._contents.warnings.append(f'{len(reasons)} of {len(raws)} messages on {topic} '
                                           f'were left out; the first: {reasons[0]}')
        return decoded

    def _check_topic(self, key: str, topic: str, wanted: str) -> None:
        topics = self._contents.topics
        if topic not in topics:
            raise NoTopicError(self._path, key, topic, wanted, topics)
        if topics[topic] != wanted:
            raise TopicTypeError(key, topic, wanted, topics)

    def _stamped(self, topic: str, decoded: Sequence[tuple[Stamped, Raw]]) -> list[Stamped]:
        """Return items with stamps; a driver that leaves all empty gets the times of receipt."""
        stamped = [item for item, _ in decoded if item.stamp != 0]
        if len(stamped) == len(decoded):
            return stamped
        if stamped:
            self._contents.warnings.append(f'{len(decoded) - len(stamped)} messages on {topic} '
                                           'without a stamp were left out')
            return stamped
        self._contents.warnings.append(f'the messages on {topic} have no stamps; the times at '
                                       'which they were recorded are used')
        return [replace(item, stamp=raw.log_time) for item, raw in decoded]

    def _in_order(self, topic: str, stamped: Sequence[tuple[int, T]]) -> list[T]:
        """Return what fits the order of the stamps; raises TimeBackwardsError."""
        stamps = [stamp for stamp, _ in stamped]
        fits = in_order(stamps)
        if fits is None:
            raise TimeBackwardsError(topic, *_first_jump_back(stamps))
        wrong = [index for index, right in enumerate(fits) if not right]
        if wrong:
            self._contents.warnings.append(
                f'{len(wrong)} of {len(stamps)} messages on {topic} were left out: their stamps '
                f'are far from those around them (first message {wrong[0] + 1}, of '
                f'{stamps[wrong[0]] * 1e-9:.3f} s)')
        return [item for (_, item), right in zip(stamped, fits, strict=True) if right]


def _first_jump_back(stamps: Sequence[int]) -> tuple[int, float]:
    """Return the index behind the first jump back, and by how many seconds it goes."""
    for index, latest in enumerate(accumulate(stamps, max)):
        if latest - stamps[index] > LARGEST_STEP:
            return index, (latest - stamps[index]) * 1e-9
    raise ValueError('the stamps never jump back')


def _transforms(data: bytes) -> Any:
    """Return the transforms of a serialised message that can be understood; MessageError."""
    try:
        message: Any = TYPES.deserialize_cdr(data, TF)
    except (SerdeError, IndexError) as error:
        raise MessageError('TFMessage', f'damaged message: {error}') from error
    return [transform for transform, _ in well_formed(message.transforms)]


def _check_frames(kind: str, frames: Iterable[str]) -> None:
    names = list(dict.fromkeys(frames))
    if len(names) > 1:
        raise TwoFramesError(kind, names[0], names[1])


def _check_clocks(profiles: Sequence[RawProfile], poses: Sequence[TimedPose]) -> None:
    gap = max(profiles[0].stamp - poses[-1].stamp, poses[0].stamp - profiles[-1].stamp)
    if gap > 0:
        raise ClocksApartError(gap * 1e-9)
