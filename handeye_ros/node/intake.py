"""The subscriptions of the node: profiles, and poses from a topic, /tf or joint values."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
import threading
import time
import traceback
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped
from handeye_ros.bags.bag import pose_from_joints
from handeye_ros.bags.messages import pose_from_cdr, ProfileReader, split, transforms_from_cdr
from handeye_ros.bags.reader import CLOUD, JOINTS, POSE
from handeye_ros.bags.transforms import FlangeTracker
from handeye_ros.config import Config
from handeye_ros.data import RawProfile, TimedPose
from handeye_ros.errors import InputError, INSTALL_TF2, UnusableMessageError
from handeye_ros.node.diagnostics import why_silent
from handeye_ros.node.executable import InvalidHandle, RCLError
from handeye_ros.node.kinematics import LiveKinematics
from handeye_ros.node.live import LiveSession
from handeye_ros.node.streams import Arrivals
from handeye_ros.robot.urdf import read_arm
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState, PointCloud2

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels of rclpy come without it
    TFMessage = None

__all__ = ['Intake', 'TFMessage', 'THROTTLE']

# Best effort matches reliable publishers too. The queue holds 20 s of poses at 100 Hz, for times
# when other work takes the processor.
STREAM = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED_TREE = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)

PAUSE = 2e-3  # s between two reads of all topics
MOST_AT_ONCE = 200  # messages of one topic before the next topic
THROTTLE = 5.0  # s between two warnings of a kind

Stamped = TypeVar('Stamped', RawProfile, TimedPose)

NO_TF = ('pose_source is tf, but tf2_msgs is not installed: '
         f'{INSTALL_TF2}; or publish the poses on pose_topic')


class NoExecutor(MutuallyExclusiveCallbackGroup):
    """Excludes subscriptions from executors, which are slower than reading in a thread."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: no executor may wait for a subscription."""
        return False


def topics_of(config: Config) -> tuple[str, str, str]:
    """Return the settings of topics that may change at run time."""
    return config.profile_topic, config.pose_source, config.pose_topic


class Intake:
    """
    The subscriptions, and the thread that reads their messages.

    An invalid message is counted and left out. kinematics: None without a URDF.
    """

    def __init__(self, node: Node, live: LiveSession) -> None:
        """Subscribe; raises InputError."""
        self._node = node
        self._live = live
        self._group = NoExecutor()
        self._drains: list[Callable[[], int]] = []
        self._subscriptions: list[Any] = []
        config = live.config
        self._reader = ProfileReader(config.profile)
        self.kinematics = LiveKinematics(live, config) if config.robot_description else None
        self.listen()

    def listen(self) -> None:
        """Subscribe to the topics of the current settings; raises InputError."""
        old_subscriptions, self._drains, self._subscriptions = self._subscriptions, [], []
        for subscription in old_subscriptions:
            self._node.destroy_subscription(subscription)
        config = self._live.config
        self._topics = topics_of(config)
        self._tracker = FlangeTracker(config.base_frame, config.robot_effector_frame)
        self._last_stamp: int | None = None  # ns, of the last message of profiles
        self._live.streams.arrivals = Arrivals()
        self._listen(PointCloud2, config.profile_topic, self._on_profile, STREAM)
        if self.kinematics:
            self._live.samples.store.joints = self.kinematics.between
            self._listen(JointState, config.joint_topic, self._on_joint_values, STREAM)
        elif config.kinematics:
            pose_of = partial(pose_from_joints, read_arm(Path(config.kinematics)))
            self._listen(JointState, config.joint_topic, partial(self._on_pose, pose_of), STREAM)
        elif config.pose_source == 'topic':
            self._listen(PoseStamped, config.pose_topic, partial(self._on_pose, pose_from_cdr),
                         STREAM)
        elif TFMessage:
            self._listen(TFMessage, '/tf_static', partial(self._on_transforms, True), LATCHED_TREE)
            self._listen(TFMessage, '/tf', partial(self._on_transforms, False), STREAM)
        else:
            raise InputError(NO_TF)

    def changes(self, config: Config) -> bool:
        """Return whether settings name other topics than now; raises InputError."""
        if topics_of(config) == self._topics:
            return False
        if any(outcome.sample for outcome in self._live.copied().outcomes):
            raise InputError('the topics cannot change while there are samples from them: call '
                             '~/clear_samples first, which begins a new session')
        by_topic = config.pose_source == 'topic'
        if not by_topic and not TFMessage:
            raise InputError(NO_TF)
        names = [self._name(config.profile_topic)] + [self._name(config.pose_topic)] * by_topic
        if len(set(names)) < len(names):
            raise InputError('profile_topic and pose_topic are the same: each needs its own')
        return True

    def _name(self, topic: str) -> str:
        """Return the full name of a topic; raises InputError."""
        try:
            return str(self._node.resolve_topic_name(topic))
        except RCLError as error:
            reason = str(error).splitlines()[0].partition(', at /')[0]
            raise InputError(f'"{topic}" cannot name a topic: {reason}') from error

    def start(self) -> None:
        """Start reading messages."""
        threading.Thread(target=self._run, name='streams', daemon=True).start()

    def obstacle(self, kind: str) -> str:
        """Return why no messages of a kind (profile, pose) arrive; empty if unknown."""
        config = self._live.config
        if kind == 'profile':
            return why_silent(self._node, 'profile_topic', config.profile_topic, CLOUD)
        if config.kinematics or config.robot_description:
            return why_silent(self._node, 'joint_topic', config.joint_topic, JOINTS)
        if config.pose_source == 'topic':
            return why_silent(self._node, 'pose_topic', config.pose_topic, POSE)
        return self._tracker.missing()

    def restart(self) -> None:
        """Accept transforms of any time from now on: a bag may be played again."""
        self._tracker.restart()

    def _listen(self, kind: Any, topic: str, callback: Callable[[Any], None], qos: QoSProfile
                ) -> None:
        """Subscribe to a topic; the thread calls the callback with every message."""
        self._name(topic)  # raises InputError
        subscription = self._node.create_subscription(
            kind, topic, callback, qos, callback_group=self._group, raw=True,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._subscriptions.append(subscription)
        self._drains.append(partial(self._drain, subscription.handle, kind, callback))

    def _run(self) -> None:
        """Read all topics repeatedly until the node ends."""
        while self._node.context.ok():
            drains, counts = self._drains, [0]
            try:
                counts += [drain() for drain in drains]
            except InvalidHandle:
                if drains is self._drains:  # else the subscriptions were replaced
                    return
            if max(counts) < MOST_AT_ONCE:
                time.sleep(PAUSE)

    def _drain(self, handle: Any, kind: Any, callback: Callable[[Any], None]) -> int:
        """Read at most MOST_AT_ONCE messages of a topic; return how many."""
        with handle:
            for count in range(MOST_AT_ONCE):
                received = handle.take_message(kind, True)
                if not received:
                    return count
                self._process(kind, callback, received[0])
        return MOST_AT_ONCE

    def _process(self, kind: Any, callback: Callable[[Any], None], msg: Any) -> None:
        try:
            callback(msg)
        except Exception as error:  # noqa: BLE001 - the streams must continue
            if not isinstance(error, UnusableMessageError):
                self._node.get_logger().error(traceback.format_exc())
            stream = 'profile' if kind is PointCloud2 else 'pose'
            self._live.streams.arrivals.malformed(stream, str(error))
            self._node.get_logger().warning(str(error), throttle_duration_sec=THROTTLE)

    def _on_profile(self, data: bytes) -> None:
        config = self._live.config
        if self._reader.config != config.profile:
            self._reader = ProfileReader(config.profile)
        profile = self._stamped(self._reader.take(data))
        message = replace(profile, stamp=profile.stamp + round(config.time_offset * 1e9))
        for profile_part in split(message, self._last_stamp, config.profile):
            self._live.add_profile(profile_part)
        self._last_stamp = message.stamp

    def _on_pose(self, pose_of: Callable[[bytes], TimedPose], data: bytes) -> None:
        self._live.add_poses([self._stamped(pose_of(data))])

    def _on_joint_values(self, data: bytes) -> None:
        assert self.kinematics is not None
        self._live.add_poses([self.kinematics.pose(data)])

    def _on_transforms(self, static: bool, data: bytes) -> None:
        self._live.add_poses(self._tracker.add(transforms_from_cdr(data), static))

    def _stamped(self, item: Stamped) -> Stamped:
        """Return an item; without a stamp it gets the time of receipt."""
        if item.stamp:
            return item
        self._node.get_logger().warning(
            'messages come without a stamp: the time of receipt is used',
            throttle_duration_sec=THROTTLE)
        return replace(item, stamp=self._node.get_clock().now().nanoseconds)
