# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether the clocks of sensor and robot differ.

They do if, at stop after stop, the profiles come to rest or leave it later than the poses, and
the samples fit the poses of that other time.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from handeye_ros import se3, targets
from handeye_ros.checks.hypotheses import Explanation, Hypothesis, require_stated
from handeye_ros.checks.settings import FEWEST_CONDITIONS, fit_of
from handeye_ros.config import Config
from handeye_ros.data import Array, Profile, Sample
from handeye_ros.errors import DataError, FeatureError, UnusableMessageError
from handeye_ros.sampling.features import of_profiles
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import NS, Stop
from handeye_ros.sampling.stream import interpolate
import numpy as np

LAG = NS // 20  # ns between two profiles that are compared
STILL_SHARE = 0.1  # smallest share of the comparisons with a robot at rest
MOVING, SMALLEST_CHANGE = 4.0, 5e-5  # largest change at rest: ratio, and at least (m)
SMALLEST = 0.05  # s: a smaller time offset is not visible at stops


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
    found = [(stop, part) for stop in session.stops if not stop.refused
             and not session.excludes(stop) and (part := _profiles(stop, config))]
    seen = [part for _, part in found]
    if len(seen) < targets.target_for(config).minimum:
        return
    changes = np.concatenate([[], *(_differences(profiles) for profiles, *_ in seen)])
    rest = float(np.quantile(changes, STILL_SHARE)) if len(changes) else 0.0
    limit = max(MOVING * rest, SMALLEST_CHANGE)
    stills = [_still(*part, limit, config) for part in seen]
    # compared are the stops in which the profiles come to rest, whatever they show as it is set
    stated = fit_of([stop.sample for (stop, _), still in zip(found, stills, strict=True)
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
    def refit() -> Explanation | None:
        poses = {id(still): stop.pose for still, stop in _pairs(stills, behind)}
        fit = fit_of([replace(still.sample, T_base_flange=poses[id(still)])
                      if id(still) in poses else None for still in stills if still.sample],
                     config)
        return fit if fit and fit.solution.redundancy >= FEWEST_CONDITIONS else None

    def refusal(fit: Explanation) -> DataError:
        late = _offset(stills, behind)
        return DataError(
            'the samples do not fit the poses of their time, but as if the profiles were '
            f'{abs(late):.1f} s {"late" if late > 0 else "early"}: the clocks of sensor and robot '
            f'differ; set time_offset to {config.time_offset - late:.1f} (it is '
            f'{config.time_offset:g}), or give both the same clock', reason='clocks_differ')
    return Hypothesis(refit, refusal)
