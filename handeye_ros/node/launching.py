# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What launch files share: arguments, and the replay of a recording. For `ros2 launch` alone."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from handeye_ros.errors import InputError
from launch import LaunchContext
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

KEYS = {  # of the configuration, by the names of their arguments
    'profile_topic': 'profile_topic', 'pose_topic': 'pose_topic', 'pose_source': 'pose_source',
    'base_frame': 'robot_base_frame', 'effector_frame': 'robot_effector_frame'}
ARGUMENTS = {
    'namespace': ('', 'namespace of all that is started'),
    'bag': ('', 'a recording to replay: a rosbag2 folder, or an .mcap or .db3 file'),
    'rate': ('1.0', 'speed of the replay; 1: as recorded'),
    'use_sim_time': ('false', 'take the time from /clock'),
}
RECORDED = ('/profile', '/flange_pose')  # in a bag; in a namespace, both sides move into it
TRUTHS = {'true': True, '1': True, 'false': False, '0': False}


def declared(keys: Mapping[str, str], source: str, others: Mapping[str, tuple[object, str]]
             ) -> list[DeclareLaunchArgument]:
    """
    Return arguments: keys of the configuration, others, and ARGUMENTS; `replayed` reads these.

    keys: by the names of their arguments; source: where a key is looked up that is not given;
    others: default and description.
    """
    texts = {name: ('', f'{key}; empty: as the {source} says') for name, key in keys.items()}
    return [DeclareLaunchArgument(name, default_value=value, description=description)
            for name, (value, description) in {**texts, **others, **ARGUMENTS}.items()]


def values_given(context: LaunchContext, keys: Mapping[str, str]) -> dict[str, str]:
    """Return the values of the keys whose arguments are given."""
    return {key: value for name, key in keys.items() if (value := given(context, name))}


def given(context: LaunchContext, name: str) -> str:
    """Return the value of an argument."""
    return str(LaunchConfiguration(name).perform(context))


def file_given(context: LaunchContext, name: str) -> str:
    """Return the absolute path of a file of an argument; raises InputError if it is missing."""
    path = Path(given(context, name)).expanduser().absolute()
    if not path.is_file():  # launch_ros would go on without it
        raise InputError(f'{name} is "{given(context, name)}", and there is no file {path}')
    return str(path)


def is_true(context: LaunchContext, name: str) -> bool:
    """Return whether an argument says true; raises InputError if it says neither."""
    word = given(context, name)
    if word.lower() not in TRUTHS:
        raise InputError(f'{name} is "{word}", expected true or false')
    return TRUTHS[word.lower()]


def remappings(context: LaunchContext) -> list[tuple[str, str]]:
    """Return the remappings of the topics of a recording, where one is replayed."""
    return [(topic, topic.lstrip('/')) for topic in RECORDED] if given(context, 'bag') else []


def replayed(context: LaunchContext) -> list[Node]:
    """Return the node that replays a recording, where one is asked for."""
    if not given(context, 'bag'):
        return []
    # it waits until a node subscribes, which on a busy machine takes its time
    return [Node(package='handeye_ros', executable='replay', name='replay', output='screen',
                 namespace=given(context, 'namespace'), remappings=remappings(context),
                 arguments=[given(context, 'bag'), '--rate', given(context, 'rate'),
                            '--timeout', '30'])]
