# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Publishes saved calibrations on /tf_static: `ros2 run handeye_ros publish FILE...`."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
import sys

from handeye_ros.data import Calibration
from handeye_ros.errors import InputError, NoRosError
from handeye_ros.node.executables import non_ros_arguments, run_for_exit_code, spin
from handeye_ros.node.ros_messages import LATCHED_QOS, transform_of
from handeye_ros.node.streams import TFMessage
from handeye_ros.results.calibration_file import read_calibration
from rclpy.node import Node


def publisher(paths: Sequence[Path]) -> Node:
    """
    Return a node that publishes the calibrations of files or folders.

    Raises InputError for a file that cannot be used, or two of one sensor: nothing is published.
    """
    if not TFMessage:
        raise NoRosError('publish', 'tf2_msgs')
    calibrations: dict[str, Calibration] = {}  # by the frame of the sensor
    for path in paths:
        calibration = read_calibration(path.absolute())
        if calibration.child_frame in calibrations:
            raise InputError(f'{path} is the second file that gives the pose of '
                             f'{calibration.child_frame}: name each sensor once')
        calibrations[calibration.child_frame] = calibration
    node = Node('handeye_publish')
    stamp = node.get_clock().now().nanoseconds
    # in one message: a latched topic keeps only the last
    node.create_publisher(TFMessage, '/tf_static', LATCHED_QOS).publish(TFMessage(
        transforms=[transform_of(calibration, stamp) for calibration in calibrations.values()]))
    for frame, calibration in calibrations.items():
        node.get_logger().info(f'{frame} in {calibration.parent_frame} is on /tf_static '
                               f'(calibration {calibration.name})')
    return node


def main() -> int:
    """Run the executable `publish`."""
    parser = argparse.ArgumentParser(prog='publish', description=__doc__)
    parser.add_argument('files', nargs='+', type=Path, metavar='FILE',
                        help='a calibration.yaml, or the folder that holds it')
    options = parser.parse_args(non_ros_arguments())
    return run_for_exit_code(spin, partial(publisher, options.files))


if __name__ == '__main__':
    sys.exit(main())
