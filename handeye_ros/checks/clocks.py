# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether the clocks of sensor and robot differ.

They do if, at stop after stop, the profiles come to rest or leave it later than the poses, and
the samples fit the poses of that other time; in a sweep, if the offset between them changes by
more than clocks drift apart.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from handeye_ros import se3, targets
from handeye_ros.calibration import clock_estimate
from handeye_ros.checks.hypotheses import (
    Explanation,
    explanation_of_results,
    Hypothesis,
    refuse_better,
)
from handeye_ros.config import Config
from handeye_ros.data import Array, CLOCK_DRIFT, NS, Profile, Sample
from handeye_ros.errors import DataError, FeatureError, UnusableMessageError
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.features import combined_features
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.stream import interpolate
import numpy as np

COMPARED_LAG = NS // 20  # ns between two profiles that are compared
STILL_SHARE = 0.1  # smallest share of the comparisons with a robot at rest
LARGEST_REST_RATIO, SMALLEST_CHANGE = 4.0, 5e-5  # largest change at rest: ratio, and at least (m)
SMALLEST_OFFSET = 0.05  # s: a smaller time offset is not visible at stops
CLOCK_STEP = 10.0  # times clock_drift_std: more is a step of a clock


@dataclass(frozen=True, eq=False)
class _Still:
    """
    The longest time of a stop in which the profiles do not change.

    sample: of these profiles, None without one
    pose: (4, 4) T_base_flange of the stop
    stop: (2,) first and last stamp of its poses (s)
    rest: (2,) of this time (s), NaN where the profiles do not change before or after it in the
        stop
    """

    sample: Sample | None
    pose: Array
    stop: Array
    rest: Array


def require_steady_clocks(solution: Solution) -> None:
    """Raise DataError (clocks_differ) where the clocks of a sweep drift apart as none do."""
    drift = clock_estimate(solution, CLOCK_DRIFT)
    if drift and abs(drift.value) > CLOCK_STEP * solution.problem.config.clock_drift_std:
        raise DataError(
            f'the clocks of profiles and poses drift apart by {drift.value * 60e3:.0f} ms a '
            'minute, or one of them jumped meanwhile: give both the same clock, without steps, '
            'and record again', reason='clocks_differ')


def require_same_clock(session: Session, config: Config) -> None:
    """
    Raise DataError (clocks_differ) where the samples fit poses of another time better.

    Asks nothing with fewer stops than the target needs.
    """
    stops = [(stop, part) for stop in session.stops if not stop.final_reason
             and not session.excludes(stop) and (part := _compared_profiles(stop, config))]
    seen = [part for _, part in stops]
    if len(seen) < targets.target_for(config).min_samples:
        return
    changes = np.concatenate([_differences(profiles) for profiles, *_ in seen])
    limit = max(LARGEST_REST_RATIO * float(np.quantile(changes, STILL_SHARE)), SMALLEST_CHANGE)
    stills = [_still(*part, limit, config) for part in seen]
    # compared are the stops in which the profiles come to rest, whatever they show as it is set
    stated = explanation_of_results([
        stop.sample for (stop, _), still in zip(stops, stills, strict=True) if still.sample],
        config)
    refuse_better(stated, [_shifted_by(stills, stops_earlier, config)
                           for stops_earlier in (0, 1, -1)
                           if abs(_offset(stills, stops_earlier)) > SMALLEST_OFFSET])


def _compared_profiles(stop: Stop, config: Config) -> tuple[list[Profile], Array, Array] | None:
    """Return some profiles of a stop, its pose (4, 4), start and end (2,) in s; None: too few."""
    seen, profiles = stop.load(config), list[Profile]()
    for profile in seen.profiles:
        if not profiles or profile.stamp - profiles[-1].stamp >= COMPARED_LAG:
            with suppress(UnusableMessageError):
                profiles.append(profile.read(config.profile))
    if len(profiles) < 2:
        return None
    pose = se3.mean_pose(interpolate(seen.poses, [pose.stamp for pose in seen.poses]))
    return profiles, pose, np.array([seen.poses[0].stamp, seen.poses[-1].stamp]) / NS


def _differences(profiles: Sequence[Profile]) -> Array:
    """Return the difference of each profile from the one before, (n - 1,) in metres."""
    return np.array([_change(a.points, b.points)
                     for a, b in zip(profiles[:-1], profiles[1:], strict=True)])


def _change(a: Array, b: Array) -> float:
    """
    Return the 80 % quantile of the range difference (m) of profiles (n, 2) where both are.

    It is inf where one alone shows points.
    """
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if min(len(a), len(b)) < 2:
        return 0.0 if len(a) == len(b) else np.inf
    low, high = (max(a[:, 0].min(), b[:, 0].min()), min(a[:, 0].max(), b[:, 0].max()))
    x = np.linspace(low, high, 60)
    (za, zb) = (np.interp(x, *points[np.argsort(points[:, 0])].T) for points in (a, b))
    return float(np.quantile(np.abs(za - zb), 0.8))  # an edge that passes changes a part only


def _still(profiles: list[Profile], pose: Array, stop: Array, limit: float, config: Config
           ) -> _Still:
    """Return the profiles of the longest time of a stop without a change."""
    moving = np.flatnonzero(np.append(_differences(profiles) > limit, True))
    before = np.append(-1, moving[:-1])
    k = int(np.argmax(moving - before))
    first, last = int(before[k]) + 1, int(moving[k])
    opened, closed = first > 0, last < len(profiles) - 1
    used, sample = profiles[first + opened:last + 1 - closed], None
    if len(used) > 2:
        with suppress(FeatureError):
            used, features = combined_features(used, config)
            sample = Sample(used[0].stamp, pose, features, len(used))
    rest = np.array([profiles[first].stamp, profiles[last].stamp]) / NS
    return _Still(sample, pose, stop, np.where([opened, closed], rest, np.nan))


def _offset(stills: Sequence[_Still], stops_earlier: int) -> float:
    """
    Return the delay of the profiles (s) if they belong a given number of stops earlier.

    Where the clocks differ, most stops show it, and rests begin and end to the same side of the
    stops; a few stops without rest prove nothing.
    """
    pairs = list(zip(stills[max(stops_earlier, 0):], stills[max(-stops_earlier, 0):],
                     strict=False))
    offsets = np.array([still.rest - other.stop for still, other in pairs])
    offsets = offsets[np.isfinite(offsets)]
    about = [still.stop[0] - other.stop[0] for still, other in pairs]
    if len(offsets) and np.quantile(offsets, 0.25) < 0 < np.quantile(offsets, 0.75):
        return 0.0  # profiles that scatter seem to rest for shorter than the robot
    return float(np.median(offsets if 2 * len(offsets) > len(about) else about))


def _shifted_by(stills: Sequence[_Still], stops_earlier: int, config: Config) -> Hypothesis:
    """Return the hypothesis that profiles belong a given number of stops earlier."""
    def refit() -> Explanation:
        return explanation_of_results([
            replace(still.sample, T_base_flange=stills[k - stops_earlier].pose)
            if 0 <= k - stops_earlier < len(stills) else None
            for k, still in enumerate(stills) if still.sample], config)

    def refusal(fit: Explanation) -> DataError:
        late = _offset(stills, stops_earlier)
        return DataError(
            'the samples do not fit the poses of their time, but as if the profiles were '
            f'{abs(late):.1f} s {"late" if late > 0 else "early"}: the clocks of sensor and robot '
            f'differ; set time_offset to {config.time_offset - late:.1f} (it is '
            f'{config.time_offset:g}), or give both the same clock', reason='clocks_differ')
    return Hypothesis(refit, refusal)
