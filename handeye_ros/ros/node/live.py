"""
The session of a running node with its answer, and the thread that works for it.

Knows no ROS. What the services do is here and in live_samples.py.
"""
from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import threading
import traceback

from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import Calibration, Sample
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.guidance.advice import Advice
from handeye_ros.guidance.view import extremes
from handeye_ros.results import calibration_file, exports
from handeye_ros.results.errors import NothingToSaveError
from handeye_ros.ros.node.answer import Answer
from handeye_ros.ros.node.live_samples import LiveSamples
from handeye_ros.ros.node.place import Place
from handeye_ros.ros.node.settings import changes_advice, changes_answer
from handeye_ros.ros.node.store import Store
from handeye_ros.sampling.crossing import flat_crossing
from handeye_ros.sampling.errors import ClearedError
from handeye_ros.sampling.review import Review, review
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome
from handeye_ros.sampling.wording import calibration_summary
import numpy as np

KNOWN_FREEDOM = 6  # conditions more than unknowns, from which on angles are believed


class LiveSession(LiveSamples):
    """
    The samples of a running node, what they say of each other, and the last answer.

    failure: of the last work of the thread, empty where it did it; on_failure: is told the
    traceback.
    """

    def __init__(self, config: Config, place: Place, store: Store | None = None) -> None:
        """Start without samples; raises BadValueError for a method that does not exist."""
        super().__init__(config, store)
        self.place = place
        self.answer = Answer()
        self.review: Review | None = None
        self.no_review = ''
        self.advice = pipeline.advise((), config)
        self._seen = np.zeros((0, 2))  # points of profiles, at the ends of the view
        self._reviewed: tuple[Outcome, ...] | None = None
        self._asked = self._due = False  # for an answer, ever; and again, as settings changed
        self.failure = ''
        self.on_failure: Callable[[str], object] = lambda text: None

    @property
    def calibration(self) -> Calibration | None:
        """Return the last answer that was not refused."""
        return self.answer.calibration

    @property
    def reviewed(self) -> tuple[Outcome, ...]:
        """Return the samples that the agreements of the review belong to, in its order."""
        return self._reviewed or ()

    # what a worker does

    def start(self) -> None:
        """Let a thread of its own do what has to be done, until the process ends."""
        threading.Thread(target=self._run, name='worker', daemon=True).start()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            try:
                self.settle()
                self.failure = ''
            except Exception as error:  # noqa: BLE001 - the next stop must be judged all the same
                self.failure = ('the work on the samples failed, which should not happen: '
                                f'{error!r}; see the log, and please report it')
                self.on_failure(traceback.format_exc())

    def settle(self) -> None:
        """Judge the stops that are over, review all samples, solve again for other settings."""
        self.judge_all()
        self._review()
        if self._due:
            with suppress(HandeyeError):  # it is told by the state of the answer
                self.compute()

    def _review(self) -> None:
        """Tell how well the samples agree, where they have changed since the last time."""
        session, config = self.copied(), self.config
        outcomes = tuple(o for o in session.outcomes if o.sample)
        if self._reviewed != outcomes:
            included = [o.number not in config.samples.exclude for o in outcomes]
            try:
                found = review([o.sample for o in outcomes if o.sample], included, config)
                self.review, self.no_review, self._reviewed = found, '', outcomes
            except DataError as error:
                self.review, self.no_review, self._reviewed = None, str(error), outcomes
            self.advice = self._advise([o.sample for o, use in zip(outcomes, included, strict=True)
                                        if use and o.sample], config)
        self.on_change()

    def _why_not(self, outcome: Outcome) -> str:
        """Return that the laser crosses an edge too flatly, once the edge is known."""
        known = self.review
        if outcome.sample is None or known is None or (
                known.solution.degrees_of_freedom < KNOWN_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, known.solution, self.config)

    def _advise(self, samples: list[Sample], config: Config) -> Advice:
        """Return what to do next; the view is learnt from the profiles of now, too."""
        current = self.latest.current(config)
        if current:
            self._seen = extremes(np.concatenate([self._seen, current.points]))
        return pipeline.advise(sorted(samples, key=lambda s: s.stamp), config, self._seen)

    # what is asked; each returns what to say

    def compute(self) -> tuple[Calibration, str]:
        """
        Return the answer from all samples, and what to say.

        The stop that the robot stands in now counts as over. Raises DataError when there is no
        answer, or InputError; the answer before is then gone.
        """
        self._asked, self._due, cleared = True, False, self._cleared
        try:
            found, stamps = self._solved()
        except HandeyeError as error:
            self.answer.withdraw(f'the last attempt to compute it was refused ({error})')
            self.on_change()
            raise
        with self._lock:
            if self._cleared != cleared:
                raise ClearedError
            self.answer.found(found, stamps)
        self.on_change()
        return found, calibration_summary(found)

    def _solved(self) -> tuple[Calibration, frozenset[int]]:
        with self._work:
            self.judge_all()
            for stop in self.copied().rest():
                self._judge(stop)
            session, config = self.copied(), self.config
        session.require_stations()
        self.working = 'the calibration is computed'
        self.on_change()
        try:
            found = pipeline.solve_session(session, config)
        finally:
            self.working = ''
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        return (replace(found, provenance={**found.provenance, 'inputs': inputs}),
                stamps_of(session))

    def clear_samples(self) -> str:
        """Forget all samples, the answer, and all that was received; raises InputError."""
        text = super().clear_samples()
        self.answer.withdraw('the samples were cleared')
        self._asked = False
        self.on_change()
        return text

    def save(self) -> str:
        """Write the last answer; raises NothingToSaveError, and InputError if it cannot."""
        with self._lock:
            calibration, now = self.calibration, stamps_of(self._session)
        if calibration is None:
            raise NothingToSaveError
        name = calibration_file.folder_name(self.config)
        saved = exports.save_all(replace(calibration, name=name), self.place.folder(self.config),
                                 self.config.save.formats)
        return f'{saved}{self.answer.changes(now)}'

    # what is set

    def configure(self, config: Config) -> None:
        """Go on with another configuration, already checked by params.changed."""
        before = self.config
        super().configure(config)
        if changes_answer(before, config):
            self._reviewed, self._due = None, self._asked
        if changes_advice(before, config):
            self._reviewed = None
        self._wake.set()


def stamps_of(session: Session) -> frozenset[int]:
    """Return what tells the samples of a session apart."""
    return frozenset(sample.stamp for sample in session.samples)
