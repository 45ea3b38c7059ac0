"""
Where a face ends: the edge of a plate that is sharp, rounded or bevelled.

The edge is where the plane of the face meets the plane of the wall below it. A wall in sight
gives it as the crossing of two lines, whatever lies between them. Otherwise the plate ends at
its last point before the drop, the bent end included.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
import math

from handeye_ros.data import Array, EdgePoint
from handeye_ros.profiles.bends import bend_of
from handeye_ros.profiles.segment import returned, Segment
import numpy as np
from numpy.typing import NDArray

STEEPEST = 4.0  # slope of a surface from which light still comes back
MOST_LOST = 4  # rows from one point of the plate to the next
SLACK_SIGMAS = 6.0  # of the range between two neighbours on a surface
TAIL_ROWS = 80  # behind a face that may still be the bent end of its plate, or its wall
WALL_LEAN = 0.45  # largest |tangent| between a wall in the profile and the face's normal
SMALLEST_WALL = 1.2e-3  # of a wall in sight, from the face down (m)
WALL_POINTS = 4
BEND_SIGMAS = 2.0  # an end that is lower than this is bent
FLAT_SIGMAS = 3.0  # below the face line, up to which its points are on it
STEEPEST_BEND = 1.5  # slope of a bent end from where it leaves the face line
SHORTEST_BEND = 20  # points of the face before its last one that may be bent
LOST_DOUBT = 0.17  # 1 sigma of what lost points do to an edge, in columns
LAST_POINTS = 3  # that tell how deep the end lies
MOST_STRAY = 2  # points between two levels that only straddle the edge
MOST_MIXED = 16  # points between two levels: a wider transition is a surface
RAMP_DOUBT = 0.1  # 1 sigma of where the edge is within a wide transition, of its width


@dataclass(frozen=True, eq=False)
class End:
    """One end of a segment: its row, the direction of the rows behind it (+1 or -1)."""

    segment: Segment
    outward: int

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


@dataclass(frozen=True, eq=False)
class Frame:
    """
    The frame of a face at one of its ends: along the face, outwards, and below it.

    origin: (2,) the point of the face line at the segment's last point; along: (2,) unit
    vector; below: (2,) unit vector away from the sensor.
    """

    origin: Array
    along: Array
    below: Array

    def of(self, points: Array) -> tuple[Array, Array]:
        """Return how far along and below points (k, 2) lie."""
        away = points - self.origin
        return away @ self.along, away @ self.below


def frame_of(end: End, points: Array, near: int) -> Frame:
    """Return the frame of a face's end; near: -1 where the range grows away from the sensor."""
    segment, x = end.segment, points[end.row, 0]
    middle = points[segment.rows[len(segment.rows) // 2], 0]
    outward = -1.0 if x < middle else 1.0
    length = math.hypot(1.0, segment.slope)
    along = np.array([outward / length, outward * segment.slope / length])
    below = np.array([near * segment.slope / length, -near / length])
    return Frame(np.array([x, segment.height(x)]), along, below)


def tail(end: End, points: Array, near: int, column: float) -> NDArray[np.intp]:
    """
    Return the rows behind a segment's last point that its surface continues on, outwards.

    The surface turns away from the sensor, as steeply as light comes back from it at most; one
    wrong point does not end it. column: distance along x between neighbours on the segment.
    """
    last = min(max(end.row + end.outward * TAIL_ROWS, 0), len(points) - 1)
    rows = np.arange(end.row, last + end.outward, end.outward)
    rows = rows.take(returned(points.take(rows, axis=0)))
    found = _connected(rows, points, near, end.segment.noise, column)
    if found < len(rows) - 1:
        skipped = np.concatenate([rows[:found], rows[found + 1:]])
        further = _connected(skipped, points, near, end.segment.noise, column)
        if further > found:
            return skipped[1:further]
    return rows[1:found]


def _connected(rows: NDArray[np.intp], points: Array, near: int, noise: float, column: float
               ) -> int:
    """Return how many of the rows follow each other on one surface that turns away."""
    found = points.take(rows, axis=0)
    step = found[1:] - found[:-1]
    aside, drop = np.abs(step[:, 0]), -near * step[:, 1]
    slack = SLACK_SIGMAS * noise
    # a driver may leave lost points out: then the next row need not be near
    follows = ((drop < STEEPEST * aside + slack) & (drop > -slack)
               & (np.abs(rows[1:] - rows[:-1]) <= MOST_LOST)
               & (aside < (MOST_LOST + 0.5) * column))
    return int(follows.argmin()) + 1 if not follows.all() else len(rows)


def wall_edge(end: End, rows: NDArray[np.intp], points: Array, near: int, column: float
              ) -> tuple[float, float] | None:
    """
    Return where a wall in a face's tail (rows) meets the face line, and its 1 sigma.

    The place is along the face from its last point on. None when no wall is in sight.
    """
    all_u, all_v = u, v = frame_of(end, points, near).of(points.take(rows, axis=0))
    if len(v) < WALL_POINTS or v.max() < SMALLEST_WALL:
        return None
    low = (v > 0.5 * v.max()) & (v < 0.97 * v.max())
    if low.sum() < WALL_POINTS:
        return None
    u, v = u[low], v[low]
    mean, spread = float(v.mean()), float(v.std())
    lean = float((v - mean) @ (u - u.mean())) / len(v) / spread ** 2
    if abs(lean) > WALL_LEAN:
        return None
    scatter = float((u - u.mean() - lean * (v - mean)).std()) + column / 12 ** 0.5
    std = scatter * np.sqrt((1 + (mean / spread) ** 2) / len(v))
    place, least = float(u.mean() - lean * mean), _end_of_face(end, all_u, all_v)
    # a wall seen so steeply that it seems to stand below the face is badly measured
    return max(place, least), float(np.hypot(std, max(least - place, 0.0)))


def _end_of_face(end: End, u: Array, v: Array) -> float:
    """Return where the flat part of a face ends, of a tail that lies along it at u, below at v."""
    low = v > FLAT_SIGMAS * end.segment.noise
    flat = int(np.argmax(low)) if low.any() else len(v)
    return float(u[flat - 1]) if flat else 0.0


def end_edge(end: End, rows: NDArray[np.intp], ground: Segment | None, points: Array, near: int,
             column: float, kind: str) -> EdgePoint:
    """
    Return where a plate ends, its tail (rows) included, before a drop.

    ground: what is seen below, if anything; column: between neighbours along x. How far a bent
    end is from its edge is judged later, from all stations (see all_edges).
    """
    segment = end.segment
    frame = frame_of(end, points, near)
    plate = np.concatenate([segment.rows[::end.outward][-LAST_POINTS:], rows])
    u, v = frame.of(points.take(plate, axis=0))
    pitch = column * np.hypot(1.0, segment.slope)
    step = float(np.clip(np.diff(u[-LAST_POINTS:]).mean(), 0.0, pitch)) if len(rows) else pitch
    flat = _end_of_face(end, u[LAST_POINTS:], v[LAST_POINTS:])
    last = max(float(u[-1]), flat)
    mixed, width = _transition(end, int(plate[-1]), ground, points)
    place = last + (step * (1 + mixed) / 2 if not width else pitch * width)
    std = np.sqrt(pitch ** 2 * ((1 + min(mixed, 2)) ** 2 / 12 + LOST_DOUBT ** 2)
                  + (RAMP_DOUBT * pitch * 2 * width) ** 2)
    edge = edge_point(frame, place, float(std), kind)
    if v[-LAST_POINTS:].mean() < BEND_SIGMAS * segment.noise / LAST_POINTS ** 0.5:
        return edge
    before = max(2 * len(rows), SHORTEST_BEND)
    rows = np.concatenate([segment.rows[::end.outward][-before:], rows])
    bend = bend_of(*frame.of(points[rows]), place, segment.noise)
    # what goes down without going out is no bend, but a wall that is hardly seen
    depth = min(bend.depth, STEEPEST_BEND * (last - flat) + FLAT_SIGMAS * segment.noise)
    return replace(edge, bend=depth * frame.below, radius=bend.radius,
                   roundness=bend.roundness)


def _transition(end: End, last: int, ground: Segment | None, points: Array
                ) -> tuple[int, float]:
    """
    Return what lies between a plate's last point and the ground: how many points, and more.

    A column whose spot straddles the edge returns something between the levels: the edge is as
    likely on its one side as on the other. A sensor that smooths, or whose spot is wide, makes a
    ramp of them: the second value is how many columns behind the last point of the plate it is
    at half its height, 0 without a ramp.
    """
    between = abs(end.start_of(ground) - last) - 1 if ground else 0
    columns = np.arange(between + 2)
    rows = last + end.outward * columns
    if ground is None or not 0 < between <= MOST_MIXED:
        return 0, 0.0
    seen = returned(points.take(rows, axis=0))
    columns = columns.take(seen)
    x, z = points.take(rows.take(seen), axis=0).T
    height = np.abs(z - end.segment.height(x))
    share = (height - height[0]) / (np.abs(ground.height(x) - end.segment.height(x)) - height[0])
    mixed = int((share[1:-1] < 0.8).sum())
    if mixed <= MOST_STRAY:
        return (mixed if len(seen) == len(rows) else 0), 0.0
    after = max(int(np.argmax(share > 0.5)), 1)
    part = (0.5 - share[after - 1]) / max(float(share[after] - share[after - 1]), 0.1)
    return mixed, float(columns[after - 1] + part * (columns[after] - columns[after - 1]))


def edge_point(frame: Frame, place: float, std: float, kind: str) -> EdgePoint:
    """Return the edge at a place along the face from its last point on, its line exact."""
    return EdgePoint(frame.origin + place * frame.along, frame.along, std, 0.0, kind)


def std_at(segment: Segment, x: float, points: Array) -> float:
    """Return 1 sigma of the range of a segment's line at x."""
    xs = points[segment.rows, 0]
    spread = xs.std()
    return float(segment.noise * np.sqrt((1 + ((x - xs.mean()) / spread) ** 2) / len(xs)))
