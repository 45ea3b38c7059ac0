"""Writes profiles and poses as a rosbag2 folder (mcap), as a driver and a robot would."""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.results import folder
from handeye_ros.results import truth_file as truth_file
from handeye_ros.ros.bags.contents import CLOUD, full_name, JOINTS, POSE
from handeye_ros.ros.bags.messages import DATATYPES, UNITS
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)

# The points of real drivers: dtypes with the fields x, y and z.
LAYOUTS: dict[str, np.dtype[Any]] = {
    'xyz': np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4')]),
    'double': np.dtype([('x', '<f8'), ('y', '<f8'), ('z', '<f8')]),
    'big_endian': np.dtype([('x', '>f4'), ('y', '>f4'), ('z', '>f4')]),
    'padded': np.dtype({'names': ['x', 'y', 'z', 'intensity'], 'formats': ['<f4'] * 4,
                        'offsets': [0, 4, 8, 16], 'itemsize': 32}),
    'scancontrol': np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('intensity', '<u2'),
                             ('reflection_width', '<u2'), ('threshold', '<u2'),
                             ('moment0', '<u4'), ('moment1', '<u4')]),
}


def write(path: Path, profiles: Iterable[Profile], poses: Iterable[TimedPose],
          config: Config | None = None, *, truth: Mapping[str, Any] | None = None,
          tables: Mapping[str, str] | None = None, layout: str = 'xyz', force: bool = False,
          joints: Sequence[tuple[int, Array]] = ()) -> None:
    """
    Write a rosbag2 folder, with truth.yaml in it when the truth is given.

    config: gives the topics and the unit of the coordinates; tables: texts of other files in the
    folder, by name; layout: a key of LAYOUTS. force: an existing bag is replaced. joints: stamps
    and values of joint_1, joint_2, ... Raises BagError when there is something at path already,
    UnwritableError when it cannot be made.

    """
    texts = dict(tables or {})
    if truth is not None:
        texts[truth_file.NAME] = truth_file.text(truth)
    folder.write(path, texts, lambda made: _write_messages(
        made, profiles, poses, config or Config(), LAYOUTS[layout], joints), force)


def _write_messages(path: Path, profiles: Iterable[Profile], poses: Iterable[TimedPose],
                    config: Config, dtype: np.dtype[Any], joints: Sequence[tuple[int, Array]]
                    ) -> None:
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        clouds = writer.add_connection(full_name(config.profile_topic), CLOUD,
                                       typestore=TYPES)
        stamped = writer.add_connection(full_name(config.pose_topic), POSE, typestore=TYPES)
        items: list[Profile | TimedPose] = [*profiles, *poses]
        for item in sorted(items, key=lambda item: item.stamp):
            writer.write(clouds if isinstance(item, Profile) else stamped, item.stamp,
                         serialised(item, dtype, config.profile.unit))
        if joints:
            _write_joints(writer, full_name(config.joint_topic), joints)


def _write_joints(writer: Writer, topic: str, joints: Sequence[tuple[int, Array]]) -> None:
    connection = writer.add_connection(topic, JOINTS, typestore=TYPES)
    state, nothing = TYPES.types[JOINTS], np.zeros(0)
    for stamp, values in joints:
        names = [f'joint_{k}' for k in range(1, len(values) + 1)]
        message = state(_header(TYPES, stamp, ''), names, values, nothing, nothing)
        writer.write(connection, stamp, bytes(TYPES.serialize_cdr(message, JOINTS)))


def serialised(item: Profile | TimedPose, dtype: np.dtype[Any], unit: str) -> bytes:
    """Return the message of a profile, its points laid out and in a unit, or of a pose."""
    if isinstance(item, Profile):
        return bytes(TYPES.serialize_cdr(_cloud(TYPES, item, dtype, unit), CLOUD))
    return bytes(TYPES.serialize_cdr(_pose_stamped(TYPES, item), POSE))


def cloud_cdr(profile: Profile, config: Config) -> bytes:
    """Return a profile as a serialised sensor_msgs/PointCloud2, with no digit lost."""
    types = _types()
    cloud = _cloud(types, profile, LAYOUTS['double'], config.profile.unit)
    return bytes(types.serialize_cdr(cloud, 'sensor_msgs/msg/PointCloud2'))


@cache
def _types() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


def _header(types: Any, stamp: int, frame_id: str) -> Any:
    time = types.types['builtin_interfaces/msg/Time'](*divmod(stamp, 1_000_000_000))
    return types.types['std_msgs/msg/Header'](time, frame_id)


def _cloud(types: Any, profile: Profile, dtype: np.dtype[Any], unit: str) -> Any:
    points = np.zeros(len(profile.points), dtype)
    for axis, column in zip(profile.axes, _columns(profile, unit), strict=True):
        points[axis[-1]] = column
    point_field = types.types['sensor_msgs/msg/PointField']
    codes = {name: code for code, name in DATATYPES.items()}
    fields = [point_field(name, offset, codes[kind.str[1:]], 1)
              for name, (kind, offset, *_) in (dtype.fields or {}).items()]
    size = dtype.itemsize * len(points)
    return types.types['sensor_msgs/msg/PointCloud2'](
        _header(types, profile.stamp, profile.frame_id), 1, len(points), fields,
        dtype['x'].byteorder == '>', dtype.itemsize, size, points.view(np.uint8).ravel(),
        bool(np.isfinite(profile.points).all()))


def _columns(profile: Profile, unit: str) -> Array:
    """Return the coordinates (2, n) along the unsigned axes of the message, in its unit."""
    signs = np.array([-1.0 if axis[0] == '-' else 1.0 for axis in profile.axes])
    return np.asarray((profile.points * signs).T / UNITS[unit])


def _pose_stamped(types: Any, pose: TimedPose) -> Any:
    point = types.types['geometry_msgs/msg/Point'](*map(float, pose.translation))
    quaternion = types.types['geometry_msgs/msg/Quaternion'](*map(float, pose.quaternion))
    return types.types['geometry_msgs/msg/PoseStamped'](
        _header(types, pose.stamp, pose.parent_frame),
        types.types['geometry_msgs/msg/Pose'](point, quaternion))
