"""Messages that the node publishes: transform, features, markers."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, TransformStamped
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature, Sample
from handeye_ros.results.outcome import mounted, sensor_axes
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

FLANGES = ColorRGBA(r=0.5, g=0.5, b=0.5, a=1.0)
POINTS = ColorRGBA(r=1.0, g=0.6, b=0.0, a=1.0)
LINES = ColorRGBA(r=0.2, g=0.6, b=1.0, a=1.0)
TARGET = ColorRGBA(r=0.1, g=0.8, b=0.3, a=0.5)

EDGE = 0.1  # m of an edge that is drawn when the plate's size is unknown


def transform_stamped(calibration: Calibration, stamp: Time) -> TransformStamped:
    """Return the answer as a transform of the sensor in its parent frame."""
    msg = TransformStamped(child_frame_id=calibration.child_frame)
    msg.header = Header(stamp=stamp, frame_id=calibration.parent_frame)
    T = calibration.T_flange_sensor
    _set(msg.transform.translation, 'xyz', T[:3, 3])
    _set(msg.transform.rotation, 'xyzw', se3.quaternion(T))
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


def markers(samples: Sequence[Sample], calibration: Calibration | None, config: Config
            ) -> MarkerArray:
    """
    Return where the samples were taken and, once there is an answer, what they saw.

    All in the frame that the target rests in: the base, or the flange with eye_on_base.
    """
    in_hand = config.calibration_type == 'eye_in_hand'
    frame_id = config.robot_base_frame if in_hand else config.robot_effector_frame
    found = [Marker(action=Marker.DELETEALL)]
    if samples:
        poses = mounted(samples, config)
        found.append(_marker(Marker.SPHERE_LIST, FLANGES, 0.01, poses[:, :3, 3]))
    if samples and calibration:
        T_sensors = poses @ calibration.T_flange_sensor
        points = _seen(samples, T_sensors, config, _points)
        ends = _seen(samples, T_sensors, config, _ends)
        found.extend([_marker(Marker.POINTS, POINTS, 0.001, points)] if len(points) else [])
        found.extend([_marker(Marker.LINE_LIST, LINES, 0.0005, ends)] if len(ends) else [])
    if calibration:
        found.extend(_target(calibration.target, config))
    for number, marker in enumerate(found):
        marker.header.frame_id = frame_id
        marker.ns, marker.id = 'handeye', number
    return MarkerArray(markers=found)


def _seen(samples: Sequence[Sample], T_sensors: Array, config: Config, points_of: Any) -> Array:
    """Return points (n, 3) of all samples where the answer puts them."""
    parts = [se3.apply(T, _in_sensor(points_of(sample.features), config))
             for sample, T in zip(samples, T_sensors, strict=True)]
    return np.concatenate(parts)


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


def _target(target: Any, config: Config) -> list[Marker]:
    """Return the target as it was estimated."""
    if 'centre' in target:
        sphere = _marker(Marker.SPHERE, TARGET, 2 * target['radius'])
        _set(sphere.pose.position, 'xyz', [target['centre'][axis] for axis in 'xyz'])
        return [sphere]
    if 'pose' in target:
        length, width = config.target.size or (EDGE, EDGE)
        corner = np.array([[length, 0, 0], [0, 0, 0], [0, width, 0]], dtype=float)
        edges = _marker(Marker.LINE_STRIP, TARGET, 0.001, corner)
        pose = target['pose']
        _set(edges.pose.position, 'xyz', [pose['translation'][axis] for axis in 'xyz'])
        _set(edges.pose.orientation, 'xyzw', [pose['rotation'][axis] for axis in 'xyzw'])
        return [edges]
    return []


def _marker(kind: int, color: ColorRGBA, size: float, points: Iterable[Array] = ()) -> Marker:
    marker = Marker(type=kind, action=Marker.ADD, color=color)
    marker.pose.orientation.w = 1.0
    _set(marker.scale, 'xyz', (size, size, size))
    marker.points = [_set(Point(), 'xyz', point) for point in points]
    return marker


def _set(msg: Any, names: str, values: Iterable[float]) -> Any:
    for name, value in zip(names, values, strict=True):
        setattr(msg, name, float(value))
    return msg
