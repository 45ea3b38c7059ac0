"""
A running session that also verifies: between start and result the stops are no samples.

Knows no ROS.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Reject, TimedPose
from handeye_ros.diagnosis.summaries import sample_summary
from handeye_ros.results import calibration_file, exports
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.sampling.stops import Outcome, Stop
from handeye_ros.verification import verification
from handeye_ros.verification.course import Course
from handeye_ros.verification.errors import (
    NoAnswerError,
    NothingToVerifyError,
    NotStartedError,
    UnusableStopError,
)
from handeye_ros.verification.verification import Verification

ANSWERS = ('pass', 'fail')  # the verdicts that end a verification
NEXT = 'what begins from now on counts'


class LiveVerify(LiveSession):
    """The samples of a running node, the last answer, and a verification of it."""

    _course: Course | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what else is to be known, one sentence each."""
        course = self._course
        return super().warnings if course is None else (
            f'a verification ({course.routine.name}) goes on: stops are no samples until '
            '~/verify_result', *super().warnings)

    # what comes in

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile."""
        super().add_profile(profile)
        course = self._course
        if course and course.scans:
            course.parts[-1].add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses."""
        poses = list(poses)
        super().add_poses(poses)
        course = self._course
        if course and course.scans:
            course.parts[-1].add_poses(poses)

    def _judge(self, stop: Stop) -> None:
        if self._course is None:
            super()._judge(stop)
        else:
            self._count(self._course, stop)

    def _take(self) -> str:
        if self._course is None:
            return super()._take()
        stop = self._here()
        with self._work:
            self.judge_all()
            return self._wanted(self._course, stop)

    def _count(self, course: Course, stop: Stop) -> str:
        """Let a stop count for the verification; return what to say."""
        with self._lock:
            self._session.leave(stop)
        if course.scans:
            return f'{course.text}: stops do not count, points are taken while the robot moves'
        found = course.add(stop, self.config, self._judging.result)
        text = f'{course.text}; {sample_summary(found)}'
        self._told(not isinstance(found, Reject), 0, f'verification: {text}')
        self.on_outcome(Outcome(0, stop, found))
        return text

    def _wanted(self, course: Course, stop: Stop) -> str:
        """Let a stop count that was asked for; raises UnusableStopError."""
        text = self._count(course, stop)
        found = course.parts[-1].stops.get(stop.began)
        if isinstance(found, Reject):
            raise UnusableStopError(found.reason)
        return text

    # what is asked; each returns what to say

    def verify_start(self) -> str:
        """
        Begin a verification, or the next face, ball or pass of the one that goes on.

        Raises NoRoutineError, UnknownNameError, WrongCountError and NothingToVerifyError.
        """
        self.judge_all()
        course = self._course
        if course is None or course.is_full:
            course = Course(self.config)
            self._to_verify()  # a file may have to be read, and nobody is to wait for that
        else:
            course.go_on()
        with self._work:
            for stop in self.copied().rest():  # here the robot stood before
                with self._lock:
                    self._session.leave(stop)
            self._course = course
        self.on_change()
        what = 'scan the gauge' if course.scans else 'move on, and stop with other tilts'
        return f'{course.text}; {what}: {NEXT}, until ~/verify_result'

    def verify_result(self) -> str:
        """
        Return the verdict with its figures, and write them; the stop of now counts as over.

        Raises NotStartedError, NothingToVerifyError, TooFewSeenError, DataError, and
        NoAnswerError where it is neither pass nor fail: the verification then goes on.
        """
        with self._work:
            course = self._course
            if course is None:
                raise NotStartedError
            self._judge_rest()
            asked = course.copied()
        found = self._found(asked)
        text = f'{verification.sentence(found)}; {self._written(found)}'
        with self._work:
            if found.verdict in ANSWERS and self._course is course:
                self._end()
        self.on_change()
        if found.verdict not in ANSWERS:
            raise NoAnswerError(found.verdict, (*found.reasons, text))
        return text

    def _found(self, course: Course) -> Verification:
        """Return what a verification shows; other services go on meanwhile."""
        with self._doing('the calibration is verified'):
            return self._second.run(course.result, self._to_verify(), self.config, urgent=True)

    def clear_samples(self) -> str:
        """Forget all samples, a verification, the answer, and all that was received."""
        with self._work:
            self._end()
            return super().clear_samples()

    def configure(self, config: Config) -> None:
        """Go on with another configuration; another routine ends a verification."""
        if config.verify.routine != self.config.verify.routine:
            self._end()
        super().configure(config)

    def _end(self) -> None:
        self._course = None

    def _to_verify(self) -> Calibration:
        """Return the calibration of verify.calibration, or the answer; NothingToVerifyError."""
        file = self.config.verify.calibration
        if file:
            return calibration_file.read_calibration(Path(file).expanduser())
        if self.calibration is None:
            raise NothingToVerifyError
        return self.calibration

    def _written(self, found: Verification) -> str:
        """Write a verification into the folder of the name; return what to say."""
        config = self.config
        poses = config.pose_topic if config.pose_source == 'topic' else '/tf'
        text = verification.yaml_text(replace(found, inputs=(config.profile_topic, poses)))
        file = self.place.folder(config) / f'verification_{found.routine}.yaml'
        former = exports.set_aside(file.parent, [file.name], {file.name})
        calibration_file.write_whole(file, text)
        return str(exports.Saved((file,), former))
