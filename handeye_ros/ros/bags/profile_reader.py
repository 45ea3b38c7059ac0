"""
Profiles as they are received: enough is read of each to tell what it is, of a few all.

A sensor sends thousands while the robot moves, and a station uses a few hundred: the points of
the others are never needed. Whether its bytes make a cloud is seen of every message; what only
the points themselves show (a wrong unit or axis) is seen of a few a second, and of all from one
that cannot be used to the next one that can.
"""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Profile, RawProfile
from handeye_ros.ros.bags import cdr
from handeye_ros.ros.bags.batches import rows_of
from handeye_ros.ros.bags.messages import (
    frame_name,
    profile_from_cloud,
    require_layout,
    stamp_of,
)
import numpy as np

PROBE = 200_000_000  # ns of the stamps between two profiles that are read at once
MOST_LAYOUTS = 1000  # that are remembered: one for each number of points
LONGEST_LAYOUT = 4000  # bytes of one
OVERHEAD = 600  # bytes of what is held beside a message


def profile_from_cdr(data: bytes, config: ProfileConfig) -> Profile:
    """Return the profile in a serialised sensor_msgs/PointCloud2; raises MessageError."""
    return profile_from_cloud(cdr.cloud(data), config)


class Like(NamedTuple):
    """
    What messages have in common that are laid out alike, all but the stamp.

    encoding: their first two bytes; end: where their data begins; described: the bytes up to
    there; size: of a whole one at least.
    """

    encoding: bytes
    end: int
    described: bytes
    size: int
    frame: str
    rows: int


NOTHING = Like(b'none', 0, b'', 0, '', 0)


class ProfileReader:
    """Takes the serialised clouds of one topic in the order in which they come."""

    def __init__(self, config: ProfileConfig) -> None:
        """Start with none; config: how the clouds are to be read."""
        self.config = config
        # the size of what follows, and the rows of profiles, by what tells them
        self._layouts: dict[bytes, tuple[int, int]] = {}
        self._described = 0  # bytes that the last message took to describe its data
        self._like = NOTHING  # the last message
        self._probed = -PROBE
        self._trusted = False

    def take(self, data: bytes, fetch: Callable[[], bytes] | None = None) -> RawProfile:
        """
        Return the profile of a message, to be read where it is used.

        fetch: gives the message again; without it, it is kept. Raises MessageError.
        """
        like = self._like
        if (data[:2] == like.encoding and data[cdr.STAMPED:like.end] == like.described
                and len(data) >= like.size):
            stamp, frame, rows = cdr.stamp_of(data), like.frame, like.rows
        else:
            head, end = cdr.header(data, 'PointCloud2')
            stamp, frame = stamp_of(head), frame_name(head.frame_id)
            rows = self._rows(data, end, frame)
        profile = RawProfile(stamp, frame, fetch or partial(bytes, data), profile_from_cdr,
                             self.config, 0 if fetch else len(data) + OVERHEAD, rows)
        if not self._trusted or abs(stamp - self._probed) >= PROBE:
            self._probe(data if rows == 1 else cdr.row(data, 0, stamp), stamp)
        return profile

    def _rows(self, data: bytes, end: int, frame: str) -> int:
        """
        Return how many profiles a message holds; raises MessageError for what is no cloud.

        end: of the header, frame: in it. Drivers describe the same all the time.
        """
        size, rows = self._layouts.get(data[:2] + data[end:end + self._described], (0, 0))
        if rows and size <= len(data) - end:
            data_start = end + self._described
            self._like = Like(data[:2], data_start, data[cdr.STAMPED:data_start], end + size,
                              frame, rows)
            return rows
        cloud = cdr.cloud(data)
        require_layout(cloud, self.config)
        self._described = cloud.data_start - end
        rows = rows_of(cloud, self.config)
        told = cloud.height == 1 or self.config.rows != 'auto'  # else by what the points are
        if told and len(self._layouts) < MOST_LAYOUTS and self._described < LONGEST_LAYOUT:
            key = data[:2] + data[end:cloud.data_start]
            self._layouts[key] = self._described + len(cloud.data), rows
        return rows

    def _probe(self, data: bytes, stamp: int) -> None:
        """Refuse points that cannot be those of a profile."""
        self._trusted = False
        points = profile_from_cdr(data, self.config).points
        self._trusted, self._probed = bool(np.isfinite(points[:, 1]).any()), stamp
