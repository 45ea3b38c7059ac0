# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Puts saved calibrations on /tf_static at boot.

ros2 launch handeye_ros publish.launch.py calibrations:='/path/a.yaml /path/of/folder_b'
"""
import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and what starts once they are known."""
    return LaunchDescription([
        DeclareLaunchArgument('calibrations', description=(
            'calibration.yaml files, or the folders that hold them; blanks between, quotes around '
            'a path with blanks')),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the node'),
        OpaqueFunction(function=nodes),
    ])


def nodes(context: LaunchContext) -> list[Node]:
    """Return the node that publishes them."""
    files = shlex.split(LaunchConfiguration('calibrations').perform(context))
    return [Node(package='handeye_ros', executable='publish', name='handeye_publish',
                 namespace=LaunchConfiguration('namespace').perform(context), output='screen',
                 arguments=files)]
