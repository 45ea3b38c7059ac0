"""A bag as a stream, for scans: its poses by stamp, then its profiles one after the other."""
from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Profile, TimedPose
from handeye_ros.ros.bags.bag import pose_topics, poses_of
from handeye_ros.ros.bags.contents import CLOUD, Contents, full_name, message_of, Raw, type_of
from handeye_ros.ros.bags.messages import returns_from_cloud
from handeye_ros.ros.bags.storage import scan
from handeye_ros.ros.errors import AllMalformedError, MessageError, NoTopicError, TopicTypeError
from rosbags.rosbag2 import Reader
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores

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
    poses: tuple[TimedPose, ...] = ()
    warnings: list[str] = field(default_factory=list)
    _whole: bool = True

    def profiles(self) -> Iterator[Profile]:
        """Yield the profiles in the order of recording: returns alone, with intensity."""
        topic, types = full_name(self.config.profile_topic), get_typestore(Stores.ROS2_JAZZY)
        reasons: Counter[str] = Counter()
        count = 0
        for data in self._raw(topic):
            count += 1
            try:
                message: Any = types.deserialize_cdr(data, CLOUD)
                yield returns_from_cloud(message, self.config.profile)
            except MessageError as error:
                reasons[str(error)] += 1
            except (SerdeError, IndexError) as error:
                reasons[f'damaged message: {error}'] += 1
        lost = reasons.total()
        if lost and lost > MOST_SHARE * count:
            raise AllMalformedError(topic, lost, count, reasons.most_common(1)[0][0])
        if lost:
            self.warnings.append(f'{lost} of {count} messages on {topic} were left out; the '
                                 f'most frequent reason: {reasons.most_common(1)[0][0]}')

    def _raw(self, topic: str) -> Iterator[bytes | memoryview]:
        """Yield the messages of a topic; of a damaged bag what can be read, all at once."""
        if self._whole:
            with closing(_opened(self.path)) as reader:
                wanted = [c for c in reader.connections if full_name(c.topic) == topic]
                yield from (data for _, _, data in reader.messages(wanted))
        else:
            yield from (raw.data for raw in scan(self.path, (topic,)).messages)


def flow(path: Path, config: Config) -> Flow:
    """
    Return the stream of a bag, its poses read.

    Raises BagError, NoTopicError, TopicTypeError, and what the reader of the poses raises.
    """
    topics = pose_topics(config)
    whole = True
    try:
        contents = _contents(path, {full_name(topic) for topic in topics})
    except Exception:  # noqa: BLE001 - damage leads rosbags to errors of all kinds
        contents, whole = scan(path, topics), False
    _check_profiles(path, config, contents)
    poses = poses_of(path, contents, config)
    return Flow(path, config, tuple(poses), contents.warnings, whole)


def _opened(path: Path) -> Reader:
    reader = Reader(path)
    reader.open()
    return reader


def _contents(path: Path, topics: Collection[str]) -> Contents:
    """Return all topics of a whole bag, and the messages of some."""
    with closing(_opened(path)) as reader:
        wanted = [c for c in reader.connections if full_name(c.topic) in topics]
        return Contents(
            {full_name(c.topic): type_of(c.msgtype, 'cdr') for c in reader.connections},
            [Raw(full_name(c.topic), time, message_of(bytes(data)))
             for c, time, data in reader.messages(wanted)] if wanted else [])


def _check_profiles(path: Path, config: Config, contents: Contents) -> None:
    topic, topics = full_name(config.profile_topic), contents.topics
    if topic not in topics:
        raise NoTopicError(path, 'profile_topic', topic, CLOUD, topics)
    if topics[topic] != CLOUD:
        raise TopicTypeError('profile_topic', topic, CLOUD, topics)
