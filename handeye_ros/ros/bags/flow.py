"""A bag as a stream, for scans: its poses by stamp, then its profiles one after the other."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from handeye_ros.config import Config, ProfileConfig
from handeye_ros.data import Profile, RawProfile, TimedPose
from handeye_ros.ros.bags import cdr
from handeye_ros.ros.bags.bag import read_poses
from handeye_ros.ros.bags.batches import rows_of, split
from handeye_ros.ros.bags.contents import CLOUD, Contents, full_name
from handeye_ros.ros.bags.messages import returns_from_cloud
from handeye_ros.ros.bags.profile_reader import profile_from_cdr
from handeye_ros.ros.bags.storage import messages
from handeye_ros.ros.errors import AllMalformedError, MessageError, NoTopicError, TopicTypeError

MOST_SHARE = 0.5  # of malformed messages that are left out


@dataclass
class Flow:
    """
    The profiles of a bag, read when they are asked for, and its poses.

    warnings: what was left out, complete when all was asked for. Raises InputError when asked
    for what is not there.
    """

    path: Path
    config: Config
    poses: Sequence[TimedPose] = ()
    warnings: list[str] = field(default_factory=list)

    def profiles(self) -> Iterator[Profile]:
        """Yield the profiles in the order of recording: returns alone, with intensity."""
        topic = full_name(self.config.profile_topic)
        reasons: Counter[str] = Counter()
        count, contents = 0, Contents()
        for raw, _ in messages(self.path, contents, (topic,)):
            count += 1
            try:
                yield from returns_of(raw.data, self.config.profile)
            except MessageError as error:
                reasons[str(error)] += 1
        self.warnings += [w for w in contents.warnings if w not in self.warnings]
        lost = reasons.total()
        if lost and lost > MOST_SHARE * count:
            raise AllMalformedError(topic, lost, count, reasons.most_common(1)[0][0])
        if lost:
            self.warnings.append(f'{lost} of {count} messages on {topic} were left out; the '
                                 f'most frequent reason: {reasons.most_common(1)[0][0]}')


def returns_of(data: bytes, config: ProfileConfig) -> Iterator[Profile]:
    """
    Yield the profiles of one serialised message: returns alone, with intensity.

    Where there are several, the robot may move meanwhile. Raises MessageError.
    """
    cloud = cdr.cloud(data)
    rows = rows_of(cloud, config)
    if rows == 1:
        yield returns_from_cloud(cloud, config)
        return
    if not config.period:
        raise MessageError('PointCloud2', f'it holds {rows} profiles, and nobody knows when each '
                           'was taken: set profile.period')
    whole = RawProfile(cloud.header.stamp, '', partial(bytes, data), profile_from_cdr, config,
                       rows=rows)
    for one in split(whole, None, config):
        yield returns_from_cloud(cdr.cloud(one.fetch()), config)


def flow(path: Path, config: Config) -> Flow:
    """
    Return the stream of a bag, its poses read.

    Raises BagError, NoTopicError, TopicTypeError, and what the reader of the poses raises.
    """
    poses, contents = read_poses(path, config)
    _check_profiles(path, config, contents)
    return Flow(path, config, poses, contents.warnings)


def _check_profiles(path: Path, config: Config, contents: Contents) -> None:
    topic, topics = full_name(config.profile_topic), contents.topics
    if topic not in topics:
        raise NoTopicError(path, 'profile_topic', topic, CLOUD, topics)
    if topics[topic] != CLOUD:
        raise TopicTypeError('profile_topic', topic, CLOUD, topics)
