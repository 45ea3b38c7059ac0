# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishes what a calibrated sensor sees as points in the base frame, live or from a bag.

With eye_on_base they are in the frame of the flange.

ros2 launch handeye_ros scan.launch.py calibration:=/path/of/result profile_topic:=/scan
ros2 launch handeye_ros scan.launch.py --show-args
"""
import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

# Arguments that are keys of the configuration; empty: as the calibration says.
KEYS = {'profile_topic': 'profile_topic', 'pose_topic': 'pose_topic',
        'pose_source': 'pose_source', 'base_frame': 'robot_base_frame',
        'effector_frame': 'robot_effector_frame'}
OTHERS = {
    'options': ('', 'more of the executable, such as "--std --voxel 0.0005 --range 0.15 0.2"'),
    'namespace': ('', 'namespace of all that is started'),
    'bag': ('', 'a recording to replay: a rosbag2 folder, or an .mcap or .db3 file'),
    'rate': ('1.0', 'speed of the replay; 1: as recorded'),
    'use_sim_time': ('false', 'take the time from /clock'),
}
RECORDED = ('/profile', '/flange_pose')  # in a bag; in a namespace, both sides move into it


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and what starts once they are known."""
    return LaunchDescription([
        DeclareLaunchArgument('calibration', description=(
            'a calibration.yaml, or the folder that holds one')),
        *(DeclareLaunchArgument(name, default_value='', description=(
            f'{key}; empty: as the calibration says')) for name, key in KEYS.items()),
        *(DeclareLaunchArgument(name, default_value=value, description=description)
          for name, (value, description) in OTHERS.items()),
        OpaqueFunction(function=nodes),
    ])


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for."""
    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    def is_true(name: str) -> bool:
        return given(name).lower() in ('true', '1')

    settings = [word for name, key in KEYS.items() if given(name)
                for word in ('--set', f'{key}={given(name)}')]
    recorded = [(topic, topic.lstrip('/')) for topic in RECORDED] if given('bag') else []
    found = [
        Node(package='handeye_ros', executable='scan', name='handeye_scan', output='screen',
             namespace=given('namespace'), remappings=recorded,
             parameters=[{'use_sim_time': is_true('use_sim_time')}],
             arguments=[given('calibration'), *settings, *shlex.split(given('options'))])]
    if given('bag'):
        # it waits until the node subscribes, which on a busy machine takes its time
        found.append(Node(package='handeye_ros', executable='replay', name='replay',
                          output='screen', namespace=given('namespace'),
                          arguments=[given('bag'), '--rate', given('rate'), '--timeout', '30'],
                          remappings=recorded))
    return found
