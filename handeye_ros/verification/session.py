# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A running verification: stop by stop, one part (face, ball, pass) after the other.

Knows no ROS and no threads.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Self

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.verification.fit import StationSet
from handeye_ros.verification.routines import routine_of, settings_for, TEETH
from handeye_ros.verification.stations import stations_of, stations_of_pass
from handeye_ros.verification.verify import Verification, verify

MOST_PROFILES = 500  # of a pass that are kept, evenly spread
MOST_POSES = 200_000  # of a pass that are kept, the last ones


@dataclass(eq=False)
class Part:
    """
    The stops or points of one face, ball or pass.

    stops: by their start times; profiles, poses: of a pass; every step-th of the received
    profiles is kept.
    """

    stops: dict[int, Sample | Reject] = field(default_factory=dict)
    profiles: list[AnyProfile] = field(default_factory=list)
    poses: deque[TimedPose] = field(default_factory=lambda: deque(maxlen=MOST_POSES))
    received: int = 0
    step: int = 1

    @property
    def samples(self) -> list[Sample]:
        """Return the samples in the order of their stops."""
        return [s for _, s in sorted(self.stops.items()) if isinstance(s, Sample)]

    @property
    def is_empty(self) -> bool:
        """Return whether nothing usable was received."""
        return not self.samples and not self.profiles

    def add_profile(self, profile: AnyProfile) -> None:
        """Keep a profile of a pass, or drop it: those kept remain evenly spaced."""
        if self.received % self.step == 0:
            self.profiles.append(profile)
        self.received += 1
        if len(self.profiles) > 2 * MOST_PROFILES:
            self.profiles, self.step = self.profiles[::2], 2 * self.step


class VerificationSession:
    """A verification in progress."""

    def __init__(self, config: Config) -> None:
        """Begin the first part; raises InputError."""
        if not config.verify.routine:
            raise InputError('verify.routine is not set, so there is nothing to measure: set it '
                             'to the artefact under the sensor (docs/measure.md)')
        self.routine = routine_of(config.verify.routine)
        self._possible = self.routine.parts(len(config.verify.lengths))
        self.parts = [Part()]

    def copied(self) -> Self:
        """Return an independent copy."""
        duplicate = copy(self)
        duplicate.parts = [replace(part, stops=dict(part.stops), profiles=list(part.profiles),
                                   poses=part.poses.copy()) for part in self.parts]
        return duplicate

    @property
    def scans(self) -> bool:
        """Return whether points of passes are measured, not stops."""
        return self.routine.target == TEETH

    @property
    def text(self) -> str:
        """Return the progress in words."""
        part, most = self.parts[-1], self._possible[-1]
        number = f', part {len(self.parts)}' if most > 1 else ''
        if number and len(self._possible) == 1:
            number += f' of {most}'
        counts = (f'{part.received} profiles' if self.scans else
                  f'{len(part.samples)} usable stops of {len(part.stops)}')
        return f'{self.routine.name}{number}: {counts}'

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile of a pass; where stops are measured, none is needed."""
        if self.scans:
            self.parts[-1].add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses of a pass, as above."""
        if self.scans:
            self.parts[-1].poses.extend(poses)

    def go_on(self) -> None:
        """Begin the next part, if this one is not empty; none where the session is full."""
        if not self.parts[-1].is_empty:
            self.parts.append(Part())

    @property
    def is_full(self) -> bool:
        """Return whether the last part has begun and is not empty."""
        return len(self.parts) >= self._possible[-1] and not self.parts[-1].is_empty

    def add(self, stop: Stop, config: Config, judge: Callable[[Stop, Config], Sample | Reject]
            ) -> Sample | Reject:
        """Add a stop; return its result for the routine. judge: evaluates the stop."""
        result = judge(stop, settings_for(self.routine, config, self._possible[0]))
        self.parts[-1].stops[stop.began] = result
        return result

    def result(self, calibration: Calibration, config: Config) -> Verification:
        """Return the result; raises InputError and DataError."""
        settings = settings_for(self.routine, config, len(self.parts))
        bags = [self._scanned(part, settings) if self.scans else
                stations_of(self.routine, part.samples, calibration, settings)
                for part in self.parts]
        reason = next((s.reason for part in self.parts for s in part.stops.values()
                       if isinstance(s, Reject)), '')
        return verify(self.routine, bags, calibration, settings, reason)

    def _scanned(self, part: Part, config: Config) -> StationSet:
        profiles: list[Profile] = []
        for profile in part.profiles:
            with suppress(UnusableMessageError):
                profiles.append(profile.read(config.profile))
        track = trajectory_of(list(part.poses), config.sampling.max_pose_gap)
        # the stamps have time_offset in them
        return stations_of_pass(profiles, track, replace(config, time_offset=0.0))
