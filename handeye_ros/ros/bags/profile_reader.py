"""
Profiles as they are received: enough is read of each to check it, of a few all.

A sensor sends thousands while the robot moves, and a station uses a few hundred: the points of
the others are never needed. Whether its bytes make a cloud is checked of every message; what only
the points themselves show (a wrong unit or axis) is checked of a few a second, and of all from
one that cannot be used to the next one that can.

Several profiles in one message: with a period the stamps of its rows are known. Without one it
is only known that they were taken within the time from one message to the next: such a profile
counts where the robot stood still during all of it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
import struct
from typing import Any, NamedTuple

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, Profile, RawProfile
from handeye_ros.ros.bags.contents import CLOUD
from handeye_ros.ros.bags.messages import (
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
from handeye_ros.ros.errors import MessageError
import numpy as np

PROBE = 200_000_000  # ns of the stamps between two profiles that are read at once
MOST_LAYOUTS = 1000  # that are remembered: one for each number of points
LONGEST_LAYOUT = 4000  # bytes of one
OVERHEAD = 600  # bytes of what is held beside a message

SHARED = 0.5  # of the line that rows share which are profiles
FEWEST_COLUMNS = 10  # of rows that are compared
# the fraction of the time of a message that lies before its stamp
BEFORE = {'first': 0.0, 'middle': 0.5, 'last': 1.0}

STAMPED = 12  # where the stamp of a serialised message ends
STAMPS = (struct.Struct('>4xiI'), struct.Struct('<4xiI'))  # by the second byte of a message


class Layout(NamedTuple):
    """What clouds have in common that are alike but for stamp and data; size: of one at least."""

    size: int
    frame: str
    rows: int


class ProfileReader:
    """
    Takes the serialised clouds of one topic in the order in which they come.

    Drivers describe the same all the time: 5,300 clouds of a bag take 54 ms so, and 154 ms where
    each is deserialised.
    """

    def __init__(self, config: ProfileConfig) -> None:
        """Start with none; config: how the clouds are to be read."""
        self.config = config
        self._layouts: dict[bytes, Layout] = {}  # by the bytes that describe the data
        self._data_start = STAMPED  # in the last message that was deserialised
        self._probed = -PROBE
        self._trusted = False

    def take(self, data: bytes, fetch: Callable[[], bytes] | None = None) -> RawProfile:
        """
        Return the profile of a message, to be read where it is used.

        fetch: gives the message again; without it, it is kept. Raises MessageError.
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
        """Return what a message describes; raises MessageError for what is no cloud."""
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
        """Refuse points that cannot be those of a profile."""
        self._trusted = False
        cloud = deserialised(data, CLOUD)
        points = profile_from_cloud(cloud if rows == 1 else row_of(cloud, 0), self.config).points
        self._trusted, self._probed = bool(np.isfinite(points[:, 1]).any()), stamp


def rows_of(msg: Any, config: ProfileConfig) -> int:
    """
    Return how many profiles the rows of a sensor_msgs/PointCloud2 are, 1 where they are points.

    Rows that run along the same part of the line are profiles. Raises MessageError.

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
    """Return the smallest and the largest of the values that are finite, NaN without any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def split(raw: RawProfile, before: int | None, config: ProfileConfig) -> list[RawProfile]:
    """
    Return the profiles of a message, in the order of their stamps.

    before: the stamp of the message before, None for the first; where there is no period the
    first message is left out, as nobody knows how long it took.
    """
    if raw.rows == 1:
        return [raw]
    part, reach, step = BEFORE[config.stamp], (0, 0), config.period * 1e9
    if not step:
        if before is None or before >= raw.stamp:
            return []
        took, step = raw.stamp - before, 1.0  # single nanoseconds keep their order
        reach = (round(part * took), round((1.0 - part) * took))
    first = raw.stamp - round(part * (raw.rows - 1) * step)
    stamps = [first + round(index * step) for index in range(raw.rows)]
    return [replace(raw, stamp=stamp, rows=1, held=raw.held // raw.rows,
                    fetch=partial(_row_message, raw.fetch, index, stamp), reach=reach)
            for index, stamp in enumerate(stamps)]


def _row_message(fetch: Callable[[], bytes], index: int, stamp: int) -> bytes:
    """Return a row of a message as a message with a stamp; raises MessageError."""
    row = row_of(deserialised(fetch(), CLOUD), index)
    sec, nanosec = divmod(stamp, 1_000_000_000)
    header = replace(row.header, stamp=replace(row.header.stamp, sec=sec, nanosec=nanosec))
    return to_cdr(replace(row, header=header))


def returns_of(data: bytes, config: ProfileConfig) -> Iterator[Profile]:
    """
    Yield the profiles of one serialised message: returns alone, with intensity.

    Where there are several, the robot may move meanwhile. Raises MessageError.
    """
    cloud = deserialised(data, CLOUD)
    rows = rows_of(cloud, config)
    if rows == 1:
        yield returns_from_cloud(cloud, config)
        return
    if not config.period:
        raise MessageError('PointCloud2', f'it holds {rows} profiles, and does not say when each '
                           'was taken: set profile.period')
    whole = RawProfile(stamp_of(cloud.header), '', partial(bytes, data), profile_from_cdr, config,
                       rows=rows)
    for index, one in enumerate(split(whole, None, config)):
        yield replace(returns_from_cloud(row_of(cloud, index), config), stamp=one.stamp)
