# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishes the flange pose of a corrected arm: `ros2 run handeye_ros corrected_pose`.

It publishes one PoseStamped for every JointState of the arm, with its stamp (without one, the time
of receipt), and a transform on /tf from the base to a separate frame, besides that of the
controller.
"""
from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
import sys

from geometry_msgs.msg import PoseStamped
from handeye_ros.arm import read_urdf
from handeye_ros.bags.poses import OtherJointsError, pose_from_joints
from handeye_ros.errors import INSTALL_TF2, UnusableMessageError
from handeye_ros.node.executables import non_ros_arguments, run_for_exit_code, spin
from handeye_ros.node.ros_messages import pose_stamped, transform_stamped
from handeye_ros.node.streams import BEST_EFFORT_QOS, TFMessage, WARNING_PERIOD
from handeye_ros.results.kinematics_file import read_arm
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState


class CorrectedPose(Node):
    """Subscribes to joint values and publishes flange poses at the same rate."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Subscribe; raises InputError for a file of an arm that is none."""
        arm = read_arm(options.kinematics) if options.kinematics else (
            read_urdf(options.urdf, options.base, options.flange)[1])
        super().__init__('handeye_corrected_pose')
        self._arm, self._frame = arm, options.frame
        self._poses = self.create_publisher(PoseStamped, options.pose_topic, QoSProfile(depth=100))
        self._tree = (self.create_publisher(TFMessage, '/tf', QoSProfile(depth=100))
                      if TFMessage else None)
        if not TFMessage:
            self.get_logger().warning('tf2_msgs is not installed: the poses are published on '
                                      f'{options.pose_topic} only, not on /tf; {INSTALL_TF2}')
        self.create_subscription(JointState, options.joint_topic, self._on_joints, BEST_EFFORT_QOS,
                                 raw=True)
        self.get_logger().info(f'{options.pose_topic} is {arm.flange} in {arm.base}')

    def _on_joints(self, data: bytes) -> None:
        try:
            pose = pose_from_joints(self._arm, data)
        except UnusableMessageError as error:
            if not isinstance(error, OtherJointsError):
                self.get_logger().warning(str(error), throttle_duration_sec=WARNING_PERIOD)
            return
        stamp = pose.stamp or self.get_clock().now().nanoseconds
        base = pose.parent_frame
        self._poses.publish(pose_stamped(pose.translation, pose.quaternion, base, stamp))
        if self._tree:
            self._tree.publish(TFMessage(transforms=[transform_stamped(
                pose.translation, pose.quaternion, base, self._frame, stamp)]))


def main() -> int:
    """Run the executable `corrected_pose`."""
    parser = argparse.ArgumentParser(prog='corrected_pose', description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument('--urdf', type=Path, metavar='FILE',
                        help='the corrected.urdf of "handeye kinematics"')
    source.add_argument('--kinematics', type=Path, metavar='FILE', help='its kinematics.yaml')
    for name, default, text in (
            ('base', '', 'link of the URDF (default: the root)'),
            ('flange', '', 'link of the URDF (default: the usual name, or the only last link)'),
            ('joint-topic', 'joint_states', 'with the JointState (default: %(default)s)'),
            ('pose-topic', 'corrected_pose', 'for the poses (default: %(default)s)'),
            ('frame', 'corrected_flange', 'of the flange on /tf (default: %(default)s)')):
        parser.add_argument(f'--{name}', default=default, help=text)
    options = parser.parse_args(non_ros_arguments())
    return run_for_exit_code(spin, partial(CorrectedPose, options))


if __name__ == '__main__':
    sys.exit(main())
