"""
A verification by the running node; stops give no samples until its result.

Knows no ROS.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.checks.review import sample_summary
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Reject, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.node.answer import Answer
from handeye_ros.node.samples import LiveSamples
from handeye_ros.node.state import Attempt
from handeye_ros.node.worker import Progress, Runner
from handeye_ros.output import write_whole
from handeye_ros.results import calibration_file, exports
from handeye_ros.sampling.stops import Outcome, Stop
from handeye_ros.verification import verification
from handeye_ros.verification.session import VerificationSession
from handeye_ros.verification.verification import Verification

ANSWERS = ('pass', 'fail')  # the verdicts that end a verification


class LiveVerification:
    """
    The verification of the calibration, with stops or scans.

    last: the last verdict with its figures, empty before; on_change: called after a verification
    began or gave a verdict.
    """

    def __init__(self, samples: LiveSamples, answer: Answer, folders: OutputFolders,
                 runner: Runner, progress: Progress) -> None:
        """Start without a verification; runner: runs long computations."""
        self._samples, self._answer, self._folders = samples, answer, folders
        self._runner, self._progress = runner, progress
        self._session: VerificationSession | None = None
        self.last = ''
        self.on_change: Callable[[], None] = lambda: None

    @property
    def _config(self) -> Config:
        return self._samples.config

    @property
    def text(self) -> str:
        """Return the progress in words; empty without a verification."""
        return self._session.text if self._session else ''

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence that stops give no samples; empty if they do."""
        session = self._session
        return () if session is None else (
            f'a verification ({session.routine.name}) continues: stops are not samples until '
            '~/verify_result',)

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        session = self._session
        if session and session.scans:
            session.parts[-1].add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Add poses."""
        session = self._session
        if session and session.scans:
            session.parts[-1].add_poses(poses)

    def add(self, stop: Stop, complete: bool = True) -> str:
        """
        Add a stop to the verification; return the message.

        A stop that is not complete is added as it is, and replaced when it is complete.
        """
        session = self._session
        if complete:
            self._samples.streams.leave(stop)
        if session is None:  # another thread has just ended it
            return 'the verification was ended: stops are samples again'
        if session.scans:
            return f'{session.text}: stops do not count, points are taken while the robot moves'
        result = session.add(stop, self._config, self._samples.evaluator.result)
        text = f'{session.text}; {sample_summary(result)}'
        self._samples.attempt = Attempt(not isinstance(result, Reject), 0,
                                        f'verification: {text}')
        self._samples.on_outcome(Outcome(0, stop, result))
        return text

    def take(self, stop: Stop) -> str:
        """Add a requested stop; raises DataError for one that gives nothing."""
        session, text = self._session, self.add(stop)
        result = session.parts[-1].stops.get(stop.began) if session else None
        if isinstance(result, Reject):
            raise DataError(f'the stop does not count for the verification: {result.reason}')
        return text

    # services; each returns its message

    def begin(self) -> str:
        """
        Begin a verification, or the next part (face, ball, pass) of the current one.

        Raises InputError, and DataError without a calibration.
        """
        self._samples.evaluate_all()
        session = self._session
        if session is None or session.is_full:
            session = VerificationSession(self._config)
            self._calibration()  # may read a file: outside of the lock
        else:
            session.go_on()
        with self._samples.work:
            for stop in self._samples.streams.copied().rest():  # they began before
                self._samples.streams.leave(stop)
            self._session, self._samples.consumer = session, self
        self.on_change()
        advice = 'scan the gauge' if session.scans else 'move on, and stop with other tilts'
        return (f'{session.text}; {advice}: what begins from now on counts, until '
                '~/verify_result')

    def result(self) -> str:
        """
        Write the verdict with its figures; the current stop counts as complete.

        Raises DataError, also where it is neither pass nor fail: the verification then continues.
        """
        with self._samples.work:
            session = self._session
            if session is None:
                raise DataError('no verification was started: call ~/verify_start, stop at '
                                'several poses, and ask again')
            self._samples.evaluate_rest()
            copied = session.copied()
        with self._progress.doing('the calibration is verified'):
            result = self._runner.run(copied.result, self._calibration(), self._config,
                                      urgent=True)
        self.last = verification.sentence(result)
        text = f'{self.last}; {self._written(result)}'
        with self._samples.work:
            if result.verdict in ANSWERS and self._session is session:
                self.end()
        self.on_change()
        if result.verdict not in ANSWERS:
            raise DataError(f'{result.verdict}: ' + '; '.join((*result.reasons, text)))
        return text

    def configured(self, old: Config, new: Config) -> None:
        """End the verification if another routine is set."""
        if old.verify.routine != new.verify.routine:
            self.end()

    def end(self) -> None:
        """End the verification: stops give samples again."""
        self._samples.consumer = None
        self._session = None

    def _calibration(self) -> Calibration:
        """Return the calibration of verify.calibration, or the answer; raises DataError."""
        file = self._config.verify.calibration
        if file:
            return calibration_file.read_calibration(Path(file).expanduser())
        if self._answer.calibration is None:
            raise DataError('there is no calibration to verify: call ~/compute_calibration, or '
                            'set verify.calibration to the file of one')
        return self._answer.calibration

    def _written(self, result: Verification) -> str:
        """Write a verification into the folder of its name; return the message."""
        config = self._config
        poses = config.pose_topic if config.pose_source == 'topic' else '/tf'
        text = verification.yaml_text(replace(result, inputs=(config.profile_topic, poses)))
        file = self._folders.folder(config) / f'verification_{result.routine}.yaml'
        previous = exports.set_aside(file.parent, [file.name], {file.name})
        write_whole(file, text)
        return str(exports.Saved((file,), previous))
