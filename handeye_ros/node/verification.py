# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A verification at the running node: until its result, stops count for it and are no samples."""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.node.pool import result_or_ended
from handeye_ros.node.state import Attempt
from handeye_ros.output import yaml_text
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.table import sample_summary
from handeye_ros.results.verification_file import sentence
from handeye_ros.sampling.stops import decoded, Stop
from handeye_ros.sampling.stream import Copyable
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.verification.routines import Routine, routine_of, settings_for
from handeye_ros.verification.stations import stations_of, stations_of_passes
from handeye_ros.verification.verify import plain_values, Verification, verify

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession

VERIFIED = 'the calibration is verified'
KEPT_PROFILES = 500  # of a pass that are kept, evenly spread
KEPT_POSES = 200_000  # of a pass that are kept, the last ones


@dataclass(eq=False)
class Part(Copyable):
    """
    What was measured of one face, ball or pass.

    stops: what each of them gave, by its stamp; profiles, poses: of a pass; every step-th of
    the received profiles is kept.
    """

    stops: dict[int, Sample | Reject] = field(default_factory=dict)
    profiles: list[AnyProfile] = field(default_factory=list)
    poses: deque[TimedPose] = field(default_factory=lambda: deque(maxlen=KEPT_POSES))
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
        if len(self.profiles) > 2 * KEPT_PROFILES:
            self.profiles, self.step = self.profiles[::2], 2 * self.step


def result_of_parts(routine: Routine, parts: Sequence[Part], calibration: Calibration,
                    config: Config) -> Verification:
    """Return the verification by what was measured; raises InputError and DataError."""
    config = settings_for(routine, config, len(parts))
    if routine.in_passes:
        passes = [(decoded(part.profiles, config),
                   trajectory_of(list(part.poses), config.sampling.max_pose_gap))
                  for part in parts]
        # the stamps have time_offset in them
        stations = stations_of_passes(passes, replace(config, time_offset=0.0))
    else:
        stations = stations_of(routine, [part.samples for part in parts], calibration, config)
    return verify(routine, stations, calibration, [
        result for part in parts for result in part.stops.values() if isinstance(result, Reject)])


class LiveVerification:
    """
    The verification of a running session.

    Its methods but add_profile and add_poses are for the worker (see live.py). routine: None where
    none is running; verdict: the last one.
    """

    def __init__(self, live: LiveSession) -> None:
        """Begin with none."""
        self._live = live
        self.verdict = ''
        self.end()

    def end(self) -> None:
        """End the verification, with or without a result; for who holds the lock."""
        self.routine: Routine | None = None
        self._possible: Sequence[int] = ()  # numbers of parts
        self._parts: list[Part] = []

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile of a pass; where stops are measured, none is needed."""
        if self.routine and self.routine.in_passes:
            self._parts[-1].add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses of a pass, as above."""
        if self.routine and self.routine.in_passes:
            self._parts[-1].poses.extend(poses)

    @property
    def text(self) -> str:
        """Return the progress in words, empty where none is running."""
        with self._live.lock:
            routine, possible, parts = self.routine, self._possible, self._parts
        if routine is None:
            return ''
        number = f', part {len(parts)}' if possible[-1] > 1 else ''
        if number and len(possible) == 1:
            number += f' of {possible[-1]}'
        counts = (f'{parts[-1].received} profiles' if routine.in_passes else
                  f'{len(parts[-1].samples)} usable stops of {len(parts[-1].stops)}')
        return f'{routine.name}{number}: {counts}'

    def verify_start(self) -> str:
        """
        Begin a verification, or the next part (face, ball, pass) of the current one.

        Raises InputError for the settings, DataError without a calibration.
        """
        live, parts = self._live, self._parts
        while live.process_next():  # what began before is a sample
            pass
        routine, possible, dropped = self.routine, self._possible, ''
        if routine is None or len(parts) == possible[-1] and not parts[-1].is_empty:
            if not live.config.verify.routine:
                raise InputError('verify.routine is not set, so there is nothing to measure: set '
                                 'it to the artefact under the sensor (docs/measure.md)')
            routine, parts = routine_of(live.config.verify.routine), [Part()]
            possible = routine.recordings_for(len(live.config.verify.lengths))
            self._calibration()  # may read a file
            dropped = self.text and f'; what was measured before is dropped ({self.text})'
        elif not parts[-1].is_empty:
            parts = [*parts, Part()]
        with live.lock:
            for stop in live.session.copied().remaining():  # they began before
                live.session.mark_done(stop)
            live.to_evaluate.clear()  # so did these
            self.routine, self._possible, self._parts = routine, possible, parts
        advice = 'scan the gauge' if routine.in_passes else 'move on, and stop with other tilts'
        return (f'{self.text}; {advice}: what begins from now on counts, until ~/verify_result'
                f'{dropped}')

    def add_stop(self, stop: Stop) -> str:
        """Add a stop, in place of an earlier part of it; return the progress, or DataError."""
        live, routine = self._live, self.routine
        assert routine
        if routine.in_passes:
            raise DataError(f'{self.text}: stops do not count, points are taken while the robot '
                            'moves')
        result = live.result_elsewhere(stop, routine.settings(live.config))
        self._parts[-1].stops[stop.stamp] = result
        text = f'{self.text}; {sample_summary(result)}'
        live.attempt = Attempt(f'verification: {text}', replace(stop, result=result))
        if isinstance(result, Reject):
            raise DataError(result.reason)
        return text

    def verify_result(self) -> Future[str]:
        """
        Compute and write the verdict with its figures; the current stop counts as complete.

        It, or its future, raises DataError without a verification, a calibration or enough stops,
        and where it is neither pass nor fail: the verification then continues.
        """
        live = self._live
        if self.routine is None:
            raise DataError('no verification was started: call ~/verify_start, and measure the '
                            'artefact')
        live.process_all()
        calibration = self._calibration()
        with live.lock:
            parts = [part.copied() for part in self._parts]
        return live.run_job(VERIFIED, partial(self._accept, self._parts), result_of_parts,
                            self.routine, parts, calibration, live.config)

    def _accept(self, parts: list[Part], job: Future[Verification]) -> str:
        """Write the verdict on parts, and end their verification; return the message."""
        live, result = self._live, result_or_ended(job)
        verified = live.config.verify.calibration
        name = f'verification_{result.routine}.yaml'
        content = plain_values(
            result, (live.config.profile_topic, live.config.pose_origin[0]),
            Path(verified).expanduser() if verified else None)
        saved = exports.write({name: yaml_text(content)}, live.folders.own(live.config), {name})
        self.verdict = sentence(content)
        text = f'{self.verdict}; {saved}'
        if result.verdict not in ('pass', 'fail'):
            raise DataError(f'{result.verdict}: ' + '; '.join((*result.reasons, text)))
        with live.lock:
            if self._parts is parts:  # no other one was begun meanwhile
                self.end()
        return text

    def _calibration(self) -> Calibration:
        """Return that of verify.calibration, or the answer; raises HandeyeError."""
        file = self._live.config.verify.calibration
        if file:
            return read_calibration(Path(file).expanduser())
        if self._live.answer.calibration is None:
            raise DataError('there is no calibration to verify: call ~/compute_calibration, or '
                            'set verify.calibration to the file of one')
        return self._live.answer.calibration
