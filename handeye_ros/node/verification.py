# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A verification at the running node: until its result, stops count for it and are no samples."""
from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from handeye_ros.agreement import sample_summary
from handeye_ros.data import Calibration, Reject
from handeye_ros.errors import DataError
from handeye_ros.node.pool import result_or_ended
from handeye_ros.node.state import Attempt
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.sampling.stops import Stop
from handeye_ros.verification.session import VerificationSession
from handeye_ros.verification.verify import (
    sentence,
    Verification,
    with_provenance,
    yaml_text,
)

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession

VERIFIED = 'the calibration is verified'


class LiveVerification:
    """
    The verification of a running session; its methods are for the worker (see live.py).

    session: None where none is running; what is scanned it gets from live. verdict: the last one.
    """

    def __init__(self, live: LiveSession) -> None:
        """Begin with none."""
        self._live = live
        self.session: VerificationSession | None = None
        self.verdict = ''

    def verify_start(self) -> str:
        """
        Begin a verification, or the next part (face, ball, pass) of the current one.

        Raises InputError for the settings, DataError without a calibration.
        """
        live, session = self._live, self.session
        while live.evaluate_next():  # what began before is a sample
            pass
        if session is None or session.is_full:
            session = VerificationSession(live.config)
            self._calibration()  # may read a file
        else:
            session.go_on()
        with live.lock:
            for stop in live.session.copied().rest():  # they began before
                live.session.leave(stop)
            self.session = session
        advice = 'scan the gauge' if session.scans else 'move on, and stop with other tilts'
        return (f'{session.text}; {advice}: what begins from now on counts, until '
                '~/verify_result')

    def add_stop(self, stop: Stop, over: bool) -> str:
        """
        Add a stop, in place of an earlier part of it; return the progress, or raise DataError.

        over: whether it is complete, and is not looked at again.
        """
        live, session = self._live, self.session
        assert session
        if over:
            with live.lock:
                live.session.leave(stop)
        if session.scans:
            raise DataError(f'{session.text}: stops do not count, points are taken while the '
                            'robot moves')
        result = session.add(stop, live.config, live.result_of)
        text = f'{session.text}; {sample_summary(result)}'
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
        if self.session is None:
            raise DataError('no verification was started: call ~/verify_start, and measure the '
                            'artefact')
        live.evaluate_all()
        calibration = self._calibration()
        with live.lock:
            session = self.session.copied()
        return live.compute(VERIFIED, self._put, session.result, calibration, live.config)

    def _put(self, job: Future[Verification]) -> str:
        live, result = self._live, result_or_ended(job)
        verified = live.config.verify.calibration
        name = f'verification_{result.routine}.yaml'
        content = yaml_text(with_provenance(
            result, (live.config.profile_topic, live.pose_topic),
            Path(verified).expanduser() if verified else None))
        saved = exports.write({name: content}, live.folders.own(live.config), {name})
        self.verdict = sentence(result)
        text = f'{self.verdict}; {saved}'
        if result.verdict not in ('pass', 'fail'):
            raise DataError(f'{result.verdict}: ' + '; '.join((*result.reasons, text)))
        self.session = None
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
