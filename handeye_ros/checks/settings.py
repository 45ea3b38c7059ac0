# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Tests whether other settings or another time offset explain a recording without an answer.

Each hypothesis changes one setting, or two that belong together, and reads the same profiles of
the same stops again. It is named if most stops fit about as well as the configured noise allows,
and clearly more of them, or clearly better, than as it is set (alternatives.py).

Clocks differ if, at stop after stop, the profiles come to rest or leave it later than the poses,
and the samples fit the poses of that other time.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations
import math

from handeye_ros import se3, targets
from handeye_ros.checks.alternatives import Fit, Hypothesis, RARE, require_stated
from handeye_ros.config import Config, with_assignments
from handeye_ros.data import Array, EdgePoint, Profile, Reject, Sample
from handeye_ros.errors import DataError, FeatureError, NamedCauseError, UnusableMessageError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mounted
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.features import of_profiles, result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import evenly, NS, Stop
from handeye_ros.sampling.stream import interpolate
import numpy as np

MOST_STOPS, MOST_PROFILES = 40, 4  # stops read again, profiles of each
FEWEST_CONDITIONS = 6  # smallest redundancy of a hypothesis
SIGN = 'profile.range_sign'
LAG = NS // 20  # ns between two profiles that are compared
STILL_SHARE = 0.1  # smallest share of the comparisons with a robot at rest
MOVING, SMALLEST_CHANGE = 4.0, 5e-5  # largest change at rest: ratio, and at least (m)
SMALLEST = 0.05  # s: a smaller time offset is not visible at stops


class WrongSettingError(NamedCauseError):
    """Settings without an answer, where other settings give one."""


def require_settings(session: Session, config: Config) -> None:
    """Raise WrongSettingError where other settings explain the stops of a session better."""
    if config.sampling.moving:  # a pass: many profiles with their own poses
        return
    kept = [outcome.stop for outcome in session.outcomes if not outcome.refused
            and not session.excludes(outcome)]
    stops = [_thinned(stop, config) for stop in kept[:MOST_STOPS]]
    results = [result_of(stop, config) for stop in stops]
    seen = with_common_shape([r for r in results if isinstance(r, Sample)])
    with_edge = {s.stamp for s in seen if any(isinstance(f, EdgePoint) for f in s.features)}
    edges = np.array([result.stamp in with_edge for result in results], dtype=bool)
    stated = fit_of(results, config, all_starts=True)  # as a solve starts
    changes = list(_changes(config))

    def explanation(values: dict[str, str], all_starts: bool = False) -> tuple[Fit | None, float]:
        """Return the fit with other values of settings, and its evidence beyond the level."""
        changed = _changed(config, values)
        fit = fit_of([result_of(stop, changed) for stop in stops], changed, all_starts)
        if fit and changed.target.type == 'plane':  # it explains no edge that is seen as it is set
            fit = replace(fit, beside=edges)
        if not fit or not fit.believable or fit.solution.redundancy < FEWEST_CONDITIONS:
            return None, 0.0
        level = 2 * len(values) * math.log(len(changes) / RARE)
        return fit, fit.evidence_against(stated) - level

    best, most = '', 0.0
    for values in changes:
        fit, gain = explanation(values)
        if fit and gain > most and len(values) > 1:
            # the sign of the range is often free, and then no part of the cause
            without = {key: value for key, value in values.items() if key != SIGN}
            simpler, other = explanation(without, all_starts=True)
            if simpler and other > most:
                fit, gain, values = simpler, other, without
        if fit and gain > most:
            to = ' and '.join(f'{key} to {value}' for key, value in values.items())
            if values == {'target.type': 'plane'}:
                to += '; or, if the target has edges, cross them inside the field of view'
            if values == {'target.radius': '0'}:
                radius = float(fit.solution.estimate.target[-1])
                to = f'target.radius to {radius:.4f}, which these stops show, or to 0 (unknown)'
            named = ' and '.join(f'{key} {value}' for key, value in values.items())
            best, most = f'{fit.compared(stated, named)}: set {to}', gain
    if best:
        raise WrongSettingError(best)


def _changes(config: Config) -> Iterator[dict[str, str]]:
    """Yield the likely corrections of settings, the most likely first."""
    profile = config.profile
    sign = {SIGN: str(-profile.range_sign)}
    kinds = [{'target.type': name} for name in targets.METHODS if name != config.target.type]
    unit = {'m': 'mm', 'mm': 'm'}[profile.unit]
    kind = {'eye_on_base': 'eye_in_hand', 'eye_in_hand': 'eye_on_base'}[config.calibration_type]
    axes = [{'profile.axes': f'[{a}, {b}]'} for a, b in permutations('xyz', 2)
            if (a, b) != tuple(profile.axes)]
    if config.target.radius:
        yield {'target.radius': '0'}
    yield from (sign, {'profile.unit': unit}, *kinds, *axes, {'calibration_type': kind})
    yield from (change | sign for change in (*kinds, *axes))


def _changed(config: Config, values: dict[str, str]) -> Config:
    """Return the configuration with other values; measures of another target are reset."""
    if 'target.type' in values:
        config = replace(config, method='auto', target=replace(config.target, radius=0.0, size=()))
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def fit_of(results: Sequence[Sample | Reject | None], config: Config, all_starts: bool = False
           ) -> Fit | None:
    """
    Return the fit of what stops gave, None if the samples are too few or do not fit.

    results: of each of the stops that are compared; all_starts: see Fit.of.
    """
    method = targets.method_for(config)
    number = {r.stamp: k for k, r in enumerate(results) if isinstance(r, Sample)}
    ordered = with_common_shape([r for r in results if isinstance(r, Sample)])
    if len(ordered) < method.minimum:
        return None
    problem = Problem(method, mounted(ordered, config), method.observe(ordered), config)
    stops = np.array([number[sample.stamp] for sample in ordered])
    return Fit.of(problem, stops, len(results), all_starts)


def _thinned(stop: Stop, config: Config) -> Stop:
    """Return a stop with a few of its profiles."""
    stop = stop.needed(config)
    return replace(stop, profiles=tuple(evenly(stop.profiles, MOST_PROFILES)))


@dataclass(frozen=True, eq=False)
class _Still:
    """
    The longest time of a stop in which the profiles do not change.

    pose: (4, 4) T_base_flange of the stop; start, end: of its poses (ns); first, last: of this
    time (ns); opened, closed: whether the profiles change before and after it in the stop.
    """

    sample: Sample | None
    pose: Array
    start: int
    end: int
    first: int
    last: int
    opened: bool
    closed: bool


def require_same_clock(session: Session, config: Config) -> None:
    """Raise DataError (clocks_differ) where the samples fit poses of another time better."""
    found = [(outcome, part) for outcome in session.outcomes if not outcome.refused
             and not session.excludes(outcome) and (part := _profiles(outcome.stop, config))]
    seen = [part for _, part in found]
    if len(seen) < targets.method_for(config).minimum:
        return
    changes = np.concatenate([[], *(_differences(profiles) for profiles, *_ in seen)])
    rest = float(np.quantile(changes, STILL_SHARE)) if len(changes) else 0.0
    limit = max(MOVING * rest, SMALLEST_CHANGE)
    stills = [_still(*part, limit, config) for part in seen]
    # compared are the stops in which the profiles come to rest, whatever they show as it is set
    stated = fit_of([outcome.sample for (outcome, _), still in zip(found, stills, strict=True)
                     if still.sample], config)
    require_stated(stated, [_late(stills, behind, config) for behind in (0, 1, -1)
                                       if abs(_offset(stills, behind)) > SMALLEST])


def _profiles(stop: Stop, config: Config) -> tuple[list[Profile], Array, int, int] | None:
    """Return some profiles of a stop, its pose (4, 4), start and end (ns); None: too few."""
    seen, found = stop.load(config), list[Profile]()
    for profile in seen.profiles:
        if not found or profile.stamp - found[-1].stamp >= LAG:
            with suppress(UnusableMessageError):
                found.append(profile.read(config.profile))
    if len(found) < 2:
        return None
    pose = se3.mean_pose(interpolate(seen.poses, [pose.stamp for pose in seen.poses]))
    return found, pose, seen.poses[0].stamp, seen.poses[-1].stamp


def _differences(profiles: Sequence[Profile]) -> Array:
    """Return the difference of each profile from the one before, (n - 1,) in metres."""
    return np.array([_change(a.points, b.points)
                     for a, b in zip(profiles[:-1], profiles[1:], strict=True)])


def _change(a: Array, b: Array) -> float:
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if min(len(a), len(b)) < 2:
        return 0.0 if len(a) == len(b) else np.inf
    low, high = (max(a[:, 0].min(), b[:, 0].min()), min(a[:, 0].max(), b[:, 0].max()))
    x = np.linspace(low, high, 60)
    (za, zb) = (np.interp(x, *points[np.argsort(points[:, 0])].T) for points in (a, b))
    return float(np.quantile(np.abs(za - zb), 0.8))  # an edge that passes changes a part only


def _still(profiles: list[Profile], pose: Array, start: int, end: int, limit: float,
           config: Config) -> _Still:
    """Return the profiles of the longest time of a stop without a change."""
    moving = np.flatnonzero(np.append(_differences(profiles) > limit, True))
    before = np.append(-1, moving[:-1])
    k = int(np.argmax(moving - before))
    first, last = int(before[k]) + 1, int(moving[k])
    opened, closed = first > 0, last < len(profiles) - 1
    used = profiles[first + opened:last + 1 - closed]
    return _Still(_sample(used, pose, config), pose, start, end, profiles[first].stamp,
                  profiles[last].stamp, opened, closed)


def _sample(profiles: list[Profile], pose: Array, config: Config) -> Sample | None:
    with suppress(FeatureError):
        if len(profiles) > 2:
            used, features = of_profiles(profiles, config)
            return Sample(used[0].stamp, pose, features, len(used))
    return None


def _offset(stills: Sequence[_Still], behind: int) -> float:
    """
    Return the delay of the profiles (s) if they belong a given number of stops earlier.

    Where the clocks differ, most stops show it; a few stops without rest prove nothing.
    """
    found, about = [], []
    for still, stop in _pairs(stills, behind):
        found += [still.first - stop.start] if still.opened else []
        found += [still.last - stop.end] if still.closed else []
        about.append(still.start - stop.start)
    return float(np.median(found if 2 * len(found) > len(about) else about or [0])) / NS


def _pairs(stills: Sequence[_Still], behind: int) -> list[tuple[_Still, _Still]]:
    """Return the profiles of each stop with the stop whose pose may belong to them."""
    return [(still, stills[k - behind]) for k, still in enumerate(stills)
            if 0 <= k - behind < len(stills)]


def _late(stills: Sequence[_Still], behind: int, config: Config) -> Hypothesis:
    """Return the hypothesis that profiles belong a given number of stops earlier."""
    def refit() -> Fit | None:
        poses = {id(still): stop.pose for still, stop in _pairs(stills, behind)}
        fit = fit_of([replace(still.sample, T_base_flange=poses[id(still)])
                      if id(still) in poses else None for still in stills if still.sample],
                     config)
        return fit if fit and fit.solution.redundancy >= FEWEST_CONDITIONS else None

    def refusal(fit: Fit) -> DataError:
        late = _offset(stills, behind)
        return DataError(
            'the samples do not fit the poses of their time, but as if the profiles were '
            f'{abs(late):.1f} s {"late" if late > 0 else "early"}: the clocks of sensor and robot '
            f'differ; set time_offset to {config.time_offset - late:.1f} (it is '
            f'{config.time_offset:g}), or give both the same clock', reason='clocks_differ')
    return Hypothesis(refit, refusal)
