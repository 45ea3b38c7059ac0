# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Where a face of a profile ends in an edge, and where it only ends.

`edge_at` decides from one end of a face: all that makes it real, or speaks against it, stands
there, in the order of the file. `face_features` (faces.py) chooses the face, one beside a nearer
surface last; `features_of_stop` (sampling/features.py) needs an edge on that side in most profiles
of a stop, and takes those of the most frequent ending; in the solve a target leaves an edge unused
that lies on none of its own (`reassign`).

The sensor looks down on a face (===) that ends at its right:

    ======         ======         ======                     ======
         |               |              .
         |_____          |              ._____
    step: the      roof: a wall   shadow: a step whose       gap: nothing is
    next surface   or face goes   foot the sensor or its     seen beyond it
    is lower       down in sight  own light does not reach

The edge is where the plane of the face meets the plane of the wall below it. A wall in sight
gives it as the crossing of two lines, whatever lies between them. Otherwise the plate ends about
half a column beyond its last point before the drop. Beyond the straight piece its surface may go
on in a *tail*: a rounded or bevelled end, or a wall.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, has_return, Indices
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.edge_rounding import fitted_bend
from handeye_ros.profiles.segment import (
    legendre_2,
    line_through,
    Segment,
    STEEPEST_SURFACE,
)
import numpy as np
from numpy.typing import NDArray

BOW_SIGMAS = 3.0  # least bow of a face that counts
BOW_REACH = 2.5  # the bow goes on up to so many spreads of its points; the ends are at 1.7


@dataclass(frozen=True, eq=False)
class FaceEnd:
    """
    Where a straight piece of a profile ends with its last column, and the frame of its face there.

    The first end of a piece is the last one of the reversed profile, see ends_of_segments. The
    frame has its origin on the face line, at the last column; places in it are u, outwards along
    the face, and v, down from it (m).

    segment: the straight piece
    segments: all of the profile, in the order of its columns
    points: (n, 2) of the profile
    is_return: (n,) which columns have one
    near_sign: times a range, it is larger for nearer points
    """

    segment: Segment
    segments: Sequence[Segment]
    points: Array
    is_return: NDArray[np.bool_]
    near_sign: int

    @property
    def has_lost_columns(self) -> bool:
        """
        Return whether columns of this profile lack a return.

        A driver that leaves them out does not show where the view ends.
        """
        return not self.is_return.all()

    @cached_property
    def beyond(self) -> list[Segment]:
        """Return the pieces that reach beyond the end, whether they overlap it or not."""
        return [other for other in self.segments if other.last > self.segment.last]

    @cached_property
    def pitch(self) -> float:
        """Return the mean distance (m) between neighbouring columns along the face."""
        first, last = self.segment.first, self.segment.last
        return math.dist(self.points[first], self.points[last]) / (last - first)

    @cached_property
    def frame(self) -> Array:
        """Return the frame of the face (3, 2): origin, and unit vectors outwards and down."""
        segment = self.segment
        x, first = (self.points.item(column, 0) for column in (segment.last, segment.first))
        along = np.array([1.0, segment.slope]) / math.hypot(1.0, segment.slope)
        down = self.near_sign * np.array([along[1], -along[0]])
        return np.array([[x, segment.height(x)], math.copysign(1.0, x - first) * along, down])

    def coordinates(self, columns: Indices) -> tuple[Array, Array]:
        """Return u and v (k,) of columns (k,); a bow of the face is taken off v."""
        origin, outwards, down = self.frame
        offsets = self.points.take(columns, axis=0) - origin
        u = offsets @ outwards
        return u, offsets @ down - self._bow_at(u)

    def edge(self, u: float, std: float, ending: str) -> EdgePoint:
        """Return the edge point on the face at u, with 1 sigma along the face."""
        origin, outwards, down = self.frame
        point = origin + u * outwards + self._bow_at(np.array(u)) * down
        return EdgePoint(point, outwards, std, 0.0, ending)

    def _bow_at(self, u: Array) -> Array:
        """Return v (n,) of the bowed face at u (n,); beyond BOW_REACH it goes on level."""
        (x, _), (outwards_x, _), (_, down_z) = self.frame
        middle, spread, height = self._bow
        spreads = np.clip((x + u * outwards_x - middle) / spread, -BOW_REACH, BOW_REACH)
        return np.asarray(height * down_z * legendre_2(spreads))

    @cached_property
    def _bow(self) -> tuple[float, float, float]:
        """Return middle and spread (along x) of the face, and the RMS of its bow, 0 if unsure."""
        x, z = self.points.take(self.segment.straight_columns, axis=0).T
        middle, spread = float(x.mean()), float(x.std())
        parabola = legendre_2((x - middle) / spread)
        square = float(parabola @ parabola)
        height = float((z - self.segment.height(x)) @ parabola) / square
        return middle, spread, height * (
            height ** 2 * square > (BOW_SIGMAS * self.segment.noise) ** 2)

    def rise_of(self, column: int) -> float:
        """Return by how much a point is nearer than the face line (m, along the range)."""
        x, z = self.points[column].tolist()
        return float(self.near_sign * (z - self.segment.height(x)))


def ends_of_segments(segments: Sequence[Segment], points: Array, config: Config
                     ) -> Iterator[tuple[FaceEnd, FaceEnd]]:
    """Yield the first and the last end of segments of a profile (n, 2), the longest first."""
    is_return, near_sign = has_return(points), -config.profile.range_sign
    mirrored = [segment.reversed(len(points)) for segment in reversed(segments)]
    for k in sorted(range(len(segments)), key=lambda k: -len(segments[k].columns)):
        yield (FaceEnd(mirrored[-1 - k], mirrored, points[::-1], is_return[::-1], near_sign),
               FaceEnd(segments[k], segments, points, is_return, near_sign))


class NoEdgeError(FeatureError):
    """Why a face ends without an edge: it ends only..."""


GAP_COLUMNS = 3  # missing returns beyond a face that make its end an edge
VIEW_MARGIN = 1e-3  # smallest distance of an edge from the end of the view (m)
AT_NEARER = 'at something nearer'  # where a face ends without an edge


def edge_at(end: FaceEnd) -> EdgePoint:
    """
    Return the edge at the end of a face; raises NoEdgeError where the face only ends.

    An end is real if one of these is seen beyond it; in a profile with lost columns the view must
    also go on for VIEW_MARGIN:

    roof    a wall or another face that meets it and goes down
    step    a lower surface
    shadow  a lower surface, with lost columns before it
    gap     lost columns and no surface beyond, or a nearer one too far aside to hide more
    open    nothing at all, in a profile without lost columns, as of a driver that leaves them out:
            it may be the border, and the target decides (reassign)

    It is none before a surface of the same height, before a nearer one, or at the border of a
    profile with lost columns. The edge is at the crossing with the other face, at a wall seen in
    the tail, or else beyond the last point before the drop.
    """
    tail, beyond = _tail(end), end.beyond
    if beyond and _is_bevel(end, beyond[0], tail):
        beyond = beyond[1:]  # of the same plate
    next_surface = beyond[0] if beyond else None
    if next_surface:
        tail = tail[tail < next_surface.first]
    if next_surface and _meet_in_roof(end, next_surface, tail):
        # a surface that turns away from the sensor leaves the face line over its whole length
        if end.rise_of(next_surface.last) > 0:
            raise NoEdgeError(AT_NEARER)
        _require_room(end)
        return _edge_at_roof(end, next_surface)
    ending = _ending(end, next_surface, tail)
    _require_room(end)
    ground = next_surface if ending in ('step', 'shadow') else None
    return _edge_at_wall(end, tail) or _edge_before_drop(end, tail, ending, ground)


def _require_room(end: FaceEnd) -> None:
    """Raise NoEdgeError for an edge so near an end of the view that either side may be cut off."""
    last = end.segment.last
    # on the side of the face too: less of it in view may be a sliver
    room = min(last, len(end.points) - 1 - last) * end.pitch
    if end.has_lost_columns and room < VIEW_MARGIN:
        raise NoEdgeError(
            f'{room * 1e3:.1f} mm from the end of the view, where its edge may be cut off (move '
            f'it {VIEW_MARGIN * 1e3:.0f} mm or more into the view)')


LOST_BETWEEN = 4  # largest step between neighbouring points of the plate, in columns
SLACK_SIGMAS = 6.0  # of the range difference between two neighbours on a surface
FURTHER_COLUMNS = 80  # columns beyond a face that may still be its bent end or its wall


def _tail(end: FaceEnd) -> Indices:
    """
    Return the tail of a face: the columns beyond its straight piece where its surface goes on.

    The surface may turn away from the sensor, up to the slope from which light returns. One wrong
    point does not end it.
    """
    beyond, skipped = end.segment.last + 1, False
    tail = [end.segment.last]
    returns = end.is_return[beyond:beyond + FURTHER_COLUMNS].nonzero()[0]
    for column in (beyond + returns).tolist():
        if _goes_on(end, tail[-1], column):
            tail.append(column)
        elif skipped:
            break
        else:
            skipped = True
    return np.array(tail[1:], dtype=np.intp)


def _goes_on(end: FaceEnd, column: int, after: int) -> bool:
    """Return whether the surface of a column goes on to a later one, and may curve away."""
    (x, z), (x_after, z_after) = end.points[column].tolist(), end.points[after].tolist()
    aside, drop = abs(x_after - x), end.near_sign * (z - z_after)
    slack = SLACK_SIGMAS * end.segment.noise
    # a driver may leave lost points out: then the next column need not be near
    return (after - column <= LOST_BETWEEN and aside < (LOST_BETWEEN + 0.5) * end.pitch
            and -slack < drop < STEEPEST_SURFACE * aside + slack)


MAX_BEVEL = 2.5e-3  # of a bevel between a face and its wall; a larger piece is a face (m)
WALL_SLOPE = 0.45  # largest |tangent| between a wall in the profile and the face's normal


def _is_bevel(end: FaceEnd, piece: Segment, tail: Indices) -> bool:
    """Return whether the next piece is a bevel of the same plate, not a wall or face."""
    if piece.first not in tail:
        return False
    u, v = end.coordinates(piece.columns[[0, -1]])
    size, depth = math.hypot(u[1] - u[0], v[1] - v[0]), float(v[1] - v[0])
    return size <= MAX_BEVEL and depth > 0 and abs(u[1] - u[0]) > WALL_SLOPE * depth


ROOF_ANGLE = 0.15  # two pieces that meet at a smaller angle (rad) are one bent face
ROOF_REACH = 8.0  # they meet when their ends are this many columns from the crossing


def _meet_in_roof(end: FaceEnd, other: Segment, tail: Indices) -> bool:
    """Return whether the lines of a face and of the next surface cross between, at an angle."""
    face, (origin, outwards, _) = end.segment, end.frame
    if abs(math.atan(face.slope) - math.atan(other.slope)) < ROOF_ANGLE:
        return False
    crossing, start = ((x - origin[0]) / outwards[0]
                       for x in (face.crossing(other), end.points[other.first, 0]))
    # a rounded or bevelled corner leaves room between the pieces, with points of its own
    has_tail = len(tail) > 0 and other.first - tail[-1] <= LOST_BETWEEN
    reach = max(ROOF_REACH * end.pitch, MAX_BEVEL if has_tail else 0.0)
    return bool(min(start, 0.0) - reach <= crossing <= max(start, 0.0) + reach
                and abs(start) <= 2 * reach)


def _edge_at_roof(end: FaceEnd, other: Segment) -> EdgePoint:
    """Return the edge where the lines of a face and of another surface cross."""
    face, (origin, outwards, _) = end.segment, end.frame
    crossing_x = face.crossing(other)
    # offset errors of both lines, extrapolated to their crossing; a steep surface that is noisier
    # than the face has an additional error of that size
    stds = [max(other.noise ** 2 - face.noise ** 2, 0.0) ** 0.5]
    for line in (face, other):
        x = end.points[line.columns, 0]
        stds.append(line.noise * math.sqrt(
            (1 + ((crossing_x - x.mean()) / x.std()) ** 2) / len(x)))
    std = math.hypot(*stds) / abs(face.slope - other.slope) * math.hypot(1.0, face.slope)
    return end.edge((crossing_x - origin[0]) / outwards[0], std, 'roof')


SHADOW_SLOPE = 2.0  # largest width hidden beyond a nearer surface, over its height
MIN_STEP_SIGMAS = 8.0


def _ending(end: FaceEnd, next_surface: Segment | None, tail: Indices) -> str:
    """
    Return how a face ends that is no roof; raises NoEdgeError where it does not end.

    A nearer surface hides what lies beside it, but not farther aside than SHADOW_SLOPE times its
    height. Where nothing is seen even so, the face has ended before (gap).
    """
    if next_surface is None:
        if not end.has_lost_columns:
            return 'open'
        if np.count_nonzero(~end.is_return[end.segment.last + 1:]) >= GAP_COLUMNS:
            return 'gap'
        raise NoEdgeError('at the border of the field of view')
    start, least = next_surface.first, smallest_step(end, next_surface)
    rise = end.rise_of(start)
    if rise < -least:
        last = int(tail[-1]) if len(tail) else end.segment.last
        lost_count = np.count_nonzero(~end.is_return[last:start])
        return 'shadow' if lost_count >= GAP_COLUMNS else 'step'
    if rise <= least:
        raise NoEdgeError('where its surface goes on at nearly the same height')
    if abs(end.points[start, 0] - end.points[end.segment.last, 0]) > SHADOW_SLOPE * rise:
        return 'gap'
    raise NoEdgeError(AT_NEARER)


def smallest_step(end: FaceEnd, other: Segment) -> float:
    """Return the smallest height (m) between a face and another surface that is a step."""
    return MIN_STEP_SIGMAS * max(end.segment.noise, other.noise)


MIN_WALL = 1.2e-3  # smallest depth of a visible wall below the face (m)
WALL_POINTS = 4  # fewest points of a wall
# depths over the lowest one that are surely on the wall: above may be a bevel or a rounding, and
# below the mixed points at its foot
WALL_FROM, WALL_TO = 0.5, 0.97


def _edge_at_wall(end: FaceEnd, tail: Indices) -> EdgePoint | None:
    """Return the edge where a wall, seen in the tail of a face, meets it; None without a wall."""
    if len(tail) < WALL_POINTS:
        return None
    tail_u, tail_v = end.coordinates(tail)
    lowest = float(tail_v.max())
    on_wall = (tail_v > WALL_FROM * lowest) & (tail_v < WALL_TO * lowest)
    if lowest < MIN_WALL or np.count_nonzero(on_wall) < WALL_POINTS:
        return None
    v = tail_v[on_wall]
    line = line_through(v, tail_u[on_wall])  # u of the wall is top + slope * v
    if line is None or abs(line[1]) >= WALL_SLOPE:
        return None
    top, _, _, residual = line
    scatter = float(residual.std()) + end.pitch / 12 ** 0.5
    std = scatter * np.sqrt((1 + (v.mean() / v.std()) ** 2) / len(v))
    flat_end = _u_of_flat_end(end, tail_u, tail_v)
    # a wall seen so steeply that it seems to stand below the face is badly measured
    return end.edge(max(top, flat_end), float(np.hypot(std, max(flat_end - top, 0.0))), 'roof')


FLAT_SIGMAS = 3.0  # largest distance of a face point below the face line


def _u_of_flat_end(end: FaceEnd, tail_u: Array, tail_v: Array) -> float:
    """Return u of the last point of the tail before it leaves the face line."""
    flat = int(np.append(tail_v > FLAT_SIGMAS * end.segment.noise, True).argmax())
    return float(tail_u[flat - 1]) if flat else 0.0


LAST_POINTS = 3  # last points that give the depth of an end
BENT_END_SIGMAS = 2.0  # an end that is lower than this is bent
STEEPEST_ROUNDING = 1.5  # slope of a bent end from where it leaves the face line
MIN_ROUNDING = 20  # points before the last one of a face that may be bent
RIM_SHARE, MAX_RIM = 4, 3  # last points of a bent end that are not used: 1 in so many; at most
LOST_STD = 0.17  # 1 sigma of an edge due to lost points, in columns


def _edge_before_drop(end: FaceEnd, tail: Indices, ending: str, ground: Segment | None
                      ) -> EdgePoint:
    """
    Return the edge at the end of a plate, its tail included, before a drop.

    ground: the surface seen below, of a step or shadow; None of other endings.
    """
    plate = np.concatenate([end.segment.columns[-LAST_POINTS:], tail])
    u, v = end.coordinates(plate)
    pitch, noise = end.pitch, end.segment.noise
    flat_end = _u_of_flat_end(end, u[LAST_POINTS:], v[LAST_POINTS:])
    plate_end = max(float(u[-1]), flat_end)
    # the points of a bent end are nearer to each other
    spacing = float(u[-1] - u[-LAST_POINTS]) / (LAST_POINTS - 1) if len(tail) else pitch
    way, std = _distance_to_edge(end, int(plate[-1]), min(max(spacing, 0.0), pitch), ground)
    edge_u = plate_end + way
    edge = end.edge(edge_u, math.hypot(std, pitch * LOST_STD), ending)
    if v[-LAST_POINTS:].mean() < BENT_END_SIGMAS * noise / LAST_POINTS ** 0.5:
        return edge
    # the end is bent. How far it is from the edge is determined later, from all samples (see
    # sampling/edge_shapes.py); its last points are the worst
    before = end.segment.columns[-max(2 * len(tail), MIN_ROUNDING):]
    inner = tail[:len(tail) - min(len(tail) // RIM_SHARE, MAX_RIM)]
    bend = fitted_bend(*end.coordinates(np.concatenate([before, inner])), edge_u, pitch, noise)
    # an end that goes down but not outwards is no bend, but a hardly visible wall
    depth = min(bend.depth, STEEPEST_ROUNDING * (plate_end - flat_end) + FLAT_SIGMAS * noise)
    _, outwards, down = end.frame
    return replace(edge, to_lowest=depth * down, shape_log_likelihoods=bend.shape_log_likelihoods,
                   rounding_offset=(bend.rounding_u - edge_u) * outwards + bend.rounding_v * down,
                   rounding_std=bend.rounding_std)


MAX_RAMP = 16  # points between two levels: a wider transition is a surface
MIXED_POINTS = 2  # most points between two levels that are only mixed at the edge
RAMP_STD = 0.2  # 1 sigma of the edge within a wide transition, over the way to its middle
GROUND_SHARE = 0.8  # of the way down: points below may be of a noisy ground
MIN_SHARE_STEP = 0.1  # between points at half the way: a smaller one is noise, to divide by


def _distance_to_edge(end: FaceEnd, last: int, spacing: float, ground: Segment | None
                      ) -> tuple[float, float]:
    """
    Return how far the edge lies beyond the last column of a plate, and 1 sigma (m).

    A column whose spot straddles the edge returns a range between the levels: the edge is equally
    likely anywhere between the plate and the next point that is not mixed. A sensor that smooths,
    or has a wide spot, makes a ramp of more than MIXED_POINTS, and the edge is half way down.
    spacing: of the points (m); ground: the surface seen below, or None.
    """
    mixed, uniform_std = 0, end.pitch / 12 ** 0.5
    if ground and 0 < ground.first - last - 1 <= MAX_RAMP:
        points = end.points[last:ground.first + 1]
        columns = np.flatnonzero(has_return(points))
        x, z = points.take(columns, axis=0).T
        depth, ground_depth = (np.abs(level - end.segment.height(x)) for level in (
            z, ground.height(x)))
        # of the way down, the whole of a ground that is no deeper
        way = ground_depth - depth[0]
        share = np.divide(depth - depth[0], way, out=np.ones_like(way), where=way > 0)
        between = int((share[1:-1] < GROUND_SHARE).sum())
        if between > MIXED_POINTS:
            after = max(int(np.argmax(share > 0.5)), 1)
            fraction = (0.5 - share[after - 1]) / max(
                float(share[after] - share[after - 1]), MIN_SHARE_STEP)
            half_way = end.pitch * float(
                columns[after - 1] + fraction * (columns[after] - columns[after - 1]))
            return half_way, math.hypot((1 + MIXED_POINTS) * uniform_std, RAMP_STD * half_way)
        mixed = between if len(columns) == len(points) else 0
    return spacing * (1 + mixed) / 2, (1 + mixed) * uniform_std
