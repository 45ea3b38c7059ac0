"""The end of a face in a profile: its frame, and the points on the continuation of its surface."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

from handeye_ros.data import Array
from handeye_ros.profiles.segment import Segment, STEEPEST
import numpy as np
from numpy.typing import NDArray

MOST_LOST = 4  # largest number of rows between neighbouring points of the plate
SLACK_SIGMAS = 6.0  # of the range difference between two neighbours on a surface
CONTINUATION_ROWS = 80  # rows behind a face that may still be its bent end or its wall


@dataclass(frozen=True, eq=False)
class Returns:
    """
    A profile with its returns, for the search of ends of faces.

    points: (n, 2) of the profile; rows: (k,) with a return; near: sign for which near * range is
    larger for nearer points: -1 if the range grows away from the sensor.
    """

    points: Array
    rows: NDArray[np.intp]
    near: int

    def lost(self, first: int, last: int) -> int:
        """Return the number of rows without a return, after the first and up to the last."""
        found = self.rows.searchsorted([first, last])
        return last - first - int(found[1] - found[0])

    def outwards(self, row: int, outward: int) -> NDArray[np.intp]:
        """Return a row and the returns among the CONTINUATION_ROWS behind it."""
        at = int(self.rows.searchsorted(row))
        if outward > 0:
            some = self.rows[at:at + CONTINUATION_ROWS + 1]
            return some[:some.searchsorted(row + CONTINUATION_ROWS + 1)]
        some = self.rows[max(at - CONTINUATION_ROWS, 0):at + 1]
        return some[some.searchsorted(row - CONTINUATION_ROWS):][::-1]


@dataclass(frozen=True, eq=False)
class Frame:
    """
    The frame of a face at one of its ends: along the face, outwards, and below.

    origin: (2,) the point of the face line at the segment's last point; along: (2,) unit
    vector; below: (2,) unit vector away from the sensor.
    """

    origin: Array
    along: Array
    below: Array

    def of(self, points: Array) -> tuple[Array, Array]:
        """Return the coordinates of points (k, 2) along and below the face."""
        away = points - self.origin
        return away @ self.along, away @ self.below


@dataclass(frozen=True, eq=False)
class End:
    """One end of a segment of a profile, with the direction of the rows behind it (+1 or -1)."""

    segment: Segment
    outward: int
    seen: Returns

    @property
    def row(self) -> int:
        """Return the last row of the segment."""
        return self.segment.last if self.outward > 0 else self.segment.first

    def start_of(self, other: Segment) -> int:
        """Return the first row of another segment as seen from this end."""
        return other.first if self.outward > 0 else other.last

    def end_of(self, other: Segment) -> int:
        """Return the last row of another segment as seen from this end."""
        return other.last if self.outward > 0 else other.first

    @property
    def column(self) -> float:
        """Return the mean distance along x between neighbouring columns of the segment."""
        first, last = self.segment.first, self.segment.last
        x = self.seen.points[:, 0]
        return abs(float(x[last] - x[first])) / (last - first)

    @cached_property
    def frame(self) -> Frame:
        """Return the frame of the face here."""
        segment, points = self.segment, self.seen.points
        x, middle = (points.item(row, 0) for row in
                     (self.row, segment.rows.item(len(segment.rows) // 2)))
        outward = -1.0 if x < middle else 1.0
        length, near = math.hypot(1.0, segment.slope), self.seen.near
        frame = np.array([[x, segment.height(x)],
                          [outward / length, outward * segment.slope / length],
                          [near * segment.slope / length, -near / length]])
        return Frame(*frame)

    def along_and_below(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return the coordinates of rows of the profile along and below the face."""
        return self.frame.of(self.seen.points.take(rows, axis=0))


def continuation(end: End) -> NDArray[np.intp]:
    """
    Return the rows behind the last point of a segment that continue its surface, outwards.

    The surface may turn away from the sensor, up to the slope from which light returns. One wrong
    point does not end it.
    """
    rows = end.seen.outwards(end.row, end.outward)
    # mostly there is nothing, or only the drop
    if len(rows) == 1 or not (_follows(end, rows[0], rows[1])
                              or (len(rows) > 2 and _follows(end, rows[0], rows[2]))):
        return rows[1:1]
    follows = _follows(end, rows[:-1], rows[1:])
    found = leading(follows) + 1
    if found < len(rows) - 1 and _follows(end, rows[found - 1], rows[found + 1]):
        more = found + 2 + leading(follows[found + 1:])
        return np.concatenate([rows[1:found], rows[found + 1:more]])
    return rows[1:found]


def leading(values: NDArray[np.bool_]) -> int:
    """Return the number of true values before the first false one."""
    first = int(values.argmin()) if len(values) else 0
    return len(values) if not len(values) or values[first] else first


def _follows(end: End, rows: Any, after: Any) -> Any:
    """Return whether a row (or which rows) continues a surface that curves away."""
    points, slack = end.seen.points, SLACK_SIGMAS * end.segment.noise
    step = (points[after] - points[rows]).T
    aside, drop = abs(step[0]), -end.seen.near * step[1]
    # a driver may leave lost points out: then the next row need not be near
    return ((drop < STEEPEST * aside + slack) & (drop > -slack)
            & (abs(after - rows) <= MOST_LOST) & (aside < (MOST_LOST + 0.5) * end.column))
