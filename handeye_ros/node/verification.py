# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A verification at the running node: until its result, stops count for it and are no samples."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TYPE_CHECKING

from handeye_ros.data import Calibration, Reject, Sample
from handeye_ros.errors import DataError, InputError, looked_up
from handeye_ros.node.state import Attempt
from handeye_ros.output import yaml_text
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.printed import sample_summary
from handeye_ros.sampling.stops import Stop
from handeye_ros.verification.result_file import plain_values, sentence
from handeye_ros.verification.routines import FEW, Routine, ROUTINES
from handeye_ros.verification.verify import Verification, verify_stops

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession

VERIFYING = 'the calibration is verified'


class LiveVerification:
    """
    The verification of a running session; its methods are for the worker (see live.py).

    routine: None where none is running
    last_result: of the last one, as the content of its file; empty before the first
    """

    def __init__(self, live: LiveSession) -> None:
        """Begin without a verification."""
        self._live = live
        self.last_result: Mapping[str, Any] = {}
        self._verified: Calibration | None = None  # the answer that it is of
        self.routine: Routine | None = None
        self.end()

    def end(self) -> None:
        """End the verification, with or without a result; stops begun before give no sample."""
        if self.routine:
            with suppress(InputError):  # of two frames, where no stop is taken
                self._live.discard_begun_stops()
        self.routine = None
        self._recordings: list[dict[int, Sample | Reject]] = [{}]  # by stamp what stops gave

    @property
    def result_of_current_answer(self) -> Mapping[str, Any]:
        """Return the last result; empty where it is of another answer than the current one."""
        live = self._live
        is_current = live.config.verify.calibration or (
            self._verified and self._verified is live.solver.calibration)
        return self.last_result if is_current else {}

    @property
    def _most_recordings(self) -> int:
        """Return the largest number of recordings with the settings of now."""
        routine, lengths = self.routine, self._live.config.verify.lengths
        return max(routine.recording_counts.get(len(lengths), [1])) if routine else 1

    @property
    def has_next_recording(self) -> bool:
        """Return whether another recording (of a face, a ball) follows the current one."""
        return len(self._recordings) < self._most_recordings

    @property
    def text(self) -> str:
        """Return the progress in words, empty where none is running."""
        routine, recordings = self.routine, self._recordings  # which may end meanwhile
        last = [*recordings[-1].values()]
        usable = sum(isinstance(result, Sample) for result in last)
        which = f', recording {len(recordings)}' if self._most_recordings > 1 else ''
        return f'{routine.name}{which}: {usable} usable stops of {len(last)}' if routine else ''

    def verify_start(self) -> str:
        """
        Begin a verification, or the next recording (of a face, a ball) of the current one.

        Returns what to do. Raises InputError for the settings, the file of verify.calibration, and
        stops of two frames; DataError without a calibration.
        """
        live = self._live
        live.evaluate_waiting()  # what began before is a sample, or of the recording before
        progress_before = self.text
        measured = any(isinstance(result, Sample) for result in self._recordings[-1].values())
        begins = self.routine is None or (measured and not self.has_next_recording)
        next_routine = self._configured_routine() if begins else None
        live.discard_begun_stops()
        if next_routine:
            self.routine, self._recordings = next_routine, [{}]
        elif measured:
            self._recordings = [*self._recordings, {}]
        dropped = (f'; what was measured before is dropped ({progress_before})'
                   if begins and progress_before else '')
        return (f'{self.text}; move on, and stop with other tilts: what begins from now on '
                f'counts, until ~/verify_result{dropped}')

    def _configured_routine(self) -> Routine:
        """Return what the settings ask for; raises InputError, DataError without calibration."""
        settings = self._live.config.verify
        if not settings.routine:
            raise InputError('verify.routine is not set, so there is nothing to measure: set it '
                             'to the artefact under the sensor (docs/measure.md)')
        routine = looked_up('routine', settings.routine, ROUTINES)
        if routine.in_passes:
            raise InputError(f'{routine.name} is scanned in passes: record a bag of each, and '
                             f'call "handeye verify {routine.name}" with them')
        routine.recordings_for(len(settings.lengths))  # raises for a wrong number
        self._calibration()  # raises what is missing
        return routine

    def add_stop(self, stop: Stop) -> str:
        """
        Evaluate a stop for the verification, and return the progress in words.

        Its result replaces that of an earlier part of the same stop. Raises DataError for a stop
        that shows nothing to measure, which is counted all the same.
        """
        live, routine = self._live, self.routine
        assert routine
        result = live.evaluate_in_process(stop, routine.settings(live.config))
        self._recordings[-1][stop.stamp] = result
        text = f'{self.text}; {sample_summary(result)}'
        live.attempt = Attempt(f'verification: {text}', replace(stop, result=result))
        if isinstance(result, Reject):
            raise DataError(result.reason)
        return text

    def verify_result(self) -> Future[str]:
        """
        Compute and write the verdict with its figures; the current stop counts as complete.

        The call, or its future, raises DataError without a verification, a calibration or enough
        stops, and for a verdict that is neither pass nor fail: the verification then continues.
        """
        if self.routine is None:
            raise DataError('no verification was started: call ~/verify_start first')
        live = self._live
        live.evaluate_all()
        try:
            config = self.routine.settings(live.config, len(self._recordings))
        except InputError as error:
            hint = ': begin each with ~/verify_start' if error.code == FEW else ''
            raise InputError(f'{error}{hint}') from None
        file = live.config.verify.calibration or live.solver.saved
        accept = partial(self._accept, self._recordings, file, live.solver.calibration)
        return live.worker.run_job(
            VERIFYING, accept, verify_stops, self.routine,
            [[*stops.values()] for stops in self._recordings], self._calibration(), config)

    def _accept(self, recordings: Sequence[object], file: str, answer: Calibration | None,
                result: Verification) -> str:
        """
        Write the verdict on recordings, and end their verification; return the message.

        file: of the calibration, '' where it was not saved; answer: of the node then.
        """
        live, self._verified = self._live, answer
        name = f'verification_{result.routine}.yaml'
        self.last_result = content = plain_values(
            result, (live.config.profile_topic, live.config.topic_of_poses),
            Path(file).expanduser() if file else None)
        folder = live.folders.locked_folder(live.config)
        saved = exports.write({name: yaml_text(content)}, folder, {name})
        text = f'{sentence(content)}; {saved}'
        if result.verdict not in ('pass', 'fail'):
            raise DataError(text)
        if self._recordings is recordings:  # no other one or verification was begun meanwhile
            self.end()
        return text

    def _calibration(self) -> Calibration:
        """Return the calibration of verify.calibration, or the answer; raises HandeyeError."""
        file = self._live.config.verify.calibration
        return (read_calibration(Path(file).expanduser()) if file else
                self._live.solver.require_calibration('verify (verify.calibration names none)'))
