"""
The face line and the edge points of one profile across a plate.

The face is the surface nearer to the sensor. It ends at a step down, at a gap (nothing behind
it) or at a roof edge (it turns away). Where the field of view ends, or a few returns are
missing inside the face, there is no edge.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.profiles.lines import face_line
from handeye_ros.profiles.segment import Segment, straight_segments
import numpy as np

GAP_COLUMNS = 3  # missing returns behind a face that make its end an edge
ROOF_ANGLE = 0.15  # two pieces that meet at a smaller angle (rad) are one bent face
ROOF_REACH = 8.0  # they meet when their ends are this many columns from the crossing
MIN_STEP_SIGMAS = 8.0
SURE_EDGE = 1.5  # a face with a sure edge is worth this many times its points
SHADOW_SLOPE = 2.0  # a step hides less than this many times its height behind it
EDGE_KINDS = ('roof', 'step', 'gap', 'open')


@dataclass(frozen=True, eq=False)
class _End:
    """One end of a segment: its row, the direction of the rows behind it (+1 or -1)."""

    segment: Segment
    outward: int

    @property
    def row(self) -> int:
        return self.segment.last if self.outward > 0 else self.segment.first


def face_features(points: Array, config: Config) -> tuple[Feature, ...]:
    """
    Return the face line and the edge points (one or two) of a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return.
    Raises FeatureError when there is no face with an edge in the profile.
    """
    near = -config.profile.range_sign  # multiplied with a range, larger is nearer
    noise, min_points = config.noise.sensor, config.sampling.min_points
    segments = straight_segments(points, noise, min_points)
    if not segments:
        raise FeatureError(f'no straight face of {min_points} points or more in the profile')
    candidates = [(s, edges) for s in segments
                  if (edges := _edges(s, segments, points, near)) is not None]
    with_edges = [(s, edges) for s, edges in candidates if edges]
    if not with_edges:
        raise FeatureError('no edge of a face in the profile: the face ends only at the border '
                           'of the field of view or at something nearer')
    face, edges = max(with_edges, key=_preference)
    return (face_line(face, points), *edges)


def plane_features(points: Array, config: Config) -> tuple[FaceLine]:
    """
    Return the longest straight piece of a profile: all of a plane that is in sight.

    points: (n, 2) in the sensor plane, NaN where there was no return. Edges are neither needed
    nor looked for. Raises FeatureError.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    if not segments:
        raise FeatureError('no straight piece of '
                           f'{config.sampling.min_points} points or more in the profile')
    return (face_line(max(segments, key=lambda s: len(s.rows)), points),)


def _preference(candidate: tuple[Segment, list[EdgePoint]]) -> float:
    """Return how likely a segment is the face: its number of points, more for a sure edge."""
    segment, edges = candidate
    sure = any(edge.kind in ('step', 'roof') for edge in edges)
    return len(segment.rows) * (SURE_EDGE if sure else 1.0)


def _edges(segment: Segment, segments: Sequence[Segment], points: Array, near: int
           ) -> list[EdgePoint] | None:
    """Return the edges of a segment, or None when something beside it is nearer: no face."""
    edges = []
    for end in (_End(segment, -1), _End(segment, 1)):
        kind, other = _what_follows(end, segments, points, near)
        if kind == 'nearer':
            return None
        if kind == 'roof' and other is not None:
            edges.append(_roof_edge(end, other, points))
        elif kind in EDGE_KINDS:
            edges.append(_end_edge(end, kind, points))
    return edges


def _what_follows(end: _End, segments: Sequence[Segment], points: Array, near: int
                  ) -> tuple[str, Segment | None]:
    """Return 'roof', 'step', 'gap', 'open', 'nearer' or 'border', and what follows."""
    following = [s for s in segments if s is not end.segment
                 and (s.first - end.row) * end.outward > 0]
    if not following:
        behind = points[end.row + 1:] if end.outward > 0 else points[:end.row]
        missing = int((~np.isfinite(behind).all(axis=1)).sum())
        if missing >= GAP_COLUMNS:
            return 'gap', None
        # a driver that leaves lost points out does not say where the field of view ends
        return ('open' if np.isfinite(points).all() else 'border'), None
    other = min(following, key=lambda s: abs(s.first - end.row))
    crossing = _roof_crossing(end, other, points)
    start_row = other.first if end.outward > 0 else other.last
    # a surface that turns away from the sensor leaves the line over its whole length
    row = (other.last if end.outward > 0 else other.first) if crossing else start_row
    x, z = points[row]
    rise = near * (z - end.segment.height(x))
    if rise > 0 and (crossing or rise > _smallest_step(end, other)):
        gap = abs(x - points[end.row, 0])
        return ('gap' if not crossing and gap > SHADOW_SLOPE * rise else 'nearer'), other
    if crossing:
        return 'roof', other
    if -rise > _smallest_step(end, other):
        return 'step', other
    return 'border', other


def _smallest_step(end: _End, other: Segment) -> float:
    return MIN_STEP_SIGMAS * max(end.segment.noise, other.noise)


def _roof_crossing(end: _End, other: Segment, points: Array) -> bool:
    """Return whether the two pieces meet in a corner where both end."""
    a, b = end.segment, other
    if abs(np.arctan(a.slope) - np.arctan(b.slope)) < ROOF_ANGLE:
        return False
    x = (b.offset - a.offset) / (a.slope - b.slope)
    x_end = points[end.row, 0]
    x_start = points[other.first if end.outward > 0 else other.last, 0]
    reach = ROOF_REACH * _column(a, points)
    return bool(min(x_end, x_start) - reach <= x <= max(x_end, x_start) + reach
                and abs(x_start - x_end) <= 2 * reach)


def _column(segment: Segment, points: Array) -> float:
    """Return the distance between neighbouring columns on a segment, along x."""
    x = points[segment.rows, 0]
    return float(np.median(np.abs(np.diff(x) / np.diff(segment.rows))))


def _roof_edge(end: _End, other: Segment, points: Array) -> EdgePoint:
    a, b = end.segment, other
    x = (b.offset - a.offset) / (a.slope - b.slope)
    # offset errors of both lines, carried to where they cross
    offset_std = np.hypot(_std_at(a, x, points), _std_at(b, x, points))
    std = float(offset_std / abs(a.slope - b.slope) * np.hypot(1.0, a.slope))
    return _edge_point(end, x, std, 'roof', points)


def _end_edge(end: _End, kind: str, points: Array) -> EdgePoint:
    """Return the edge half a column behind the last good point, later by mixed points."""
    x_end = points[end.row, 0]
    outward = float(np.sign(x_end - points[end.segment.rows, 0].mean()))
    column = _column(end.segment, points)
    width = column * (1 + _mixed_points(end, points, column))
    return _edge_point(end, x_end + outward * width / 2, width / 12 ** 0.5, kind, points)


def _mixed_points(end: _End, points: Array, column: float) -> int:
    """
    Return how many points right behind the end lie between its level and the next.

    A column whose spot straddles the edge returns something between the levels: the edge is
    as likely on its one side as on the other.
    """
    rows = end.row + end.outward * np.arange(1, 4)
    rows = rows[(rows >= 0) & (rows < len(points))]
    beyond = points[rows]
    if len(beyond) < 3 or not np.isfinite(beyond).all():
        return 0
    height = np.abs(beyond[:, 1] - end.segment.height(beyond[:, 0]))
    return int((height[:2] < 0.8 * height[2]).sum()) if height[2] > 0 else 0


def _edge_point(end: _End, x: float, std: float, kind: str, points: Array) -> EdgePoint:
    segment = end.segment
    length = np.hypot(1.0, segment.slope)
    outward = np.sign(points[end.row, 0] - points[segment.rows, 0].mean())
    direction = outward * np.array([1.0, segment.slope]) / length
    return EdgePoint(np.array([x, segment.height(x)]), direction, std,
                     _std_at(segment, x, points) / length, kind)


def _std_at(segment: Segment, x: float, points: Array) -> float:
    """Return 1 sigma of the range of a segment's line at x."""
    xs = points[segment.rows, 0]
    spread = xs.std()
    return float(segment.noise * np.sqrt((1 + ((x - xs.mean()) / spread) ** 2) / len(xs)))
