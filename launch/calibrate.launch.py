# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Starts the node, and what is asked for around it.

ros2 launch handeye_ros calibrate.launch.py config:=my_cell.yaml profile_topic:=/scan rviz:=true
ros2 launch handeye_ros calibrate.launch.py --show-args
"""
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

# Arguments that are keys of the configuration; empty: as the configuration file says.
KEYS = {'name': 'name', 'profile_topic': 'profile_topic', 'pose_topic': 'pose_topic',
        'pose_source': 'pose_source', 'base_frame': 'robot_base_frame',
        'effector_frame': 'robot_effector_frame', 'output_dir': 'output_dir',
        'session': 'session'}
OTHERS = {
    'page': ('', 'port of the page of the session, such as 8765; empty: as the file says'),
    'namespace': ('', 'namespace of all that is started'),
    'bag': ('', 'a recording to replay: a rosbag2 folder, or an .mcap or .db3 file'),
    'rate': ('1.0', 'speed of the replay; 1: as recorded'),
    'rviz': ('false', 'start RViz with the layout of this package'),
    'use_sim_time': ('false', 'take the time from /clock'),
}
RECORDED = ('/profile', '/flange_pose')  # in a bag; in a namespace, both sides move into it
# by RViz, whose layout names them without a namespace
SHOWN = ('/handeye/markers', '/handeye/current', '/handeye/features', '/handeye/next_pose',
         '/profile')


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and what starts once they are known."""
    share = FindPackageShare('handeye_ros')
    plate = PathJoinSubstitution([share, 'config', 'plate.yaml'])
    layout = PathJoinSubstitution([share, 'rviz', 'handeye.rviz'])
    return LaunchDescription([
        DeclareLaunchArgument('config', default_value=plate,
                              description='parameters of the node; config/ holds examples'),
        DeclareLaunchArgument('rviz_layout', default_value=layout, description='of RViz'),
        *(DeclareLaunchArgument(name, default_value='', description=(
            f'{key}; empty: as the configuration file says')) for name, key in KEYS.items()),
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

    set_here = {key: given(name) for name, key in KEYS.items() if given(name)}
    if given('page'):
        set_here['page.port'] = int(given('page'))
    namespace = given('namespace')
    recorded = [(topic, topic.lstrip('/')) for topic in RECORDED] if given('bag') else []
    found = [
        Node(package='handeye_ros', executable='calibrate', name='handeye', output='screen',
             namespace=namespace, remappings=recorded,
             # a file that says what the time is must not be overruled by a default
             parameters=[{'use_sim_time': is_true('use_sim_time')}, given('config'),
                         *([set_here] if set_here else [])])]
    if given('bag'):
        # it waits until the node subscribes
        found.append(Node(package='handeye_ros', executable='replay', name='replay',
                          output='screen', namespace=namespace,
                          # a node that starts on a busy machine takes its time to subscribe
                          arguments=[given('bag'), '--rate', given('rate'), '--timeout', '30'],
                          remappings=recorded))
    if is_true('rviz'):
        found.append(Node(package='rviz2', executable='rviz2', name='rviz2',
                          namespace=namespace, arguments=['-d', given('rviz_layout')],
                          remappings=[(topic, topic.lstrip('/')) for topic in SHOWN]))
    return found
