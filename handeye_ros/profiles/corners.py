"""
The two faces that meet in an edge, both seen in one profile: a block or a groove.

What lies between their ends (a bevel, a rounding, a weld) belongs to neither.
"""
from __future__ import annotations

from itertools import combinations

from handeye_ros.config import Config
from handeye_ros.data import Array, FaceLine
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.lines import face_line
from handeye_ros.profiles.segment import Segment, straight_segments
import numpy as np

MOST_CORNERS, SMALLEST_CORNER = 3, 0.25  # of a profile; shorter face, over the best one's
FAR_END = 0.75  # of its length, that its other end is away: faces that cross are no edge
SMALLEST_ANGLE = 0.26  # between two faces (rad): less is one bent face
REACH = 0.5  # of a face's length: its end is at most so far from where the two cross, for a
# groove can hide its own bottom from the camera
SMALLEST_REACH = 2e-3  # m: of faces however short


def corner_features(points: Array, config: Config) -> tuple[FaceLine, ...]:
    """
    Return the lines of the faces of a profile that meet, two by two, each two in the order of x.

    points: (n, 2) in the sensor plane, NaN where there was no return. Any two of them may be the
    edge: a block on a table makes a groove with it. First come those whose shorter face is the
    longest. Raises FeatureError where no two faces meet.
    """
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    pairs = [pair for pair in combinations(segments, 2) if _meet(*pair, points)]
    if not pairs:
        raise FeatureError(_reason(segments, config.sampling.min_points))
    shorter = [min(len(segment.rows) for segment in pair) for pair in pairs]
    order = sorted(range(len(pairs)), key=lambda k: -shorter[k])[:MOST_CORNERS]
    best = [pairs[k] for k in order if shorter[k] >= SMALLEST_CORNER * max(shorter)]
    lines = {segment: face_line(segment, points) for pair in best for segment in pair}
    return tuple(line for pair in best for line in sorted(
        (lines[segment] for segment in pair), key=lambda line: float(line.centre[0])))


def _reason(segments: list[Segment], min_points: int) -> str:
    if len(segments) < 2:
        return (f'{len(segments)} straight faces of {min_points} points or more in the profile: '
                'both faces of the edge must be in view')
    return (f'no two of the {len(segments)} straight pieces in the profile meet in an edge of '
            f'more than {np.degrees(SMALLEST_ANGLE):.0f} degrees')


def _meet(a: Segment, b: Segment, points: Array) -> bool:
    """Return whether two pieces turn at an angle, and end near where their lines cross."""
    if abs(np.arctan(a.slope) - np.arctan(b.slope)) < SMALLEST_ANGLE:
        return False
    x = (b.offset - a.offset) / (a.slope - b.slope)
    crossing = np.array([x, a.height(x)])
    return _near_end(a, crossing, points) and _near_end(b, crossing, points)


def _near_end(segment: Segment, crossing: Array, points: Array) -> bool:
    ends = points[[segment.first, segment.last]]
    away = np.linalg.norm(ends - crossing, axis=1)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return bool(away.min() < max(REACH * length, SMALLEST_REACH) and away.max() > FAR_END * length)
