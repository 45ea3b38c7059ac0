"""
A running node without ROS: its streams, samples, review, answer and verification as one.

One thread judges the stops: their answers come first. The other does what follows from them
(review, advice, solving again): always of the newest state, so nothing of it ever piles up.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
import threading

from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, TimedPose
from handeye_ros.diagnosis.summaries import calibration_summary
from handeye_ros.errors import DataError, HandeyeError, InputError
from handeye_ros.output import folder_name
from handeye_ros.results import exports
from handeye_ros.results.errors import NothingToSaveError
from handeye_ros.ros.errors import WorkerEndedError
from handeye_ros.ros.node.answer import Answer, changes_answer
from handeye_ros.ros.node.live_verify import LiveVerification
from handeye_ros.ros.node.reviewer import Reviewer
from handeye_ros.ros.node.samples import LiveSamples
from handeye_ros.ros.node.streams import Streams
from handeye_ros.ros.node.threads import Progress, Threads
from handeye_ros.ros.node.worker import give_back, InProcess, Judge, Runner
from handeye_ros.ros.sessions.store import Place, Store
from handeye_ros.sampling.errors import ClearedError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome

COMPUTED = 'the calibration is computed'


class LiveSession:
    """
    What a running node does, made of its parts; each of them may be looked at.

    on_outcome: called with each new outcome; on_change: after whatever changes the state;
    on_failure: with the traceback of work of a thread that failed.
    """

    def __init__(self, config: Config, place: Place, store: Store | None = None,
                 solver: Runner | None = None, judge: Runner | None = None) -> None:
        """
        Start without samples; raises BadValueError for a method that does not exist.

        solver: runs what takes long; judge: what an answer waits for.
        """
        self.place = place
        self.solver, self._judge = solver or InProcess(), Judge(judge or InProcess())
        self.progress = Progress()
        self.streams = Streams(config)
        self.samples = LiveSamples(self.streams, self._judge, store or Store(), self.progress)
        self.reviewer = Reviewer(self.samples, self.solver)
        self.answer = Answer()
        self.verification = LiveVerification(self.samples, self.answer, place, self.solver,
                                             self.progress)
        self._judged = threading.Event()  # since which there is something to derive
        self._asked = self._due = False  # for an answer, ever; and again, as settings changed
        self.threads = Threads(lambda text: self.on_failure(text))
        self.samples.objection = self.reviewer.objection
        self.samples.on_outcome = lambda outcome: self.on_outcome(outcome)
        self.on_outcome: Callable[[Outcome], None] = lambda outcome: None
        self.on_failure: Callable[[str], object] = lambda text: None
        self.on_change: Callable[[], None] = lambda: None
        for part in (self.progress, self.reviewer, self.verification):
            part.on_change = lambda: self.on_change()

    @property
    def config(self) -> Config:
        """Return the settings of now."""
        return self.streams.config

    @property
    def framed(self) -> Config:
        """Return the settings of now with the frame of the poses as the base."""
        return self.streams.session.with_base(self.config)

    @property
    def calibration(self) -> Calibration | None:
        """Return the last answer that was not refused."""
        return self.answer.calibration

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what else is to be known, one sentence each."""
        return (*self.verification.warnings, *self.streams.warnings,
                *filter(None, (self._judge.trouble,)))

    def copied(self) -> Session:
        """Return the session of this moment."""
        return self.streams.copied()

    # what comes in

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile."""
        self.streams.add_profile(profile)
        self.verification.add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses."""
        poses = list(poses)
        self.streams.add_poses(poses)
        self.verification.add_poses(poses)

    # what the threads do

    def start(self) -> None:
        """Let the threads do what has to be done, until the process ends."""
        self._judge.begin()
        self.threads.start(self.streams.wake, self._judge_stops)
        self.threads.start(self._judged, self._derive)

    def stop(self) -> None:
        """End what takes long, and the threads with it."""
        self.threads.stop()
        self.solver.stop()
        self._judge.stop()

    def restore(self, session: Session, before: Config) -> str:
        """Go on with an earlier run, and solve what it has; see LiveSamples.restore."""
        text = self.samples.restore(session, before)
        self._asked = self._due = bool(session.samples)
        return text

    def replace_session(self, store: Store, session: Session, before: Config) -> str:
        """Go on with another session instead of the one of now; see LiveSamples.restore."""
        with self.samples.work:
            self.verification.end()
            self.samples.forget()
            self.samples.store.close()
            store.joints, self.samples.store = self.samples.store.joints, store
            text = self.restore(session, before)
        self.answer.withdraw('another session was opened')
        with self.streams.lock:
            self.reviewer.clear()
        self.on_change()
        return text

    def _judge_stops(self) -> None:
        self.samples.judge_all()
        self.on_change()
        self._judged.set()
        self.samples.store.sync()
        give_back()

    def update(self) -> None:
        """Judge the stops that are over, review all samples, solve again for other settings."""
        self.samples.judge_all()
        self._derive()

    def _derive(self) -> None:
        """Do what follows from the samples of now."""
        self.samples.extract_again()
        if self._due:  # the answer first: after a restart somebody waits for it
            with suppress(DataError, InputError):  # it is reported by the state of the answer
                self._compute(self.samples.judge_all)
        self.reviewer.update()

    # what is asked; each returns what to say

    def compute(self) -> tuple[Calibration, str]:
        """
        Return the answer from all samples, and what to say.

        The stop that the robot stands in now counts as over. Raises DataError when there is no
        answer, or InputError; the answer before is then gone.
        """
        self._asked = True
        return self._compute(self.samples.judge_rest)

    def _compute(self, judge: Callable[[], None]) -> tuple[Calibration, str]:
        """Do so from the stops that judge() takes for over."""
        self._due, cleared = False, self.samples.cleared
        try:
            found, stamps = self._solved(judge)
        except WorkerEndedError:  # which says nothing of the samples
            self._due = self._asked
            raise
        except HandeyeError as error:
            self.answer.withdraw(f'the last attempt to compute it was refused ({error})')
            self.on_change()
            raise
        with self.streams.lock:
            if self.samples.cleared != cleared:
                raise ClearedError
            self.answer.replace(found, stamps)
        self.on_change()
        return found, calibration_summary(found)

    def _solved(self, judge: Callable[[], None]) -> tuple[Calibration, frozenset[int]]:
        self.samples.extract_again()
        with self.samples.work:
            judge()
            session, config = self.copied(), self.config
        self.streams.wake.set()
        session.require_stations()
        with self.progress.doing(COMPUTED):
            found = pipeline.solve_session(
                session, config, partial(self.solver.run, pipeline.solve, urgent=True))
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        if self.samples.store.path:
            inputs.append({'session': self.samples.store.path})
        return (replace(found, provenance={**found.provenance, 'inputs': inputs}),
                stamps_of(session))

    def clear_samples(self) -> str:
        """Forget samples, verification, answer, and all that was received; raises InputError."""
        with self.samples.work:
            self.verification.end()
            text = self.samples.clear()
        self.answer.withdraw('the samples were cleared')
        self._asked = False
        with self.streams.lock:
            self.reviewer.clear()
        self.on_change()
        return text

    def save(self) -> str:
        """Write the last answer; raises NothingToSaveError, and InputError if it cannot."""
        with self.streams.lock:
            calibration, now = self.calibration, stamps_of(self.streams.session)
        if calibration is None:
            raise NothingToSaveError
        name = folder_name(self.config)
        saved = exports.save_all(replace(calibration, name=name), self.place.folder(self.config),
                                 self.config.save.formats)
        self.answer.saved(calibration, str(saved.files[0]))
        self.on_change()
        computing = COMPUTED in self.progress.text
        again = f'; {COMPUTED} again: save it again after that' if computing else ''
        return f'{saved}{self.answer.changes(now)}{again}'

    # what is set

    def configure(self, config: Config) -> None:
        """Go on with another configuration, already checked by params.changed."""
        before = self.config
        self.verification.configured(before, config)
        self.samples.configure(config)
        if changes_answer(before, config):
            self._due = self._asked
        self.reviewer.configured(before, config)
        self.streams.wake.set()


def stamps_of(session: Session) -> frozenset[int]:
    """Return what tells the samples of a session apart."""
    return frozenset(sample.stamp for sample in session.samples)
