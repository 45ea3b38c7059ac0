# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The face line and the edge points of one profile across a plate.

The face is the surface nearer to the sensor. It ends at a step down, at a gap (nothing behind
it) or at a roof edge (it turns away). Where the field of view ends, or a few returns are
missing inside the face, there is no edge.
"""
from __future__ import annotations

import math

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.edges import edge_at, End, smallest_step
from handeye_ros.profiles.lines import face_line, on_line, white_std
from handeye_ros.profiles.segment import returned, Segment, segments_among, straight_segments

SURE_EDGE = 1.5  # weight of a face with a sure edge
BEHIND = 0.02  # weight of a surface beside a nearer one: all stations should choose the same
WIDEST_GAP, SPLINTER = 0.02, 0.002  # largest gap between adjacent surfaces; largest splinter (m)
MOST_SURFACES, SMALLEST_SURFACE = 3, 0.1  # surfaces that may be the plane; size over the longest


def face_features(points: Array, config: Config) -> tuple[Feature, ...]:
    """
    Return the face line and the edge points (one or two) of a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return. Of several pieces, the face
    is the one with the most points, weighted by how sure its edges are.
    Raises FeatureError when there is no face with an edge in the profile.
    """
    returns, min_points = returned(points), config.sampling.min_points
    segments = segments_among(returns, points, config.noise.sensor, min_points)
    if not segments:
        raise FeatureError(f'no straight face of {min_points} points or more in the profile')
    best, face, edges, reasons = 0.0, segments[0], list[EdgePoint](), list[str]()
    # the longest first: most of the others then cannot be preferred, whatever their edges are
    for segment in sorted(segments, key=lambda s: -len(s.rows)):
        if len(segment.rows) * SURE_EDGE < best:
            break
        ends = [End(segment, points, returns, -config.profile.range_sign, outward)
                for outward in (-1, 1)]
        found = [edge_at(end, segments) for end in ends]
        reasons += [reason for reason in found if isinstance(reason, str)]
        of_segment = [edge for edge in found if isinstance(edge, EdgePoint)]
        sure = any(edge.kind in ('step', 'shadow', 'roof') for edge in of_segment)
        behind = any(_is_above(end, other) for end in ends for other in end.following(segments))
        likely = len(segment.rows) * (SURE_EDGE if sure else 1.0) * (BEHIND if behind else 1.0)
        if of_segment and (likely > best or (likely == best and segment.first < face.first)):
            best, face, edges = likely, segment, of_segment
    if not edges:
        raise FeatureError('no edge of a face in the profile: the face ends only '
                           + ' or '.join(dict.fromkeys(reasons)))
    line = face_line(face, points)
    return (line, *(on_line(edge, line, line.std / white_std(face)) for edge in edges))


def _is_above(end: End, other: Segment) -> bool:
    """Return whether the adjacent surface, behind a gap or a wall, is nearer."""
    rise = end.rise_of(other.rows.item(len(other.rows) // 2))
    if rise / math.hypot(1.0, end.segment.slope) <= smallest_step(end, other):
        return False
    u, v = end.outwards_and_below(other.rows[[0, -1]])
    return math.hypot(u[1] - u[0], v[1] - v[0]) > SPLINTER and bool(u.min() < WIDEST_GAP)


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
