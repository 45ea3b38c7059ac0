# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The edge at the end of a face: sharp, rounded or bevelled.

The edge is where the plane of the face meets the plane of the wall below it. A wall in sight
gives it as the crossing of two lines, whatever lies between them. Otherwise the plate ends at
its last point before the drop, the bent end included. What lies behind the end is searched in the
frame of the face, on the continuation of its surface.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any

from handeye_ros.data import Array, EdgePoint
from handeye_ros.profiles.edge_rounding import rounding_of
from handeye_ros.profiles.segment import returned, Segment, STEEPEST
import numpy as np
from numpy.typing import NDArray

MOST_LOST = 4  # largest number of rows between neighbouring points of the plate
SLACK_SIGMAS = 6.0  # of the range difference between two neighbours on a surface
CONTINUATION_ROWS = 80  # rows behind a face that may still be its bent end or its wall
WALL_SLOPE = 0.45  # largest |tangent| between a wall in the profile and the face's normal
SMALLEST_WALL = 1.2e-3  # smallest depth of a visible wall below the face (m)
WALL_POINTS = 4
ROUNDED_SIGMAS = 2.0  # an end that is lower than this is bent
FLAT_SIGMAS = 3.0  # largest distance of a face point below the face line
STEEPEST_ROUNDING = 1.5  # slope of a bent end from where it leaves the face line
SHORTEST_ROUNDING = 20  # points before the last one of a face that may be bent
RIM_SHARE, LARGEST_RIM = 4, 3  # last points of a bent end that are not used: 1 in so many; at most
LOST_STD = 0.17  # 1 sigma of an edge due to lost points, in columns
LAST_POINTS = 3  # last points that give the depth of an end
MOST_STRAY = 2  # most points between two levels that are only mixed at the edge
MOST_MIXED = 16  # points between two levels: a wider transition is a surface
RAMP_STD = 0.1  # 1 sigma of the edge within a wide transition, over its width


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


def wall_edge(end: End, rows: NDArray[np.intp]) -> tuple[float, float] | None:
    """
    Return position and 1 sigma (m) where a wall in the continuation (rows) meets the face line.

    The position is along the face from its last point. None without a visible wall.
    """
    if len(rows) < WALL_POINTS:
        return None
    all_u, all_v = u, v = end.along_and_below(rows)
    lowest = float(v.max())
    if lowest < SMALLEST_WALL:
        return None
    low = (v > 0.5 * lowest) & (v < 0.97 * lowest)
    if np.count_nonzero(low) < WALL_POINTS:
        return None
    u, v = u[low], v[low]
    mean, spread = float(v.mean()), float(v.std())
    slope = float((v - mean) @ (u - u.mean())) / len(v) / spread ** 2
    if abs(slope) > WALL_SLOPE:
        return None
    scatter = float((u - u.mean() - slope * (v - mean)).std()) + end.column / 12 ** 0.5
    std = scatter * np.sqrt((1 + (mean / spread) ** 2) / len(v))
    place, least = float(u.mean() - slope * mean), _end_of_face(end, all_u, all_v)
    # a wall seen so steeply that it seems to stand below the face is badly measured
    return max(place, least), float(np.hypot(std, max(least - place, 0.0)))


def _end_of_face(end: End, u: Array, v: Array) -> float:
    """Return the end of the flat part of a face, with points at u along and v below it."""
    flat = leading(v <= FLAT_SIGMAS * end.segment.noise)
    return float(u[flat - 1]) if flat else 0.0


def end_edge(end: End, rows: NDArray[np.intp], ground: Segment | None, kind: str) -> EdgePoint:
    """
    Return the end of a plate before a drop, its continuation (rows) included.

    ground: the surface seen below, or None. The distance of a bent end from its edge is determined
    later from all stations (see sampling/edge_shapes.py).
    """
    segment = end.segment
    plate = segment.rows[::end.outward][-LAST_POINTS:]
    plate = np.concatenate([plate, rows]) if len(rows) else plate
    u, v = end.along_and_below(plate)
    pitch = end.column * math.hypot(1.0, segment.slope)
    step = float(u[-1] - u[-LAST_POINTS]) / (LAST_POINTS - 1)
    step = min(max(step, 0.0), pitch) if len(rows) else pitch
    flat = _end_of_face(end, u[LAST_POINTS:], v[LAST_POINTS:]) if len(rows) else 0.0
    last = max(float(u[-1]), flat)
    mixed, width = _transition(end, int(plate[-1]), ground)
    place = last + (step * (1 + mixed) / 2 if not width else pitch * width)
    std = math.sqrt(pitch ** 2 * ((1 + min(mixed, 2)) ** 2 / 12 + LOST_STD ** 2)
                    + (RAMP_STD * pitch * 2 * width) ** 2)
    edge = edge_point(end.frame, place, std, kind)
    lowest = sum(v[-LAST_POINTS:].tolist()) / LAST_POINTS
    if lowest < ROUNDED_SIGMAS * segment.noise / LAST_POINTS ** 0.5:
        return edge
    return _rounded(end, edge, rows, place, last - flat)


def _rounded(end: End, edge: EdgePoint, rows: NDArray[np.intp], place: float, beyond: float
             ) -> EdgePoint:
    """Return an edge with its rounding; beyond: the extent of the end outwards."""
    segment, before = end.segment, max(2 * len(rows), SHORTEST_ROUNDING)
    believed = rows[:len(rows) - min(len(rows) // RIM_SHARE, LARGEST_RIM)]
    rows = np.concatenate([segment.rows[::end.outward][-before:], believed])
    rounding = rounding_of(*end.along_and_below(rows), place,
                           end.column * math.hypot(1.0, segment.slope), segment.noise)
    # an end that goes down but not outwards is no bend, but a hardly visible wall
    depth = min(rounding.depth, STEEPEST_ROUNDING * beyond + FLAT_SIGMAS * segment.noise)
    out, below = rounding.middle
    arc = (out - place) * end.frame.along + below * end.frame.below
    return replace(edge, drop=depth * end.frame.below, shapes=rounding.shapes, arc=arc,
                   arc_std=rounding.middle_std)


def _transition(end: End, last: int, ground: Segment | None) -> tuple[int, float]:
    """
    Return the number of mixed points between plate and ground, and the middle of their ramp.

    A column whose spot straddles the edge returns a range between the levels; the edge is equally
    likely on both of its sides. A sensor that smooths, or has a wide spot, makes a ramp: the
    second value is the number of columns from the last point of the plate to half height, 0
    without a ramp.
    """
    between = abs(end.start_of(ground) - last) - 1 if ground else 0
    if ground is None or not 0 < between <= MOST_MIXED:
        return 0, 0.0
    columns = np.arange(between + 2)
    points = end.seen.points.take(last + end.outward * columns, axis=0)
    seen = returned(points)
    columns = columns.take(seen)
    x, z = points.take(seen, axis=0).T
    height = np.abs(z - end.segment.height(x))
    share = (height - height[0]) / (np.abs(ground.height(x) - end.segment.height(x)) - height[0])
    mixed = int((share[1:-1] < 0.8).sum())
    if mixed <= MOST_STRAY:
        return (mixed if len(seen) == len(points) else 0), 0.0
    after = max(int(np.argmax(share > 0.5)), 1)
    part = (0.5 - share[after - 1]) / max(float(share[after] - share[after - 1]), 0.1)
    return mixed, float(columns[after - 1] + part * (columns[after] - columns[after - 1]))


def edge_point(frame: Frame, place: float, std: float, kind: str) -> EdgePoint:
    """Return the edge point on the face line, at a place (m) from the last point of the face."""
    return EdgePoint(frame.origin + place * frame.along, frame.along, std, 0.0, kind)


def std_at(segment: Segment, x: float, points: Array) -> float:
    """Return 1 sigma of the range of a segment's line at x."""
    xs = points[segment.rows, 0]
    spread = xs.std()
    return float(segment.noise * np.sqrt((1 + ((x - xs.mean()) / spread) ** 2) / len(xs)))
