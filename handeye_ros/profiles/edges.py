"""
The edge at the end of a face: sharp, rounded or bevelled.

The edge is where the plane of the face meets the plane of the wall below it. A wall in sight
gives it as the crossing of two lines, whatever lies between them. Otherwise the plate ends at
its last point before the drop, the bent end included.
"""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros.data import Array, EdgePoint
from handeye_ros.profiles.continuation import End, Frame, leading
from handeye_ros.profiles.edge_rounding import rounding_of
from handeye_ros.profiles.segment import returned, Segment
import numpy as np
from numpy.typing import NDArray

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
