# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Where a face of a profile ends in an edge, and where it only ends.

`edge_at` decides from one end of a face: all that makes it real, or speaks against it, stands
there. `face_features` (faces.py) chooses the face; `combine` (sampling/features.py) needs the edge
in most profiles of a stop; in the solve a target leaves an edge unused that lies on none of its
own (`reassign`).

The sensor looks down on a face (===) that ends at its right:

    ======         ======         ======                     ======
         |               |              .
         |_____          |              ._____
    step: the      roof: a wall   shadow: a step whose       gap: nothing is
    next surface   or face goes   foot the sensor or its     seen beyond it
    is lower       down in sight  own light does not reach

The edge is where the plane of the face meets the plane of the wall below it. A wall in sight
gives it as the crossing of two lines, whatever lies between them. Otherwise the plate ends at its
last point before the drop, the bent end included. What lies beyond the end is searched in the
frame of the face, on the continuation of its surface.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
import math

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.edge_rounding import rounding_of
from handeye_ros.profiles.segment import returned, Segment, STEEPEST_SURFACE, unit_parabola
import numpy as np
from numpy.typing import NDArray

GAP_COLUMNS = 3  # missing returns beyond a face that make its end an edge
VIEW_MARGIN = 1e-3  # smallest distance of an edge from the end of the view (m)
ROOF_ANGLE = 0.15  # two pieces that meet at a smaller angle (rad) are one bent face
ROOF_REACH = 8.0  # they meet when their ends are this many columns from the crossing
MIN_STEP_SIGMAS = 8.0
SHADOW_SLOPE = 2.0  # largest width hidden beyond a step, over its height
LARGEST_BEVEL = 2.5e-3  # of a bevel between a face and its wall; a larger piece is a face (m)
LOST_BETWEEN = 4  # largest number of columns between neighbouring points of the plate
SLACK_SIGMAS = 6.0  # of the range difference between two neighbours on a surface
FURTHER_COLUMNS = 80  # columns beyond a face that may still be its bent end or its wall
WALL_SLOPE = 0.45  # largest |tangent| between a wall in the profile and the face's normal
SMALLEST_WALL = 1.2e-3  # smallest depth of a visible wall below the face (m)
WALL_POINTS = 4
BENT_END_SIGMAS = 2.0  # an end that is lower than this is bent
FLAT_SIGMAS = 3.0  # largest distance of a face point below the face line
STEEPEST_ROUNDING = 1.5  # slope of a bent end from where it leaves the face line
SHORTEST_ROUNDING = 20  # points before the last one of a face that may be bent
RIM_SHARE, LONGEST_RIM = 4, 3  # last points of a bent end that are not used: 1 in so many; at most
LOST_STD = 0.17  # 1 sigma of an edge due to lost points, in columns
LAST_POINTS = 3  # last points that give the depth of an end
MIXED_POINTS = 2  # most points between two levels that are only mixed at the edge
BOW_SIGMAS = 3.0  # least bow of a face that counts
BOW_REACH = 2.5  # spreads of its points up to which the bow of a face goes on (1.7: its ends)
LONGEST_RAMP = 16  # points between two levels: a wider transition is a surface
RAMP_STD = 0.1  # 1 sigma of the edge within a wide transition, over its width


@dataclass(frozen=True, eq=False)
class FaceEnd:
    """
    The end of a straight piece with the last of its columns, and the frame of the face there.

    The other end is the last one in the reversed profile, see ends_of_segments.

    segments: all of the profile, in the order of its columns
    points: (n, 2) of the profile
    returns: (k,) columns with a return
    near_sign: times a range, it is larger for nearer points
    """

    segment: Segment
    segments: Sequence[Segment]
    points: Array
    returns: NDArray[np.intp]
    near_sign: int

    @cached_property
    def beyond(self) -> list[Segment]:
        """Return the pieces that reach beyond the end, whether they overlap it or not."""
        return [other for other in self.segments if other.last > self.segment.last]

    def lost(self, first: int, last: int) -> int:
        """Return the number of columns without a return, from the first to before the last."""
        bounds = self.returns.searchsorted([first, last])
        return last - first - int(bounds[1] - bounds[0])

    @cached_property
    def pitch(self) -> float:
        """Return the mean distance (m) between neighbouring columns along the face."""
        first, last = self.segment.first, self.segment.last
        along = abs(self.points.item(last, 0) - self.points.item(first, 0)) / (last - first)
        return along * math.hypot(1.0, self.segment.slope)

    @cached_property
    def frame(self) -> Array:
        """
        Return the frame of the face (3, 2): origin, and unit vectors outwards and below.

        The origin is the point of the face line at the segment's last point.
        """
        segment, near = self.segment, self.near_sign
        x, first = (self.points.item(column, 0) for column in (segment.last, segment.first))
        along = np.array([1.0, segment.slope]) / math.hypot(1.0, segment.slope)
        below = near * np.array([along[1], -along[0]])
        return np.array([[x, segment.height(x)], math.copysign(1.0, x - first) * along, below])

    def outwards_and_below(self, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return where columns (k,) are: outwards along the face (k,), and below it (k,), in m."""
        origin, along, below = self.frame
        away = self.points.take(columns, axis=0) - origin
        u = away @ along
        return u, away @ below - self._bow(u)

    def _bow(self, u: Array) -> Array:
        """Return how far (n,) below its line the face is, outwards at u (n,), and near its end."""
        (x, _), (along, _), (_, below) = self.frame
        middle, spread, bow = self._parabola
        away = np.clip((x + u * along - middle) / spread, -BOW_REACH, BOW_REACH)
        return np.asarray(bow * below * unit_parabola(away))

    @cached_property
    def _parabola(self) -> tuple[float, float, float]:
        """Return middle, spread (along x) and RMS height of the bow of the face, 0 if not sure."""
        x, z = self.points.take(self.segment.straight, axis=0).T
        middle, spread = float(x.mean()), float(x.std())
        shape = unit_parabola((x - middle) / spread)
        square = float(shape @ shape)
        height = float((z - self.segment.height(x)) @ shape) / square
        return middle, spread, height * (
            height ** 2 * square > (BOW_SIGMAS * self.segment.noise) ** 2)

    def edge(self, place: float, std: float, ending: str) -> EdgePoint:
        """Return the edge point on the face, at a place (m) outwards from the origin."""
        origin, along, below = self.frame
        point = origin + place * along + self._bow(np.array(place)) * below
        return EdgePoint(point, along, std, 0.0, ending)

    def rise_of(self, column: int) -> float:
        """Return by how much a point is nearer than the face line (m, along the range)."""
        x, z = self.points[column].tolist()
        return float(self.near_sign * (z - self.segment.height(x)))


def ends_of_segments(segments: Sequence[Segment], points: Array, config: Config
                     ) -> Iterator[tuple[FaceEnd, FaceEnd]]:
    """Yield the first and the last end of segments of a profile (n, 2), the longest first."""
    n, returns, near = len(points), returned(points), -config.profile.range_sign
    turned = [segment.reversed(n) for segment in reversed(segments)]
    for k in sorted(range(len(segments)), key=lambda k: -len(segments[k].columns)):
        yield (FaceEnd(turned[-1 - k], turned, points[::-1], n - 1 - returns[::-1], near),
               FaceEnd(segments[k], segments, points, returns, near))


class NoEdgeError(FeatureError):
    """Why a face ends without an edge: it ends only..."""


def edge_at(end: FaceEnd) -> EdgePoint:
    """
    Return the edge at the end of a face; raises NoEdgeError where it is none.

    The face ends in an edge where a wall is seen (roof), where the next surface is lower (step, or
    shadow if its foot is hidden), or where nothing is seen beyond it (gap, or open if the driver
    does not say).
    """
    end_columns, size, corner = _end_columns(end), len(end.points), None
    beyond = end.beyond
    if beyond and _is_bevel(end, beyond[0], end_columns):
        beyond = beyond[1:]  # of the same plate
    next_surface = beyond[0] if beyond else None
    # a driver that leaves lost points out does not say where the field of view ends
    marks_lost = len(end.returns) < size
    if next_surface:
        end_columns = end_columns[end_columns < next_surface.first]
        corner = _corner(end, next_surface, end_columns)
        ending = 'roof' if corner else _ending_before(end, next_surface, end_columns)
    elif not marks_lost:
        ending = 'open'
    elif end.lost(end.segment.last + 1, size) >= GAP_COLUMNS:
        ending = 'gap'
    else:
        raise NoEdgeError('at the border of the field of view')
    room = min(end.segment.last, size - 1 - end.segment.last) * end.pitch
    if marks_lost and room < VIEW_MARGIN:
        raise NoEdgeError(
            f'{room * 1e3:.1f} mm from the end of the view, where its edge may be cut off (move '
            f'it {VIEW_MARGIN * 1e3:.0f} mm or more into the view)')
    if corner:
        return corner
    if wall := _wall(end, end_columns):
        return end.edge(*wall, 'roof')
    ground = next_surface if ending in ('step', 'shadow') else None
    return _edge_before_drop(end, end_columns, ground, ending)


def _ending_before(end: FaceEnd, next_surface: Segment, end_columns: NDArray[np.intp]) -> str:
    """
    Return how a face ends before another surface; raises NoEdgeError where it does not.

    A nearer surface hides what lies beside it, but not farther aside than SHADOW_SLOPE times its
    height. Where nothing is seen even so, the face has ended before (gap).
    """
    start, least = next_surface.first, smallest_step(end, next_surface)
    rise = end.rise_of(start)
    if rise < -least:
        last = int(end_columns[-1]) if len(end_columns) else end.segment.last
        return 'shadow' if end.lost(last, start) >= GAP_COLUMNS else 'step'
    if rise <= least:
        raise NoEdgeError('where its surface goes on at nearly the same height')
    if abs(end.points[start, 0] - end.points[end.segment.last, 0]) > SHADOW_SLOPE * rise:
        return 'gap'
    raise NoEdgeError('at something nearer')


def smallest_step(end: FaceEnd, other: Segment) -> float:
    """Return the smallest height (m) between a face and another surface that is a step."""
    return MIN_STEP_SIGMAS * max(end.segment.noise, other.noise)


def _is_bevel(end: FaceEnd, other: Segment, end_columns: NDArray[np.intp]) -> bool:
    """Return whether the next piece is a bevel of the same plate, not a wall or face."""
    if other.first not in end_columns:
        return False
    u, v = end.outwards_and_below(other.columns[[0, -1]])
    size, down = math.hypot(u[1] - u[0], v[1] - v[0]), float(v[1] - v[0])
    return size <= LARGEST_BEVEL and down > 0 and abs(u[1] - u[0]) > WALL_SLOPE * down


def _corner(end: FaceEnd, other: Segment, end_columns: NDArray[np.intp]) -> EdgePoint | None:
    """
    Return the edge where the lines of a face and of the next surface cross.

    None where they do not meet there. Raises NoEdgeError where the other one rises to the sensor:
    a surface that turns away from it leaves the line over its whole length.
    """
    a, b = end.segment, other
    if abs(math.atan(a.slope) - math.atan(b.slope)) < ROOF_ANGLE:
        return None
    x, (origin, along, _) = a.crossing(b), end.frame
    place, start = ((where - origin[0]) / along[0] for where in (x, end.points[other.first, 0]))
    # a rounded or bevelled corner leaves room between the pieces, with points of its own
    bent = len(end_columns) > 0 and other.first - end_columns[-1] <= LOST_BETWEEN
    reach = max(ROOF_REACH * end.pitch, LARGEST_BEVEL if bent else 0.0)
    if not (min(start, 0.0) - reach <= place <= max(start, 0.0) + reach
            and abs(start) <= 2 * reach):
        return None
    if end.rise_of(other.last) > 0:
        raise NoEdgeError('at something nearer')
    # offset errors of both lines, extrapolated to their crossing; a steep surface that is noisier
    # than the face has an additional error of that size
    stds = [max(b.noise ** 2 - a.noise ** 2, 0.0) ** 0.5]
    for line in (a, b):
        xs = end.points[line.columns, 0]
        stds.append(line.noise * math.sqrt((1 + ((x - xs.mean()) / xs.std()) ** 2) / len(xs)))
    std = math.hypot(*stds) / abs(a.slope - b.slope) * math.hypot(1.0, a.slope)
    return end.edge(place, std, 'roof')


def _end_columns(end: FaceEnd) -> NDArray[np.intp]:
    """
    Return the end columns: beyond the end of a face, but of its surface, outwards.

    The surface may turn away from the sensor, up to the slope from which light returns. One wrong
    point does not end it.
    """
    at = int(end.returns.searchsorted(end.segment.last))
    ahead = end.returns[at:at + FURTHER_COLUMNS + 2].tolist()
    columns, skipped = [end.segment.last], False
    for column, after in pairwise([*ahead[1:], end.segment.last]):
        if column - end.segment.last > FURTHER_COLUMNS:
            break
        if _follows(end, columns[-1], column):
            columns.append(column)
        elif skipped or not _follows(end, columns[-1], after):
            break
        else:
            skipped = True
    return np.array(columns[1:], dtype=np.intp)


def _follows(end: FaceEnd, column: int, after: int) -> bool:
    """Return whether a column continues the surface of another one, and may curve away."""
    (x, z), (x_after, z_after) = end.points[column].tolist(), end.points[after].tolist()
    aside, drop = abs(x_after - x), end.near_sign * (z - z_after)
    slack = SLACK_SIGMAS * end.segment.noise
    # a driver may leave lost points out: then the next column need not be near
    return (0 < after - column <= LOST_BETWEEN and aside < (LOST_BETWEEN + 0.5) * end.pitch
            and -slack < drop < STEEPEST_SURFACE * aside + slack)


def _wall(end: FaceEnd, end_columns: NDArray[np.intp]) -> tuple[float, float] | None:
    """
    Return position and 1 sigma (m) where a wall in the end columns meets the face line.

    The position is along the face from its last point. None without a visible wall.
    """
    if len(end_columns) < WALL_POINTS:
        return None
    all_u, all_v = u, v = end.outwards_and_below(end_columns)
    lowest = float(v.max())
    low = (v > 0.5 * lowest) & (v < 0.97 * lowest)
    if lowest < SMALLEST_WALL or np.count_nonzero(low) < WALL_POINTS:
        return None
    u, v = u[low], v[low]
    mean, spread = float(v.mean()), float(v.std())
    covariance = float((v - mean) @ (u - u.mean())) / len(v)
    if not abs(covariance) < WALL_SLOPE * spread ** 2:  # also of points at one depth
        return None
    slope = covariance / spread ** 2
    scatter = float((u - u.mean() - slope * (v - mean)).std()) + end.pitch / 12 ** 0.5
    std = scatter * np.sqrt((1 + (mean / spread) ** 2) / len(v))
    place, least = float(u.mean() - slope * mean), _end_of_face(end, all_u, all_v)
    # a wall seen so steeply that it seems to stand below the face is badly measured
    return max(place, least), float(np.hypot(std, max(least - place, 0.0)))


def _end_of_face(end: FaceEnd, u: Array, v: Array) -> float:
    """Return the end of the flat part of a face, with points at u along and v below it."""
    flat = int(np.append(v > FLAT_SIGMAS * end.segment.noise, True).argmax())
    return float(u[flat - 1]) if flat else 0.0


def _edge_before_drop(end: FaceEnd, end_columns: NDArray[np.intp], ground: Segment | None,
                      ending: str) -> EdgePoint:
    """
    Return the end of a plate before a drop, the end columns included.

    It lies between the last point of the plate and the next one that is not mixed of both sides,
    or, where a sensor makes a ramp of the drop, where that is half way down. A bent end has a
    depth, an arc and odds of its shapes. ground: the surface seen below, or None.
    """
    plate = np.concatenate([end.segment.columns[-LAST_POINTS:], end_columns])
    u, v = end.outwards_and_below(plate)
    pitch, noise = end.pitch, end.segment.noise
    flat = _end_of_face(end, u[LAST_POINTS:], v[LAST_POINTS:])
    last = max(float(u[-1]), flat)
    mixed, half_way = _transition(end, int(plate[-1]), ground)
    # the points of a bent end are nearer to each other
    step = float(u[-1] - u[-LAST_POINTS]) / (LAST_POINTS - 1) if len(end_columns) else pitch
    place = last + (half_way or min(max(step, 0.0), pitch) * (1 + mixed) / 2)
    std = math.hypot(pitch * (1 + min(mixed, MIXED_POINTS)) / 12 ** 0.5, pitch * LOST_STD,
                     2 * RAMP_STD * half_way)
    edge = end.edge(place, std, ending)
    if v[-LAST_POINTS:].mean() < BENT_END_SIGMAS * noise / LAST_POINTS ** 0.5:
        return edge
    # how far a bent end is from the edge is determined later, from all samples (see
    # sampling/edge_shapes.py); its last points are the worst
    before = end.segment.columns[-max(2 * len(end_columns), SHORTEST_ROUNDING):]
    inner = end_columns[:len(end_columns) - min(len(end_columns) // RIM_SHARE, LONGEST_RIM)]
    u, v = end.outwards_and_below(np.concatenate([before, inner]))
    depth, shapes, (out, below), arc_std = rounding_of(u, v, place, pitch, noise)
    # an end that goes down but not outwards is no bend, but a hardly visible wall
    depth = min(depth, STEEPEST_ROUNDING * (last - flat) + FLAT_SIGMAS * noise)
    _, outwards, downwards = end.frame
    return replace(edge, drop=depth * downwards, shape_log_odds=shapes, arc_std=arc_std,
                   arc_offset=(out - place) * outwards + below * downwards)


def _transition(end: FaceEnd, last: int, ground: Segment | None) -> tuple[int, float]:
    """
    Return the number of mixed columns between plate and ground, and the place half way down.

    A column whose spot straddles the edge returns a range between the levels; the edge is equally
    likely on both of its sides. A sensor that smooths, or has a wide spot, makes a ramp of more
    than MIXED_POINTS: only then the place (m) is not 0, from the last column of the plate, `last`.
    """
    if ground is None or not 0 < ground.first - last - 1 <= LONGEST_RAMP:
        return 0, 0.0
    points = end.points[last:ground.first + 1]
    columns = returned(points)
    x, z = points.take(columns, axis=0).T
    height = np.abs(z - end.segment.height(x))
    share = (height - height[0]) / (np.abs(ground.height(x) - end.segment.height(x)) - height[0])
    mixed = int((share[1:-1] < 0.8).sum())
    if mixed <= MIXED_POINTS:
        return (mixed if len(columns) == len(points) else 0), 0.0
    after = max(int(np.argmax(share > 0.5)), 1)
    way = (0.5 - share[after - 1]) / max(float(share[after] - share[after - 1]), 0.1)
    half_way = columns[after - 1] + way * (columns[after] - columns[after - 1])
    return mixed, float(half_way) * end.pitch
