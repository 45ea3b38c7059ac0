"""
ROS messages to profiles and poses: the one home of message conversion.

Nothing here imports ROS: the functions take the messages of rclpy and those that rosbags
deserialises alike. What comes in may be malformed in any way; every such message raises
MessageError and nothing else.
"""
from __future__ import annotations

from dataclasses import replace
from functools import cache
import math
import sys
from typing import Any

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.ros.bags.contents import CLOUD, POSE
from handeye_ros.ros.bags.points import (
    along_the_line,
    chosen,
    middle,
    require_one_plane,
    require_unit,
    returns,
    surely_of_unit,
)
from handeye_ros.ros.errors import MessageError
import numpy as np
from numpy.typing import NDArray

# sensor_msgs/PointField: datatype -> numpy
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}

INTENSITY = 'intensity'  # the field of it, where a driver gives it

UNITS = {'m': 1.0, 'mm': 1e-3}

LARGEST_POSITION = 1e6  # m; a robot in mm stays below, so that the solver can name that error
LENGTH_TOLERANCE = 1e-2  # of a quaternion's length


@cache
def typestore() -> Any:
    """Return the types of messages of ROS 2 Jazzy; their import takes long."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def deserialised(data: bytes, kind: str) -> Any:
    """Return a serialised message of a type, its arrays views of the bytes; MessageError."""
    try:
        return typestore().deserialize_cdr(memoryview(data), kind)
    except Exception as error:  # damaged bytes lead the parser to errors of all kinds
        raise MessageError(kind.rpartition('/')[2], f'damaged message: {error}') from error


def stamp_of(header: Any) -> int:
    """Return the stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def to_cdr(message: Any) -> bytes:
    """Return a message of the typestore as it is serialised."""
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
    Return the profile in a sensor_msgs/PointCloud2, in metres and in the order of the line.

    A point with any value that is not finite, or that cannot be measured, is no return: NaN in
    both columns; rows of the message follow each other. A cloud without points is a profile
    without returns. Raises MessageError.

    """
    if int(msg.width) * int(msg.height) == 0:
        return _empty(msg, config)
    points, good, seen = _points(msg, config)
    return replace(_empty(msg, config), points=along_the_line(points, good, seen, _plane(config)),
                   beside=middle(seen[:, 2]))


def returns_from_cloud(msg: Any, config: ProfileConfig) -> Profile:
    """
    Return the returns alone of a sensor_msgs/PointCloud2, in the order of the message.

    With the intensity where there is a field of that name. For what asks for points and not for
    their order along the line, which is most of the work. Raises MessageError.

    """
    if int(msg.width) * int(msg.height) == 0:
        return _empty(msg, config)
    _, good, seen = _points(msg, config)
    intensity = (_column(msg, INTENSITY)[good]
                 if INTENSITY in {str(field.name) for field in msg.fields} else None)
    return replace(_empty(msg, config), points=seen[:, :2], intensity=intensity)


def _empty(msg: Any, config: ProfileConfig) -> Profile:
    return Profile(stamp_of(msg.header), frame_name(msg.header.frame_id), np.empty((0, 2)),
                   (config.axes[0], config.axes[1]))


def _points(msg: Any, config: ProfileConfig) -> tuple[Array, NDArray[np.bool_], Array]:
    """
    Return the points (n, 3) of a cloud in metres, which of them are returns (n,), and those.

    Columns: along the line, range, across the plane. Raises MessageError.
    """
    columns = np.stack((_column(msg, config.axes[0]), _ranges(msg, config), _beside(msg, config)))
    points = (columns * UNITS[config.unit]).T
    good = returns(points)
    seen = chosen(points, good)
    if not surely_of_unit(points, seen):
        require_unit(points, config.unit)
    require_one_plane(seen, _plane(config))
    return points, good, seen


def require_layout(msg: Any, config: ProfileConfig) -> None:
    """Refuse a sensor_msgs/PointCloud2 whose points do not lie in its data (MessageError)."""
    if int(msg.width) * int(msg.height):
        for axis in config.axes:
            view_of(msg, axis[-1])


def frame_name(frame_id: str) -> str:
    """Return the name of a frame as tf2 has it, without the slash of ROS 1."""
    return sys.intern(str(frame_id).removeprefix('/'))  # it comes thousands of times


def _plane(config: ProfileConfig) -> tuple[str, str, str]:
    """Return the axes along the line, of the range and across the plane, without signs."""
    along, across = (axis[-1] for axis in config.axes)
    return along, across, ({'x', 'y', 'z'} - {along, across}).pop()


def _beside(msg: Any, config: ProfileConfig) -> Array:
    """Return the coordinates across the sensor plane (n,), NaN where the message has none."""
    try:
        return _column(msg, _plane(config)[2])
    except MessageError:
        return np.full(int(msg.width) * int(msg.height), np.nan)


def _ranges(msg: Any, config: ProfileConfig) -> Array:
    """Return the ranges of a cloud (n,), NaN where they are values that mean no return."""
    name = config.axes[1]
    values = _column(msg, name)
    for value in config.invalid:
        # as the driver has it: in its type, before the sign of the axis
        invalid = np.isclose(values, -value if name[0] == '-' else value, rtol=1e-6, atol=0.0)
        values[invalid] = np.nan
    return values


def _column(msg: Any, name: str) -> Array:
    """Return a field of a cloud, such as a signed axis (n,), as float64 as it is sent."""
    with np.errstate(invalid='ignore'):  # a signalling NaN is a NaN
        values = view_of(msg, name.removeprefix('-')).astype(np.float64).ravel()
    return -values if name[0] == '-' else values


def view_of(msg: Any, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    """Return a field of a cloud (height, width), as it lies in its data."""
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
    """Return the steps in bytes and the buffer, which is long enough for all points."""
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
