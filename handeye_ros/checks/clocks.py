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

from handeye_ros import se3
from handeye_ros.calibration import clock_estimate
from handeye_ros.checks.hypotheses import explanation_of_samples, Hypothesis, refuse_better
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, CLOCK_DRIFT, NS, Profile, Sample
from handeye_ros.errors import BadValueError, DataError, FeatureError
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.features import combined_features
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import decoded, Stop
from handeye_ros.sampling.stream import interpolate
import numpy as np
from numpy.typing import NDArray

COMPARED_LAG = NS // 20  # ns between two profiles that are compared
STILL_SHARE = 0.1  # smallest share of the comparisons with a robot at rest
LARGEST_REST_RATIO, SMALLEST_CHANGE = 4.0, 5e-5  # largest change at rest: ratio, and at least (m)
SMALLEST_OFFSET = 0.05  # s: a smaller time offset is not visible at stops
CLOCK_STEP = 10.0  # times clock_drift_std: more is a step of a clock


def require_steady_clocks(solution: Solution) -> None:
    """Raise DataError (clocks_differ) where the clocks of a sweep drift apart as none do."""
    drift = clock_estimate(solution, CLOCK_DRIFT)
    if drift and abs(drift.value) > CLOCK_STEP * solution.problem.config.clock_drift_std:
        raise DataError(
            f'the clocks of profiles and poses drift apart by {drift.value * 60e3:.0f} ms a '
            'minute, or one of them jumped meanwhile: give both the same clock, without steps, '
            'and record again', reason='clocks_differ')


def require_same_clock(session: Session, config: Config) -> None:
    """Raise DataError (clocks_differ) where the samples of stops fit poses of another time."""
    seen = [(stop, profiles, _changes(profiles)) for stop in session.stops
            if not stop.final_reason and not session.excludes(stop)
            if len(profiles := _compared_profiles(stop, config)) > 1]
    if not seen:
        return
    limit = max(SMALLEST_CHANGE, LARGEST_REST_RATIO * float(np.quantile(
        np.concatenate([changes for *_, changes in seen]), STILL_SHARE)))
    rests = [_rest(stop.load(config), profiles, changes > limit, config)
             for stop, profiles, changes in seen]
    # compared are the stops in which the profiles come to rest, whatever they show as it is set
    stamps, hypotheses = [rest.sample.stamp for rest in rests if rest.sample], []
    for earlier in (0, 1, -1):  # stops earlier: the poses to which the profiles may belong
        pairs = list(zip(rests[max(earlier, 0):], rests[max(-earlier, 0):], strict=False))
        late = _delay(pairs)
        if abs(late) > SMALLEST_OFFSET:
            samples = [replace(rest.sample, T_base_flange=other.pose) for rest, other in pairs
                       if rest.sample]
            fit = explanation_of_samples(with_common_shape(samples), config, stamps)
            offset, setting = config.time_offset - late, ''
            with suppress(BadValueError):  # it may be out of the range of the key
                with_values(config, {'time_offset': offset})
                setting = f'set time_offset to {offset:.1f} (it is {config.time_offset:g}), or '
            hypotheses.append(Hypothesis(fit, DataError(
                'the samples do not fit the poses of their time, but as if the profiles were '
                f'{abs(late):.1f} s {"late" if late > 0 else "early"}: the clocks of sensor and '
                f'robot differ; {setting}give both the same clock', reason='clocks_differ')))
    samples = with_common_shape(session.samples)
    refuse_better(explanation_of_samples(samples, config, [s.stamp for s in samples]), hypotheses)


def _compared_profiles(stop: Stop, config: Config) -> list[Profile]:
    """Return the profiles of a stop that are compared, each with the one before."""
    profiles = list[Profile]()
    for profile in decoded(stop.load(config).profiles, config):
        if not profiles or profile.stamp - profiles[-1].stamp >= COMPARED_LAG:
            profiles.append(profile)
    return profiles


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
        za, zb = (np.interp(x, *points[np.argsort(points[:, 0])].T) for points in (a, b))
        return float(np.quantile(np.abs(za - zb), 0.8))

    shown = [profile.points[np.isfinite(profile.points).all(axis=1)] for profile in profiles]
    return np.array([change(a, b) for a, b in zip(shown[:-1], shown[1:], strict=True)])


@dataclass(frozen=True, eq=False)
class _Rest:
    """
    The longest time of a stop in which the profiles do not change.

    sample: of these profiles, with the stamp of that of the stop; None without one
    pose: (4, 4) T_base_flange of the stop
    span: (2,) first and last stamp of the poses of the stop (s)
    rest: (2,) of this time (s), NaN where the profiles do not change before or after it in the
        stop
    """

    sample: Sample | None
    pose: Array
    span: Array
    rest: Array


def _rest(stop: Stop, profiles: Sequence[Profile], moving: NDArray[np.bool_], config: Config
          ) -> _Rest:
    """Return the rest of a stop; moving: (n - 1,) whether a profile differs from that before."""
    ends = np.flatnonzero(np.append(moving, True))
    begins = np.append(0, ends[:-1] + 1)
    k = int(np.argmax(ends - begins))
    first, last = int(begins[k]), int(ends[k])
    opened, closed = first > 0, last < len(profiles) - 1
    used, sample = profiles[first + opened:last + 1 - closed], None
    pose = se3.mean_pose(interpolate(stop.poses, [pose.stamp for pose in stop.poses]))
    if len(used) > 2:
        with suppress(FeatureError):
            shown, features = combined_features(used, config)
            sample = Sample(stop.result.stamp, pose, features, len(shown))
    rest = np.array([profiles[first].stamp, profiles[last].stamp]) / NS
    return _Rest(sample, pose, np.array([stop.start, stop.end]) / NS,
                 np.where([opened, closed], rest, np.nan))


def _delay(pairs: Sequence[tuple[_Rest, _Rest]]) -> float:
    """
    Return the delay of profiles (s) that belong to the poses of others of the stops.

    Where the clocks differ, most stops show it, and rests begin and end to the same side of the
    stops; a few stops without rest prove nothing.
    """
    delays = np.array([rest.rest - other.span for rest, other in pairs])
    delays = delays[np.isfinite(delays)]
    about = [rest.span[0] - other.span[0] for rest, other in pairs]
    if len(delays) and np.quantile(delays, 0.25) < 0 < np.quantile(delays, 0.75):
        return 0.0  # profiles that scatter seem to rest for shorter than the robot
    return float(np.median(delays if 2 * len(delays) > len(about) else about))
