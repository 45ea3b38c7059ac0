"""
Reads profiles and poses from a rosbag2 recording; bag_write.py writes them.

The recording may be larger than the memory: it is read once, and the profiles of a station are
read again from their positions in the file.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from handeye_ros import pipeline, tabulated
from handeye_ros.bags.contents import CLOUD, Contents, full_name, JOINTS, POSE
from handeye_ros.bags.poses import JointPoses, Poses, PoseTable
from handeye_ros.bags.profile_reader import returns_of
from handeye_ros.bags.storage import block_groups, messages, Progress
from handeye_ros.bags.topic import Profiles, require_topic, Topic
from handeye_ros.bags.transforms import Tree
from handeye_ros.config import Config
from handeye_ros.data import Calibration, Profile, RawProfile, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.node.errors import AllMalformedError, MessageError
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.evidence import config_of, Evidence, recording_of
from handeye_ros.robot.model import Arm, Chain
from handeye_ros.robot.samples import JointRecording
from handeye_ros.robot.urdf import read_arm
from handeye_ros.sampling.stream import FEW, FEW_SHARE
from handeye_ros.sampling.stream_errors import ClocksApartError, TwoFramesError

MOST_MALFORMED = 0.5  # largest fraction of malformed messages in a scan


@dataclass(frozen=True, eq=False)
class Recording:
    """
    The contents of a bag for a calibration.

    profiles, poses: in the order of their stamps. warnings: sentences on lost or repaired data.
    files: those that were read.
    """

    profiles: tuple[RawProfile, ...]
    poses: Sequence[TimedPose]
    warnings: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @cached_property
    def inputs(self) -> tuple[dict[str, str], ...]:
        """Return path and sha256 of all files read, for the provenance of results."""
        return tuple(input_values(file) for file in self.files)


def read(path: Path, config: Config, progress: Progress = lambda share: None,
         arm: Arm | None = None) -> Recording:
    """
    Return the profiles and flange poses in a rosbag2 folder or an .mcap or .db3 file.

    A damaged file is read up to the damage, with a warning. progress: receives the fraction of the
    bytes that were read. arm: gives the poses from the joint values, as with the key kinematics.
    Raises InputError when the bag or its topics cannot be read, and DataError when its stamps mix
    two runs, or profiles and poses do not overlap in time.

    """
    contents, source = Contents(), PoseSource(config, arm)
    clouds = Topic('profile_topic', config.profile_topic, CLOUD,
                   Profiles(config.profile))
    _read_topics(path, contents, (clouds, *source.topics), progress)
    profiles = tuple(clouds.items(path, contents))
    poses = source.poses(path, contents)
    if config.time_offset:
        offset = round(config.time_offset * 1e9)
        profiles = tuple(replace(p, stamp=p.stamp + offset) for p in profiles)
    profiles = _most_frequent_frame(profiles, contents)
    gap = max(profiles[0].stamp - poses[-1].stamp, poses[0].stamp - profiles[-1].stamp)
    if gap > 0:
        raise ClocksApartError(gap * 1e-9)
    return Recording(profiles, poses, tuple(contents.warnings), tuple(contents.files))


def _most_frequent_frame(profiles: tuple[RawProfile, ...], contents: Contents
                         ) -> tuple[RawProfile, ...]:
    """Return the profiles of the most frequent frame; TwoFramesError unless others are strays."""
    frames = Counter(profile.frame_id for profile in profiles)
    (frame, count), *other_frames = frames.most_common(2)
    strays = len(profiles) - count
    if not other_frames:
        return profiles
    if strays > max(FEW, FEW_SHARE * len(profiles)) or strays >= count:
        raise TwoFramesError('profile', *list(frames)[:2])
    contents.warnings.append(f'left out {strays} profiles of other frames than "{frame}"')
    return tuple(profile for profile in profiles if profile.frame_id == frame)


def read_poses(path: Path, config: Config, arm: Arm | None = None
               ) -> tuple[Sequence[TimedPose], Contents]:
    """Return only the flange poses of a bag, and its other contents; see read."""
    contents, source = Contents(), PoseSource(config, arm)
    _read_topics(path, contents, source.topics, lambda share: None)
    return source.poses(path, contents), contents


class PoseSource:
    """The topics with the flange poses."""

    def __init__(self, config: Config, arm: Arm | None = None) -> None:
        """Start with none; config: names their source; arm: see read."""
        self._config = config
        self._tree = Tree()
        arm = read_arm(Path(config.kinematics)) if config.kinematics and arm is None else arm
        self._store: JointPoses | Poses = JointPoses(arm) if arm else Poses()
        self._topic = (Topic('joint_topic', config.joint_topic, JOINTS, self._store) if arm else
                       Topic('pose_topic', config.pose_topic, POSE, self._store))
        self._by_tree = config.pose_source == 'tf' and not arm
        self.topics: tuple[Topic[Any], ...] = (
            self._tree.topics if self._by_tree else (self._topic,))

    def poses(self, path: Path, contents: Contents) -> Sequence[TimedPose]:
        """Return the poses, in one frame."""
        if self._by_tree:
            return self._tree.poses(path, contents, self._config)
        poses = self._topic.items(path, contents)
        if len(self._store.frames) > 1:
            raise TwoFramesError('pose', *self._store.frames[:2])
        return poses


def _read_topics(path: Path, contents: Contents, topics: Sequence[Topic[Any]],
                 progress: Progress) -> None:
    """Pass every block of messages to its topic."""
    # if two settings name one topic, the first gets its messages; its type refuses the second
    take_by_topic = {topic.name: topic.take for topic in reversed(topics)}
    for blocks in block_groups(path, contents, take_by_topic, progress):
        for block in blocks:
            take_by_topic[block.topic](block)


def read_with_joints(path: Path, config: Config, chain: Chain, progress: Progress
                     ) -> JointRecording:
    """Return a bag with the poses of an arm at its joint values; raises as read does."""
    recording = read(path, config, progress, Arm(chain))
    poses = recording.poses
    assert isinstance(poses, PoseTable) and poses.joints is not None
    try:
        reported, _ = read_poses(path, replace(config, kinematics=''))
    except HandeyeError:
        reported = ()
    return JointRecording(recording.profiles, poses, poses.joints, reported, recording.warnings,
                          recording.inputs)


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
        count, contents = 0, Contents()
        for raw in messages(self.path, contents, (topic,)):
            count += 1
            try:
                yield from returns_of(raw.data, self.config.profile)
            except MessageError as error:
                reasons[str(error)] += 1
        self.warnings += [w for w in contents.warnings if w not in self.warnings]
        malformed = reasons.total()
        if malformed and malformed > MOST_MALFORMED * count:
            raise AllMalformedError(topic, malformed, count, reasons.most_common(1)[0][0])
        if malformed:
            self.warnings.append(f'{malformed} of {count} messages on {topic} were left out; the '
                                 f'most frequent reason: {reasons.most_common(1)[0][0]}')


def flow(path: Path, config: Config) -> Flow:
    """
    Return the stream of a bag with its poses.

    Raises BagError, NoTopicError, TopicTypeError, and what the reader of the poses raises.
    """
    poses, contents = read_poses(path, config)
    require_topic(path, contents, 'profile_topic', full_name(config.profile_topic), CLOUD)
    return Flow(path, config, poses, contents.warnings)


def evidence(calibration: Calibration, bag: Path | None) -> Evidence:
    """
    Return the evidence of a recording; bag: None for the one named in the calibration.

    Without a recording, `missing` gives the reason. Raises InputError for an unreadable bag.
    """
    config = config_of(calibration)
    if tabulated.of(config):
        return Evidence(missing='stops are shown of recordings; this was solved from files')
    missing = ''
    if bag is None:
        bag, missing = recording_of(calibration)
    if bag is None:
        return Evidence(missing=missing)
    recording = read(bag, config)
    return pipeline.evidence(recording.profiles, recording.poses, config)
