# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishes laser points in the base frame: `ros2 run handeye_ros scan`.

With eye_on_base they are in the frame of the flange. They are published on ~/points, a cloud for
the profiles of every 50 ms. Each profile is placed by the pose at its stamp plus time_offset, and
waits for the pose after it. The number of dropped profiles is logged.
"""
from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
import re
import sys
from threading import Lock
from typing import Any

from handeye_ros.bags.messages import returns_of
from handeye_ros.config import Config, with_assignments
from handeye_ros.data import Profile, RawProfile, TimedPose
from handeye_ros.errors import UnusableMessageError
from handeye_ros.frames import frame_mismatch_warning
from handeye_ros.node.executables import non_ros_arguments, run_for_exit_code, spin
from handeye_ros.node.message_counts import new_counts
from handeye_ros.node.ros_messages import cloud
from handeye_ros.node.streams import log_new_warnings, Streams, WARNING_PERIOD
from handeye_ros.results.calibration_file import config_to_measure, read_calibration
from handeye_ros.sampling.stream import REORDER_TIME
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.scanning.scan import Scanner, ScanOptions
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

CLOUD_PERIOD = 0.05  # s between two clouds
TROUBLES_PERIOD = 1.0  # s between two looks for troubles
KEPT_POSES = 2000  # profiles may still need them: 20 s of 100 Hz
POSES_AROUND = 1_000_000_000  # ns of poses before a profile, for the interpolation
KEPT_PROFILES = 4000  # may wait for a pose; the oldest are dropped first


class ScanNode(Node):
    """Takes profiles and poses, and publishes points in the frame of the scanned surface."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Subscribe; raises InputError for arguments, and poses on /tf without tf2_msgs."""
        options = ScanOptions.of_texts(arguments.range, arguments.incidence, arguments.voxel,
                                       arguments.std)
        calibration = read_calibration(arguments.calibration)
        config = with_assignments(config_to_measure(calibration), arguments.set)
        super().__init__('handeye_scan')
        self.config: Config = replace(config, time_offset=0.0)  # the scanner adds it
        self.message_counts = new_counts()
        self._sensor = calibration.child_frame
        self._scanner = Scanner(calibration, config, options)
        # ns from the stamp of a profile to that of the last pose that places it
        self._pose_delay = round((config.time_offset + max(calibration.rotation_lag, 0.0)) * 1e9)
        self._lock = Lock()  # of the two deques, for the thread of the streams and the timer
        self._profiles: deque[Profile] = deque(maxlen=KEPT_PROFILES)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT_POSES)
        self._points = self.create_publisher(PointCloud2, '~/points', 10)
        self._logged_warnings: set[str] = set()  # without their numbers
        self._streams = Streams(self, self)
        self.create_timer(CLOUD_PERIOD, self._publish_ready)
        self.create_timer(TROUBLES_PERIOD, self._log_troubles)

    def add_profile(self, profile: RawProfile) -> None:
        """Keep the points of a profile until its pose is known."""
        returns = returns_of(profile)
        self.message_counts['profile'].add(profile.stamp)
        if doubt := frame_mismatch_warning(profile.frame_id, self._sensor):
            self.get_logger().warning(doubt, throttle_duration_sec=WARNING_PERIOD)
        self._append(self._profiles, returns)

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Keep poses; raises UnusableMessageError for those in another frame."""
        for pose in poses:
            if not self.config.kinematics and pose.parent_frame.lstrip('/') not in (
                    '', self.config.base_frame):
                raise UnusableMessageError(f'a pose is given in "{pose.parent_frame}", but '
                                           f'robot_base_frame is "{self.config.base_frame}"')
            self.message_counts['pose'].add(pose.stamp)
            self._append(self._poses, pose)

    def _append(self, buffer: deque[Any], item: Profile | TimedPose) -> None:
        """Append an item; if the clock was set back, without those before."""
        with self._lock:
            if buffer and buffer[-1].stamp - item.stamp > REORDER_TIME:
                buffer.clear()
            buffer.append(item)

    def _log_troubles(self) -> None:
        """Log why messages do not come, or cannot be used."""
        troubles = self._streams.graph_troubles()
        states = [self.message_counts[kind].state(topic, troubles[kind]) for kind, topic in (
            ('profile', self.config.profile_topic), ('pose', self.config.topic_of_poses))]
        self._logged_warnings = log_new_warnings(
            self, [troubles['session'], *(state['trouble'] for state in states)],
            self._logged_warnings)

    def _publish_ready(self) -> None:
        """Publish the points of profiles older than the last pose."""
        with self._lock:
            latest = self._poses[-1].stamp if self._poses else 0
            ready = [profile for profile in self._profiles
                     if profile.stamp + self._pose_delay <= latest]
            if not ready:
                return
            for profile in ready:
                self._profiles.remove(profile)
            span = latest - ready[0].stamp - self._pose_delay + POSES_AROUND
            poses = [pose for pose in self._poses if abs(latest - pose.stamp) <= span]
        trajectory = trajectory_of(poses, self.config.sampling.max_pose_gap)
        dropped_before = self._scanner.without_pose
        points = self._scanner.mapped(ready, trajectory)
        dropped = self._scanner.without_pose
        if dropped > dropped_before:
            self.get_logger().warning(f'{dropped} profiles without a pose were dropped so far',
                                      throttle_duration_sec=WARNING_PERIOD)
        if len(points):
            self._points.publish(cloud(points, self._scanner.frame, ready[-1].stamp))


def main() -> int:
    """Run the executable `scan`."""
    parser = argparse.ArgumentParser(prog='scan', description=__doc__)
    parser.add_argument('calibration', type=Path, help='a calibration.yaml, or the folder that '
                        'holds it; its settings (topics, unit, frames) are used')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE',
                        help='change a setting; may be repeated')
    parser.add_argument('--range', nargs=2, type=str.strip, default=('-inf', 'inf'),
                        metavar=('NEAR', 'FAR'), help='keep points in this range of the sensor')
    parser.add_argument('--incidence', type=float, default=90.0, metavar='DEGREES',
                        help='largest angle between range axis and surface normal in a profile')
    parser.add_argument('--voxel', default='0', help='keep a point of each cube with this edge')
    parser.add_argument('--std', action='store_true', help='add the 1 sigma of each point (m)')
    # else argparse takes a negative length, as of --range -200mm -100mm, for an option
    words = [f' {word}' if re.match(r'-[\d.i]', word) else word for word in non_ros_arguments()]
    return run_for_exit_code(spin, partial(ScanNode, parser.parse_args(words)))


if __name__ == '__main__':
    sys.exit(main())
