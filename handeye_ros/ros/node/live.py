"""
The session of a running node with its answer, and the threads that work for it.

One thread judges the stops: their answers come first. The other does what follows from them
(review, advice, solving again): always of the newest state, so nothing of it ever piles up.

Knows no ROS. What the services do is here and in live_samples.py.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
import threading

from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import Calibration
from handeye_ros.diagnosis.crossing import flat_crossing
from handeye_ros.diagnosis.review import FEWEST, Review, review
from handeye_ros.diagnosis.summaries import calibration_summary
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.guidance.view import extremes
from handeye_ros.results import calibration_file, exports
from handeye_ros.results.errors import NothingToSaveError
from handeye_ros.ros.node.answer import Answer
from handeye_ros.ros.node.live_samples import LiveSamples
from handeye_ros.ros.node.memory import give_back
from handeye_ros.ros.node.place import Place
from handeye_ros.ros.node.second import Here, Runner
from handeye_ros.ros.node.settings import changes_advice, changes_answer
from handeye_ros.ros.node.store import Store
from handeye_ros.ros.node.workers import Workers
from handeye_ros.sampling.errors import ClearedError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome
import numpy as np

COMPUTED = 'the calibration is computed'
KNOWN_FREEDOM = 6  # conditions more than unknowns, from which on angles are believed


class LiveSession(LiveSamples):
    """
    The samples of a running node, what they say of each other, and the last answer.

    on_failure: is told the traceback of work of a thread that failed.
    """

    def __init__(self, config: Config, place: Place, store: Store | None = None,
                 second: Runner | None = None, judging: Runner | None = None) -> None:
        """
        Start without samples; raises BadValueError for a method that does not exist.

        second: runs what takes long; judging: what an answer waits for.
        """
        super().__init__(config, store, judging)
        self.place = place
        self._second = second or Here()
        self._judged = threading.Event()  # since which there is something to derive
        self.answer = Answer()
        self.review: Review | None = None
        self.no_review = ''
        self.advice = pipeline.advise((), config)
        self._seen = np.zeros((0, 2))  # points of profiles, at the ends of the view
        self._reviewed: tuple[Outcome, ...] | None = None
        self._settings, self._advised = 1, 0  # how often they changed; at the last advice
        self._asked = self._due = False  # for an answer, ever; and again, as settings changed
        self._workers = Workers(lambda text: self.on_failure(text))
        self.on_failure: Callable[[str], object] = lambda text: None

    @property
    def calibration(self) -> Calibration | None:
        """Return the last answer that was not refused."""
        return self.answer.calibration

    @property
    def reviewed(self) -> tuple[Outcome, ...]:
        """Return the samples that the agreements of the review belong to, in its order."""
        return self._reviewed or ()

    @property
    def failure(self) -> str:
        """Return what of the last work of the threads failed, empty where nothing did."""
        return self._workers.failure

    # what the threads do

    def start(self) -> None:
        """Let the threads do what has to be done, until the process ends."""
        self._judging.begin()
        self._workers.start(self._wake, self._judge_and_tell)
        self._workers.start(self._judged, self._derive)

    def stop(self) -> None:
        """End what takes long, and the threads with it."""
        self._workers.stop()
        self._second.stop()
        self._judging.stop()

    def _judge_and_tell(self) -> None:
        self.judge_all()
        self.on_change()
        self._judged.set()
        self._store.settle()
        give_back()

    def settle(self) -> None:
        """Judge the stops that are over, review all samples, solve again for other settings."""
        self.judge_all()
        self._derive()

    def _derive(self) -> None:
        """Do what follows from the samples of now."""
        self.extract_anew()
        self._review()
        if self._due:
            with suppress(HandeyeError):  # it is told by the state of the answer
                self._compute(self.judge_all)

    def _review(self) -> None:
        """Tell how well the samples agree and what is missing, where they have changed."""
        cleared, settings = self._cleared, self._settings
        outcomes, included = self._to_review()
        samples = [o.sample for o in outcomes if o.sample]
        if self._reviewed == outcomes and self._advised == settings:
            return
        found, why = None, ''
        try:
            found = self._runner(samples).run(review, samples, included, self.config)
        except DataError as error:
            why = str(error)
        with self._lock:
            if self._cleared == cleared:
                self.review, self.no_review, self._reviewed = found, why, outcomes
        self.on_change()
        self._advise(settings)

    def _runner(self, samples: Sequence[object]) -> Runner:
        """Return who tells what of samples: so few that nothing is solved need no process."""
        return self._second if len(samples) >= FEWEST else Here()

    def _to_review(self) -> tuple[tuple[Outcome, ...], list[bool]]:
        """Return the samples of now, and which of them are not left out."""
        outcomes = tuple(o for o in self.copied().outcomes if o.sample)
        return outcomes, [o.number not in self.config.samples.exclude for o in outcomes]

    def _why_not(self, outcome: Outcome) -> str:
        """Return that the laser crosses an edge too flatly, once the edge is known."""
        known = self.review
        if outcome.sample is None or known is None or (
                known.solution.degrees_of_freedom < KNOWN_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, known.solution, self.config)

    def _advise(self, settings: int) -> None:
        """Tell what to do next, as the samples of now say."""
        cleared, current = self._cleared, self.latest.current(self.config)
        if current:
            self._seen = extremes(np.concatenate([self._seen, current.points]))
        samples = sorted((o.sample for o, use in zip(*self._to_review(), strict=True)
                          if use and o.sample), key=lambda sample: sample.stamp)
        advice = self._runner(samples).run(pipeline.advise, samples, self.config, self._seen)
        with self._lock:
            if self._cleared == cleared:
                self.advice, self._advised = advice, settings
        self.on_change()

    # what is asked; each returns what to say

    def compute(self) -> tuple[Calibration, str]:
        """
        Return the answer from all samples, and what to say.

        The stop that the robot stands in now counts as over. Raises DataError when there is no
        answer, or InputError; the answer before is then gone.
        """
        self._asked = True
        return self._compute(self._judge_rest)

    def _compute(self, judge: Callable[[], None]) -> tuple[Calibration, str]:
        """Do so from the stops that judge() takes for over."""
        self._due, cleared = False, self._cleared
        try:
            found, stamps = self._solved(judge)
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

    def _solved(self, judge: Callable[[], None]) -> tuple[Calibration, frozenset[int]]:
        self.extract_anew()
        with self._work:
            judge()
            session, config = self.copied(), self.config
        self._wake.set()
        session.require_stations()
        with self._doing(COMPUTED):
            found = pipeline.solve_session(
                session, config, partial(self._second.run, pipeline.solve, urgent=True))
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        return (replace(found, provenance={**found.provenance, 'inputs': inputs}),
                stamps_of(session))

    def clear_samples(self) -> str:
        """Forget all samples, the answer, and all that was received; raises InputError."""
        text = super().clear_samples()
        self.answer.withdraw('the samples were cleared')
        self._asked = False
        with self._lock:
            self.review, self.no_review, self._reviewed = None, '', None
            self.advice = pipeline.advise((), self.config)
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
        again = f'; {COMPUTED} anew: save it again after that' if COMPUTED in self.working else ''
        return f'{saved}{self.answer.changes(now)}{again}'

    # what is set

    def configure(self, config: Config) -> None:
        """Go on with another configuration, already checked by params.changed."""
        before = self.config
        super().configure(config)
        if changes_answer(before, config):
            self._due = self._asked
        if changes_answer(before, config) or changes_advice(before, config):
            self._settings += 1
        self._wake.set()


def stamps_of(session: Session) -> frozenset[int]:
    """Return what tells the samples of a session apart."""
    return frozenset(sample.stamp for sample in session.samples)
