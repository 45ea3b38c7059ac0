# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What comes in: the subscriptions of a node, and the thread that reads them."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
import threading
import time
from typing import Any, Protocol, TypeVar

from geometry_msgs.msg import PoseStamped
from handeye_ros.bags.messages import (
    message_of,
    ProfileReader,
    profiles_of,
    stamp_and_frame,
)
from handeye_ros.bags.poses import OtherJointsError, pose_topics
from handeye_ros.bags.storage import CLOUD_TYPE, JOINTS_TYPE, POSE_TYPE, TF_TYPE
from handeye_ros.bags.transforms import FlangeFollower
from handeye_ros.config import Config
from handeye_ros.data import RawProfile, TimedPose
from handeye_ros.errors import InputError, INSTALL_TF2, sentence_and_log
from handeye_ros.node.message_counts import MessageCount, new_counts
from handeye_ros.words import without_numbers
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError  # rclpy has them there alone
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, PointCloud2

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # the wheels of rclpy come without it
    TFMessage = None

# The queue holds 20 s of poses at 100 Hz, for times when other work takes the processor.
BEST_EFFORT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
STATIC_TF_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MESSAGES = {CLOUD_TYPE: PointCloud2, POSE_TYPE: PoseStamped, JOINTS_TYPE: JointState,
            TF_TYPE: TFMessage}
NO_CALLBACKS = SubscriptionEventCallbacks(use_default_callbacks=False)

READ_PERIOD = 2e-3  # s between two reads of all topics
MAX_AT_ONCE = 200  # messages of one topic before the next topic
# of executables of this package
OWN_TOPICS = ('/handeye/features', '/handeye/next_pose', '/handeye_scan/points')
LOOK_PERIOD = 0.1  # s between two looks at what the publishers offer
WARNING_PERIOD = 5.0  # s between two warnings of a kind
MAX_LISTED = 5  # largest number of topics or nodes in a sentence

Stamped = TypeVar('Stamped', RawProfile, TimedPose)


class UnexecutedGroup(MutuallyExclusiveCallbackGroup):
    """Excludes subscriptions from executors, which are slower than reading in a thread."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: no executor may wait for a subscription."""
        return False


class Receiver(Protocol):
    """
    Takes what the topics of its settings bring, in the thread that reads them.

    message_counts: of profiles and poses, by kind, which Streams begins anew; the receiver counts
        the usable ones
    """

    message_counts: dict[str, MessageCount]

    @property
    def config(self) -> Config:
        """Return the settings; those of topics and frames stay."""

    def add_profile(self, profile: RawProfile) -> None:
        """Take a profile, its stamp with time_offset."""

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Take poses."""


@dataclass(eq=False)
class _Subscribed:
    """
    A topic that is read.

    counts: the numbers of its messages; several topics of poses share them
    on_message: called with each serialised message
    key: the key of the configuration that names the topic: it should have one publisher; '' for
        topics that may have several
    publishers: rclpy's TopicEndpointInfo of each of this type, as of LOOK_PERIOD ago at most
    last_number: the number of the last message, as its publisher counts them
    obstacle: why messages of other devices, which are no faults, give nothing
    """

    counts: MessageCount
    message_type: str
    name: str
    on_message: Callable[[bytes], None]
    qos: QoSProfile
    key: str = ''
    subscription: Any = None
    publishers: Sequence[Any] = ()
    last_number: int = 0
    obstacle: str = ''


class Streams:
    """
    The subscriptions to the topics of a configuration, and the thread that reads their messages.

    Topics with a key are read as reliably as all of their publishers offer: large clouds do not
    arrive otherwise. /tf and joint values that are only stored are read best effort, /tf_static
    transient local. An invalid message is counted and dropped.
    """

    def __init__(self, node: Node, receiver: Receiver,
                 add_joints: Callable[[int, bytes], None] | None = None) -> None:
        """
        Subscribe, and begin to read and to count messages anew; raises InputError.

        add_joints: takes stamp (ns) and serialised JointState, of which no pose is made.
        """
        self._node, self._receiver, self._add_joints = node, receiver, add_joints
        receiver.message_counts = new_counts()  # silence begins now
        config, self._group = receiver.config, UnexecutedGroup()
        self._profile_reader = ProfileReader(config.profile)
        self._follower = FlangeFollower(config.base_frame, config.robot_effector_frame,
                                        config.sampling.max_pose_gap)
        self._last_stamp: int | None = None  # ns, of the last message of profiles
        self._topics = self._configured_topics(config)
        for topic in self._topics:
            self._subscribe(topic)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read_until_end, name='streams', daemon=True)
        self._thread.start()

    def _configured_topics(self, config: Config) -> list[_Subscribed]:
        """Return the topics that settings name; raises InputError."""
        counts = self._receiver.message_counts
        topics = [_Subscribed(counts['profile'], CLOUD_TYPE, config.profile_topic,
                              self._on_profile, RELIABLE_QOS, 'profile_topic')]
        if self._add_joints and not config.kinematics:
            topics.append(_Subscribed(MessageCount('joint state'), JOINTS_TYPE, config.joint_topic,
                                      partial(self._on_joints, self._add_joints), BEST_EFFORT_QOS))
        for source in pose_topics(config, self._follower):
            if source.message_type == TF_TYPE and not TFMessage:
                raise InputError('pose_source is tf, but tf2_msgs is not installed: '
                                 f'{INSTALL_TF2}; or publish the poses on pose_topic')
            qos = {'/tf': BEST_EFFORT_QOS, '/tf_static': STATIC_TF_QOS}.get(source.name,
                                                                            RELIABLE_QOS)
            topics.append(_Subscribed(counts['pose'], source.message_type, source.name,
                                      partial(self._on_poses, source.read), qos, source.key))
        if len({self._full_name(topic.name) for topic in topics}) < len(topics):
            raise InputError('two of profile_topic, pose_topic and joint_topic are the same: each '
                             'needs its own')
        return topics

    def _subscribe(self, topic: _Subscribed) -> None:
        """Subscribe to a topic with its QoS, for serialised messages."""
        topic.subscription = self._node.create_subscription(
            MESSAGES[topic.message_type], topic.name, topic.on_message, topic.qos, raw=True,
            callback_group=self._group, event_callbacks=NO_CALLBACKS)

    def stop(self) -> None:
        """Read no more messages."""
        self._ended.set()
        self._thread.join()
        for topic in self._topics:
            self._node.destroy_subscription(topic.subscription)

    def names_other_topics(self, config: Config) -> bool:
        """Return whether settings name other topics than these; raises InputError."""
        keys = ('profile_topic', 'pose_source', 'pose_topic', 'joint_topic', 'kinematics')
        current = self._receiver.config
        if all(getattr(config, key) == getattr(current, key) for key in keys):
            return False
        self._configured_topics(config)  # raises before these end
        return True

    def _full_name(self, topic: str) -> str:
        """Return the full name of a topic; raises InputError."""
        try:
            return str(self._node.resolve_topic_name(topic))
        except RCLError as error:
            reason = str(error).splitlines()[0].partition(', at /')[0]
            raise InputError(f'"{topic}" cannot name a topic: {reason}') from error

    def restart(self) -> None:
        """Accept transforms of any time from now on: a bag may be played again."""
        self._follower.restart()
        self._last_stamp = None

    # the thread

    def _read_until_end(self) -> None:
        """Read all topics repeatedly until the end."""
        last_look = 0.0
        with suppress(InvalidHandle):  # a node that ends destroys what is read
            while self._node.context.ok() and not self._ended.is_set():
                most_read = 0
                try:
                    most_read = max(map(self._read_messages, self._topics))
                    if time.monotonic() - last_look > LOOK_PERIOD:
                        last_look = time.monotonic()
                        self._look_at_publishers()
                except RCLError as error:  # also at its end
                    if self._node.context.ok():
                        self._node.get_logger().warning(
                            f'the topics cannot be read now: {error}',
                            throttle_duration_sec=WARNING_PERIOD)
                if most_read < MAX_AT_ONCE:
                    time.sleep(READ_PERIOD)

    def _look_at_publishers(self) -> None:
        """
        Look up the publishers of each topic.

        Subscribe again where their reliability has changed.
        """
        for topic in [topic for topic in self._topics if topic.key]:
            topic.publishers = [
                info for info in self._node.get_publishers_info_by_topic(topic.name)
                if info.topic_type == topic.message_type]
            offered = {info.qos_profile.reliability for info in topic.publishers}
            qos = BEST_EFFORT_QOS if BEST_EFFORT_QOS.reliability in offered else RELIABLE_QOS
            if offered and qos is not topic.qos:
                old_subscription = topic.subscription
                topic.qos, topic.last_number = qos, 0
                self._subscribe(topic)
                self._node.destroy_subscription(old_subscription)

    def _read_messages(self, topic: _Subscribed) -> int:
        """Read at most MAX_AT_ONCE messages of a topic; return how many."""
        handle, message_type = topic.subscription.handle, MESSAGES[topic.message_type]
        with handle:
            for count in range(MAX_AT_ONCE):
                taken = handle.take_message(message_type, True)
                if not taken:
                    return count
                data, info = taken
                number = info['publication_sequence_number'] or 0
                if len(topic.publishers) == 1 and 0 < topic.last_number < number:
                    topic.counts.add_lost(number - topic.last_number - 1)
                topic.last_number = number
                try:
                    topic.on_message(data)
                except OtherJointsError as error:
                    topic.obstacle = str(error)
                except Exception as error:  # noqa: BLE001 - the streams must continue
                    reason = sentence_and_log(f'the reading of {topic.name}', error)
                    topic.counts.add_malformed(reason)
                    self._node.get_logger().warning(reason, throttle_duration_sec=WARNING_PERIOD)
        return MAX_AT_ONCE

    def _on_profile(self, data: bytes) -> None:
        """Give the profiles of a message to the receiver, their stamps with time_offset."""
        config = self._receiver.config
        if self._profile_reader.config != config.profile:
            self._profile_reader = ProfileReader(config.profile)
        message = self._stamped(self._profile_reader.take(data))
        for profile in profiles_of(message, self._last_stamp):
            self._receiver.add_profile(replace(profile, stamp=profile.stamp + config.offset_ns))
        self._last_stamp = message.stamp

    def _on_poses(self, read_poses: Callable[[bytes], Iterable[TimedPose]], data: bytes) -> None:
        """Give the poses of the flange that a message holds to the receiver."""
        self._receiver.add_poses([self._stamped(pose) for pose in read_poses(data)])

    def _on_joints(self, add_joints: Callable[[int, bytes], None], data: bytes) -> None:
        """Pass on joint values as they are, for `handeye kinematics`."""
        stamp, _ = stamp_and_frame(message_of(JOINTS_TYPE, data))
        add_joints(stamp or self._time_of_receipt(), data)

    def _stamped(self, item: Stamped) -> Stamped:
        """Return a profile or pose; without a stamp it gets the time of receipt."""
        return item if item.stamp else replace(item, stamp=self._time_of_receipt())

    def _time_of_receipt(self) -> int:
        """Return the current time (ns), and log a warning that messages have no stamp."""
        self._node.get_logger().warning(
            'messages come without a stamp: the time of receipt is used',
            throttle_duration_sec=WARNING_PERIOD)
        return int(self._node.get_clock().now().nanoseconds)

    # what the graph of ROS tells about them

    def graph_troubles(self) -> dict[str, str]:
        """
        Return what is wrong with publishers and nodes, as far as it is known.

        By kind (profile, pose): why no messages arrive; session: several publishers of a topic,
        and a second node of this name.
        """
        reason = '' if self._receiver.config.key_of_poses else self._follower.missing_reason()
        troubles, sentences, node = {'pose': reason}, [], self._node
        for topic in [topic for topic in self._topics if topic.key]:
            kind = topic.counts.kind
            troubles[kind] = self._trouble_of(topic)
            nodes = sorted(f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                           for info in topic.publishers)
            if len(nodes) > 1:
                sentences.append(
                    f'{len(nodes)} publishers send {kind}s on {self._full_name(topic.name)} '
                    f'({", ".join(nodes[:MAX_LISTED])}): let only one publish')
        this_node = (node.get_name(), node.get_namespace())
        if node.get_node_names_and_namespaces().count(this_node) > 1:
            sentences.append(
                f'there are two nodes {node.get_fully_qualified_name()}: both publish, and either '
                'may answer; end one, or rename it (-r __node:=other)')
        note = ['one that was killed is listed for 20 s more'] if sentences else []
        return {**troubles, 'session': '; '.join(sentences + note)}

    def _trouble_of(self, topic: _Subscribed) -> str:
        """Return why no messages may arrive on a topic, '' if nothing is known against it."""
        name, expected = self._full_name(topic.name), topic.message_type
        if topic.publishers:
            return topic.obstacle if topic.counts.count or topic.qos is RELIABLE_QOS else (
                'its driver publishes with best effort: large messages may all get lost; publish '
                'reliably')
        others = ', '.join([other for other in self.topics_of(expected)
                            if other != name][:MAX_LISTED])  # its own has just begun
        offered = {info.topic_type for info in self._node.get_publishers_info_by_topic(topic.name)}
        problem = (f'it carries {", ".join(sorted(offered))}, expected {expected}' if offered else
                   f'{name} has no publisher')
        return problem + (f'; {expected} is on {others}: set {topic.key}' if others else '')

    def topics_of(self, message_type: str) -> list[str]:
        """Return the topics with publishers of a message type, without those of this package."""
        node = self._node
        return sorted(name for name, types in node.get_topic_names_and_types()
                      if message_type in types and not name.endswith(OWN_TOPICS)
                      and any(info.topic_type == message_type
                              for info in node.get_publishers_info_by_topic(name)))


def log_new_warnings(node: Node, sentences: Iterable[str], logged: set[str]) -> set[str]:
    """Log sentences that are new but for their numbers; return all without them, as `logged`."""
    warnings = {without_numbers(sentence): sentence for sentence in sentences if sentence}
    for kind in warnings.keys() - logged:
        node.get_logger().warning(warnings[kind])
    return set(warnings)
