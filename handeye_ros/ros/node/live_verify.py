"""
A verification by a running node: between start and result the stops are no samples.

Knows no ROS.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Reject, TimedPose
from handeye_ros.diagnosis.summaries import sample_summary
from handeye_ros.output import write_whole
from handeye_ros.results import calibration_file, exports
from handeye_ros.ros.node.answer import Answer
from handeye_ros.ros.node.samples import LiveSamples
from handeye_ros.ros.node.worker import Progress, Runner
from handeye_ros.ros.sessions.store import Place
from handeye_ros.sampling.state import Attempt
from handeye_ros.sampling.stops import Outcome, Stop
from handeye_ros.verification import verification
from handeye_ros.verification.errors import (
    NoAnswerError,
    NothingToVerifyError,
    NotStartedError,
    UnusableStopError,
)
from handeye_ros.verification.session import VerificationSession
from handeye_ros.verification.verification import Verification

ANSWERS = ('pass', 'fail')  # the verdicts that end a verification
NEXT = 'what begins from now on counts'
NO_ROUTINE = 'the verification was ended: stops are samples again'


class LiveVerification:
    """
    A verification of the calibration by the stops of the robot: a consumer of stops.

    last: the last verdict with its figures, empty before; on_change: called after it began or
    ended.
    """

    def __init__(self, samples: LiveSamples, answer: Answer, place: Place, runner: Runner,
                 progress: Progress) -> None:
        """Start with none going on; runner: runs what takes long."""
        self._samples, self._answer, self._place = samples, answer, place
        self._runner, self._progress = runner, progress
        self._course: VerificationSession | None = None
        self.last = ''
        self.on_change: Callable[[], None] = lambda: None

    @property
    def _config(self) -> Config:
        return self._samples.config

    @property
    def text(self) -> str:
        """Return how far it is, in words; empty where none goes on."""
        return self._course.text if self._course else ''

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return that it goes on."""
        course = self._course
        return () if course is None else (
            f'a verification ({course.routine.name}) continues: stops are not samples until '
            '~/verify_result',)

    # what comes in

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile."""
        course = self._course
        if course and course.scans:
            course.parts[-1].add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses."""
        course = self._course
        if course and course.scans:
            course.parts[-1].add_poses(poses)

    def count(self, stop: Stop, over: bool = True) -> str:
        """
        Let a stop count for the verification; return what to say.

        One that the robot still stands in counts as it is now, and again when it is over.
        """
        course = self._course
        if over:
            self._samples.streams.leave(stop)
        if course is None:  # it was ended this moment
            return NO_ROUTINE
        if course.scans:
            return f'{course.text}: stops do not count, points are taken while the robot moves'
        found = course.add(stop, self._config, self._samples.judge.result)
        text = f'{course.text}; {sample_summary(found)}'
        self._samples.attempt = Attempt(not isinstance(found, Reject), 0,
                                        f'verification: {text}')
        self._samples.on_outcome(Outcome(0, stop, found))
        return text

    def take(self, stop: Stop) -> str:
        """Let a stop count that was asked for; raises UnusableStopError."""
        course, text = self._course, self.count(stop)
        found = course.parts[-1].stops.get(stop.began) if course else None
        if isinstance(found, Reject):
            raise UnusableStopError(found.reason)
        return text

    # what is asked; each returns what to say

    def begin(self) -> str:
        """
        Begin a verification, or the next face, ball or pass of the one that goes on.

        Raises NoRoutineError, UnknownNameError, WrongCountError and NothingToVerifyError.
        """
        self._samples.judge_all()
        course = self._course
        if course is None or course.is_full:
            course = VerificationSession(self._config)
            self._to_verify()  # a file may have to be read, and nobody is to wait for that
        else:
            course.go_on()
        with self._samples.work:
            for stop in self._samples.streams.copied().rest():  # here the robot stood before
                self._samples.streams.leave(stop)
            self._course, self._samples.consumer = course, self
        self.on_change()
        what = 'scan the gauge' if course.scans else 'move on, and stop with other tilts'
        return f'{course.text}; {what}: {NEXT}, until ~/verify_result'

    def result(self) -> str:
        """
        Return the verdict with its figures, and write them; the stop of now counts as over.

        Raises NotStartedError, NothingToVerifyError, TooFewSeenError, DataError, and
        NoAnswerError where it is neither pass nor fail: the verification then goes on.
        """
        with self._samples.work:
            course = self._course
            if course is None:
                raise NotStartedError
            self._samples.judge_rest()
            asked = course.copied()
        found = self._verified(asked)
        self.last = verification.sentence(found)
        text = f'{self.last}; {self._written(found)}'
        with self._samples.work:
            if found.verdict in ANSWERS and self._course is course:
                self.end()
        self.on_change()
        if found.verdict not in ANSWERS:
            raise NoAnswerError(found.verdict, (*found.reasons, text))
        return text

    def _verified(self, course: VerificationSession) -> Verification:
        """Return what a verification shows; other services go on meanwhile."""
        with self._progress.doing('the calibration is verified'):
            return self._runner.run(course.result, self._to_verify(), self._config, urgent=True)

    def configured(self, before: Config, after: Config) -> None:
        """End it where another routine is set."""
        if before.verify.routine != after.verify.routine:
            self.end()

    def end(self) -> None:
        """Let stops be samples again."""
        self._samples.consumer = None
        self._course = None

    def _to_verify(self) -> Calibration:
        """Return the calibration of verify.calibration, or the answer; NothingToVerifyError."""
        file = self._config.verify.calibration
        if file:
            return calibration_file.read_calibration(Path(file).expanduser())
        if self._answer.calibration is None:
            raise NothingToVerifyError
        return self._answer.calibration

    def _written(self, found: Verification) -> str:
        """Write a verification into the folder of the name; return what to say."""
        config = self._config
        poses = config.pose_topic if config.pose_source == 'topic' else '/tf'
        text = verification.yaml_text(replace(found, inputs=(config.profile_topic, poses)))
        file = self._place.folder(config) / f'verification_{found.routine}.yaml'
        former = exports.set_aside(file.parent, [file.name], {file.name})
        write_whole(file, text)
        return str(exports.Saved((file,), former))
