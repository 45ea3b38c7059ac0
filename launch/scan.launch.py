# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishes what a calibrated sensor sees as points in the base frame, live or from a bag.

With eye_on_base they are in the frame of the flange.

ros2 launch handeye_ros scan.launch.py calibration:=/path/of/result profile_topic:=/scan
ros2 launch handeye_ros scan.launch.py --show-args
"""
import shlex

from handeye_ros.node.launching import (
    declared,
    given,
    is_true,
    KEYS,
    remappings,
    replayed,
    values_given,
)
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and what starts once they are known."""
    return LaunchDescription([
        DeclareLaunchArgument('calibration', description=(
            'a calibration.yaml, or the folder that holds one')),
        *declared(KEYS, 'calibration', {'options': (
            '', 'more of the executable, such as "--std --voxel 0.0005 --range 0.15 0.2"')}),
        OpaqueFunction(function=nodes),
    ])


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for; raises InputError."""
    settings = [word for key, value in values_given(context, KEYS).items()
                for word in ('--set', f'{key}={value}')]
    return [
        Node(package='handeye_ros', executable='scan', name='handeye_scan', output='screen',
             namespace=given(context, 'namespace'), remappings=remappings(context),
             parameters=[{'use_sim_time': is_true(context, 'use_sim_time')}],
             arguments=[given(context, 'calibration'), *settings,
                        *shlex.split(given(context, 'options'))]),
        *replayed(context)]
