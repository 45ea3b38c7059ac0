# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Features of a station, combined from all its profiles.

The scatter between the profiles gives the uncertainty of what they share.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from handeye_ros import targets
from handeye_ros.config import Config, flipped_range
from handeye_ros.data import AnyProfile, Arc, Array, EdgePoint, FaceLine, Feature, Profile
from handeye_ros.errors import DataError, FeatureError, mm
from handeye_ros.estimation.problem import Target
from handeye_ros.profiles.arcs import normal_points
from handeye_ros.profiles.lines import combined_line, on_line
import numpy as np
from numpy.typing import NDArray

LARGEST_DISAGREEMENT = 5e-4  # between profiles of a robot that stands still (m)
SMALLEST_DISAGREEMENT = 1e-4  # the same for arcs, beyond their own scatter
LEAST_AGREEING = 0.6  # smallest share of the profiles of a stop
ALONG = 0.1  # weight of a distance along a surface against one across, to match lines
MOST_TIMES = 4  # profiles of one stop count as at most this many for an edge


def _disagreeing(what: str, apart: float) -> FeatureError:
    """Return the refusal of profiles that show the target at places so far apart (m)."""
    return FeatureError(f'the profiles of this station do not agree on {what}: they are '
                        f'{mm(apart)} apart; something moved, or some of them show another '
                        'object; take the sample again', reason='disagreeing')


def of_station(profiles: Sequence[Profile], method: Target, config: Config
               ) -> tuple[list[Profile], tuple[Feature, ...]]:
    """
    Return the profiles of a station that show the target, and their combined features.

    Raises FeatureError when most do not show it, or do not agree.
    """
    used, found, reasons = [], [], Counter[str]()
    for profile, features in zip(profiles, features_of_each(profiles, method, config),
                                 strict=True):
        if isinstance(features, DataError):
            reasons[str(features)] += 1
        else:
            found.append(features)
            used.append(profile)
    if not found or 2 * len(found) < len(profiles):
        raise FeatureError(reasons.most_common(1)[0][0])
    return used, combine(found, 1 if method.essential else len(method.kinds))


def features_of_each(profiles: Sequence[Profile], method: Target, config: Config
                     ) -> Sequence[tuple[Feature, ...] | DataError]:
    """Return for each profile its features or the error."""
    return method.extract_each([profile.points for profile in profiles], config)


def features_of(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features of one profile; raises FeatureError."""
    return targets.method_for(config).extract(profile.points, config)


def evenly(profiles: Sequence[AnyProfile], most: int) -> list[AnyProfile]:
    """Return at most a number of the profiles, evenly spaced."""
    if len(profiles) <= most:
        return list(profiles)
    return [profiles[i] for i in np.linspace(0, len(profiles) - 1, most).astype(int)]


def flipped_features(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features with the opposite profile.range_sign."""
    method = targets.method_for(config)
    if not method.essential:
        return ()
    try:
        return method.extract(profile.points, flipped_range(config))
    except FeatureError:
        return ()


def combine(found: Sequence[tuple[Feature, ...]], together: int = 1) -> tuple[Feature, ...]:
    """
    Return the features of a station from those of its profiles (one tuple each).

    Features are matched by kind, place and facing direction; together: number of consecutive lines
    that are used only together. Raises FeatureError when the profiles of the station do not agree.
    """
    if len(found) == 1:
        return found[0]
    arcs = [f for features in found for f in features if isinstance(f, Arc)]
    if arcs:
        return (_combined_arc(arcs),)
    edges = [f for features in found for f in features if isinstance(f, EdgePoint)]
    lines = _combined_lines([[f for f in features if isinstance(f, FaceLine)]
                             for features in found], together)
    combined: list[Feature] = list(lines)
    for sign in (-1.0, 1.0):
        same = [e for e in edges if np.sign(e.direction[0]) == sign]
        if 2 * len(same) > len(found):
            combined.append(on_line(_combined_edge(same), lines[0]))
    if edges and not any(isinstance(f, EdgePoint) for f in combined):
        points = np.array([edge.point for edge in edges])
        raise _disagreeing('where the edge is',
                           float(np.linalg.norm(np.ptp(points, axis=0))))
    return tuple(combined)


def _combined_lines(seen: Sequence[Sequence[FaceLine]], together: int) -> list[FaceLine]:
    """
    Return one line for each surface that most of the profiles show.

    Raises FeatureError if fewer lines agree than each profile shows.
    """
    usual = Counter(map(len, seen)).most_common(1)[0][0]
    lines = next(lines for lines in seen if len(lines) == usual)
    combined: list[FaceLine] = []
    failed = None
    for first in range(0, usual, together):
        try:
            combined += [_combined_line([min(others, key=partial(_apart, line))
                                         for others in seen if others])
                         for line in lines[first:first + together]]
        except FeatureError as error:
            failed = failed or error
    if failed and len(combined) < min(map(len, seen)):
        raise failed
    return combined


def _apart(line: FaceLine, other: FaceLine) -> float:
    """Return the distance between two lines (m): across, plus a small part along."""
    away = line.centre - other.centre
    across = away[1] * line.direction[0] - away[0] * line.direction[1]
    return float(abs(across) + ALONG * abs(away[0]))


def _combined_line(lines: Sequence[FaceLine]) -> FaceLine:
    centres = np.array([line.centre for line in lines])
    slopes = np.array([line.direction[1] / line.direction[0] for line in lines])
    x = float(np.median(centres[:, 0]))
    heights = centres[:, 1] + slopes * (x - centres[:, 0])
    good = _agreeing(heights, 6.0, 6 * float(np.mean([line.std for line in lines])),
                     'how high the face is')
    slope = float(slopes[good].mean())
    scatter = heights[good].std(ddof=1) / np.hypot(1.0, slope) if good.sum() > 1 else 0.0
    return combined_line([line for line, g in zip(lines, good, strict=True) if g],
                         np.array([x, heights[good].mean()]), slope, float(scatter))


def _combined_edge(edges: Sequence[EdgePoint]) -> EdgePoint:
    kind = Counter(e.kind for e in edges).most_common(1)[0][0]
    edges = [e for e in edges if e.kind == kind]  # each kind has its own bias
    points = np.array([e.point for e in edges])
    direction = np.median([e.direction for e in edges], axis=0)
    direction /= np.linalg.norm(direction)
    along, across = points @ direction, points @ [-direction[1], direction[0]]
    single = float(np.median([e.std for e in edges]))
    expected = float(np.median([e.std_across for e in edges]))
    good = _agreeing(along, 4.0, 2 * single, 'where the edge is')
    good &= _agreeing(across, 6.0, 6 * expected, 'where the edge is')
    n = max(int(good.sum()), 1)
    scatter = float(along[good].std(ddof=1)) if n > 1 else single
    # a robot that stands still repeats the rounding to a column, and mixed and lost points pull
    # the edge inwards in every profile: that does not average out
    std = np.hypot(single, scatter / min(n, MOST_TIMES) ** 0.5)
    return EdgePoint(points[good].mean(axis=0), direction, float(std), expected, kind,
                     np.median([e.drop for e in edges], axis=0),
                     *_combined_ends(points, edges, good))


def _combined_ends(points: Array, edges: Sequence[EdgePoint], good: NDArray[np.bool_]
                   ) -> tuple[Array, Array, float]:
    """Return shapes, arc and arc_std of edges at points (n, 2) if most of them are rounded."""
    bent = good & [len(edge.shapes) > 0 for edge in edges]
    if 2 * bent.sum() <= good.sum():
        return np.empty(0), np.zeros(2), 0.0
    used = [edge for edge, chosen in zip(edges, bent, strict=True) if chosen]
    middles = points[bent] + [edge.arc for edge in used]
    times = min(len(used), MOST_TIMES)
    shapes = np.mean([edge.shapes for edge in used], axis=0) * times
    std = float(np.median([edge.arc_std for edge in used])) / times ** 0.5
    return shapes - shapes.max(), middles.mean(axis=0) - points[good].mean(axis=0), std


def _agreeing(values: Array, times: float, least: float, what: str) -> NDArray[np.bool_]:
    """
    Return which values (n,) are near the median: within `times` scatters, or `least`.

    Raises FeatureError when too few are, or when they scatter more than a robot at
    rest may move.
    """
    middle = np.quantile(values, 0.5, method='lower')
    scatter = 1.4826 * np.median(np.abs(values - middle))  # 1 sigma of a normal distribution
    limit = min(max(times * scatter, least), LARGEST_DISAGREEMENT)
    good = np.abs(values - middle) <= limit
    if good.sum() < LEAST_AGREEING * len(values):
        raise _disagreeing(what, float(np.ptp(values)))
    return np.asarray(good)


def _combined_arc(arcs: Sequence[Arc]) -> Arc:
    """Return one arc from all points of the profiles of a station."""
    centres = np.array([a.centre for a in arcs])
    centre, radius = np.median(centres, axis=0), np.median([a.radius for a in arcs])
    # a short arc determines its centre worse than the position of its points
    away = np.array([_scatter(a, centre, radius) for a in arcs])
    own = float(np.median([_scatter(a, a.centre, a.radius) for a in arcs]))
    good = away < min(LARGEST_DISAGREEMENT, own + max(3.0 * own, SMALLEST_DISAGREEMENT))
    if good.sum() < LEAST_AGREEING * len(arcs):
        raise _disagreeing('where the sphere is',
                           float(np.linalg.norm(np.ptp(centres, axis=0))))
    used = [a.raw for a, believed in zip(arcs, good, strict=True) if believed]
    arc = normal_points(np.concatenate(used))
    # for the residuals: 0.8 MB of a sample at most
    rows = np.linspace(0, len(arc.raw) - 1, min(len(arc.raw), 50_000)).astype(int)
    return replace(arc, raw=arc.raw[rows])


def _scatter(arc: Arc, centre: Array, radius: float) -> float:
    """Return the RMS distance of the points of an arc from its circle."""
    off = np.linalg.norm(arc.raw - centre, axis=1) - radius
    return float(np.sqrt((off ** 2).mean()))
