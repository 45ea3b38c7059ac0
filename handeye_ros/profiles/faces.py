# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The face line and the edge points of one profile across a plate.

The face is the surface nearer to the sensor. It ends at a step down, at a gap (nothing behind
it) or at a roof edge (it turns away). Where the field of view ends, or a few returns are
missing inside the face, there is no edge.
"""
from __future__ import annotations

from collections.abc import Sequence
import math

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.edges import (
    continuation,
    edge_point,
    End,
    end_edge,
    MOST_LOST,
    Returns,
    std_at,
    wall_edge,
    WALL_SLOPE,
)
from handeye_ros.profiles.lines import face_line, on_line, white_std
from handeye_ros.profiles.segment import returned, Segment, segments_among, straight_segments
import numpy as np
from numpy.typing import NDArray

GAP_COLUMNS = 3  # missing returns behind a face that make its end an edge
ROOF_ANGLE = 0.15  # two pieces that meet at a smaller angle (rad) are one bent face
ROOF_REACH = 8.0  # they meet when their ends are this many columns from the crossing
MIN_STEP_SIGMAS = 8.0
SURE_EDGE = 1.5  # weight of a face with a sure edge
BEHIND = 0.02  # weight of a surface beside a nearer one: all stations should choose the same
SHADOW_SLOPE = 2.0  # largest width hidden behind a step, over its height
WIDEST_GAP, SPLINTER = 0.02, 0.002  # largest gap between adjacent surfaces; largest splinter (m)
LARGEST_BEVEL = 2.5e-3  # of a bevel between a face and its wall; a larger piece is a face (m)
STEEP_ERROR = 1.0  # error of a steep surface, as a share of its additional noise
MOST_SURFACES, SMALLEST_SURFACE = 3, 0.1  # surfaces that may be the plane; size over the longest
EDGE_KINDS = ('roof', 'step', 'gap', 'open')  # a step may turn out as a shadow


def face_features(points: Array, config: Config) -> tuple[Feature, ...]:
    """
    Return the face line and the edge points (one or two) of a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return.
    Raises FeatureError when there is no face with an edge in the profile.
    """
    noise, min_points = config.noise.sensor, config.sampling.min_points
    seen = Returns(points, returned(points), -config.profile.range_sign)
    segments = segments_among(seen.rows, points, noise, min_points)
    if not segments:
        raise FeatureError(f'no straight face of {min_points} points or more in the profile')
    face, edges = _preferred(segments, seen)
    if face is None:
        raise FeatureError('no edge of a face in the profile: the face ends only at the border '
                           'of the field of view or at something nearer')
    line = face_line(face, points)
    return (line, *(on_line(edge, line, line.std / white_std(face)) for edge in edges))


def plane_features(points: Array, config: Config) -> tuple[FaceLine, ...]:
    """
    Return all straight pieces of a profile as candidates for the plane, longest first.

    points: (n, 2) in the sensor plane, NaN where there was no return. Edges are neither needed
    nor looked for. Raises FeatureError.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    if not segments:
        raise FeatureError('no straight piece of '
                           f'{config.sampling.min_points} points or more in the profile')
    longest = sorted(segments, key=lambda s: -len(s.rows))[:MOST_SURFACES]
    return tuple(face_line(segment, points) for segment in longest
                 if len(segment.rows) >= SMALLEST_SURFACE * len(longest[0].rows))


def _preferred(segments: Sequence[Segment], seen: Returns
               ) -> tuple[Segment | None, list[EdgePoint]]:
    """Return the most likely face segment and its edges; None without any edge."""
    best = 0.0
    found: tuple[Segment | None, list[EdgePoint]] = (None, [])
    # the longest first: most of the others then cannot be preferred, whatever their edges are
    for segment in sorted(segments, key=lambda s: -len(s.rows)):
        if len(segment.rows) * SURE_EDGE < best:
            break
        edges, behind = _edges(segment, segments, seen)
        likely = _preference(segment, edges, behind) if edges else 0.0
        if likely > best or (likely == best and found[0] and segment.first < found[0].first):
            best, found = likely, (segment, edges)
    return found


def _preference(segment: Segment, edges: Sequence[EdgePoint], behind: bool) -> float:
    """Return the score of a segment as the face: its number of points, weighted by its edges."""
    sure = any(edge.kind in ('step', 'shadow', 'roof') for edge in edges)
    return len(segment.rows) * (SURE_EDGE if sure else 1.0) * (BEHIND if behind else 1.0)


def _edges(segment: Segment, segments: Sequence[Segment], seen: Returns
           ) -> tuple[list[EdgePoint], bool]:
    """Return the edges of a segment, and whether a nearer surface is beside it."""
    ends = [End(segment, outward, seen) for outward in (-1, 1)]
    behind = any(_is_above(end, other) for end in ends for other in _following(end, segments))
    return [edge for end in ends if (edge := _edge(end, segments))], behind


def _following(end: End, segments: Sequence[Segment]) -> list[Segment]:
    """Return the segments behind an end, the nearest first."""
    return [s for s in segments[::end.outward] if s is not end.segment
            and (s.first - end.row) * end.outward > 0]


def _is_above(end: End, other: Segment) -> bool:
    """Return whether the adjacent surface, behind a gap or a wall, is nearer."""
    x, z = end.seen.points[other.rows.item(len(other.rows) // 2)].tolist()
    rise = end.seen.near * (z - end.segment.height(x)) / math.hypot(1.0, end.segment.slope)
    if rise <= _smallest_step(end, other):
        return False
    u, v = end.along_and_below(other.rows[[0, -1]])
    return math.hypot(u[1] - u[0], v[1] - v[0]) > SPLINTER and bool(u.min() < WIDEST_GAP)


def _edge(end: End, segments: Sequence[Segment]) -> EdgePoint | None:
    """
    Return the edge at the end of a segment, or None.

    segments: all of the profile, in the order of their first rows.
    """
    following = _following(end, segments)
    rows = continuation(end)
    if following and _is_bevel(end, following[0], rows):
        following = following[1:]
    other = following[0] if following else None
    if other is not None:
        rows = rows[:np.count_nonzero(np.abs(rows - end.row) < abs(end.start_of(other) - end.row))]
    kind = _kind(end, other, rows)
    if kind == 'roof' and other is not None:
        return _roof_edge(end, other)
    if kind not in EDGE_KINDS:
        return None
    wall = wall_edge(end, rows)
    if wall:
        return edge_point(end.frame, *wall, 'roof')
    ground = other if kind == 'step' else None
    kind = 'shadow' if ground and _foot_hidden(end, rows, ground) else kind
    return end_edge(end, rows, ground, kind)


def _is_bevel(end: End, other: Segment, rows: NDArray[np.intp]) -> bool:
    """Return whether the next piece is a bevel of the same plate, not a wall or face."""
    if not np.count_nonzero(rows == end.start_of(other)):
        return False
    ends = end.seen.points.take([end.start_of(other), end.end_of(other)], axis=0)
    if math.dist(*ends.tolist()) > LARGEST_BEVEL:
        return False
    u, v = end.frame.of(ends)
    return bool(v[1] - v[0] > 0 and abs(u[1] - u[0]) > WALL_SLOPE * (v[1] - v[0]))


def _kind(end: End, other: Segment | None, rows: NDArray[np.intp]) -> str:
    """Return one of EDGE_KINDS, or 'border' for an end of the view; other: the next segment."""
    points, size = end.seen.points, len(end.seen.points)
    if other is None:
        behind = (end.row + 1, size) if end.outward > 0 else (0, end.row)
        if end.seen.lost(*behind) >= GAP_COLUMNS:
            return 'gap'
        # a driver that leaves lost points out does not say where the field of view ends
        return 'border' if end.seen.lost(0, size) else 'open'
    crossing = _roof_crossing(end, other, rows)
    # a surface that turns away from the sensor leaves the line over its whole length
    x, z = points[end.end_of(other) if crossing else end.start_of(other)]
    rise = end.seen.near * (z - end.segment.height(x))
    if rise > 0 and (crossing or rise > _smallest_step(end, other)):
        gap = abs(x - points[end.row, 0])
        return 'gap' if not crossing and gap > SHADOW_SLOPE * rise else 'border'
    if crossing:
        return 'roof'
    return 'step' if -rise > _smallest_step(end, other) else 'border'


def _foot_hidden(end: End, rows: NDArray[np.intp], ground: Segment) -> bool:
    """Return whether there are no returns between the end of a plate and the ground."""
    last = int(rows[-1]) if len(rows) else end.row
    first, after = sorted((last, end.start_of(ground)))
    return end.seen.lost(first, after) >= GAP_COLUMNS


def _smallest_step(end: End, other: Segment) -> float:
    return MIN_STEP_SIGMAS * max(end.segment.noise, other.noise)


def _roof_crossing(end: End, other: Segment, rows: NDArray[np.intp]) -> bool:
    """Return whether two pieces end in a common corner."""
    a, b, points = end.segment, other, end.seen.points
    if abs(math.atan(a.slope) - math.atan(b.slope)) < ROOF_ANGLE:
        return False
    x = (b.offset - a.offset) / (a.slope - b.slope)
    x_end, x_start = points[end.row, 0], points[end.start_of(other), 0]
    # a rounded or bevelled corner leaves room between the pieces, with points of its own
    bent = len(rows) > 0 and abs(end.start_of(other) - rows[-1]) <= MOST_LOST
    reach = max(ROOF_REACH * end.column, LARGEST_BEVEL if bent else 0.0)
    return bool(min(x_end, x_start) - reach <= x <= max(x_end, x_start) + reach
                and abs(x_start - x_end) <= 2 * reach)


def _roof_edge(end: End, other: Segment) -> EdgePoint:
    a, b, points = end.segment, other, end.seen.points
    x = (b.offset - a.offset) / (a.slope - b.slope)
    # offset errors of both lines, extrapolated to their crossing; a steep surface that is noisier
    # than the face has an additional error of that size
    steep = max(b.noise ** 2 - a.noise ** 2, 0.0) ** 0.5 * STEEP_ERROR
    offset_std = np.sqrt(std_at(a, x, points) ** 2 + std_at(b, x, points) ** 2 + steep ** 2)
    length = math.hypot(1.0, a.slope)
    std = float(offset_std / abs(a.slope - b.slope) * length)
    place = (x - end.frame.origin[0]) * np.sign(end.frame.along[0]) * length
    return edge_point(end.frame, float(place), std, 'roof')
