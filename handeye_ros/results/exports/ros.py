"""A calibration as ROS takes it: a joint of a URDF, and static_transform_publisher."""
from __future__ import annotations

import shlex
from xml.sax.saxutils import quoteattr

from handeye_ros import se3
from handeye_ros.data import Calibration
from handeye_ros.results.exports.format import (
    commented,
    numbers,
    position,
    preamble,
    quaternion,
)

URDF = """\
<?xml version="1.0"?>
<!--
{comment}
Include it in the description of the robot, which has the link {parent} already.
-->
<robot name={robot} xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name={child}/>
  {joint}
</robot>
"""

JOINT = """\
<joint name={name} type="fixed">
    <parent link={parent}/>
    <child link={child}/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
  </joint>"""

LAUNCH = '''\
"""Publishes the pose of the sensor on /tf_static: ros2 launch {file}."""
{comment}from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(package='tf2_ros', executable='static_transform_publisher', name={name!r},
             arguments=[{arguments}]),
    ])
'''
LAUNCH_FILE = 'static_transform.launch.py'


def joint(calibration: Calibration) -> str:
    """Return the <joint> of a URDF that holds the calibration."""
    parent, child = calibration.parent_frame, calibration.child_frame
    return JOINT.format(name=quoteattr(f'{parent}_to_{child}'), parent=quoteattr(parent),
                        child=quoteattr(child), xyz=numbers(position(calibration)),
                        rpy=numbers(se3.rpy(calibration.T_flange_sensor)))


def urdf(calibration: Calibration) -> str:
    """Return a URDF that holds the sensor's link and its joint; xacro can include it."""
    # two dashes would end an XML comment
    comment = '\n'.join(preamble(calibration)).replace('--', '- -')
    return URDF.format(comment=comment, parent=calibration.parent_frame.replace('--', '- -'),
                       robot=quoteattr(calibration.name), joint=joint(calibration),
                       child=quoteattr(calibration.child_frame))


def arguments(calibration: Calibration) -> list[str]:
    """Return the arguments of static_transform_publisher, each by its name."""
    values = {**dict(zip(('x', 'y', 'z'), position(calibration), strict=True)),
              **dict(zip(('qx', 'qy', 'qz', 'qw'), quaternion(calibration), strict=True))}
    return [word for name, value in values.items() for word in (f'--{name}', repr(float(value)))
            ] + ['--frame-id', calibration.parent_frame,
                 '--child-frame-id', calibration.child_frame]


def command(calibration: Calibration) -> str:
    """Return the shell line that publishes the calibration on /tf_static."""
    return 'ros2 run tf2_ros static_transform_publisher ' + shlex.join(arguments(calibration))


def shell(calibration: Calibration) -> str:
    """Return a shell script of that line."""
    return f'#!/bin/sh\n{commented(calibration)}exec {command(calibration)}\n'


def launch(calibration: Calibration) -> str:
    """Return a launch file that publishes the calibration on /tf_static."""
    words = arguments(calibration)
    lines = ',\n                        '.join(
        f'{name!r}, {value!r}' for name, value in zip(words[::2], words[1::2], strict=True))
    return LAUNCH.format(file=LAUNCH_FILE, comment=commented(calibration), arguments=lines,
                         name=node_name(calibration.child_frame))


def node_name(frame: str) -> str:
    """Return a name of a node, of letters, digits and underscores, that publishes a frame."""
    allowed = ''.join(c if c.isascii() and c.isalnum() else '_' for c in frame)
    return f'publish_{allowed}'
