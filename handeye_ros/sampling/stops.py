# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A stop of the robot: the messages kept, and the sample made of them.

The messages stay with the stop, so that another configuration needs no new stops.
"""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import (
    AnyProfile,
    Array,
    EdgePoint,
    Feature,
    Profile,
    RawProfile,
    Reject,
    Sample,
    TimedPose,
)
from handeye_ros.errors import FeatureError, UnusableMessageError
from handeye_ros.sampling.dwells import Dwell, NS
from handeye_ros.sampling.passes import no_profiles, pass_sample
from handeye_ros.sampling.station_features import evenly, flipped_features, of_station
from handeye_ros.sampling.stream import around, interpolate
import numpy as np

# Profiles of a sample, evenly spread. A robot at rest sees the same speckle, and 32 profiles
# reduce the noise of single ones far below that of the poses. A stop keeps more: for other
# settings, and for the test of the clocks (50 ms apart, see diagnosis/settings.py) in 3.75 s.
MOST_PROFILES = 32
NEAREST = 1e-3  # smallest distance of an edge from the end of the view (m)


@dataclass(frozen=True, eq=False)
class Seen:
    """Poses and profiles of the duration of a stop, each in the order of their stamps."""

    poses: tuple[TimedPose, ...]
    profiles: tuple[AnyProfile, ...]


@dataclass(frozen=True, eq=False)
class Stop:
    """
    A time during which the robot stood still.

    began: stamp of its first pose, which identifies the stop; load: returns its poses and profiles
    for a configuration.
    """

    began: int
    load: Callable[[Config], Seen]

    def pose(self, config: Config) -> Array:
        """Return T_base_flange (4, 4) of its last pose."""
        last = self.load(config).poses[-1]
        return se3.from_quaternion(last.translation, last.quaternion)


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    Result of a stop: a sample, or the reason why there is none.

    number: from 1, never reused in a session; refused: why the stop gives no sample, whatever its
    profiles show, '' if it may.
    """

    number: int
    stop: Stop
    result: Sample | Reject
    refused: str = ''

    @property
    def sample(self) -> Sample | None:
        """Return the sample, or None."""
        return self.result if isinstance(self.result, Sample) else None


def stop_of(station: Dwell, profiles: Sequence[AnyProfile], config: Config) -> Stop:
    """Return the stop of a dwell; profiles: all candidates, in order."""
    inside = _inside(profiles, station)
    first, last = steady_span(station.start, station.end, config)
    begin, end = (bisect_left(inside, first, key=_stamp), bisect_right(inside, last, key=_stamp))
    kept = (*_kept(inside[:begin], 8), *_kept(inside[begin:end], 64),
            *_kept(inside[max(begin, end):], 8))  # few from times with vibration
    seen = Seen(station.poses, kept)
    return Stop(station.began, partial(_held, seen))


def _held(seen: Seen, config: Config) -> Seen:
    """Return messages that are in memory; a module function, so that a stop can be pickled."""
    return seen


def needed(stop: Stop, config: Config) -> Stop:
    """Return a stop reduced to the messages of its sample, to be processed elsewhere."""
    seen = stop.load(config)
    if config.sampling.moving:
        return Stop(stop.began, partial(_held, seen))
    profiles = _unread(seen, config)
    poses = around(seen.poses, [profile.stamp for profile in profiles])
    return Stop(stop.began, partial(_held, Seen(tuple(poses), tuple(profiles))))


def _inside(profiles: Sequence[AnyProfile], station: Dwell) -> Sequence[AnyProfile]:
    """Return the profiles surely taken during a dwell; thousands are tested."""
    begin = bisect_left(profiles, station.start, key=_stamp)
    end = bisect_right(profiles, station.end, key=_stamp)
    while begin < end and not _surely_inside(profiles[begin], station):
        begin += 1
    while begin < end and not _surely_inside(profiles[end - 1], station):
        end -= 1
    return profiles[begin:end]


def _surely_inside(profile: AnyProfile, station: Dwell) -> bool:
    """Return whether a profile was surely taken during a dwell, given its duration."""
    if not isinstance(profile, RawProfile):
        return True
    before, after = profile.reach
    return profile.stamp - before >= station.start and profile.stamp + after <= station.end


def steady_span(start: int, end: int, config: Config) -> tuple[int, int]:
    """Return the first and last stamp of a stop without vibration."""
    settle = round(config.sampling.settle_time * NS)
    return start + settle, end - settle


def _kept(profiles: Sequence[AnyProfile], least: int) -> list[AnyProfile]:
    """Return a part of the profiles of a stop: 40 per second, at most 150."""
    length = (profiles[-1].stamp - profiles[0].stamp) / NS if profiles else 0.0
    return evenly(profiles, min(150, max(least, 1 + round(40 * length))))


def sample_of(stop: Stop, config: Config) -> Sample:
    """Return the sample of a stop; raises FeatureError with the reason."""
    seen = stop.load(config)
    if config.sampling.moving:
        return pass_sample(seen.poses, seen.profiles, config)
    return _sample(seen, _still(seen, config), config)


def _sample(seen: Seen, profiles: Sequence[Profile], config: Config) -> Sample:
    """Return the sample of the messages of a stop; profiles: of its time without vibration."""
    if not profiles:
        raise no_profiles(seen.poses)
    used, combined = of_station(profiles, targets.method_for(config), config)
    require_inside(combined, used)
    poses = interpolate(seen.poses, [p.stamp for p in used])
    return Sample(used[0].stamp, se3.mean_pose(poses), combined, len(used),
                  flipped_features(used[0], config))


def require_inside(features: Sequence[Feature], profiles: Sequence[Profile]) -> None:
    """
    Reject a stop if all its edges may be cut off by the border of the view.

    The view ends where the columns of a profile end. A driver that omits columns without a return
    hides this; then nothing is refused.
    profiles: those of the stop that show the features. Raises FeatureError.
    """
    edges = [feature for feature in features if isinstance(feature, EdgePoint)]
    columns = {len(profile.points) for profile in profiles}
    if not edges or len(columns) > 1 or not np.isnan(profiles[0].points).any():
        return
    distances = [_to_the_end(edge, profiles[0].points) for edge in edges]
    if max(distances) < NEAREST:
        raise FeatureError(
            f'the edge lies {max(distances) * 1e3:.1f} mm from the end of the view, where it may '
            f'be cut off: move it {NEAREST * 1e3:.0f} mm or more into the view')


def _to_the_end(edge: EdgePoint, points: Array) -> float:
    """Return the width (m) of the columns beside an edge, on the side with fewer."""
    seen = np.flatnonzero(np.isfinite(points).all(axis=1))
    at = seen[int(np.argmin(np.abs(points[seen] - edge.point).sum(axis=1)))]
    along = points[seen] @ edge.direction
    spacing = float(np.median(np.abs(np.diff(along) / np.diff(seen))))
    return float(min(at, len(points) - 1 - at) * spacing)


def _still(seen: Seen, config: Config) -> list[Profile]:
    """Return the profiles of the time without vibration; some may be unusable."""
    read = []
    for profile in _unread(seen, config):
        with suppress(UnusableMessageError):
            read.append(profile.read(config.profile))
    return read


def _unread(seen: Seen, config: Config) -> list[AnyProfile]:
    """Return the profiles of the time without vibration, not yet decoded."""
    first, last = steady_span(seen.poses[0].stamp, seen.poses[-1].stamp, config)
    return evenly([p for p in seen.profiles if first <= p.stamp <= last], MOST_PROFILES)


def beside(stop: Stop, config: Config) -> float:
    """Return the distance (m) of the first profile's points from the plane of profile.axes."""
    for profile in stop.load(config).profiles:
        with suppress(UnusableMessageError):
            return abs(profile.read(config.profile).beside)
    return 0.0


def _stamp(profile: AnyProfile) -> int:
    return profile.stamp


def result_of(stop: Stop, config: Config) -> Sample | Reject:
    """Return the sample of a stop, or the reject with the reason."""
    seen = stop.load(config)
    profiles = _still(seen, config)
    try:
        if config.sampling.moving:
            return pass_sample(seen.poses, seen.profiles, config)
        return _sample(seen, profiles, config)
    except FeatureError as error:
        return Reject(seen.poses[0].stamp, str(error))


def judged(outcome: Outcome, config: Config) -> Outcome:
    """Return the outcome of the same stop with another configuration."""
    if outcome.refused:
        stamp = outcome.stop.load(config).poses[0].stamp
        return replace(outcome, result=Reject(stamp, outcome.refused))
    return replace(outcome, result=result_of(outcome.stop, config))


def duplicate_pose(sample: Sample, others: Iterable[Outcome], config: Config) -> str:
    """Return the stop whose pose a sample repeats, in words; empty if none."""
    limits = config.sampling
    for other in others:
        if other.sample:
            distance, angle = pose_distance(sample, other.sample)
            if distance < limits.new_translation and angle < limits.new_rotation:
                return (f'{distance * 1e3:.0f} mm and {np.degrees(angle):.1f} degrees from '
                        f'sample {other.number}: it brings nothing new')
    return ''


def pose_distance(sample: Sample, other: Sample) -> tuple[float, float]:
    """Return the distance between the flange poses of two samples (m, rad)."""
    T = se3.inverse(other.T_base_flange) @ sample.T_base_flange
    return float(np.linalg.norm(T[:3, 3])), float(np.linalg.norm(se3.log_rotation(T[:3, :3])))
