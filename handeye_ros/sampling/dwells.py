# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Finds the times at which the robot stood still in a stream of poses."""
from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import dataclass
import math

from handeye_ros.config import SamplingConfig
from handeye_ros.data import TimedPose
import numpy as np

NS = 1_000_000_000
MOTION_TIME = 3 * NS // 10  # time over which the speed is averaged
MAX_DWELL = 10 * NS  # more of one stop adds nothing but memory
MOST_POSES = 20_000  # of one stop: stamps need not go on as time does
FOREVER = 2**63


@dataclass(frozen=True, eq=False)
class Dwell:
    """
    A time during which the robot stood still; poses in order of their stamps.

    began: stamp of the first pose of this stop (ns), which may no longer be among poses.
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
    """Speed (m/s), angular speed (rad/s), and the time since the robot stopped (s)."""

    speed: float
    turning: float
    still: float

    @property
    def sentence(self) -> str:
        """Return the motion in words."""
        if self.still > MOTION_TIME / NS:
            return f'it has stood still for {self.still:.1f} s'
        return (f'it moves by {self.speed * 1e3:.1f} mm/s and '
                f'{np.degrees(self.turning):.1f} degrees/s')


class DwellFinder:
    """Cuts a stream of poses into dwells."""

    def __init__(self, sampling: SamplingConfig) -> None:
        """Start with no poses."""
        self.sampling = sampling
        self._run: deque[TimedPose] = deque()
        self._began = self._latest = -1
        self._recent: deque[TimedPose] = deque()
        self.longest = 0  # time that the robot stood still (ns)

    def copied(self) -> DwellFinder:
        """Return an independent copy."""
        other = copy(self)
        other._run, other._recent = deque(self._run), deque(self._recent)
        return other

    def add(self, pose: TimedPose) -> Dwell | None:
        """Add the next pose; return the dwell that it ends, or None."""
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
        """Return the current dwell, None before sampling.still_time."""
        return self._dwell(self._run)

    @property
    def stood(self) -> int:
        """Return the duration of the current dwell (ns)."""
        return self._latest - self._run[0].stamp if self._run else 0

    def motion(self) -> Motion | None:
        """Return the current motion of the robot, None with fewer than two poses."""
        if len(self._recent) < 2:
            return None
        first, last = self._recent[0], self._recent[-1]
        seconds = (last.stamp - first.stamp) / NS
        return Motion(float(np.linalg.norm(last.translation - first.translation)) / seconds,
                      _turned(first, last) / seconds, (last.stamp - self._run[0].stamp) / NS)

    def window(self) -> tuple[int, int]:
        """Return the first and last stamp of profiles that the current dwell can use."""
        if not self._run:
            return 0, FOREVER
        limited = self.sampling.by_itself
        return self._run[0].stamp, self._run[0].stamp + MAX_DWELL if limited else FOREVER

    def _extend(self, pose: TimedPose) -> None:
        """Add a pose to a dwell; a long one keeps its first seconds, on request its last."""
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
