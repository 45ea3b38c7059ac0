"""Messages that the node publishes of the answer and of a sample; scene.py has the markers."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TransformStamped
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature, Sample
from handeye_ros.results.outcome import sensor_axes
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def transform_stamped(calibration: Calibration, stamp: Time) -> TransformStamped:
    """Return the answer as a transform of the sensor in its parent frame."""
    msg = TransformStamped(child_frame_id=calibration.child_frame)
    msg.header = Header(stamp=stamp, frame_id=calibration.parent_frame)
    T = calibration.T_flange_sensor
    _set(msg.transform.translation, 'xyz', T[:3, 3])
    _set(msg.transform.rotation, 'xyzw', se3.quaternion(T))
    return msg


def pose_stamped(translation: Sequence[float], rotation: Sequence[float], frame_id: str,
                 stamp: Time) -> PoseStamped:
    """Return a pose (x y z, quaternion x y z w) in a frame."""
    msg = PoseStamped(header=Header(stamp=stamp, frame_id=frame_id))
    _set(msg.pose.position, 'xyz', translation)
    _set(msg.pose.orientation, 'xyzw', rotation)
    return msg


def feature_cloud(sample: Sample, config: Config, frame_id: str) -> PointCloud2:
    """Return the points that stand for a sample's features, in the sensor's frame."""
    points = _in_sensor(_points(sample.features) + _ends(sample.features), config)
    names = ('x', 'y', 'z')
    sec, nanosec = divmod(sample.stamp, 1_000_000_000)
    return PointCloud2(
        header=Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame_id),
        height=1, width=len(points), point_step=12, row_step=12 * len(points), is_dense=True,
        fields=[PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
                for i, name in enumerate(names)],
        data=points.astype('<f4').tobytes())


def _points(features: Iterable[Feature]) -> list[Array]:
    """Return the edge points and the points of arcs, each (2,) in the sensor plane."""
    points = [f.point for f in features if isinstance(f, EdgePoint)]
    return points + [p for f in features if isinstance(f, Arc) for p in f.points]


def _ends(features: Iterable[Feature]) -> list[Array]:
    """Return two points (2,) for each face line, two spreads from its centre."""
    return [f.centre + side * f.spread * f.direction
            for f in features if isinstance(f, FaceLine) for side in (-2, 2)]


def _in_sensor(points: Sequence[Array], config: Config) -> Array:
    """Return points (n, 3) of the sensor's frame."""
    plane = np.array(points).reshape(-1, 2)
    return plane @ sensor_axes(config)[:3, [0, 2]].T


def _set(msg: Any, names: str, values: Iterable[float]) -> Any:
    for name, value in zip(names, values, strict=True):
        setattr(msg, name, float(value))
    return msg
