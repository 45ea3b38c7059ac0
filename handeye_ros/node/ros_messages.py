# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""ROS messages of plain values, for all executables, and the QoS of those that stay."""
from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import Any

from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from handeye_ros import se3
from handeye_ros.data import Calibration
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def transform_of(calibration: Calibration, stamp: int) -> TransformStamped:
    """Return the message of T_flange_sensor, the sensor in the parent frame; stamp: ns."""
    T = calibration.T_flange_sensor
    return transform_stamped(T[:3, 3], se3.quaternion(T), calibration.parent_frame,
                             calibration.child_frame, stamp)


def transform_stamped(translation: Iterable[float], rotation: Iterable[float], parent: str,
                      child: str, stamp: int) -> TransformStamped:
    """
    Return the message of T_parent_child, which maps points of the child frame to the parent.

    translation: x, y, z (m); rotation: the quaternion x, y, z, w; stamp: ns.
    """
    T = Transform(translation=xyz_message(Vector3, translation),
                  rotation=xyz_message(Quaternion, rotation))
    return TransformStamped(header=header_of(stamp, parent), child_frame_id=child, transform=T)


def pose_stamped(translation: Iterable[float], rotation: Iterable[float], frame_id: str,
                 stamp: int) -> PoseStamped:
    """Return a pose (x y z in m, quaternion x y z w) in a frame; stamp: ns."""
    return PoseStamped(header=header_of(stamp, frame_id), pose=Pose(
        position=xyz_message(Point, translation), orientation=xyz_message(Quaternion, rotation)))


def header_of(stamp: int, frame_id: str) -> Header:
    """Return the header of a message; stamp: ns."""
    return Header(stamp=Time(nanoseconds=stamp).to_msg(), frame_id=frame_id)


def cloud(points: NDArray[Any], frame_id: str, stamp: int) -> PointCloud2:
    """
    Return the message of points in a frame.

    points: structured array (n,), whose fields are float32, such as x, y and z (m); stamp: ns.
    """
    return PointCloud2(
        header=header_of(stamp, frame_id), height=1, width=len(points),
        point_step=points.itemsize, row_step=points.nbytes, is_dense=True,
        fields=[PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                for k, name in enumerate(points.dtype.names or ())],
        data=array('B', points.tobytes()))


def xyz_message(message_type: Any, values: Iterable[float]) -> Any:
    """Return a message with the fields x, y, z (and w)."""
    return message_type(**dict(zip('xyzw', map(float, values))))  # noqa: B905 - three or four
