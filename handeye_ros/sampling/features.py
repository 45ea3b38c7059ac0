# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The sample that a stop gives: its pose, and the features of all its profiles combined.

The scatter between the profiles gives the uncertainty of what they share. A pass gives the samples
of its single profiles, each with the pose of its time.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from handeye_ros import se3, targets
from handeye_ros.config import Config, flipped_range
from handeye_ros.data import (
    Arc,
    Array,
    EdgePoint,
    FaceLine,
    Feature,
    NS,
    Profile,
    Reject,
    rms,
    robust_std,
    Sample,
)
from handeye_ros.errors import FeatureError, mm, UnusableMessageError
from handeye_ros.profiles.arcs import normal_points, off_circle
from handeye_ros.profiles.lines import line_of_bins, on_line
from handeye_ros.sampling.stops import decoded, evenly, evenly_chosen, Stop
from handeye_ros.sampling.stream import interpolate
from handeye_ros.sampling.trajectory import trajectory_of
import numpy as np
from numpy.typing import NDArray

LARGEST_DISAGREEMENT = 5e-4  # between profiles of a robot that stands still (m)
SMALLEST_DISAGREEMENT = 1e-4  # the same for arcs, beyond their own scatter
LEAST_AGREEING = 0.6  # smallest share of the profiles of a stop
ALONG_WEIGHT = 0.1  # weight of a distance along a surface against one across, to match lines
MOST_INDEPENDENT = 4  # profiles of one stop count as at most this many for an edge
FLIPPED_EVERY = 8  # every such profile of a pass tells whether the range counts the other way
MOST_OF_PASS = 32  # profiles of a pass that are evaluated, twice as many if few show the target


def result_of(stop: Stop, config: Config) -> Sample | Reject:
    """Return the sample of a stop, or the reject with the reason."""
    stop = stop.load(config)
    try:
        return _pass_of(stop, config) if config.sampling.moving else _sample_of(stop, config)
    except FeatureError as error:
        return Reject(stop.stamp, str(error))


def _sample_of(stop: Stop, config: Config) -> Sample:
    """Return the sample of a robot that stood still; raises FeatureError with the reason."""
    profiles = decoded(stop.settled_profiles(config), config)
    if not profiles:
        raise _no_profiles(stop, config)
    used, features = combined_features(profiles, config)
    poses = interpolate(stop.poses, [profile.stamp for profile in used])
    return Sample(used[0].stamp, se3.mean_pose(poses), features, len(used),
                  _flipped(used[0], config), centroid=_centroid(used[0]))


def _pass_of(stop: Stop, config: Config) -> Sample:
    """Return the middle sample of a pass, with those of its profiles; raises FeatureError."""
    # of a stored pass some may lie beyond its poses, with another time_offset
    profiles = [p for p in stop.profiles if stop.start <= p.stamp <= stop.end]
    for most in (MOST_OF_PASS, 2 * MOST_OF_PASS):
        shown, reasons = _features_of_each(decoded(evenly(profiles, most), config), config)
        if 2 * len(shown) >= MOST_OF_PASS or most >= len(profiles):
            break
    if not shown:
        raise FeatureError(reasons[-1]) if reasons else _no_profiles(stop, config)
    T = interpolate(stop.poses, [profile.stamp for profile, _ in shown])
    single = tuple(
        Sample(profile.stamp, pose, features,
               flipped=_flipped(profile, config) if k % FLIPPED_EVERY == 0 else None)
        for k, ((profile, features), pose) in enumerate(zip(shown, T, strict=True)))
    middle = single[len(single) // 2]
    return replace(middle, profiles=len(single), per_profile=single,
                   trajectory=trajectory_of(stop.poses, config.sampling.max_pose_gap),
                   centroid=_centroid(shown[0][0]))


def _no_profiles(stop: Stop, config: Config) -> FeatureError:
    """Return the refusal of a stop without a usable profile of the time of its poses."""
    for profile in stop.settled_profiles(config):
        try:
            profile.read(config.profile)
        except UnusableMessageError as error:
            return FeatureError(str(error), reason='unusable')
    return FeatureError(f'no profile has a stamp of the {(stop.end - stop.start) / NS:.1f} s '
                        'during which the robot stood still here: the sensor sent none, they '
                        'were dropped (the warnings say why), or its clock is not that of the '
                        'robot' + (', or time_offset was another when this was recorded: take '
                                   'the sample again' if config.time_offset else ''),
                        reason='no_profiles')


def features_of(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features of one profile; raises FeatureError."""
    return targets.target_for(config).extract(profile.points, config)


def _centroid(profile: Profile) -> Array:
    """Return the mean (3,) of the points of a profile; see Sample."""
    return np.append(profile.out_of_plane, np.nanmean(profile.points, axis=0))


def _flipped(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features of a target with edges, with the opposite profile.range_sign."""
    if targets.target_for(config).essential:
        with suppress(FeatureError):
            return features_of(profile, flipped_range(config))
    return ()


def _features_of_each(profiles: Sequence[Profile], config: Config
                      ) -> tuple[list[tuple[Profile, tuple[Feature, ...]]], list[str]]:
    """Return the profiles that show the target, with their features, and why others do not."""
    shown, reasons = [], []
    for profile in profiles:
        try:
            shown.append((profile, features_of(profile, config)))
        except FeatureError as error:
            reasons.append(str(error))
    return shown, reasons


def combined_features(profiles: Sequence[Profile], config: Config
                      ) -> tuple[list[Profile], tuple[Feature, ...]]:
    """
    Return the profiles of a stop that show the target, and their combined features.

    Raises FeatureError when most do not show it, or do not agree.
    """
    shown, reasons = _features_of_each(profiles, config)
    if not shown or 2 * len(shown) < len(profiles):
        raise FeatureError(Counter(reasons).most_common(1)[0][0])
    return ([profile for profile, _ in shown],
            combine([features for _, features in shown], targets.target_for(config).face_count))


def combine(found: Sequence[tuple[Feature, ...]], lines_per_group: int = 1) -> tuple[Feature, ...]:
    """
    Return the features of a stop from those of its profiles (one tuple each).

    Features are matched by kind, place and facing direction; lines_per_group: number of
    consecutive lines that are used only together. Raises FeatureError when the profiles of the
    stop do not agree.
    """
    if len(found) == 1:
        return found[0]
    arcs = [f for features in found for f in features if isinstance(f, Arc)]
    if arcs:
        return (_combined_arc(arcs),)
    edges = [f for features in found for f in features if isinstance(f, EdgePoint)]
    lines = _combined_lines([[f for f in features if isinstance(f, FaceLine)]
                             for features in found], lines_per_group)
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


def _combined_lines(seen: Sequence[Sequence[FaceLine]], lines_per_group: int) -> list[FaceLine]:
    """
    Return one line for each surface that most of the profiles show.

    Raises FeatureError if fewer lines agree than each profile shows.
    """
    usual = Counter(map(len, seen)).most_common(1)[0][0]
    lines = next(lines for lines in seen if len(lines) == usual)
    combined: list[FaceLine] = []
    failed = None
    for first in range(0, usual, lines_per_group):
        try:
            combined += [_combined_line([min(others, key=partial(_line_distance, line))
                                         for others in seen if others])
                         for line in lines[first:first + lines_per_group]]
        except FeatureError as error:
            failed = failed or error
    if failed and len(combined) < min(map(len, seen)):
        raise failed
    return combined


def _line_distance(line: FaceLine, other: FaceLine) -> float:
    """Return the distance between two lines (m): across, plus a small part along."""
    away = line.centre - other.centre
    across = away[1] * line.direction[0] - away[0] * line.direction[1]
    return float(abs(across) + ALONG_WEIGHT * abs(away[0]))


def _combined_line(lines: Sequence[FaceLine]) -> FaceLine:
    """
    Return one line from those of the profiles of a stop; its std includes their scatter.

    Errors that repeat in every profile, such as speckle, do not average out. Raises FeatureError.
    """
    centres = np.array([line.centre for line in lines])
    slopes = np.array([line.direction[1] / line.direction[0] for line in lines])
    x = float(np.median(centres[:, 0]))
    heights = centres[:, 1] + slopes * (x - centres[:, 0])
    good = _near_median(heights, 6.0, 6 * float(np.mean([line.std for line in lines])),
                        'how high the face is')
    lines = [line for line, g in zip(lines, good, strict=True) if g]
    slope, centre = float(slopes[good].mean()), np.array([x, heights[good].mean()])
    size = min(len(line.bins) for line in lines)
    same = [line for line in lines if len(line.bins) == size]
    each, n = np.array([line.bins for line in same]), len(same)
    across = (each - centre) @ np.array([-slope, 1.0]) / np.hypot(1.0, slope)
    white_var = (float(across.var(axis=0, ddof=1).mean()) if n > 1 else same[0].std ** 2 * size)
    spread = float(np.median([line.spread for line in lines]))
    combined = line_of_bins(centre, slope, spread, each.mean(axis=0), white_var / n)
    # a robot that shakes moves all points of a profile alike
    scatter = heights[good].std(ddof=1) / np.hypot(1.0, slope) if len(lines) > 1 else 0.0
    shared = max(float(scatter) ** 2 / n - combined.std ** 2, 0.0)
    return replace(combined, std=float(np.sqrt(combined.std ** 2 + shared)),
                   points_std=np.sqrt(combined.points_std ** 2 + shared))


def _combined_edge(edges: Sequence[EdgePoint]) -> EdgePoint:
    """
    Return one edge point from those of one side; ends of the most frequent kind alone.

    Raises FeatureError.
    """
    ending = Counter(e.ending for e in edges).most_common(1)[0][0]
    edges = [e for e in edges if e.ending == ending]  # each has its own bias
    points = np.array([e.point for e in edges])
    direction = np.median([e.direction for e in edges], axis=0)
    direction /= np.linalg.norm(direction)
    along, across = points @ direction, points @ [-direction[1], direction[0]]
    single = float(np.median([e.std for e in edges]))
    expected = float(np.median([e.std_across for e in edges]))
    good = _near_median(along, 4.0, 2 * single, 'where the edge is')
    good &= _near_median(across, 6.0, 6 * expected, 'where the edge is')
    n = max(int(good.sum()), 1)
    scatter = float(along[good].std(ddof=1)) if n > 1 else single
    # a robot that stands still repeats the rounding to a column, and mixed and lost points pull
    # the edge inwards in every profile: that does not average out
    std = np.hypot(single, scatter / min(n, MOST_INDEPENDENT) ** 0.5)
    combined = EdgePoint(points[good].mean(axis=0), direction, float(std), expected, ending,
                         np.median([e.drop for e in edges], axis=0))
    bent = [e for e, g in zip(edges, good, strict=True) if g and len(e.shape_log_odds)]
    if 2 * len(bent) <= good.sum():
        return combined
    times = min(len(bent), MOST_INDEPENDENT)
    shapes = np.mean([e.shape_log_odds for e in bent], axis=0) * times
    middle = np.mean([e.point + e.arc_offset for e in bent], axis=0)
    return replace(combined, shape_log_odds=shapes - shapes.max(),
                   arc_offset=middle - combined.point,
                   arc_std=float(np.median([e.arc_std for e in bent])) / times ** 0.5)


def _near_median(values: Array, times: float, least: float, what: str) -> NDArray[np.bool_]:
    """
    Return which values (n,) are near the median: within `times` scatters, or `least`.

    Raises FeatureError when too few are, or when they scatter more than a robot at
    rest may move.
    """
    middle = np.quantile(values, 0.5, method='lower')
    limit = min(max(times * robust_std(values - middle), least), LARGEST_DISAGREEMENT)
    good = np.abs(values - middle) <= limit
    if good.sum() < LEAST_AGREEING * len(values):
        raise _disagreeing(what, float(np.ptp(values)))
    return np.asarray(good)


def _combined_arc(arcs: Sequence[Arc]) -> Arc:
    """Return one arc from all points of the profiles of a stop."""
    centres = np.array([a.centre for a in arcs])
    middle = np.median([a.circle for a in arcs], axis=0)
    # a short arc determines its centre worse than the position of its points
    away = np.array([rms(off_circle(a.raw, middle)) for a in arcs])
    scatter = float(np.median([rms(off_circle(a.raw, a.circle)) for a in arcs]))
    good = away < min(LARGEST_DISAGREEMENT, scatter + max(3.0 * scatter, SMALLEST_DISAGREEMENT))
    if good.sum() < LEAST_AGREEING * len(arcs):
        raise _disagreeing('where the sphere is',
                           float(np.linalg.norm(np.ptp(centres, axis=0))))
    used = [a.raw for a, agrees in zip(arcs, good, strict=True) if agrees]
    arc = normal_points(np.concatenate(used))
    # for the residuals: 0.8 MB of a sample at most
    return replace(arc, raw=arc.raw[evenly_chosen(len(arc.raw), 50_000)])


def _disagreeing(what: str, apart: float) -> FeatureError:
    """Return the refusal of profiles that show the target at places so far apart (m)."""
    return FeatureError(f'the profiles of this stop do not agree on {what}: they are '
                        f'{mm(apart)} apart; something moved, or some of them show another '
                        'object; take the sample again', reason='disagreeing')
