# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Converts serialised ROS messages to profiles and poses.

Drivers differ. Deviations are corrected where possible; else the message is refused with an
UnusableMessageError, and nothing else, whose sentence names the setting to change.

The few types are read here: rosbags takes 0.2 s to import them, and twice as long for a message.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import math
import struct
import sys
from typing import Any, NamedTuple, TypeVar

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, NS, Profile, RawProfile, TimedPose, without_order
from handeye_ros.errors import UnusableMessageError
import numpy as np
from numpy.typing import NDArray

# sensor_msgs/PointField: datatype -> numpy
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
INTENSITY = 'intensity'  # its field, if the driver publishes it
UNITS = {'m': 1.0, 'mm': 1e-3}

LARGEST_POSITION = 1e6  # m; poses in mm stay below, so that the solver can report the wrong unit
LENGTH_TOLERANCE = 1e-2  # of a quaternion's length

# No line profiler measures this far (m): a larger coordinate is no return. If most are larger, or
# with mm all are smaller than ALL_TOO_NEAR, the unit is wrong.
LARGEST_COORDINATE = 10.0
NO_RETURN = 1e9  # coordinates beyond it, such as the largest float, are those of no return
ALL_TOO_NEAR = 1e-3
LARGEST_THICKNESS = 2e-3  # m: largest distance of the points of a profile from its plane
SMALLEST_TILT, LEAST_SLOPE = 2e-4, 0.01  # m, slope: less across the plane is no tilt of it
THIN_SHARE = 0.01  # of the spread across the plane: an axis with less is orthogonal to it
FEWEST_RETURNS = 10  # smallest number of returns for a decision on their order
# fraction of backward steps between returns: at most along the line, at least along the range
LINE_BACK, RANGE_BACK = 0.05, 0.1

LEAST_OVERLAP = 0.5  # smallest common fraction of the line in rows that are profiles
FEWEST_COLUMNS = 10  # of rows that are compared
# share of a message's time before its stamp
SHARE_BEFORE_STAMP = {'first': 0.0, 'middle': 0.5, 'last': 1.0}

CHECK_PERIOD = NS  # between two profiles whose points are checked
MESSAGE_OVERHEAD = 600  # bytes of memory for a message, without its data

T = TypeVar('T')


class _Cdr:
    """Reads the values of a serialised message one after the other, each aligned to its size."""

    def __init__(self, data: bytes) -> None:
        """Raise ValueError for data that are not in CDR."""
        self.data, self.at = data, 4
        if data[:2] not in (b'\0\0', b'\0\1'):
            raise ValueError('it is not in CDR')
        self.order = '<' if data[1] else '>'

    def values(self, form: str) -> tuple[Any, ...]:
        """Return values in a form of struct, the first of which takes four bytes or more."""
        form, size = self.order + form, 8 if form[-1] == 'd' else 4
        self.at += (4 - self.at) % size  # aligned behind the four bytes of the encapsulation
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def count(self, least: int) -> int:
        """Return the length of a sequence whose items take at least so many bytes."""
        count, = self.values('I')
        if count * least > len(self.data) - self.at:
            raise ValueError(f'{count} items of a sequence are not there')
        return int(count)

    def text(self) -> str:
        """Return a string."""
        size = self.count(1)
        begin, self.at = self.at, self.at + size
        return str(self.data[begin:self.at], 'utf-8').removesuffix('\0')

    def header(self) -> tuple[int, str]:
        """Return stamp and frame of a std_msgs/Header."""
        seconds, nanoseconds = self.values('iI')
        return seconds * NS + nanoseconds, frame_name(self.text())


def _read(kind: str, data: bytes, parse: Callable[[_Cdr], T]) -> T:
    """Return what parse makes of a message; damaged bytes cause several kinds of errors in it."""
    try:
        return parse(_Cdr(data))
    except (struct.error, ValueError) as error:
        raise UnusableMessageError(f'{kind} message not used: damaged message: {error}') from error


def frame_name(frame_id: str) -> str:
    """Return a frame name as in tf2, without the leading slash of ROS 1; one line of text."""
    name = str(frame_id).removeprefix('/')
    if not name.isprintable():
        name = ''.join(filter(str.isprintable, name))
    return sys.intern(name)  # it is in thousands of messages


def text_from_cdr(data: bytes) -> str:
    """Return the text of a std_msgs/String; raises UnusableMessageError."""
    return _read('String', data, _Cdr.text)


def pose_from_cdr(data: bytes) -> TimedPose:
    """Return the pose in a geometry_msgs/PoseStamped; raises UnusableMessageError."""
    stamp, frame, values = _read('PoseStamped', data, lambda cdr: (
        *cdr.header(), cdr.values('7d')))
    return _pose('PoseStamped', stamp, frame, values)


def _pose(kind: str, stamp: int, frame: str, values: Sequence[float]) -> TimedPose:
    """Return a pose with a quaternion of unit length and qw >= 0; raises UnusableMessageError."""
    norm, farthest = math.hypot(*values[3:]), max(map(abs, values[:3]))
    if not math.isfinite(norm + sum(values[:3])):
        raise UnusableMessageError(f'{kind} message not used: the pose holds values that are not '
                                   'finite')
    if farthest > LARGEST_POSITION:
        raise UnusableMessageError(f'{kind} message not used: the position reaches '
                                   f'{farthest:.3g} m')
    if abs(norm - 1.0) > LENGTH_TOLERANCE:
        raise UnusableMessageError(f'{kind} message not used: quaternion of length {norm:.4g}, '
                                   'expected 1')
    scale = (-1.0 if values[6] < 0 else 1.0) / norm
    return TimedPose(stamp, np.array(values[:3]), np.array([scale * v for v in values[3:]]), frame)


def transforms_from_cdr(data: bytes) -> list[tuple[str, TimedPose]]:
    """
    Return the child frames and poses of the valid transforms in a tf2_msgs/TFMessage.

    Raises UnusableMessageError if all are invalid: an unused invalid frame must not affect the
    others.
    """
    def parse(cdr: _Cdr) -> list[tuple[int, str, str, tuple[float, ...]]]:
        return [(*cdr.header(), frame_name(cdr.text()), cdr.values('7d'))
                for _ in range(cdr.count(72))]

    good, malformed = [], None
    for stamp, parent, child, values in _read('TFMessage', data, parse):
        try:
            good.append((child, _pose('TransformStamped', stamp, parent, values)))
        except UnusableMessageError as error:
            malformed = error
    if malformed and not good:
        raise malformed
    return good


def joints_from_cdr(data: bytes) -> tuple[int, dict[str, float]]:
    """Return stamp and positions by name in a JointState; raises UnusableMessageError."""
    def parse(cdr: _Cdr) -> tuple[int, list[str], tuple[float, ...]]:
        stamp, _ = cdr.header()
        names = [cdr.text() for _ in range(cdr.count(4))]
        return stamp, names, cdr.values(f'{cdr.count(8)}d')

    stamp, names, positions = _read('JointState', data, parse)
    if len(positions) != len(names):
        raise UnusableMessageError(f'JointState message not used: it names {len(names)} joints '
                                   f'and holds {len(positions)} positions')
    return stamp, dict(zip(names, positions, strict=True))


class Field(NamedTuple):
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    values: int


class Cloud(NamedTuple):
    """A sensor_msgs/PointCloud2; start: position of its data in the serialised message."""

    stamp: int
    frame: str
    height: int
    width: int
    fields: tuple[Field, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: bytes | memoryview
    start: int = 0

    def column(self, name: str) -> Array:
        """Return a field, such as a signed axis (n,), as float64, unscaled."""
        with np.errstate(invalid='ignore'):  # a signalling NaN is a NaN
            values = self.view(name.removeprefix('-')).astype(np.float64).ravel()
        return -values if name[0] == '-' else values

    def view(self, name: str) -> np.ndarray[Any, np.dtype[Any]]:
        """Return a field (height, width) as a view of the data; raises UnusableMessageError."""
        named = [field for field in self.fields if field.name == name]
        if len(named) != 1:
            names = ', '.join(field.name for field in self.fields) or 'none'
            raise _unusable(f'{len(named) or "no"} fields are named "{name}" (fields: {names}); '
                            'profile.axes says which axes are read')
        field, = named
        if field.datatype not in DATATYPES or field.values > 1:
            raise _unusable(f'field "{name}" has datatype {field.datatype} and {field.values} '
                            'values for each point, expected 1 to 8 and 1 value')
        dtype = np.dtype(('>' if self.is_bigendian else '<') + DATATYPES[field.datatype])
        height, width, point_step = self.height, self.width, self.point_step
        least = width * point_step
        # drivers often leave it unset
        row_step = least if height == 1 or self.row_step == 0 else self.row_step
        if (field.offset + dtype.itemsize > point_step or row_step < least
                or (height - 1) * row_step + least > len(self.data)):
            raise _unusable(f'{height} x {width} points of {point_step} bytes, in rows of '
                            f'{row_step} bytes, with the field "{name}" at byte {field.offset}, '
                            f'do not fit into {len(self.data)} bytes of data')
        return np.ndarray((height, width), dtype, self.data, field.offset,
                          (row_step, point_step))

    def row(self, index: int) -> Cloud:
        """Return a row as a cloud; raises UnusableMessageError."""
        size = self.width * self.point_step
        begin = index * (self.row_step or size)
        if index >= self.height or begin + size > len(self.data):
            raise _unusable(f'damaged message: it has no row {index}')
        return self._replace(height=1, row_step=size, data=self.data[begin:begin + size])


def _unusable(reason: str) -> UnusableMessageError:
    return UnusableMessageError(f'PointCloud2 message not used: {reason}')


def cloud_from_cdr(data: bytes) -> Cloud:
    """Return the cloud in a serialised message; raises UnusableMessageError."""
    def parse(cdr: _Cdr) -> Cloud:
        stamp, frame = cdr.header()
        height, width = cdr.values('2I')
        fields = tuple([Field(cdr.text(), *cdr.values('IB3xI')) for _ in range(cdr.count(16))])
        is_bigendian, point_step, row_step = cdr.values('B3x2I')
        size = cdr.count(1)
        return Cloud(stamp, frame, height, width, fields, bool(is_bigendian), point_step,
                     row_step, memoryview(data)[cdr.at:cdr.at + size], cdr.at)

    return _read('PointCloud2', data, parse)


def profile_from_cdr(data: bytes, config: ProfileConfig) -> Profile:
    """Return the profile in a sensor_msgs/PointCloud2; raises UnusableMessageError."""
    return profile_from_cloud(cloud_from_cdr(data), config)


def profile_from_cloud(cloud: Cloud, config: ProfileConfig) -> Profile:
    """
    Return the profile in a cloud, in metres, ordered along the line.

    A point with a value that is not finite, or that no sensor can measure, is no return: NaN in
    both columns. The rows of the message are concatenated. A cloud without points is a profile
    without returns. Raises UnusableMessageError.
    """
    if cloud.width * cloud.height == 0:
        return _empty(cloud, config)
    points, good = _points(cloud, config)
    across = points[good, 2]
    out_of_plane = 0.0
    if len(across):
        out_of_plane = float(np.nan_to_num(across.mean()))
    _require_axes(points[good, :2], config)
    if without_order(np.diff(points[good, 0])):
        line = _sorted(points, good)
    else:
        line = np.where(good[:, None], points[:, :2], np.nan)
    return replace(_empty(cloud, config), points=line, out_of_plane=out_of_plane)


def _sorted(points: Array, good: NDArray[np.bool_]) -> Array:
    """Return points (n, 2) sorted by the first column; points with equal values are averaged."""
    with np.errstate(invalid='ignore'):
        placed = np.abs(points[:, 0]) <= LARGEST_COORDINATE
    x, group = np.unique(points[placed, 0], return_inverse=True)
    good = good[placed]
    count = np.bincount(group[good], minlength=len(x))
    total = np.bincount(group[good], points[placed, 1][good], minlength=len(x))
    with np.errstate(invalid='ignore'):  # 0 / 0 where there is no return
        return np.column_stack([np.where(count > 0, x, np.nan), total / count])


def _empty(cloud: Cloud, config: ProfileConfig) -> Profile:
    return Profile(cloud.stamp, cloud.frame, np.empty((0, 2)), (config.axes[0], config.axes[1]))


def _axes(config: ProfileConfig) -> tuple[str, str, str]:
    """Return the axes along the line, of the range, and orthogonal to both, without signs."""
    along, across = (axis[-1] for axis in config.axes)
    return along, across, ({'x', 'y', 'z'} - {along, across}).pop()


def _points(cloud: Cloud, config: ProfileConfig) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the points (n, 3) of a cloud in metres, and which are returns (n,).

    Columns: along the line, range, across the plane (NaN where the driver publishes none). Points
    that are not finite, too far, or in the origin are no returns; drivers publish the origin for
    missing returns.
    """
    range_axis, across = config.axes[1], _axes(config)[2]
    along, ranges = cloud.column(config.axes[0]), cloud.column(range_axis)
    for value in config.invalid:
        # the value of the driver: in its type, before the sign of the axis
        value = -value if range_axis[0] == '-' else value
        ranges[np.isclose(ranges, value, rtol=1e-6, atol=0.0)] = np.nan
    out_of_plane = (cloud.column(across) if across in [field.name for field in cloud.fields]
                    else np.full(len(ranges), np.nan))
    points = (np.stack((along, ranges, out_of_plane)) * UNITS[config.unit]).T
    points[np.abs(points) > NO_RETURN] = np.nan
    x, z = points[:, 0], points[:, 1]
    with np.errstate(invalid='ignore'):
        good = (np.maximum(np.abs(x), np.abs(z)) <= LARGEST_COORDINATE) & ((x != 0) | (z != 0))
    _require_unit(points[:, :2], config.unit)
    _require_one_plane(points[good], _axes(config))
    return points, good


def _require_unit(points: Array, unit: str) -> None:
    """Raise for coordinates (n, 2), in metres after unit, beyond any sensor."""
    reach = np.maximum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    finite = np.isfinite(reach)
    too_far = finite & (reach > LARGEST_COORDINATE)
    if too_far.sum() > finite.sum() / 2:
        raise _unusable(f'coordinates reach {reach[too_far].max():.3g} m' + (
            ': set profile.unit to mm' if unit == 'm' else ', but profile.unit is m or mm'))
    largest = reach[finite & ~too_far].max(initial=0.0)
    if unit == 'mm' and 0.0 < largest < ALL_TOO_NEAR:
        raise _unusable(f'no coordinate is larger than {largest * 1e3:.3g} mm: set profile.unit '
                        'to m')


def _require_one_plane(points: Array, axes: tuple[str, str, str]) -> None:
    """Raise for returns (n, 3) outside the plane of the first two axes."""
    if len(points) < 2 or not np.ptp(points[:, 2]) > SMALLEST_TILT:  # nor where it is not finite
        return
    spread = np.ptp(points, axis=0)
    slope, off = _slope_across(points)
    thin = THIN_SHARE * spread[2]
    if abs(slope) > LEAST_SLOPE and off < thin < min(spread[:2]):
        raise _unusable(f'the points lie in a plane that is tilted by '
                        f'{math.degrees(math.atan(abs(slope))):.1f} degrees about {axes[0]} '
                        f'against that of {axes[0]} and {axes[1]}: let the driver publish them in '
                        f'a frame of the light plane, where {axes[2]} is 0; a static transform '
                        'can hold the tilt')
    if not spread[2] > LARGEST_THICKNESS:
        return
    text = (f'the points do not lie in the plane of {axes[0]} and {axes[1]}: '
            f'their {axes[2]} spans {spread[2] * 1e3:.1f} mm')
    if min(spread[:2]) < THIN_SHARE * spread[2]:
        flat = int(np.argmin(spread[:2]))
        along, range_axis = sorted(((2, 1), (0, 2))[flat],
                                   key=lambda k: _back(np.diff(points[:, k])))
        raise _unusable(f'{text}, their {axes[flat]} nothing: set profile.axes to '
                        f'[{axes[along]}, {axes[range_axis]}]')
    raise _unusable(f'{text}; a line profiler measures in one plane: let its driver publish '
                    'single profiles in its own frame')


def _slope_across(points: Array) -> tuple[float, float]:
    """Return the slope of the third coordinate by the second, and the RMS off the best plane."""
    centred = points - points.mean(axis=0)
    by, *_ = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)
    off = centred[:, 2] - centred[:, :2] @ by
    return float(by[1]), math.sqrt(float(off @ off) / len(off))


def _require_axes(points: Array, config: ProfileConfig) -> None:
    """Raise for returns (n, 2) whose order shows that the two axes are exchanged."""
    along, across, _ = _axes(config)
    steps = np.diff(points, axis=0)
    if (len(steps) >= FEWEST_RETURNS and _back(steps[:, 0]) > RANGE_BACK
            and _back(steps[:, 1]) < LINE_BACK):
        raise _unusable(f'the points follow each other along {across}, not along {along}: set '
                        f'profile.axes to [{across}, {along}]')


def _back(steps: Array) -> float:
    """Return the share of steps against the direction of the majority."""
    return 1.0 - max(np.count_nonzero(steps > 0), np.count_nonzero(steps < 0)) / len(steps)


class ProfileReader:
    """
    Receives the serialised clouds of one topic in order; their points are read on demand.

    A sensor publishes thousands of profiles while the robot moves, and a stop uses a few hundred.
    The layout of every message is checked, and the points (wrong unit or axis) once a second;
    after an unusable message, those of every message until the next usable one.
    """

    def __init__(self, config: ProfileConfig) -> None:
        """Start with none; config: describes the clouds."""
        self.config = config
        self._probed = -CHECK_PERIOD
        self._trusted = False

    def take(self, data: bytes, fetch: Callable[[], bytes] | None = None) -> RawProfile:
        """
        Return the profile of a message, decoded on demand.

        fetch: returns the message again; without it the message is kept. Raises
        UnusableMessageError.
        """
        cloud = cloud_from_cdr(data)
        if cloud.height * cloud.width:
            for axis in self.config.axes:
                cloud.view(axis[-1])
        rows = row_count(cloud, self.config)
        if not self._trusted or abs(cloud.stamp - self._probed) >= CHECK_PERIOD:
            self._trusted = False
            points = profile_from_cloud(cloud if rows == 1 else cloud.row(0), self.config).points
            self._trusted, self._probed = bool(np.isfinite(points[:, 1]).any()), cloud.stamp
        return RawProfile(cloud.stamp, cloud.frame, fetch or partial(bytes, data),
                          profile_from_cdr, self.config,
                          0 if fetch else len(data) + MESSAGE_OVERHEAD,
                          rows)


def row_count(cloud: Cloud, config: ProfileConfig) -> int:
    """
    Return the number of profiles in a cloud: its rows, or 1 if rows are single points.

    Rows along the same part of the line are profiles. Raises UnusableMessageError.
    """
    if config.rows == 'points' or cloud.height * cloud.width == 0 or cloud.height == 1:
        return 1
    if config.rows == 'profiles':
        return cloud.height
    if cloud.width < FEWEST_COLUMNS:
        return 1
    along = cloud.view(config.axes[0][-1]).astype(np.float64)
    ends = [along[i][np.isfinite(along[i])] for i in (0, -1)]
    if not (len(ends[0]) and len(ends[1])):
        return 1
    shared = min(end.max() for end in ends) - max(end.min() for end in ends)
    return cloud.height if shared > LEAST_OVERLAP * max(map(np.ptp, ends)) else 1


def split(raw: RawProfile, previous_stamp: int | None, config: ProfileConfig) -> list[RawProfile]:
    """
    Return the profiles of a message, in the order of their stamps.

    With a period, the stamps of its rows are known. Without one, they were taken at some time
    between two messages: such a profile counts if the robot stood still during all of this time.
    previous_stamp: of the previous message, None for the first. Without a period the first message
    is left out, as its duration is unknown.
    """
    if raw.rows == 1:
        return [raw]
    fraction, reach, step = SHARE_BEFORE_STAMP[config.stamp], (0, 0), config.period * NS
    if not step:
        if previous_stamp is None or previous_stamp >= raw.stamp:
            return []
        duration, step = raw.stamp - previous_stamp, 1.0  # single nanoseconds keep their order
        reach = (round(fraction * duration), round((1.0 - fraction) * duration))
    first = raw.stamp - round(fraction * (raw.rows - 1) * step)
    stamps = [first + round(index * step) for index in range(raw.rows)]
    return [replace(raw, stamp=stamp, rows=1, held_bytes=raw.held_bytes // raw.rows,
                    fetch=partial(_row_message, raw.fetch, index, stamp), reach=reach)
            for index, stamp in enumerate(stamps)]


def _row_message(fetch: Callable[[], bytes], index: int, stamp: int) -> bytes:
    """Return one row of a message as a message with its own stamp; UnusableMessageError."""
    data = fetch()
    cloud = cloud_from_cdr(data)
    row, head, cdr = cloud.row(index), bytearray(data[:cloud.start]), _Cdr(data)
    cdr.header()
    struct.pack_into(f'{cdr.order}iI', head, 4, *divmod(stamp, NS))
    struct.pack_into(f'{cdr.order}I', head, cdr.at + -cdr.at % 4, 1)  # the height
    # row_step, and the length of the data, are the last two numbers before the data
    struct.pack_into(f'{cdr.order}2I', head, cloud.start - 8, row.row_step, row.row_step)
    return bytes(head) + bytes(row.data) + b'\1'


def returns_of(raw: RawProfile) -> Profile:
    """
    Return only the returns of a profile, in message order.

    With the intensity if there is a field of that name. The order along the line, which takes most
    of the time, is not determined. Raises UnusableMessageError, also for an uncertain stamp.
    """
    if raw.reach != (0, 0):
        raise _unusable('it holds several profiles, and does not say when each was taken: set '
                        'profile.period')
    cloud, config = cloud_from_cdr(raw.fetch()), raw.config
    if cloud.width * cloud.height == 0:
        return _empty(cloud, config)
    points, good = _points(cloud, config)
    intensity = (cloud.column(INTENSITY)[good]
                 if INTENSITY in [field.name for field in cloud.fields] else None)
    return replace(_empty(cloud, config), stamp=raw.stamp, points=points[good, :2],
                   intensity=intensity)
