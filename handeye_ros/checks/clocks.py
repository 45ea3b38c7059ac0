# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hypotheses about the clocks of sensor and robot: the same stops with the poses of another time.

The clocks differ if, at stop after stop, the profiles come to rest or leave it later than the
poses, and the samples fit the poses of that other time; in a sweep, if the offset between them
changes by more than clocks drift apart.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.calibration import clock_estimate
from handeye_ros.checks.hypotheses import (
    explain_samples,
    Hypothesis,
    refuse_by_best,
    stops_to_explain,
)
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, CLOCK_DRIFT, has_return, NS, Profile, Sample
from handeye_ros.errors import BadValueError, DataError, FeatureError
from handeye_ros.estimation.solution import Solution
from handeye_ros.sampling.features import combined_features
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import decoded, Stop
import numpy as np
from numpy.typing import NDArray

COMPARED_LAG = NS // 20  # ns: one profile in this time is compared with that before
STILL_SHARE = 0.1  # smallest share of the comparisons with a robot at rest
MAX_REST_RATIO, MIN_CHANGE = 4.0, 5e-5  # largest change at rest: ratio, and at least (m)
MIN_OFFSET = 0.05  # s: a smaller time offset is not visible at stops
CLOCK_STEP = 10.0  # times clock_drift_std: more is a step of a clock


def require_steady_clocks(solution: Solution) -> None:
    """Raise DataError (clocks_differ) where the clocks of a sweep drift apart as none do."""
    drift = clock_estimate(solution, CLOCK_DRIFT)
    if drift and abs(drift.value) > CLOCK_STEP * solution.problem.config.clock_drift_std:
        raise DataError(
            f'the clocks of profiles and poses drift apart by {drift.value * 60e3:.0f} ms a '
            'minute, or one of them jumped meanwhile: give both the same clock, without steps, '
            'and record again', code='clocks_differ')


def require_same_clock(session: Session, config: Config) -> None:
    """Raise DataError (clocks_differ) where the samples of stops fit poses of another time."""
    rests = _rests(session, config)
    if rests:
        baseline = explain_samples(session.samples, config)
        refuse_by_best(baseline, _delay_hypotheses(rests, config))


@dataclass(frozen=True, eq=False)
class _Rest:
    """
    The longest time of a stop in which the profiles do not change.

    sample: of these profiles, with the stamp of that of the stop; None without one
    T_base_flange: (4, 4) mean pose of the stop
    pose_span: (2,) first and last stamp of the poses of the stop (s)
    profile_span: (2,) first and last stamp of the profiles of this time (s), NaN where they do not
        change before or after it in the stop
    """

    sample: Sample | None
    T_base_flange: Array
    pose_span: Array
    profile_span: Array


def _delay_hypotheses(rests: Sequence[_Rest], config: Config) -> Iterator[Hypothesis]:
    """
    Yield the hypotheses that profiles belong to the poses of this, the previous or the next stop.

    All samples of profiles at rest are to be explained, whatever they show as configured.
    """
    stamps = [rest.sample.stamp for rest in rests if rest.sample]
    for stops_late in (0, 1, -1):
        pairs = list(zip(rests[max(stops_late, 0):], rests[max(-stops_late, 0):], strict=False))
        if not pairs or abs(delay := _delay(pairs)) <= MIN_OFFSET:
            continue
        samples = [replace(seen.sample, T_base_flange=posed.T_base_flange)
                   for seen, posed in pairs if seen.sample]
        offset, setting = config.time_offset - delay, ''
        with suppress(BadValueError):  # it may be out of the range of the key
            with_values(config, {'time_offset': offset})
            setting = f'set time_offset to {offset:.1f} (it is {config.time_offset:g}), or '
        yield Hypothesis(explain_samples(samples, config, stamps), DataError(
            'the samples do not fit the poses of their time, but as if the profiles were '
            f'{abs(delay):.1f} s {"late" if delay > 0 else "early"}: the clocks of sensor and '
            f'robot differ; {setting}give both the same clock', code='clocks_differ'))


def _delay(pairs: Sequence[tuple[_Rest, _Rest]]) -> float:
    """
    Return how much later (s) the profiles of the first rest are than the poses of the second one.

    Where the clocks differ, most stops show it, and profiles come to rest and leave it to the same
    side of the robot; a few stops without rest prove nothing.
    """
    delays = np.array([seen.profile_span - posed.pose_span for seen, posed in pairs])
    delays = delays[np.isfinite(delays)]
    between_stops = [seen.pose_span[0] - posed.pose_span[0] for seen, posed in pairs]
    if len(delays) and np.quantile(delays, 0.25) < 0 < np.quantile(delays, 0.75):
        return 0.0  # profiles that scatter seem to rest for shorter than the robot
    return float(np.median(delays if 2 * len(delays) > len(pairs) else between_stops))


def _rests(session: Session, config: Config) -> list[_Rest]:
    """Return the rest of the profiles at each stop that has several, in the order of time."""
    stops = []
    for unread in sorted(stops_to_explain(session), key=lambda stop: stop.stamp):
        stop = unread.load(config)
        compared = {profile.stamp // COMPARED_LAG: profile
                    for profile in decoded(stop.profiles, config)}
        if len(profiles := [*compared.values()]) > 1:
            stops.append((replace(stop, profiles=()), profiles, _changes(profiles)))
    if not stops:
        return []
    all_changes = np.concatenate([changes for _, _, changes in stops])
    largest_at_rest = max(
        MIN_CHANGE, MAX_REST_RATIO * float(np.quantile(all_changes, STILL_SHARE)))
    return [_rest(stop, profiles, changes > largest_at_rest, config)
            for stop, profiles, changes in stops]


def _changes(profiles: Sequence[Profile]) -> Array:
    """
    Return how much each profile differs from the one before, (n - 1,).

    It is the 80 % quantile of the range difference (m) where both are: an edge that passes changes
    a part only. It is inf where one alone shows points.
    """
    def change(a: Array, b: Array) -> float:
        if min(len(a), len(b)) < 2:
            return 0.0 if len(a) == len(b) else np.inf
        x = np.linspace(max(a[:, 0].min(), b[:, 0].min()), min(a[:, 0].max(), b[:, 0].max()), 60)
        range_a, range_b = (np.interp(x, *points[np.argsort(points[:, 0])].T)
                            for points in (a, b))
        return float(np.quantile(np.abs(range_a - range_b), 0.8))

    shown = [profile.points[has_return(profile.points)] for profile in profiles]
    return np.array([change(a, b) for a, b in zip(shown[:-1], shown[1:], strict=True)])


def _rest(stop: Stop, profiles: Sequence[Profile], changed: NDArray[np.bool_], config: Config
          ) -> _Rest:
    """Return the rest of a stop; changed: (n - 1,) whether a profile differs from that before."""
    unchanged = np.split(np.arange(len(profiles)), np.flatnonzero(changed) + 1)
    longest = max(unchanged, key=len)
    first, last = int(longest[0]), int(longest[-1])
    # the profiles at both ends may be of a robot that was moving for a part of the exposure
    change_before, change_after = first > 0, last < len(profiles) - 1
    at_rest, sample = profiles[first + change_before:last + 1 - change_after], None
    T_base_flange = se3.mean_pose(np.array([*map(se3.of_pose, stop.poses)]))
    if len(at_rest) > 2:
        with suppress(FeatureError):
            used, features = combined_features(at_rest, config)
            sample = Sample(stop.result.stamp, T_base_flange, features, len(used))
    span = np.array([profiles[first].stamp, profiles[last].stamp]) / NS
    return _Rest(sample, T_base_flange, np.array([stop.start, stop.end]) / NS,
                 np.where([change_before, change_after], span, np.nan))
