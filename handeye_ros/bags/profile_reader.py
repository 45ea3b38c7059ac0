"""
Profiles as received: every message is checked, and the points of only a few are read.

A sensor publishes thousands of profiles while the robot moves, and a station uses a few hundred:
the points of the others are never needed. The layout of every message is checked. The points
(wrong unit or axis) are checked a few times per second; after an unusable message, in every
message until the next usable one.

A message may hold several profiles. With a period, the stamps of its rows are known. Without one,
they were taken at some time between two messages: such a profile counts if the robot stood still
during all of this time.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
import struct
from typing import Any, NamedTuple

from handeye_ros.bags.contents import CLOUD
from handeye_ros.bags.messages import (
    deserialised,
    frame_name,
    profile_from_cdr,
    profile_from_cloud,
    require_layout,
    returns_from_cloud,
    row_of,
    stamp_of,
    to_cdr,
    view_of,
)
from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, Profile, RawProfile
from handeye_ros.node.errors import MessageError
import numpy as np

PROBE = 200_000_000  # ns between two profiles whose points are checked
MOST_LAYOUTS = 1000  # stored layouts: one for each number of points
LONGEST_LAYOUT = 4000  # bytes of one
OVERHEAD = 600  # bytes of memory for a message, without its data

SHARED = 0.5  # smallest common fraction of the line in rows that are profiles
FEWEST_COLUMNS = 10  # of rows that are compared
# the fraction of the time of a message before its stamp
BEFORE = {'first': 0.0, 'middle': 0.5, 'last': 1.0}

STAMPED = 12  # end of the stamp in a serialised message
STAMPS = (struct.Struct('>4xiI'), struct.Struct('<4xiI'))  # by the second byte of a message


class Layout(NamedTuple):
    """Common description of clouds that differ in stamp and data only; size: minimum."""

    size: int
    frame: str
    rows: int


class ProfileReader:
    """
    Receives the serialised clouds of one topic in order.

    The description of the data is the same in most messages: 5,300 clouds of a bag take 54 ms, and
    154 ms if each is deserialised.
    """

    def __init__(self, config: ProfileConfig) -> None:
        """Start with none; config: describes the clouds."""
        self.config = config
        self._layouts: dict[bytes, Layout] = {}  # by the bytes that describe the data
        self._data_start = STAMPED  # in the last message that was deserialised
        self._probed = -PROBE
        self._trusted = False

    def take(self, data: bytes, fetch: Callable[[], bytes] | None = None) -> RawProfile:
        """
        Return the profile of a message, decoded on demand.

        fetch: returns the message again; without it the message is kept. Raises MessageError.
        """
        layout = self._layouts.get(data[:2] + data[STAMPED:self._data_start])
        if layout is None or len(data) < layout.size:
            layout = self._read_layout(data)
        seconds, nanoseconds = STAMPS[data[1]].unpack_from(data)
        stamp = seconds * 1_000_000_000 + nanoseconds
        profile = RawProfile(stamp, layout.frame, fetch or partial(bytes, data), profile_from_cdr,
                             self.config, 0 if fetch else len(data) + OVERHEAD, layout.rows)
        if not self._trusted or abs(stamp - self._probed) >= PROBE:
            self._probe(data, layout.rows, stamp)
        return profile

    def _read_layout(self, data: bytes) -> Layout:
        """Return the description of a message; raises MessageError unless it is a cloud."""
        cloud = deserialised(data, CLOUD)
        require_layout(cloud, self.config)
        size = len(to_cdr(cloud))
        start = size - 1 - len(cloud.data)  # of the data: one byte follows them
        layout = Layout(size, frame_name(cloud.header.frame_id), rows_of(cloud, self.config))
        described = cloud.height == 1 or self.config.rows != 'auto'  # else the points decide
        if (described and len(self._layouts) < MOST_LAYOUTS and start < LONGEST_LAYOUT
                and data[start:size - 1] == cloud.data.tobytes()):
            self._data_start = start
            self._layouts[data[:2] + data[STAMPED:start]] = layout
        return layout

    def _probe(self, data: bytes, rows: int, stamp: int) -> None:
        """Raise for points that cannot belong to a profile."""
        self._trusted = False
        cloud = deserialised(data, CLOUD)
        points = profile_from_cloud(cloud if rows == 1 else row_of(cloud, 0), self.config).points
        self._trusted, self._probed = bool(np.isfinite(points[:, 1]).any()), stamp


def rows_of(msg: Any, config: ProfileConfig) -> int:
    """
    Return the number of profiles in a PointCloud2: its rows, or 1 if rows are single points.

    Rows along the same part of the line are profiles. Raises MessageError.

    """
    height, width = int(msg.height), int(msg.width)
    if config.rows == 'points' or height * width == 0 or height == 1:
        return 1
    if config.rows == 'profiles':
        return height
    if width < FEWEST_COLUMNS:
        return 1
    along = view_of(msg, config.axes[0][-1])
    first, last = (_span(along[index].astype(np.float64)) for index in (0, -1))
    shared = min(first[1], last[1]) - max(first[0], last[0])
    longer = max(first[1] - first[0], last[1] - last[0])
    return height if shared > SHARED * longer else 1


def _span(values: Array) -> tuple[float, float]:
    """Return the minimum and maximum of the finite values, NaN without any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def split(raw: RawProfile, previous_stamp: int | None, config: ProfileConfig) -> list[RawProfile]:
    """
    Return the profiles of a message, in the order of their stamps.

    previous_stamp: of the previous message, None for the first. Without a period the first message
    is left out, as its duration is unknown.
    """
    if raw.rows == 1:
        return [raw]
    fraction, reach, step = BEFORE[config.stamp], (0, 0), config.period * 1e9
    if not step:
        if previous_stamp is None or previous_stamp >= raw.stamp:
            return []
        duration, step = raw.stamp - previous_stamp, 1.0  # single nanoseconds keep their order
        reach = (round(fraction * duration), round((1.0 - fraction) * duration))
    first = raw.stamp - round(fraction * (raw.rows - 1) * step)
    stamps = [first + round(index * step) for index in range(raw.rows)]
    return [replace(raw, stamp=stamp, rows=1, held=raw.held // raw.rows,
                    fetch=partial(_row_message, raw.fetch, index, stamp), reach=reach)
            for index, stamp in enumerate(stamps)]


def _row_message(fetch: Callable[[], bytes], index: int, stamp: int) -> bytes:
    """Return one row of a message as a message with its own stamp; raises MessageError."""
    row = row_of(deserialised(fetch(), CLOUD), index)
    sec, nanosec = divmod(stamp, 1_000_000_000)
    header = replace(row.header, stamp=replace(row.header.stamp, sec=sec, nanosec=nanosec))
    return to_cdr(replace(row, header=header))


def returns_of(data: bytes, config: ProfileConfig) -> Iterator[Profile]:
    """
    Yield the profiles of one serialised message: only returns, with intensity.

    The robot may move between several profiles. Raises MessageError.
    """
    cloud = deserialised(data, CLOUD)
    rows = rows_of(cloud, config)
    if rows == 1:
        yield returns_from_cloud(cloud, config)
        return
    if not config.period:
        raise MessageError('PointCloud2', f'it holds {rows} profiles, and does not say when each '
                           'was taken: set profile.period')
    raw = RawProfile(stamp_of(cloud.header), '', partial(bytes, data), profile_from_cdr, config,
                     rows=rows)
    for index, row in enumerate(split(raw, None, config)):
        yield replace(returns_from_cloud(row_of(cloud, index), config), stamp=row.stamp)
