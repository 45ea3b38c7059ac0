# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Converts serialised ROS messages to profiles and poses.

Drivers differ. Deviations are corrected where possible; else the message is refused with an
UnusableMessageError, and nothing else, whose sentence names the setting to change, where one
helps. Refused are: data that are no message (`message_of`) or lack a row (`_row`); poses that are
not finite, too far, or no rotation (`_pose`); a field that is missing, stands twice, has several
numbers or an unknown type, and points and rows that do not fit into the data (`field_view`);
coordinates in another unit, off one plane, or of exchanged axes (`_require_...`); several profiles
without profile.period, where the time of each counts (`returns_of`).

Messages are read by rosbags, which needs no ROS: their attributes are those of ROS.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache, partial
import math
from typing import Any

from handeye_ros.arithmetic import rms
from handeye_ros.bags.storage import CLOUD_TYPE, POSE_TYPE, TF_TYPE
from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, column_order, NS, Profile, RawProfile, TimedPose
from handeye_ros.errors import UnusableMessageError
from handeye_ros.units import UNITS
import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

# sensor_msgs/PointField: datatype -> numpy
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
INTENSITY = 'intensity'  # its field, if the driver publishes it

MAX_POSITION = 1e6  # m; poses in mm stay below, so that the solver can report the wrong unit
MESSAGE_QUATERNION_TOLERANCE = 1e-2  # of a quaternion's length

# No line profiler measures this far (m): a larger coordinate is no return. If most are larger, or
# with mm all are smaller than ALL_TOO_NEAR, the unit is wrong.
MAX_COORDINATE = 10.0
NO_RETURN = 1e9  # coordinates beyond it, such as the largest float, are those of no return
ALL_TOO_NEAR = 1e-3
MAX_THICKNESS = 2e-3  # m: largest distance of the points of a profile from its plane
MIN_TILT, MIN_SLOPE = 2e-4, 0.01  # m, slope: less across the plane is no tilt of it
THIN_SHARE = 0.01  # of the spread across the plane: an axis with less is orthogonal to it
MIN_RETURNS = 10  # smallest number of returns for a decision on their order
# fraction of backward steps between returns: at most along the line, at least along the range
LINE_BACKWARD, RANGE_BACKWARD = 0.05, 0.1

MIN_OVERLAP = 0.5  # smallest common fraction of the line in rows that are profiles
MIN_COLUMNS = 10  # of rows that are compared
# share of a message's time before its stamp
SHARE_BEFORE_STAMP = {'first': 0.0, 'middle': 0.5, 'last': 1.0}

CHECK_PERIOD = NS  # between two profiles whose points are checked,
CHECK_COUNT = 100  # or so many messages, where these have no stamp
MESSAGE_OVERHEAD = 600  # bytes of memory for a message, without its data


@cache
def typestore() -> Typestore:
    """Return the message types of ROS 2: those read here are the same in all its releases."""
    return get_typestore(Stores.ROS2_DASHING)  # 35 ms; Jazzy, with five more, takes 55


def message_of(message_type: str, data: bytes) -> Any:
    """Return a serialised message of a type; raises UnusableMessageError if it is damaged."""
    try:
        return typestore().deserialize_cdr(data, message_type)
    except SerdeError as error:
        name = message_type.rpartition('/')[2]
        raise UnusableMessageError(f'{name} message not used: damaged message: {error}') from error


def stamp_and_frame(message: Any) -> tuple[int, str]:
    """Return the stamp (ns) and the frame in the header of a message."""
    header = message.header
    return header.stamp.sec * NS + header.stamp.nanosec, frame_name(header.frame_id)


@lru_cache(100)  # it is in thousands of messages
def frame_name(frame_id: str) -> str:
    """Return a frame name as in tf2, without the leading slash of ROS 1; one line of text."""
    return ''.join(filter(str.isprintable, frame_id.removeprefix('/')))


def pose_from_cdr(data: bytes) -> TimedPose:
    """Return the pose in a geometry_msgs/PoseStamped; raises UnusableMessageError."""
    message = message_of(POSE_TYPE, data)
    return _pose('PoseStamped', message, message.pose.position, message.pose.orientation)


def _pose(kind: str, message: Any, position: Any, orientation: Any) -> TimedPose:
    """
    Return a pose (m), its quaternion of unit length with w >= 0.

    kind: of the message, in words; position, orientation: its fields. Raises UnusableMessageError.
    """
    translation = position.x, position.y, position.z
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    length, farthest = math.hypot(*quaternion), max(map(abs, translation))
    if not math.isfinite(length + sum(translation)):
        problem = 'the pose holds values that are not finite'
    elif farthest > MAX_POSITION:
        problem = f'the position reaches {farthest:.3g} m'
    elif abs(length - 1.0) > MESSAGE_QUATERNION_TOLERANCE:
        problem = f'quaternion of length {length:.4g}, expected 1'
    else:
        stamp, frame = stamp_and_frame(message)
        sign = -1.0 if orientation.w < 0 else 1.0
        return TimedPose(stamp, np.array(translation), quaternion * (sign / length), frame)
    raise UnusableMessageError(f'{kind} message not used: {problem}')


def transforms_from_cdr(data: bytes) -> list[tuple[str, TimedPose]]:
    """
    Return the child frames and poses of the valid transforms in a tf2_msgs/TFMessage.

    Raises UnusableMessageError if all are invalid: an unused invalid frame must not affect the
    others.
    """
    poses, refusal = [], None
    for stamped in message_of(TF_TYPE, data).transforms:
        transform = stamped.transform
        try:
            poses.append((frame_name(stamped.child_frame_id), _pose(
                'TransformStamped', stamped, transform.translation, transform.rotation)))
        except UnusableMessageError as error:
            refusal = error
    if refusal and not poses:
        raise refusal
    return poses


def _cloud_error(reason: str) -> UnusableMessageError:
    """Return the error of a PointCloud2 that is not used."""
    return UnusableMessageError(f'PointCloud2 message not used: {reason}')


def field_values(cloud: Any, name: str) -> Array:
    """
    Return a field of a PointCloud2, such as a signed axis (n,), as float64, unscaled.

    Raises UnusableMessageError.
    """
    with np.errstate(invalid='ignore'):  # a signalling NaN is a NaN
        values = field_view(cloud, name.removeprefix('-')).astype(np.float64).ravel()
    return -values if name[0] == '-' else values


def field_view(cloud: Any, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    """
    Return a field (height, width) of a PointCloud2 as a view of its data.

    Raises UnusableMessageError.
    """
    usable = [field for field in cloud.fields
              if field.name == name and field.datatype in DATATYPES and field.count <= 1]
    if len(usable) != 1:
        names = ', '.join(field.name for field in cloud.fields) or 'none'
        raise _cloud_error(
            f'{len(usable) or "no"} fields are named "{name}" and hold one number for each point '
            f'(fields: {names}); profile.axes says which axes are read')
    field, = usable
    dtype = np.dtype(('>' if cloud.is_bigendian else '<') + DATATYPES[field.datatype])
    height, width, point_step = cloud.height, cloud.width, cloud.point_step
    if height * width == 0:
        return np.empty((height, width), dtype)
    least = width * point_step
    row_step = least if height == 1 else cloud.row_step or least  # drivers often leave it unset
    if (field.offset + dtype.itemsize > point_step or row_step < least
            or (height - 1) * row_step + least > len(cloud.data)):
        raise _cloud_error(
            f'{height} x {width} points of {point_step} bytes, in rows of {row_step} bytes, with '
            f'the field "{name}" at byte {field.offset}, do not fit into {len(cloud.data)} bytes '
            'of data')
    return np.ndarray((height, width), dtype, cloud.data, field.offset, (row_step, point_step))


def _row(cloud: Any, index: int) -> Any:
    """Return one row of a PointCloud2 as a cloud; raises UnusableMessageError."""
    size = cloud.width * cloud.point_step
    begin = index * (cloud.row_step or size)
    if index >= cloud.height or begin + size > len(cloud.data):
        raise _cloud_error(f'damaged message: it has no row {index}')
    return replace(cloud, height=1, row_step=size, data=cloud.data[begin:begin + size])


def profile_from_cdr(data: bytes, config: ProfileConfig) -> Profile:
    """Return the profile in a sensor_msgs/PointCloud2; raises UnusableMessageError."""
    return profile_from_cloud(message_of(CLOUD_TYPE, data), config)


def profile_from_cloud(cloud: Any, config: ProfileConfig) -> Profile:
    """
    Return the profile in a PointCloud2, in metres, ordered along the line.

    A point with a value that is not finite, or that no sensor can measure, is no return: NaN in
    both columns. The rows of the message are concatenated. A cloud without points is a profile
    without returns. Raises UnusableMessageError.
    """
    points, is_return = _points(cloud, config)
    _require_axes(points[is_return, :2], config)
    x = points[:, 0]
    order = column_order(np.where(np.abs(x) <= MAX_COORDINATE, x, np.nan), is_return)
    points, is_return = points[order], is_return[order]
    out_of_plane = np.nan_to_num(points[is_return, 2].mean()) if is_return.any() else 0.0
    return Profile(*stamp_and_frame(cloud), np.where(is_return[:, None], points[:, :2], np.nan),
                   (config.axes[0], config.axes[1]), float(out_of_plane))


def _axes(config: ProfileConfig) -> tuple[str, str, str]:
    """Return the axes along the line, of the range, and orthogonal to both, without signs."""
    line_axis, range_axis = (axis[-1] for axis in config.axes)
    return line_axis, range_axis, ({'x', 'y', 'z'} - {line_axis, range_axis}).pop()


def _points(cloud: Any, config: ProfileConfig) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the points (n, 3) of a PointCloud2 in metres, and which are returns (n,).

    Columns: along the line, range, across the plane (NaN where the driver publishes none). Points
    that are not finite, too far, or in the origin are no returns; drivers publish the origin for
    missing returns. Raises UnusableMessageError for another unit or plane, or a missing field.
    """
    if cloud.width * cloud.height == 0:
        return np.empty((0, 3)), np.empty(0, bool)
    range_axis, normal_axis = config.axes[1], _axes(config)[2]
    along, ranges = field_values(cloud, config.axes[0]), field_values(cloud, range_axis)
    for value in config.invalid:
        # the value of the driver: in its type, before the sign of the axis
        value = -value if range_axis[0] == '-' else value
        ranges[np.isclose(ranges, value, rtol=1e-6, atol=0.0)] = np.nan
    out_of_plane = (field_values(cloud, normal_axis)
                    if normal_axis in [field.name for field in cloud.fields]
                    else np.full(len(ranges), np.nan))
    points = (np.stack((along, ranges, out_of_plane)) * UNITS['m'][config.unit]).T
    points[np.abs(points) > NO_RETURN] = np.nan
    x, z = points[:, 0], points[:, 1]
    with np.errstate(invalid='ignore'):
        is_return = (np.maximum(np.abs(x), np.abs(z)) <= MAX_COORDINATE) & (
            (x != 0) | (z != 0))
    _require_unit(points[:, :2], config.unit)
    _require_one_plane(points[is_return], _axes(config))
    return points, is_return


def _require_unit(points: Array, unit: str) -> None:
    """Raise for coordinates (n, 2), by `unit` in metres, that no sensor measures."""
    reach = np.maximum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    finite = np.isfinite(reach)
    too_far = finite & (reach > MAX_COORDINATE)
    # ranges of one value, at other places along the line than a wrong unit gives, are no returns
    x, z = points[too_far].T
    is_marker = too_far.any() and np.ptp(z) == 0 and (
        np.ptp(x) == 0 or np.abs(x).max() <= MAX_COORDINATE)
    if too_far.sum() > finite.sum() / 2 and not is_marker:
        raise _cloud_error(f'coordinates reach {reach[too_far].max():.3g} m' + (
            ': set profile.unit to mm' if unit == 'm' else ', but profile.unit is m or mm'))
    largest = reach[finite & ~too_far].max(initial=0.0)
    if unit == 'mm' and 0.0 < largest < ALL_TOO_NEAR:
        raise _cloud_error(f'no coordinate is larger than {largest * 1e3:.3g} mm: set '
                           'profile.unit to m')


def _require_one_plane(points: Array, axes: tuple[str, str, str]) -> None:
    """
    Raise for returns (n, 3) outside the plane of the first two axes.

    axes: names of the columns: along the line, range, across the plane.
    """
    if len(points) < 2 or not np.ptp(points[:, 2]) > MIN_TILT:  # nor where it is not finite
        return
    spread = np.ptp(points, axis=0)
    centred = points - points.mean(axis=0)
    slopes, *_ = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)
    distance_rms, thin = rms(centred[:, 2] - centred[:, :2] @ slopes), THIN_SHARE * spread[2]
    is_flat = min(spread[:2]) < thin  # one of the two axes is orthogonal to the plane
    is_tilted = abs(slopes[1]) > MIN_SLOPE and distance_rms < thin and not is_flat
    if is_tilted or spread[2] > MAX_THICKNESS:
        flat = axes[int(np.argmin(spread[:2]))]
        first, second = (axes[2] if axis == flat else axis for axis in axes[:2])
        advice = (f', their {flat} nothing: set profile.axes to [{first}, {second}]' if is_flat
                  else ': let the driver publish single profiles in a frame of the light plane, '
                  f'where {axes[2]} is 0 (a static transform can hold its tilt)')
        raise _cloud_error(
            f'the points do not lie in the plane of {axes[0]} and {axes[1]}: their {axes[2]} '
            f'spans {spread[2] * 1e3:.1f} mm{advice}')


def _require_axes(points: Array, config: ProfileConfig) -> None:
    """Raise for returns (n, 2) whose order shows that the two axes are exchanged."""
    line_axis, range_axis, _ = _axes(config)
    steps = np.diff(points, axis=0)
    if len(steps) < MIN_RETURNS:
        return
    # by axis, the share of steps against the direction of the majority
    backward = 1.0 - np.maximum((steps > 0).sum(axis=0), (steps < 0).sum(axis=0)) / len(steps)
    if backward[0] > RANGE_BACKWARD and backward[1] < LINE_BACKWARD:
        raise _cloud_error(f'the points follow each other along {range_axis}, not along '
                           f'{line_axis}: set profile.axes to [{range_axis}, {line_axis}]')


class ProfileReader:
    """
    Receives the serialised clouds of one topic in order; their points are read on demand.

    A sensor publishes thousands of profiles while the robot moves, and a stop uses a few hundred.
    The layout of every message is checked, and the points (wrong unit or axis) once a second, or
    of every CHECK_COUNT without a stamp: of every message until one is usable.
    """

    def __init__(self, config: ProfileConfig) -> None:
        """Start without messages; config: how the driver writes its clouds."""
        self.config = config
        self._checked = -CHECK_PERIOD  # stamp of the last profile whose points were checked
        self._unchecked = 0  # messages since
        typestore()  # before the messages come: they do not wait while it is made

    def take(self, data: bytes, fetch: Callable[[], bytes] | None = None) -> RawProfile:
        """
        Return the profile of a message, decoded on demand.

        fetch: returns the message again; without it the message is kept. Raises
        UnusableMessageError.
        """
        cloud = message_of(CLOUD_TYPE, data)
        (stamp, frame), rows = stamp_and_frame(cloud), profile_count(cloud, self.config)
        if cloud.height * cloud.width:
            for axis in self.config.axes:
                field_view(cloud, axis[-1])
        self._unchecked += 1
        if (abs(stamp - self._checked) >= CHECK_PERIOD
                or not stamp and self._unchecked >= CHECK_COUNT):
            first = profile_from_cloud(cloud if rows == 1 else _row(cloud, 0), self.config)
            if np.isfinite(first.points).any():
                self._checked, self._unchecked = stamp, 0
        return RawProfile(stamp, frame, fetch or partial(bytes, data), profile_from_cdr,
                          self.config, 0 if fetch else len(data) + MESSAGE_OVERHEAD, rows)


def profile_count(cloud: Any, config: ProfileConfig) -> int:
    """
    Return the number of profiles in a PointCloud2: its rows, or 1 if rows are single points.

    Rows along the same part of the line are profiles. Raises UnusableMessageError.
    """
    if config.rows == 'profiles':
        return max(int(cloud.height), 1)
    if config.rows == 'points' or cloud.height < 2 or cloud.width < MIN_COLUMNS:
        return 1
    rows = [row[np.isfinite(row)] for row in field_view(cloud, config.axes[0][-1])]
    spans = [(row.min(), row.max()) for row in rows if np.unique(row).size > 1]
    if len(spans) < 2:
        return 1
    (first, last), (other_first, other_last) = spans[0], spans[-1]
    shared = min(last, other_last) - max(first, other_first)
    narrower = min(last - first, other_last - other_first)
    return int(cloud.height) if shared > MIN_OVERLAP * narrower else 1


def profiles_of(raw: RawProfile, previous_stamp: int | None) -> list[RawProfile]:
    """
    Return the profiles of a message, in the order of their stamps.

    With profile.period (s), the stamps of its rows are known. Without, they were taken at some
    time between two messages (time_margins), and such a profile counts if the robot stood still
    during all of this time.

    previous_stamp: that of the previous message (ns), None for the first message; without a
        period the first is dropped, as its duration is unknown
    """
    if raw.profile_count == 1:
        return [raw]
    fraction, step = SHARE_BEFORE_STAMP[raw.config.stamp], raw.config.period * NS
    time_margins = (0, 0)
    if not step:
        if previous_stamp is None or previous_stamp >= raw.stamp:
            return []
        duration, step = raw.stamp - previous_stamp, 1.0  # single nanoseconds keep their order
        time_margins = (round(fraction * duration), round((1.0 - fraction) * duration))
    first = raw.stamp - round(fraction * (raw.profile_count - 1) * step)
    stamps = [first + round(index * step) for index in range(raw.profile_count)]
    return [replace(raw, stamp=stamp, fetch=partial(_row_message, raw.fetch, index, stamp),
                    held_bytes=raw.held_bytes // raw.profile_count, profile_count=1,
                    time_margins=time_margins)
            for index, stamp in enumerate(stamps)]


def _row_message(fetch: Callable[[], bytes], index: int, stamp: int) -> bytes:
    """
    Return one row of a message, serialised, with its own stamp (ns).

    fetch: returns the message. Raises UnusableMessageError.
    """
    row = _row(message_of(CLOUD_TYPE, fetch()), index)
    row.header.stamp.sec, row.header.stamp.nanosec = divmod(stamp, NS)
    return bytes(typestore().serialize_cdr(row, CLOUD_TYPE))


def returns_of(raw: RawProfile) -> Profile:
    """
    Return only the returns of a profile, in the order of the message (m).

    They have an intensity if the message has a field of that name. The points are not ordered
    along the line, which would take most of the time. Raises UnusableMessageError, also for a
    profile whose stamp is not certain.
    """
    if raw.time_margins != (0, 0):
        raise _cloud_error('it holds several profiles, and does not say when each was taken: set '
                           'profile.period')
    cloud, config = message_of(CLOUD_TYPE, raw.fetch()), raw.config
    points, is_return = _points(cloud, config)
    has_intensity = INTENSITY in [field.name for field in cloud.fields]
    return Profile(raw.stamp, raw.frame_id, points[is_return, :2],
                   (config.axes[0], config.axes[1]),
                   intensity=field_values(cloud, INTENSITY)[is_return] if has_intensity else None)
