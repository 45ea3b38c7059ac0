"""When the robot stood still, cut out of a stream of poses, and where it was in between."""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
import math

from handeye_ros import se3
from handeye_ros.config import SamplingConfig
from handeye_ros.data import Array, TimedPose
import numpy as np

NS = 1_000_000_000
MOTION_TIME = 3 * NS // 10  # over which the speed of the robot is reported
MAX_DWELL = 10 * NS  # more of one stop adds nothing but memory
MOST_POSES = 20_000  # of one stop: stamps need not go on as time does
FOREVER = 2**63


@dataclass(frozen=True, eq=False)
class Dwell:
    """
    A time during which the robot stood still; poses in order of their stamps.

    began: the stamp of the first pose of this stop, which poses may no longer hold.
    """

    poses: tuple[TimedPose, ...]
    began: int

    @property
    def start(self) -> int:
        """Return the stamp of the first pose."""
        return self.poses[0].stamp

    @property
    def end(self) -> int:
        """Return the stamp of the last pose."""
        return self.poses[-1].stamp


@dataclass(frozen=True)
class Motion:
    """How the robot moves: m/s, rad/s, and for how long it has stood still (s)."""

    speed: float
    turning: float
    still: float

    @property
    def sentence(self) -> str:
        """Return it in words."""
        if self.still > MOTION_TIME / NS:
            return f'it has stood still for {self.still:.1f} s'
        return (f'it moves by {self.speed * 1e3:.1f} mm/s and '
                f'{np.degrees(self.turning):.1f} degrees/s')


class DwellFinder:
    """Cuts a stream of poses into the times during which the robot stood still."""

    def __init__(self, sampling: SamplingConfig) -> None:
        """Start with no poses."""
        self.sampling = sampling
        self._run: deque[TimedPose] = deque()
        self._began = self._latest = -1
        self._recent: deque[TimedPose] = deque()
        self.longest = 0  # time that the robot stood still (ns)

    def copied(self) -> DwellFinder:
        """Return another that goes on from here by itself."""
        other = copy(self)
        other._run, other._recent = deque(self._run), deque(self._recent)
        return other

    def add(self, pose: TimedPose) -> Dwell | None:
        """Take the next pose; return the station that it ends, if it ends one."""
        self._recent.append(pose)
        while (pose.stamp - self._recent[0].stamp > MOTION_TIME
               or len(self._recent) > MOST_POSES):
            self._recent.popleft()
        continues = bool(self._run) and self._continues(pose)
        self._latest = pose.stamp
        if continues:
            self._extend(pose)
            return None
        ended = self._dwell(self._run)
        if self._run:
            self.longest = max(self.longest, self._run[-1].stamp - self._run[0].stamp)
        self._run, self._began = deque([pose]), pose.stamp
        return ended

    def current(self) -> Dwell | None:
        """Return the station that the robot stands in now, if it has stood still for long."""
        return self._dwell(self._run)

    @property
    def stood(self) -> int:
        """Return for how long the robot has stood still in the dwell of now (ns)."""
        return self._latest - self._run[0].stamp if self._run else 0

    def motion(self) -> Motion | None:
        """Return how the robot moves now, None where poses do not tell."""
        if len(self._recent) < 2:
            return None
        first, last = self._recent[0], self._recent[-1]
        seconds = (last.stamp - first.stamp) / NS
        return Motion(float(np.linalg.norm(last.translation - first.translation)) / seconds,
                      _turned(first, last) / seconds, (last.stamp - self._run[0].stamp) / NS)

    def window(self) -> tuple[int, int]:
        """Return the first and last stamp that can still matter to this stop of the robot."""
        if not self._run:
            return 0, FOREVER
        limited = self.sampling.by_itself
        return self._run[0].stamp, self._run[0].stamp + MAX_DWELL if limited else FOREVER

    def _extend(self, pose: TimedPose) -> None:
        """Let a long stop use its first seconds, or its last when samples are asked for."""
        if not self._is_full(pose):
            self._run.append(pose)
        elif not self.sampling.by_itself:
            self._run.append(pose)
            while self._is_full(pose):
                self._run.popleft()

    def _is_full(self, pose: TimedPose) -> bool:
        return (pose.stamp - self._run[0].stamp > MAX_DWELL or len(self._run) > MOST_POSES)

    def _continues(self, pose: TimedPose) -> bool:
        first, limits = self._run[0], self.sampling
        return (math.dist(pose.translation, first.translation) <= limits.still_translation
                and _turned(first, pose) <= limits.still_rotation
                and pose.stamp - self._latest <= limits.max_pose_gap * NS)

    def _dwell(self, run: deque[TimedPose]) -> Dwell | None:
        still = bool(run) and run[-1].stamp - run[0].stamp >= self.sampling.still_time * NS
        return Dwell(tuple(run), self._began) if still else None


def _turned(a: TimedPose, b: TimedPose) -> float:
    """Return the angle between close orientations (rad): twice |q1 - q2|."""
    apart = math.dist(a.quaternion, b.quaternion)  # of three numbers much quicker than numpy
    return 2 * (apart if apart < 1.0 else min(apart, math.dist(a.quaternion, -b.quaternion)))


def around(poses: Sequence[TimedPose], stamps: Sequence[int]) -> list[TimedPose]:
    """Return the poses next to stamps, and the first and the last: what interpolate needs."""
    last = len(poses) - 1
    places = {0, last}
    for stamp in stamps:
        places.add(max(bisect_right(poses, stamp, key=_stamp) - 1, 0))
        places.add(min(bisect_left(poses, stamp, key=_stamp), last))
    return [poses[place] for place in sorted(places)]


def _stamp(pose: TimedPose) -> int:
    return pose.stamp


def interpolate(poses: Sequence[TimedPose], stamps: Sequence[int]) -> Array:
    """
    Return the poses T_base_flange (n, 4, 4) at n stamps within the time of the given poses.

    Linear in the translation, slerp in the rotation. Raises ValueError outside.
    """
    poses = around(poses, stamps)
    times = np.array([p.stamp - poses[0].stamp for p in poses], dtype=float)
    at = np.array([s - poses[0].stamp for s in stamps], dtype=float)
    if at.min() < times[0] or at.max() > times[-1]:
        raise ValueError('a stamp lies outside the time of the poses')
    translations, quaternions = (np.array([getattr(p, name) for p in poses])
                                 for name in ('translation', 'quaternion'))
    return se3.interpolated(times, translations, quaternions, at)
