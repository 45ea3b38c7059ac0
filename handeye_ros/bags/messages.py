"""
Converts ROS messages to profiles and poses.

Imports no ROS: the functions take the messages of rclpy as well as those of rosbags. Malformed
messages of any kind raise MessageError and nothing else.
"""
from __future__ import annotations

from dataclasses import replace
from functools import cache
import math
import sys
from typing import Any

from handeye_ros.bags.contents import CLOUD, POSE
from handeye_ros.bags.points import (
    has_unit,
    median_of,
    ordered_points,
    require_one_plane,
    require_unit,
    returns,
    valid_columns,
)
from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.node.errors import MessageError
import numpy as np
from numpy.typing import NDArray

# sensor_msgs/PointField: datatype -> numpy
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}

INTENSITY = 'intensity'  # its field, if the driver publishes it

UNITS = {'m': 1.0, 'mm': 1e-3}

LARGEST_POSITION = 1e6  # m; poses in mm stay below, so that the solver can report the wrong unit
LENGTH_TOLERANCE = 1e-2  # of a quaternion's length


@cache
def typestore() -> Any:
    """Return the message types of ROS 2 Jazzy; the import is slow."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def deserialised(data: bytes, kind: str) -> Any:
    """Return a deserialised message, its arrays views of the bytes; MessageError."""
    try:
        return typestore().deserialize_cdr(memoryview(data), kind)
    except Exception as error:  # damaged bytes cause all kinds of errors in the parser
        raise MessageError(kind.rpartition('/')[2], f'damaged message: {error}') from error


def stamp_of(header: Any) -> int:
    """Return the stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def to_cdr(message: Any) -> bytes:
    """Return a serialised message of the typestore."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def profile_from_cdr(data: bytes, config: ProfileConfig) -> Profile:
    """Return the profile in a serialised sensor_msgs/PointCloud2; raises MessageError."""
    return profile_from_cloud(deserialised(data, CLOUD), config)


def row_of(cloud: Any, index: int) -> Any:
    """Return a row of a deserialised cloud as a cloud; raises MessageError."""
    size = cloud.width * cloud.point_step
    begin = index * (cloud.row_step or size)
    if index >= cloud.height or begin + size > len(cloud.data):
        raise MessageError('PointCloud2', f'damaged message: it has no row {index}')
    return replace(cloud, height=1, row_step=size, data=cloud.data[begin:begin + size])


def profile_from_cloud(msg: Any, config: ProfileConfig) -> Profile:
    """
    Return the profile in a sensor_msgs/PointCloud2, in metres, ordered along the line.

    A point with a value that is not finite, or that no sensor can measure, is no return: NaN in
    both columns. The rows of the message are concatenated. A cloud without points is a profile
    without returns. Raises MessageError.

    """
    if int(msg.width) * int(msg.height) == 0:
        return _empty(msg, config)
    points, good, valid_points = _points(msg, config)
    ordered = ordered_points(points, good, valid_points, _plane(config))
    return replace(_empty(msg, config), points=ordered, beside=median_of(valid_points[:, 2]))


def returns_from_cloud(msg: Any, config: ProfileConfig) -> Profile:
    """
    Return only the returns of a sensor_msgs/PointCloud2, in message order.

    With the intensity if there is a field of that name. The order along the line, which takes most
    of the time, is not determined. Raises MessageError.

    """
    if int(msg.width) * int(msg.height) == 0:
        return _empty(msg, config)
    _, good, valid_points = _points(msg, config)
    intensity = (_column(msg, INTENSITY)[good]
                 if INTENSITY in {str(field.name) for field in msg.fields} else None)
    return replace(_empty(msg, config), points=valid_points[:, :2], intensity=intensity)


def _empty(msg: Any, config: ProfileConfig) -> Profile:
    return Profile(stamp_of(msg.header), frame_name(msg.header.frame_id), np.empty((0, 2)),
                   (config.axes[0], config.axes[1]))


def _points(msg: Any, config: ProfileConfig) -> tuple[Array, NDArray[np.bool_], Array]:
    """
    Return the points (n, 3) of a cloud in metres, which are returns (n,), and the returns.

    Columns: along the line, range, across the plane. Raises MessageError.
    """
    columns = np.stack((_column(msg, config.axes[0]), _ranges(msg, config),
                        _off_plane(msg, config)))
    points = (columns * UNITS[config.unit]).T
    good = returns(points)
    valid_points = valid_columns(points, good)
    if not has_unit(points, valid_points):
        require_unit(points, config.unit)
    require_one_plane(valid_points, _plane(config))
    return points, good, valid_points


def require_layout(msg: Any, config: ProfileConfig) -> None:
    """Raise MessageError for a sensor_msgs/PointCloud2 whose points exceed its data."""
    if int(msg.width) * int(msg.height):
        for axis in config.axes:
            view_of(msg, axis[-1])


def frame_name(frame_id: str) -> str:
    """Return a frame name as in tf2, without the leading slash of ROS 1."""
    return sys.intern(str(frame_id).removeprefix('/'))  # it is in thousands of messages


def _plane(config: ProfileConfig) -> tuple[str, str, str]:
    """Return the axes along the line, of the range, and orthogonal to both, without signs."""
    along, across = (axis[-1] for axis in config.axes)
    return along, across, ({'x', 'y', 'z'} - {along, across}).pop()


def _off_plane(msg: Any, config: ProfileConfig) -> Array:
    """Return the coordinates orthogonal to the sensor plane (n,), NaN if missing."""
    try:
        return _column(msg, _plane(config)[2])
    except MessageError:
        return np.full(int(msg.width) * int(msg.height), np.nan)


def _ranges(msg: Any, config: ProfileConfig) -> Array:
    """Return the ranges of a cloud (n,), NaN for values that mark missing returns."""
    name = config.axes[1]
    values = _column(msg, name)
    for value in config.invalid:
        # the value of the driver: in its type, before the sign of the axis
        invalid = np.isclose(values, -value if name[0] == '-' else value, rtol=1e-6, atol=0.0)
        values[invalid] = np.nan
    return values


def _column(msg: Any, name: str) -> Array:
    """Return a field of a cloud, such as a signed axis (n,), as float64, unscaled."""
    with np.errstate(invalid='ignore'):  # a signalling NaN is a NaN
        values = view_of(msg, name.removeprefix('-')).astype(np.float64).ravel()
    return -values if name[0] == '-' else values


def view_of(msg: Any, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    """Return a field of a cloud (height, width) as a view of its data."""
    field = _field(msg, name)
    kind = DATATYPES.get(int(field.datatype))
    if kind is None:
        raise MessageError('PointCloud2', f'field "{field.name}" has datatype {field.datatype}, '
                           'which does not exist (they go from 1 to 8)')
    if int(field.count) > 1:
        raise MessageError('PointCloud2', f'field "{field.name}" holds {field.count} values for '
                           'each point, expected 1')
    dtype = np.dtype(('>' if msg.is_bigendian else '<') + kind)
    # Python integers: a product of the message's own would overflow before it can be checked
    height, width = int(msg.height), int(msg.width)
    point_step, row_step, data = _layout(msg, height, width)
    offset = int(field.offset)
    if offset + dtype.itemsize > point_step:
        raise MessageError('PointCloud2', f'field "{field.name}" ends at byte '
                           f'{offset + dtype.itemsize} of points that are {point_step} bytes long')
    return np.ndarray((height, width), dtype, data, offset, (row_step, point_step))


def _field(msg: Any, name: str) -> Any:
    named = [field for field in msg.fields if field.name == name]
    if len(named) != 1:
        names = ', '.join(str(field.name) for field in msg.fields) or 'none'
        raise MessageError('PointCloud2', f'{len(named) or "no"} fields are named "{name}" '
                           f'(fields: {names}); profile.axes says which axes are read')
    return named[0]


def _layout(msg: Any, height: int, width: int) -> tuple[int, int, Any]:
    """Return the steps in bytes and the buffer, extended to full length."""
    point_step, row_step = int(msg.point_step), int(msg.row_step)
    if height == 1 or row_step == 0:  # drivers often leave it unset
        row_step = width * point_step
    if point_step == 0:
        raise MessageError('PointCloud2', 'point_step is 0')
    if row_step < width * point_step:
        raise MessageError('PointCloud2', f'row_step is {row_step}, but a row of {width} points '
                           f'of {point_step} bytes takes {width * point_step}')
    needed = (height - 1) * row_step + width * point_step
    if len(msg.data) < needed:
        raise MessageError('PointCloud2', f'{height} x {width} points of {point_step} bytes take '
                           f'{needed} bytes, but data holds {len(msg.data)}')
    data = np.asarray(msg.data, np.uint8) if isinstance(msg.data, list) else msg.data
    return point_step, row_step, data


def pose_from_cdr(data: bytes) -> TimedPose:
    """Return the pose in a serialised geometry_msgs/PoseStamped; raises MessageError."""
    return pose_from_stamped(deserialised(data, POSE))


def pose_from_stamped(msg: Any) -> TimedPose:
    """Return the pose in a geometry_msgs/PoseStamped; raises MessageError."""
    return _pose('PoseStamped', msg.header, msg.pose.position, msg.pose.orientation)


def pose_from_transform(msg: Any) -> TimedPose:
    """Return the pose of the child in a geometry_msgs/TransformStamped; raises MessageError."""
    transform = msg.transform
    return _pose('TransformStamped', msg.header, transform.translation, transform.rotation)


def _pose(kind: str, header: Any, position: Any, rotation: Any) -> TimedPose:
    """Return a pose with a quaternion of unit length and qw >= 0; raises MessageError."""
    x, y, z = translation = [float(getattr(position, name)) for name in 'xyz']
    quaternion = [float(getattr(rotation, name)) for name in 'xyzw']
    norm = math.hypot(*quaternion)
    farthest = max(map(abs, translation))
    if not math.isfinite(norm + farthest + x + y + z):
        raise MessageError(kind, 'the pose holds values that are not finite')
    if farthest > LARGEST_POSITION:
        raise MessageError(kind, f'the position reaches {farthest:.3g} m')
    if abs(norm - 1.0) > LENGTH_TOLERANCE:
        raise MessageError(kind, f'quaternion of length {norm:.4g}, expected 1')
    scale = (-1.0 if quaternion[3] < 0 else 1.0) / norm
    return TimedPose(stamp_of(header), np.array(translation), np.array(quaternion) * scale,
                     frame_name(header.frame_id))
