# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The sample that a stop gives: its pose, and the features of all its profiles combined.

The target finds the features of each profile (features_of). Those of all profiles of a stop are
combined (combined_features, features_of_stop): lines, edges and arcs each in their way. The
scatter between the profiles gives the uncertainty of what they share. A pass gives the samples of
its single profiles, each with the pose of its time.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import NoReturn

from handeye_ros import se3, targets
from handeye_ros.arithmetic import even_indices, evenly_spaced, rms, robust_std
from handeye_ros.config import Config, with_flipped_range
from handeye_ros.data import (
    AnyProfile,
    Arc,
    Array,
    EdgePoint,
    FaceLine,
    Feature,
    NS,
    Profile,
    Reject,
    Sample,
)
from handeye_ros.errors import FeatureError, UnusableMessageError
from handeye_ros.profiles.arcs import distances_from_circle, fitted_arc
from handeye_ros.profiles.lines import line_of_bins, with_line_errors
from handeye_ros.sampling.interpolation import interpolate
from handeye_ros.sampling.stops import decoded, Stop
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.words import mm
import numpy as np
from numpy.typing import NDArray

MAX_DISAGREEMENT = 5e-4  # between profiles of a robot that stands still (m)
MIN_DISAGREEMENT = 1e-4  # the same for arcs, beyond their own scatter
# smallest share of the profiles of a stop that show the target; more must show an edge or a bend
MIN_SHOWING_SHARE = 0.5
MIN_AGREEING_SHARE = 0.6  # of those that show it, smallest share that agree
ALONG_WEIGHT = 0.1  # weight of a distance along a surface against one across, to match lines
MAX_INDEPENDENT = 4  # profiles of one stop count as at most this many for an edge
# How far from the median profiles agree, in robust scatters or in sigmas of one, if that is more:
# across a face, and along it at an edge, where most of the error is rounding to a column, of less
# than 2 sigmas.
ACROSS_SCATTERS, ACROSS_SIGMAS = 6.0, 6.0
EDGE_SCATTERS, EDGE_SIGMAS = 4.0, 2.0
FLIPPED_EVERY = 8  # every such profile of a pass tells whether the range counts the other way
MAX_TRAVEL = 10.0  # of the robot at a stop, times sampling.still_translation
MAX_OF_PASS = 32  # profiles of a pass that are evaluated, twice as many if few show the target


def result_of(stop: Stop, config: Config) -> Sample | Reject:
    """Return the sample of a stop, or a reject with the reason; raises InputError as Stop.load."""
    stop = stop.load(config)
    try:
        return (_sample_of_pass if config.sampling.moving else _sample_of_stop)(stop, config)
    except (FeatureError, UnusableMessageError) as error:
        return Reject(stop.stamp, str(error))


def _sample_of_stop(stop: Stop, config: Config) -> Sample:
    """Return the sample of a robot that stood still; raises as result_of catches."""
    places = np.array([pose.translation for pose in stop.poses])
    if np.ptp(places, axis=0).max() > MAX_TRAVEL * config.sampling.still_translation:
        raise FeatureError('it was taken while the robot moved: sampling.mode moving uses it')
    settled = stop.settled_profiles(config)
    profiles = decoded(settled, config)
    if not profiles:
        _raise_no_profiles(settled, stop, config)
    used, features = combined_features(profiles, config)
    poses = interpolate(stop.poses, [profile.stamp for profile in used])
    return Sample(used[0].stamp, se3.mean_pose(poses), features, len(used),
                  _flipped(used[0], config), centroid=_centroid(used[0]))


def _sample_of_pass(stop: Stop, config: Config) -> Sample:
    """Return the middle sample of a pass, with its others; raises as result_of catches."""
    # of a stored pass some may lie beyond its poses, with another time_offset
    profiles = [p for p in stop.profiles if stop.start <= p.stamp <= stop.end]
    for most in (MAX_OF_PASS, 2 * MAX_OF_PASS):
        some = decoded(evenly_spaced(profiles, most), config)
        shown, reason = _features_by_profile(some, config)
        if len(shown) >= MIN_SHOWING_SHARE * MAX_OF_PASS or len(profiles) <= most:
            break
    if not shown:
        if reason:
            raise FeatureError(reason)
        _raise_no_profiles(profiles, stop, config)
    T = interpolate(stop.poses, [profile.stamp for profile, _ in shown])
    single = tuple(
        Sample(profile.stamp, pose, features,
               flipped_features=_flipped(profile, config) if k % FLIPPED_EVERY == 0 else None)
        for k, ((profile, features), pose) in enumerate(zip(shown, T, strict=True)))
    middle = single[len(single) // 2]
    return replace(middle, profile_count=len(single), profile_samples=single,
                   trajectory=trajectory_of(stop.poses, config.sampling.max_pose_gap),
                   centroid=_centroid(shown[0][0]))


def _raise_no_profiles(unusable: Iterable[AnyProfile], stop: Stop, config: Config) -> NoReturn:
    """Raise UnusableMessageError of the first profile, FeatureError where there are none."""
    for profile in unusable:
        profile.read(config.profile)
    seconds, settle = (stop.end - stop.start) / NS, config.sampling.settle_time
    if seconds <= 2 * settle and not config.sampling.moving:
        raise FeatureError(f'sampling.settle_time takes off {settle:g} s at either end of the '
                           f'{seconds:.1f} s of this stop: stay longer at each, or lower it')
    if stop.untimed:
        raise FeatureError(
            'each message holds several profiles without their times, '
            + ('which a robot that moves needs: set profile.period' if config.sampling.moving else
               f'and none lies wholly in the {seconds:.1f} s of this stop: set profile.period, or '
               'stay longer'))
    span = 'pass' if config.sampling.moving else 'stop'
    raise FeatureError(f'no profile has a stamp of the {seconds:.1f} s of this {span}: the '
                       'sensor sent none, they were dropped or could not be read, or its clock, '
                       'with time_offset, is not that of the robot')


def features_of(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features of one profile; raises FeatureError."""
    return targets.target_for(config).extract(profile.points, config)


def _centroid(profile: Profile) -> Array:
    """Return the mean (3,) of the points of a profile; see Sample."""
    return np.append(profile.out_of_plane, np.nanmean(profile.points, axis=0))


def _flipped(profile: Profile, config: Config) -> tuple[Feature, ...]:
    """Return the features of a target with edges, with the opposite profile.range_sign."""
    if targets.target_for(config).edge_kinds:
        with suppress(FeatureError):
            return features_of(profile, with_flipped_range(config))
    return ()


def _features_by_profile(profiles: Sequence[Profile], config: Config
                         ) -> tuple[list[tuple[Profile, tuple[Feature, ...]]], str]:
    """
    Return the profiles that show the target, each with its features, and why the others do not.

    That is the most frequent reason, '' where all show it.
    """
    shown, reasons = [], Counter[str]()
    for profile in profiles:
        try:
            shown.append((profile, features_of(profile, config)))
        except FeatureError as error:
            reasons[str(error)] += 1
    return shown, max(reasons, key=reasons.__getitem__, default='')


def combined_features(profiles: Sequence[Profile], config: Config
                      ) -> tuple[list[Profile], tuple[Feature, ...]]:
    """
    Return the profiles of a stop that show the target, and their combined features.

    Raises FeatureError when most do not show it, or do not agree.
    """
    shown, reason = _features_by_profile(profiles, config)
    if not shown or len(shown) < MIN_SHOWING_SHARE * len(profiles):
        raise FeatureError(reason)
    used, features_by_profile = zip(*shown, strict=True)
    return list(used), features_of_stop(features_by_profile, targets.target_for(config).face_count)


def features_of_stop(features_by_profile: Sequence[tuple[Feature, ...]], face_count: int
                     ) -> tuple[Feature, ...]:
    """
    Return the features of a stop from those of its profiles (one tuple each).

    Lines are matched by distance, edges by the side that they face; face_count: number of
    consecutive lines that are used only together. Raises FeatureError when the profiles of the
    stop do not agree.
    """
    if len(features_by_profile) == 1:
        return features_by_profile[0]
    arcs = [f for features in features_by_profile for f in features if isinstance(f, Arc)]
    if arcs:
        return (_combined_arc(arcs),)
    edges = [f for features in features_by_profile for f in features if isinstance(f, EdgePoint)]
    lines = _combined_lines([[f for f in features if isinstance(f, FaceLine)]
                             for features in features_by_profile], face_count)
    combined_edges = []
    for side in (-1.0, 1.0):
        of_side = [edge for edge in edges if np.sign(edge.direction[0]) == side]
        if len(of_side) > MIN_SHOWING_SHARE * len(features_by_profile):
            combined_edges.append(with_line_errors(_combined_edge(of_side), lines[0]))
    if edges and not combined_edges:
        raise _disagreement_error('where the edge is', [edge.point for edge in edges])
    return (*lines, *combined_edges)


def _combined_lines(lines_by_profile: Sequence[Sequence[FaceLine]], face_count: int
                    ) -> list[FaceLine]:
    """
    Return one line for each surface that most of the profiles show.

    Raises FeatureError if fewer lines agree than each profile shows.
    """
    usual_count = Counter(map(len, lines_by_profile)).most_common(1)[0][0]
    reference = next(lines for lines in lines_by_profile if len(lines) == usual_count)
    combined: list[FaceLine] = []
    failure = None
    for first in range(0, usual_count, face_count):
        try:
            combined += [_combined_line([min(lines, key=partial(_line_distance, line))
                                         for lines in lines_by_profile if lines])
                         for line in reference[first:first + face_count]]
        except FeatureError as error:
            failure = failure or error
    if failure and len(combined) < min(map(len, lines_by_profile)):
        raise failure
    return combined


def _line_distance(line: FaceLine, other: FaceLine) -> float:
    """Return the distance between two lines (m): across, plus a small part along."""
    offset = line.centre - other.centre
    across = offset[1] * line.direction[0] - offset[0] * line.direction[1]
    return float(abs(across) + ALONG_WEIGHT * abs(offset[0]))


def _combined_line(lines: Sequence[FaceLine]) -> FaceLine:
    """
    Return one line from those of the profiles of a stop; its std includes their scatter.

    Errors that repeat in every profile, such as speckle, do not average out. Raises FeatureError.
    """
    centres = np.array([line.centre for line in lines])
    slopes = np.array([line.direction[1] / line.direction[0] for line in lines])
    x = float(np.median(centres[:, 0]))
    heights = centres[:, 1] + slopes * (x - centres[:, 0])
    least = ACROSS_SIGMAS * float(np.mean([line.std for line in lines]))
    agree = _near_median(heights, ACROSS_SCATTERS, least, 'how high the face is')
    lines = list(compress(lines, agree))
    slope, centre = float(slopes[agree].mean()), np.array([x, heights[agree].mean()])
    spread = float(np.median([line.spread for line in lines]))
    # the means of the bins over the profiles that have as many of them as most
    bin_count = Counter(len(line.bins) for line in lines).most_common(1)[0][0]
    binned = [line for line in lines if len(line.bins) == bin_count]
    bins, n = np.array([line.bins for line in binned]), len(binned)
    across = (bins - centre) @ np.array([-slope, 1.0]) / np.hypot(1.0, slope)
    white_var = (float(across.var(axis=0, ddof=1).mean()) if n > 1
                 else binned[0].std ** 2 * bin_count)
    combined = line_of_bins(centre, slope, spread, bins.mean(axis=0), white_var / n)
    # a robot that shakes moves all points of a profile alike
    scatter = heights[agree].std(ddof=1) / np.hypot(1.0, slope) if len(lines) > 1 else 0.0
    common_var = max(float(scatter) ** 2 / len(lines) - combined.std ** 2, 0.0)
    return replace(combined, std=float(np.sqrt(combined.std ** 2 + common_var)),
                   points_std=np.sqrt(combined.points_std ** 2 + common_var))


def _combined_edge(edges: Sequence[EdgePoint]) -> EdgePoint:
    """
    Return one edge point from those of one side, of the most frequent ending alone.

    Raises FeatureError.
    """
    ending = Counter(edge.ending for edge in edges).most_common(1)[0][0]
    edges = [edge for edge in edges if edge.ending == ending]  # each has a bias of its own
    points = np.array([edge.point for edge in edges])
    direction = np.median([edge.direction for edge in edges], axis=0)
    direction /= np.linalg.norm(direction)
    along, across = points @ direction, points @ [-direction[1], direction[0]]
    single_std = float(np.median([edge.std for edge in edges]))
    std_across = float(np.median([edge.std_across for edge in edges]))
    agree = _near_median(along, EDGE_SCATTERS, EDGE_SIGMAS * single_std, 'where the edge is')
    agree &= _near_median(across, ACROSS_SCATTERS, ACROSS_SIGMAS * std_across, 'where the edge is')
    edges = list(compress(edges, agree))
    n = len(edges)
    scatter = float(along[agree].std(ddof=1)) if n > 1 else single_std
    # a robot that stands still repeats the rounding to a column, and mixed and lost points pull
    # the edge inwards in every profile: that does not average out
    std = np.hypot(single_std, scatter / min(n, MAX_INDEPENDENT) ** 0.5)
    combined = EdgePoint(points[agree].mean(axis=0), direction, float(std), std_across, ending,
                         np.median([edge.to_lowest for edge in edges], axis=0))
    return _with_shape(combined, edges)


def _with_shape(combined: EdgePoint, edges: Sequence[EdgePoint]) -> EdgePoint:
    """Return the combined edge point with the rounding or bevel that most of the edges show."""
    bent = [edge for edge in edges if len(edge.shape_log_likelihoods)]
    if len(bent) <= MIN_SHOWING_SHARE * len(edges):
        return combined
    independent = min(len(bent), MAX_INDEPENDENT)
    log_likelihoods = np.mean([edge.shape_log_likelihoods for edge in bent], axis=0) * independent
    arc_middle = np.mean([edge.point + edge.rounding_offset for edge in bent], axis=0)
    return replace(combined, shape_log_likelihoods=log_likelihoods - log_likelihoods.max(),
                   rounding_offset=arc_middle - combined.point,
                   rounding_std=float(np.median([edge.rounding_std for edge in bent])
                                      / independent ** 0.5))


def _near_median(values: Array, scatters: float, least: float, what: str) -> NDArray[np.bool_]:
    """
    Return which values (n,) are within so many robust scatters of the median, or within `least`.

    Raises FeatureError, about `what`, when too few are, or when they scatter more than a robot at
    rest may move.
    """
    median = np.quantile(values, 0.5, method='lower')
    limit = min(max(scatters * robust_std(values - median), least), MAX_DISAGREEMENT)
    near = np.abs(values - median) <= limit
    if near.sum() < MIN_AGREEING_SHARE * len(values):
        raise _disagreement_error(what, values)
    return np.asarray(near)


def _combined_arc(arcs: Sequence[Arc]) -> Arc:
    """Return one arc from all points of the profiles of a stop."""
    circle = np.median([arc.circle for arc in arcs], axis=0)
    # a short arc determines its centre worse than the position of its points
    distance = np.array([rms(distances_from_circle(arc.measured, circle)) for arc in arcs])
    scatter = float(np.median([rms(distances_from_circle(arc.measured, arc.circle))
                               for arc in arcs]))
    agree = distance < min(MAX_DISAGREEMENT,
                           scatter + max(3.0 * scatter, MIN_DISAGREEMENT))
    if agree.sum() < MIN_AGREEING_SHARE * len(arcs):
        raise _disagreement_error('where the sphere is', [arc.centre for arc in arcs])
    combined = fitted_arc(np.concatenate([arc.measured for arc in compress(arcs, agree)]))
    # for the residuals: 0.8 MB of a sample at most
    kept = even_indices(len(combined.measured), 50_000)
    return replace(combined, measured=combined.measured[kept])


def _disagreement_error(what: str, places: Sequence[Array] | Array) -> FeatureError:
    """Return the refusal of profiles that show the target at places (n, ...), in m."""
    distance = float(np.linalg.norm(np.ptp(places, axis=0)))
    return FeatureError(f'the profiles of this stop do not agree on {what}: they are '
                        f'{mm(distance)} apart; something moved, or some of them show another '
                        'object; take the sample again')
