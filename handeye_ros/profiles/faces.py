# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Which straight pieces of a profile are the target, and their edges.

The face of a plate is the surface nearer to the sensor; how it may end is listed in edges.py.
Points between the ends of two faces of a corner (bevel, rounding, weld) belong to neither.
"""
from __future__ import annotations

from itertools import combinations
import math

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.edges import (
    edge_at,
    ends_of_segments,
    FaceEnd,
    NoEdgeError,
    smallest_step,
)
from handeye_ros.profiles.lines import face_line, with_line_errors
from handeye_ros.profiles.segment import Segment, straight_segments
import numpy as np

SURE_EDGE_WEIGHT = 1.5  # weight of a face with a sure edge
# weight of a surface beside a nearer one: all profiles should choose the same
BESIDE_NEARER_WEIGHT = 0.02
MAX_GAP_WIDTH = 0.014  # m, between adjacent surfaces, without what the nearer one hides
HIDDEN_PER_HEIGHT = 0.4  # width that a nearer surface hides, over its height
MAX_SPLINTER = 0.002  # largest piece that is no surface (m)
MAX_SURFACES, MIN_SURFACE = 3, 0.1  # surfaces that may be the plane; size over the longest
MAX_CORNERS, MIN_CORNER = 3, 0.25  # of a profile; of shorter faces, over the best
MIN_CORNER_ANGLE = 0.26  # between two faces (rad): less is one bent face
FAR_END = 0.75  # distance of a face's other end, over its length: faces that cross are no edge
# largest distance of a face's end from the crossing, over its length: a groove can hide its own
# bottom from the camera
REACH_SHARE = 0.5
MIN_REACH = 2e-3  # m: its lower bound, for short faces


def face_features(points: Array, config: Config) -> tuple[Feature, ...]:
    """
    Return the face line and the edge points (one or two) of a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return. Of several pieces, the face
    is the one with the most points, weighted by how sure its edges are, and far less beside a
    nearer surface.
    Raises FeatureError when there is no face with an edge in the profile.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    best_weight, face, edges, reasons = 0.0, segments[0], list[EdgePoint](), list[str]()
    # the longest first: most of the others then cannot be preferred, whatever their edges are
    for ends in ends_of_segments(segments, points, config):
        segment = ends[1].segment
        if len(segment.columns) * SURE_EDGE_WEIGHT < best_weight:
            break
        edges_of_segment = list[EdgePoint]()
        for end in ends:
            try:
                edges_of_segment.append(edge_at(end))
            except NoEdgeError as reason:
                reasons.append(str(reason))
        sure = any(edge.ending in ('step', 'shadow', 'roof') for edge in edges_of_segment)
        beside_nearer = any(_is_nearer_beside(end, other) for end in ends for other in end.beyond)
        weight = len(segment.columns) * (SURE_EDGE_WEIGHT if sure else 1.0) * (
            BESIDE_NEARER_WEIGHT if beside_nearer else 1.0)
        if edges_of_segment and (weight > best_weight
                                 or (weight == best_weight and segment.first < face.first)):
            best_weight, face, edges = weight, segment, edges_of_segment
    if not edges:
        raise FeatureError('no edge of a face in the profile: the face ends only '
                           + ' or '.join(dict.fromkeys(reasons)))
    line = face_line(face, points, config.sampling.moving)
    white_std = face.noise / math.hypot(1.0, face.slope) / math.sqrt(len(face.straight_columns))
    return (line, *(with_line_errors(edge, line, line.std / white_std) for edge in edges))


def _is_nearer_beside(end: FaceEnd, other: Segment) -> bool:
    """Return whether another surface, beyond a gap or a wall at the end, is nearer."""
    rise = end.rise_of(other.columns.item(len(other.columns) // 2))
    if rise / math.hypot(1.0, end.segment.slope) <= smallest_step(end, other):
        return False
    u, v = end.coordinates(other.columns[[0, -1]])
    return (math.hypot(u[1] - u[0], v[1] - v[0]) > MAX_SPLINTER
            and bool(u.min() < MAX_GAP_WIDTH + HIDDEN_PER_HEIGHT * rise))


def plane_features(points: Array, config: Config) -> tuple[FaceLine, ...]:
    """
    Return all straight pieces of a profile as candidates for the plane, longest first.

    points: (n, 2) in the sensor plane, NaN where there was no return. Edges are neither needed
    nor looked for. Raises FeatureError.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    longest = sorted(segments, key=lambda s: -len(s.columns))[:MAX_SURFACES]
    return tuple(face_line(segment, points, config.sampling.moving) for segment in longest
                 if len(segment.columns) >= MIN_SURFACE * len(longest[0].columns))


def face_pair_features(points: Array, config: Config) -> tuple[FaceLine, ...]:
    """
    Return the lines of adjacent faces that meet, in pairs ordered by x.

    points: (n, 2) in the sensor plane, NaN where there was no return. Any two adjacent faces may
    form the edge: a block on a table also makes a groove. Pairs whose shorter face is longest come
    first. Raises FeatureError where no two faces meet.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    if len(segments) < 2:
        raise FeatureError('only one straight face in the profile: both faces of the edge must be '
                           'in view')
    pairs = [pair for pair in combinations(segments, 2) if _meet(*pair, points)]
    if not pairs:
        raise FeatureError(f'no two of the {len(segments)} straight pieces in the profile meet in '
                           f'an edge of more than {np.degrees(MIN_CORNER_ANGLE):.0f} degrees')
    pairs.sort(key=_shorter, reverse=True)
    best = [pair for pair in pairs[:MAX_CORNERS]
            if _shorter(pair) >= MIN_CORNER * _shorter(pairs[0])]
    return tuple(line for pair in best for line in sorted(
        (face_line(segment, points, config.sampling.moving) for segment in pair),
        key=lambda line: float(line.centre[0])))


def _shorter(pair: tuple[Segment, Segment]) -> int:
    """Return the number of points of the shorter of two pieces."""
    return min(len(segment.columns) for segment in pair)


def _meet(a: Segment, b: Segment, points: Array) -> bool:
    """Return whether two pieces form an angle and end near the crossing of their lines."""
    if abs(math.atan(a.slope) - math.atan(b.slope)) < MIN_CORNER_ANGLE:
        return False
    x = a.crossing(b)
    for segment in (a, b):
        ends = points[[segment.first, segment.last]]
        near, far = np.sort(np.linalg.norm(ends - [x, a.height(x)], axis=1))
        length = float(np.linalg.norm(ends[1] - ends[0]))
        if near >= max(REACH_SHARE * length, MIN_REACH) or far <= FAR_END * length:
            return False
    return True
