"""
What the profiles of one station say together.

The scatter between the profiles gives the uncertainty of what they share.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Feature, Profile
from handeye_ros.profiles.arcs import normal_points
from handeye_ros.profiles.errors import FeatureError
import numpy as np


def of_station(profiles: Sequence[Profile], extract: Callable[[Array], tuple[Feature, ...]]
               ) -> tuple[list[Profile], tuple[Feature, ...]]:
    """
    Return the profiles of a station that show the target, and their features combined.

    extract: gives the features of the points (n, 2) of one profile, or raises FeatureError.
    Raises FeatureError when most do not show it, or do not agree.
    """
    used, found, reasons = [], [], Counter[str]()
    for profile in profiles:
        try:
            found.append(extract(profile.points))
            used.append(profile)
        except FeatureError as error:
            reasons[str(error)] += 1
    if not found or 2 * len(found) < len(profiles):
        raise FeatureError(reasons.most_common(1)[0][0])
    return used, combine(found)


def combine(found: Sequence[tuple[Feature, ...]]) -> tuple[Feature, ...]:
    """
    Return the features of one station from those of its profiles (one tuple each).

    Features are matched by kind and by the way they face. Raises FeatureError when the
    profiles of the station do not agree.
    """
    if len(found) == 1:
        return found[0]
    arcs = [f for features in found for f in features if isinstance(f, Arc)]
    if arcs:
        return (_combined_arc(arcs),)
    edges = [f for features in found for f in features if isinstance(f, EdgePoint)]
    combined: list[Feature] = [_combined_line(same) for same in _by_place(found)]
    for sign in (-1.0, 1.0):
        same = [e for e in edges if np.sign(e.direction[0]) == sign]
        if 2 * len(same) > len(found):
            combined.append(_combined_edge(same))
    if edges and not any(isinstance(f, EdgePoint) for f in combined):
        raise FeatureError('the profiles of this station do not agree on where the edge is')
    return tuple(combined)


def _by_place(found: Sequence[tuple[Feature, ...]]) -> list[list[FaceLine]]:
    """Return the first lines of all profiles, the second ones, as many as most profiles have."""
    lines = [[f for f in features if isinstance(f, FaceLine)] for features in found]
    count = Counter(map(len, lines)).most_common(1)[0][0]
    alike = [seen for seen in lines if len(seen) == count]
    return [list(same) for same in zip(*alike, strict=True)]


def _combined_line(lines: Sequence[FaceLine]) -> FaceLine:
    centres = np.array([line.centre for line in lines])
    slopes = np.array([line.direction[1] / line.direction[0] for line in lines])
    slope, x = float(np.median(slopes)), float(np.median(centres[:, 0]))
    length = np.hypot(1.0, slope)
    heights = centres[:, 1] + slopes * (x - centres[:, 0])
    z, spread = float(np.median(heights)), float(np.median([line.spread for line in lines]))
    expected = float(np.mean([line.std for line in lines]))
    good = np.abs(heights - z) < np.maximum(6 * _scatter(heights), 6 * expected)
    n = int(good.sum())
    scatter = float(heights[good].std(ddof=1) / length) if n > 1 else expected
    std = max(scatter, expected) / np.sqrt(n)
    slope = float(slopes[good].mean())
    length = np.hypot(1.0, slope)
    return FaceLine(np.array([x, heights[good].mean()]), np.array([1.0, slope]) / length,
                    spread, float(std),
                    *_combined_points([line for line, g in zip(lines, good, strict=True) if g]))


def _combined_points(lines: Sequence[FaceLine]) -> tuple[Array, Array]:
    """Return the means of the normal points of lines, share by share, and their 1 sigma."""
    k = min(len(line.points) for line in lines)
    same = [line for line in lines if len(line.points) == k]
    points = np.array([line.points for line in same])
    expected = np.sqrt(np.mean([line.points_std ** 2 for line in same], axis=0))
    if len(same) == 1 or not k:
        return points[0], expected
    normals = np.array([[-line.direction[1], line.direction[0]] for line in same])
    across = np.einsum('nki,ni->nk', points - points.mean(axis=0), normals)
    scatter = np.sqrt((across ** 2).sum() / (len(same) - 1) / k)
    return points.mean(axis=0), np.maximum(expected, scatter) / len(same) ** 0.5


def _combined_edge(edges: Sequence[EdgePoint]) -> EdgePoint:
    points = np.array([e.point for e in edges])
    direction = np.median([e.direction for e in edges], axis=0)
    direction /= np.linalg.norm(direction)
    along = points @ direction
    centre = np.median(along)
    single = float(np.median([e.std for e in edges]))
    good = np.abs(along - centre) <= np.maximum(4 * _scatter(along), 2 * single)
    across = points @ [-direction[1], direction[0]]
    expected = float(np.median([e.std_across for e in edges]))
    good &= np.abs(across - np.median(across)) <= np.maximum(6 * _scatter(across), 6 * expected)
    n = int(good.sum())
    scatter = float(along[good].std(ddof=1)) if n > 1 else single
    # a robot that stands still repeats the rounding to a column, and mixed and lost points pull
    # the edge inwards in every profile: that does not average out
    std = np.hypot(single, scatter / min(np.sqrt(n), 2.0))
    kinds = [e.kind for e in edges]
    return EdgePoint(points[good].mean(axis=0), direction, float(std), expected / np.sqrt(n),
                     max(set(kinds), key=kinds.count), float(np.median([e.bevel for e in edges])))


def _scatter(values: Array) -> float:
    """Return the median absolute deviation, scaled to 1 sigma of a normal distribution."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _combined_arc(arcs: Sequence[Arc]) -> Arc:
    """Return one arc from all points of the profiles of a station."""
    radius = np.median([a.radius for a in arcs])
    centre = np.median([a.centre for a in arcs], axis=0)
    good = [a for a in arcs if abs(a.radius - radius) < 0.05 * radius
            and np.linalg.norm(a.centre - centre) < 0.05 * radius]
    if 2 * len(good) < len(arcs):
        raise FeatureError('the profiles of this station do not agree on where the sphere is')
    return normal_points(np.concatenate([a.raw for a in good]))
