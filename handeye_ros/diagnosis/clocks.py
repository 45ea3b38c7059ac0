"""
By how much the clocks of profiles and poses are apart, once the samples do not fit.

What the sensor sees stands still when the robot does. Where its stillness begins or ends later
than that of the poses, stop after stop, and the samples of these times fit the poses, that is it.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from handeye_ros import se3, targets
from handeye_ros.checks.alternatives import Fit, Hypothesis, require_stated
from handeye_ros.config import Config
from handeye_ros.data import Array, Profile, Sample
from handeye_ros.diagnosis.wrong_settings import fit_of
from handeye_ros.errors import DataError, FeatureError, UnusableMessageError
from handeye_ros.estimation.solution import redundancy
from handeye_ros.sampling import station_features
from handeye_ros.sampling.dwells import interpolate, NS
from handeye_ros.sampling.errors import ClocksDifferError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
import numpy as np

LAG = NS // 20  # between two profiles that are compared
GRID = 60  # places along the line at which they are
CHANGED = 0.8  # quantile of the changes there, which shows an edge that passes too
STILL_SHARE = 0.1  # of the comparisons, at the least, are of a robot that stands still
MOVING, SMALLEST_CHANGE = 4.0, 5e-5  # times the change at rest; m
FEWEST_PROFILES, FEWEST_CONDITIONS = 3, 6
SMALLEST = 0.05  # s: no stop shows less


@dataclass(frozen=True, eq=False)
class _Still:
    """
    What the sensor saw at rest during a stop of the robot, begun and ended by these stamps.

    pose: (4, 4) T_base_flange of the stop; start, end: of the stop; opened, closed: whether the
    target was seen to come to rest, and to leave it, within the stop.
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
    """Raise ClocksDifferError where the samples fit the poses of another time better."""
    seen = [part for outcome in session.outcomes if not outcome.refused
            and (part := _profiles(outcome.stop, config))]
    if len(seen) < targets.method_for(config).minimum:
        return
    changes = np.concatenate([_changes(profiles) for profiles, *_ in seen])
    rest = float(np.quantile(changes, STILL_SHARE)) if len(changes) else 0.0
    limit = max(MOVING * rest, SMALLEST_CHANGE)
    stills = [_still(*part, limit, config) for part in seen]
    stated = fit_of(session.samples, config)
    hypotheses = [_late(stills, behind, config) for behind in (0, 1, -1)
                  if abs(_offset(stills, behind)) > SMALLEST]
    require_stated(stated or (), hypotheses)


def _profiles(stop: Stop, config: Config
              ) -> tuple[list[Profile], Array, int, int] | None:
    """Return the profiles of a stop, some time apart, its pose, start and end."""
    seen = stop.load(config)
    found: list[Profile] = []
    for profile in seen.profiles:
        if not found or profile.stamp - found[-1].stamp >= LAG:
            with suppress(UnusableMessageError):
                found.append(profile.read(config.profile))
    middle = [pose.stamp for pose in seen.poses]
    if len(found) < 2:
        return None
    pose = se3.mean_pose(interpolate(seen.poses, middle))
    return found, pose, middle[0], middle[-1]


def _changes(profiles: Sequence[Profile]) -> Array:
    """Return by how much each profile differs from the one before, (n - 1,) in metres."""
    return np.array([_change(a.points, b.points)
                     for a, b in zip(profiles[:-1], profiles[1:], strict=True)])


def _change(a: Array, b: Array) -> float:
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if min(len(a), len(b)) < 2:
        return 0.0 if len(a) == len(b) else np.inf
    low, high = (max(a[:, 0].min(), b[:, 0].min()), min(a[:, 0].max(), b[:, 0].max()))
    x = np.linspace(low, high, GRID)
    (za, zb) = (np.interp(x, *points[np.argsort(points[:, 0])].T) for points in (a, b))
    return float(np.quantile(np.abs(za - zb), CHANGED))


def _still(profiles: list[Profile], pose: Array, start: int, end: int, limit: float,
           config: Config) -> _Still:
    """Return what was seen in the longest time during a stop in which nothing changed."""
    moving = np.flatnonzero(np.append(_changes(profiles) > limit, True))
    before = np.concatenate([[-1], moving[:-1]])
    k = int(np.argmax(moving - before))
    first, last = int(before[k]) + 1, int(moving[k])
    opened, closed = first > 0, last < len(profiles) - 1
    used = profiles[first + opened:last + 1 - closed]
    return _Still(_sample(used, pose, config), pose, start, end, profiles[first].stamp,
                  profiles[last].stamp, opened, closed)


def _sample(profiles: list[Profile], pose: Array, config: Config) -> Sample | None:
    if len(profiles) < FEWEST_PROFILES:
        return None
    try:
        used, features = station_features.of_station(profiles, targets.method_for(config), config)
    except FeatureError:
        return None
    return Sample(used[0].stamp, pose, features, len(used))


def _offset(stills: Sequence[_Still], behind: int) -> float:
    """
    Return by how much the profiles are late (s), if they show the stop so many before.

    Clocks that differ show at most stops; a few that the robot did not reach at rest prove none.
    """
    found, about = [], []
    for still, stop in _pairs(stills, behind):
        found += [still.first - stop.start] if still.opened else []
        found += [still.last - stop.end] if still.closed else []
        about.append(still.start - stop.start)
    return float(np.median(found if 2 * len(found) > len(about) else about or [0])) / NS


def _pairs(stills: Sequence[_Still], behind: int) -> list[tuple[_Still, _Still]]:
    """Return what was seen during each stop, with the stop whose pose it may belong to."""
    return [(still, stills[k - behind]) for k, still in enumerate(stills)
            if 0 <= k - behind < len(stills)]


def _late(stills: Sequence[_Still], behind: int, config: Config) -> Hypothesis:
    """Return that what was seen during each stop is of the stop so many before."""
    def refit() -> Fit | None:
        fit = fit_of([replace(still.sample, T_base_flange=stop.pose)
                      for still, stop in _pairs(stills, behind) if still.sample], config)
        return fit if fit and redundancy(fit[0].solution) >= FEWEST_CONDITIONS else None

    def refusal(fit: Fit) -> DataError:
        return ClocksDifferError(_offset(stills, behind), config.time_offset)
    return Hypothesis(refit, refusal)
