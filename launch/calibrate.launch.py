# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Starts the node, and what is asked for around it.

ros2 launch handeye_ros calibrate.launch.py config:=my_cell.yaml profile_topic:=/scan rviz:=true
ros2 launch handeye_ros calibrate.launch.py --show-args
"""
from handeye_ros.errors import InputError
from handeye_ros.node.launching import (
    declared,
    file_given,
    given,
    is_true,
    KEYS,
    remappings,
    replayed,
    values_given,
)
from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SET_HERE = {**KEYS, 'name': 'name', 'output_dir': 'output_dir', 'session': 'session',
            'page': 'page.port'}
# by RViz, whose layout names them without a namespace
SHOWN = ('/handeye/markers', '/handeye/current', '/handeye/features', '/handeye/next_pose',
         '/profile')


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and what starts once they are known."""
    share = FindPackageShare('handeye_ros')
    return LaunchDescription([
        *declared(SET_HERE, 'configuration file', {
            'config': (PathJoinSubstitution([share, 'config', 'plate.yaml']),
                       'parameters of the node; config/ holds examples'),
            'rviz': ('false', 'start RViz with the layout of this package'),
            'rviz_layout': (PathJoinSubstitution([share, 'rviz', 'handeye.rviz']), 'of RViz')}),
        OpaqueFunction(function=nodes),
    ])


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that the arguments ask for; raises InputError."""
    set_here: dict[str, str | int] = {**values_given(context, SET_HERE)}
    if port := given(context, 'page'):
        if not port.isdecimal():
            raise InputError(f'page is "{port}", expected the number of a port')
        set_here['page.port'] = int(port)
    namespace = given(context, 'namespace')
    found = [
        Node(package='handeye_ros', executable='calibrate', name='handeye', output='screen',
             namespace=namespace, remappings=remappings(context),
             # a file that says what the time is must not be overruled by a default
             parameters=[{'use_sim_time': is_true(context, 'use_sim_time')},
                         file_given(context, 'config'), *([set_here] if set_here else [])]),
        *replayed(context)]
    if is_true(context, 'rviz'):
        found.append(Node(package='rviz2', executable='rviz2', name='rviz2',
                          namespace=namespace,
                          arguments=['-d', file_given(context, 'rviz_layout')],
                          remappings=[(topic, topic.lstrip('/')) for topic in SHOWN]))
    return found
