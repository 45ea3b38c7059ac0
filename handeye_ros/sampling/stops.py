# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Where the robot stopped, cut from the stream of poses, with the profiles of that time.

A moving robot makes passes instead, of two seconds of motion or of one rest each. A pass is a Stop
too; what differs for it is listed in sweep.py.
"""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

from handeye_ros import se3
from handeye_ros.arithmetic import evenly_spaced
from handeye_ros.config import Config, SamplingConfig
from handeye_ros.data import AnyProfile, Array, NS, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import UnusableMessageError
from handeye_ros.sampling.interpolation import poses_around
from handeye_ros.sampling.stream import by_stamp, Copyable, LAST_STAMP
import numpy as np

MOTION_TIME = 3 * NS // 10  # time over which the speed is averaged
MAX_STOP_TIME = 10 * NS  # of a stop; sampling.still_time and settle_time must fit into it
PASS_TIME = 2 * NS  # of motion
SHORT_REST = NS // 10  # a rest that was probably meant as a stop
MAX_POSES = 20_000  # of one stop: stamps need not go on as time does

# Profiles of a sample, evenly spread. A robot at rest sees the same speckle, and 32 profiles
# reduce the noise of single ones far below that of the poses. A stop keeps more: for other
# settings, and for the test of the clocks (50 ms apart, see checks/clocks.py) in 3.75 s.
PROFILES_OF_SAMPLE = 32
KEPT_PER_SECOND, MAX_KEPT = 40, 150
MIN_SETTLED, MIN_SETTLING = 64, 8  # kept of short times without and with vibration

NOT_EVALUATED = Reject(0, 'not evaluated yet')


@dataclass(frozen=True, eq=False)
class Stop:
    """
    A time during which the robot stood still, or a pass of a moving robot, and what came then.

    stamp: of the first pose (ns), though a long stop may keep later ones only; it identifies the
        stop
    poses, profiles: in the order of their stamps
    load_messages: of a stop on the disk, of which at most the last pose is in memory: returns it
        with its poses and profiles, decoded as a configuration says
    untimed: whether no profile is surely of this time, and of some it is not known (time_margins)
    number: in its session, from 1, never reused; 0 before
    result: a sample, or the reason why there is none
    """

    stamp: int
    poses: tuple[TimedPose, ...] = ()
    profiles: tuple[AnyProfile, ...] = ()
    load_messages: Callable[[Config], Stop] | None = None
    untimed: bool = False
    number: int = 0
    result: Sample | Reject = NOT_EVALUATED

    @property
    def sample(self) -> Sample | None:
        """Return the sample, or None."""
        return self.result if isinstance(self.result, Sample) else None

    @property
    def final_reason(self) -> str:
        """Return why the stop gives no sample, whatever its profiles show, '' if it may."""
        result = self.result
        return result.reason if isinstance(result, Reject) and result.final else ''

    def load(self, config: Config) -> Stop:
        """Return the stop with its messages; raises InputError for a damaged stored one."""
        if self.load_messages is None:
            return self
        messages = self.load_messages(config)
        return replace(self, poses=messages.poses, profiles=messages.profiles, load_messages=None)

    @property
    def start(self) -> int:
        """Return the stamp of the first pose that is kept."""
        return self.poses[0].stamp

    @property
    def end(self) -> int:
        """Return the stamp of the last pose."""
        return self.poses[-1].stamp

    @property
    def T_base_flange(self) -> Array:
        """Return the last pose (4, 4), which a stored stop of a node has too."""
        return se3.of_pose(self.poses[-1])

    def with_profiles(self, candidates: Sequence[AnyProfile], config: Config) -> Stop:
        """
        Return the stop with the profiles surely taken during it, among candidates in order.

        In a pass each has the pose of its stamp, which must be certain. Of many, about
        KEPT_PER_SECOND are kept, and MAX_KEPT at most before, in and after the time without
        vibration.
        """
        begin = bisect_left(candidates, self.start, key=by_stamp)
        end = bisect_right(candidates, self.end, key=by_stamp)
        taken = [profile for profile in candidates[begin:end]
                 if self.start <= profile.stamp - profile.time_margins[0]
                 and profile.stamp + profile.time_margins[1] <= self.end
                 and not (config.sampling.moving and any(profile.time_margins))]
        untimed = not taken and any(
            any(profile.time_margins) and profile.stamp - profile.time_margins[0] <= self.end
            and self.start <= profile.stamp + profile.time_margins[1] for profile in candidates)
        first_settled, last_settled = self._settled_span(config)
        begin = bisect_left(taken, first_settled, key=by_stamp)
        end = max(begin, bisect_right(taken, last_settled, key=by_stamp))
        return replace(self, untimed=untimed, profiles=(
            *_thinned(taken[:begin], MIN_SETTLING), *_thinned(taken[begin:end], MIN_SETTLED),
            *_thinned(taken[end:], MIN_SETTLING)))

    def settled_profiles(self, config: Config) -> list[AnyProfile]:
        """Return PROFILES_OF_SAMPLE of the time without vibration at most, not yet decoded."""
        first, last = self._settled_span(config)
        settled = [profile for profile in self.profiles if first <= profile.stamp <= last]
        return evenly_spaced(settled, PROFILES_OF_SAMPLE)

    def trimmed(self, config: Config) -> Stop:
        """Return the stop reduced to what its sample needs, to be evaluated elsewhere."""
        stop = replace(self, result=NOT_EVALUATED)
        if self.load_messages or config.sampling.moving:
            return stop
        profiles = self.settled_profiles(config)
        poses = poses_around(self.poses, [profile.stamp for profile in profiles])
        return replace(stop, poses=tuple(poses), profiles=tuple(profiles))

    def _settled_span(self, config: Config) -> tuple[int, int]:
        """Return the first and last stamp of the time without vibration."""
        settle = round(config.sampling.settle_time * NS)
        return self.start + settle, self.end - settle


NO_STOP = Stop(0)


def _thinned(profiles: Sequence[AnyProfile], least: int) -> list[AnyProfile]:
    """Return max(least, KEPT_PER_SECOND of their time), at most MAX_KEPT, evenly spread."""
    seconds = (profiles[-1].stamp - profiles[0].stamp) / NS if profiles else 0.0
    most = min(MAX_KEPT, max(least, 1 + round(KEPT_PER_SECOND * seconds)))
    return evenly_spaced(profiles, most)


def decoded(profiles: Iterable[AnyProfile], config: Config) -> list[Profile]:
    """Return the profiles that can be used with a configuration, decoded."""
    usable = []
    for profile in profiles:
        with suppress(UnusableMessageError):
            usable.append(profile.read(config.profile))
    return usable


class Motion(NamedTuple):
    """
    How the robot moves.

    rest_time: how long it has stood near where it is (s); in a pass, too, it may stand
    sentence: the same, or its speeds, in words, such as 'it has stood still for 1.20 s'
    """

    rest_time: float
    sentence: str


class StopFinder(Copyable):
    """
    Cuts a stream of poses into stops, or into passes where sampling.mode is moving.

    sampling: the settings; others may be set at any time
    stamp: of the first pose of the current stop or pass (ns), -1 before any pose
    longest_rest_ns: the longest time that the robot stood near one pose (ns); in a pass, too
    short_rest_count: number of stops or passes that lasted SHORT_REST, but not sampling.still_time
    """

    def __init__(self, sampling: SamplingConfig) -> None:
        """Start with no poses."""
        self.sampling = sampling
        self._poses: deque[TimedPose] = deque()  # of the current stop
        self._recent: deque[TimedPose] = deque(maxlen=MAX_POSES)  # of the last MOTION_TIME
        self._rest: TimedPose | None = None  # first pose near which the robot still is
        self.stamp = -1
        self.longest_rest_ns = self.short_rest_count = 0

    def add(self, pose: TimedPose) -> Stop | None:
        """Add the next pose; return the stop that it ends, or None."""
        sampling = self.sampling
        no_gap = bool(self._recent) and (
            pose.stamp - self._recent[-1].stamp <= sampling.max_pose_gap * NS)
        if not (no_gap and self._rest and self._is_near(self._rest, pose)):
            self._rest = pose
        self.longest_rest_ns = max(self.longest_rest_ns, pose.stamp - self._rest.stamp)
        self._recent.append(pose)
        while pose.stamp - self._recent[0].stamp > MOTION_TIME:
            self._recent.popleft()
        # a rest is one pass, too: a robot at rest shows nothing new
        if no_gap and (sampling.moving and pose.stamp - self._poses[0].stamp <= PASS_TIME
                       or self._is_near(self._poses[0], pose)):
            self._prolong(pose)
            return None
        ended = self.current()
        if self._poses and ended is None:
            self.short_rest_count += self._poses[-1].stamp - self._poses[0].stamp >= SHORT_REST
        self._poses, self.stamp = deque([pose]), pose.stamp
        return ended

    def _prolong(self, pose: TimedPose) -> None:
        """Add a pose; a stop keeps its first MAX_STOP_TIME, in manual mode its last, no others."""
        self._poses.append(pose)
        forget = self._poses.pop if self.sampling.automatic else self._poses.popleft
        while (self._poses[-1].stamp - self._poses[0].stamp > MAX_STOP_TIME
               or len(self._poses) > MAX_POSES):
            forget()

    def current(self) -> Stop | None:
        """Return the current stop without profiles, None before sampling.still_time."""
        poses, least = self._poses, self.sampling.still_time * NS
        if self.sampling.moving:  # a pass ends after PASS_TIME, but while the robot rests
            least = min(least, PASS_TIME / 2)
        is_stop = bool(poses) and poses[-1].stamp - poses[0].stamp >= least
        return Stop(self.stamp, tuple(poses)) if is_stop else None

    def motion(self) -> Motion | None:
        """Return the current motion of the robot, None with fewer than two poses."""
        if len(self._recent) < 2 or not self._rest:
            return None
        first, last = self._recent[0], self._recent[-1]
        still, seconds = (last.stamp - self._rest.stamp) / NS, (last.stamp - first.stamp) / NS
        speed = np.linalg.norm(last.translation - first.translation) / seconds
        turning = np.degrees(_angle_between(first, last)) / seconds
        return Motion(still, f'it has stood still for {still:.2f} s' if still > MOTION_TIME / NS
                      else f'it moves by {speed * 1e3:.1f} mm/s and {turning:.1f} degrees/s')

    def window(self) -> tuple[int, int]:
        """Return the first and last stamp of profiles that the current stop can use."""
        if not self._poses:
            return 0, LAST_STAMP
        first = self._poses[0].stamp
        return first, first + MAX_STOP_TIME if self.sampling.automatic else LAST_STAMP

    def _is_near(self, first: TimedPose, pose: TimedPose) -> bool:
        """Return whether the robot still is where it was."""
        limits = self.sampling
        return (math.dist(pose.translation, first.translation) <= limits.still_translation
                and _angle_between(first, pose) <= limits.still_rotation)


def _angle_between(a: TimedPose, b: TimedPose) -> float:
    """Return the angle between close orientations (rad): twice |q1 - q2|."""
    distance = math.dist(a.quaternion, b.quaternion)  # much quicker than numpy
    if distance >= 1.0:  # q and -q are one rotation
        distance = min(distance, math.dist(a.quaternion, -b.quaternion))
    return 2 * distance


class ProfileBuffer(Copyable):
    """
    The profiles that the current stop and those that wait for profiles can use, in order.

    If it is full, the oldest are dropped and counted.

    items: the profiles
    dropped_count: the number of dropped ones
    most_bytes: that may be kept
    """

    def __init__(self, most_bytes: int = 256_000_000) -> None:
        """Start with none; by default 8 s of 2000 profiles a second of 1280 points fit in."""
        self.most_bytes, self._bytes = most_bytes, 0
        self.items: list[AnyProfile] = []
        self.dropped_count = 0

    def add(self, profiles: Sequence[AnyProfile]) -> None:
        """Add the next profiles."""
        self.items += profiles
        self._bytes += sum(profile.held_bytes for profile in profiles)
        while self._bytes > self.most_bytes and len(self.items) > 1:
            self.dropped_count += 1
            self._forget(slice(0, 1))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence about the dropped ones, if any."""
        return (f'dropped {self.dropped_count} profiles, the oldest of those that wait: together '
                f'these may take {self.most_bytes / 1e6:.0f} MB',) if self.dropped_count else ()

    def clear(self) -> None:
        """Forget all profiles; those that were dropped stay counted."""
        self._forget(slice(None))

    def keep(self, first: int, last: int, now: int) -> None:
        """Keep those from first to last and those later than now (ns); forget the others."""
        self._forget(slice(bisect_right(self.items, last, key=by_stamp),
                           bisect_right(self.items, now, key=by_stamp)))
        self._forget(slice(0, bisect_left(self.items, first, key=by_stamp)))

    def _forget(self, part: slice) -> None:
        self._bytes -= sum(profile.held_bytes for profile in self.items[part])
        del self.items[part]
