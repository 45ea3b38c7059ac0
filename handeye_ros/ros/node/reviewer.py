"""
How well the samples of a running node agree, and what to do next: whenever they have changed.

Knows no ROS.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.diagnosis.review import FEWEST, flat_crossing, Review, review
from handeye_ros.errors import DataError
from handeye_ros.guidance.view import extremes
from handeye_ros.ros.node.answer import changes_advice, changes_answer
from handeye_ros.ros.node.samples import LiveSamples
from handeye_ros.ros.node.worker import InProcess, Runner
from handeye_ros.sampling.stops import Outcome
import numpy as np

SURE_FREEDOM = 6  # degrees of freedom from which on the angles at the edges are believed


class Reviewer:
    """
    The review of the samples of a running node, and the advice.

    review: None before there is one, no_review: why; reviewed: the samples that its agreements
    belong to, in this order; advised: the number of the last sample that the advice knows of, 0
    for none; seen: points (k, 2) at the ends of the field of view; on_change: called after
    each.
    """

    def __init__(self, samples: LiveSamples, runner: Runner) -> None:
        """Start with none; runner: runs what takes long."""
        self._samples, self._runner = samples, runner
        self.seen = np.zeros((0, 2))
        self._settings, self._advised = 1, 0  # how often they changed; at the last advice
        self.on_change: Callable[[], None] = lambda: None
        self.clear()

    def clear(self) -> None:
        """Forget it; the lock of the streams is held, or nobody else knows this yet."""
        self.review: Review | None = None
        self.no_review = ''
        self._reviewed: tuple[Outcome, ...] | None = None
        self.advice = pipeline.advise((), self._samples.config)
        self.advised = self._known_refused = 0
        self._poses: dict[int, Array] = {}  # of stops that gave no sample, by when they began

    @property
    def reviewed(self) -> tuple[Outcome, ...]:
        """Return the samples that the agreements of the review belong to, in its order."""
        return self._reviewed or ()

    def configured(self, before: Config, after: Config) -> None:
        """Take note of other settings."""
        self._settings += changes_answer(before, after) or changes_advice(before, after)

    def update(self) -> None:
        """Tell how well the samples agree and what is missing, where they have changed."""
        cleared, settings, config = self._samples.cleared, self._settings, self._samples.config
        outcomes, included = self._included()
        samples = [o.sample for o in outcomes if o.sample]
        refused = self._refused()
        if _same(self._reviewed, outcomes) and self._advised == settings and (
                len(refused) == self._known_refused):
            return
        found, why = None, ''
        try:
            found = self._runner_for(samples).run(review, samples, included, config)
        except DataError as error:
            why = str(error)
        with self._samples.streams.lock:
            if self._samples.cleared == cleared:
                self.review, self.no_review, self._reviewed = found, why, outcomes
        self.on_change()
        self._advise(settings, refused)

    def _refused(self) -> list[Array]:
        """Return the poses of the flange (4, 4) at which stops gave no sample."""
        config, outcomes = self._samples.config, self._samples.streams.copied().outcomes
        for outcome in outcomes:
            if outcome.sample is None and outcome.stop.began not in self._poses:
                self._poses[outcome.stop.began] = outcome.stop.pose(config)
        taken = {outcome.stop.began for outcome in outcomes if outcome.sample}
        return [T for began, T in (self._samples.refused | self._poses).items()
                if began not in taken]

    def _runner_for(self, samples: Sequence[object]) -> Runner:
        """Return what runs the work on samples: so few that nothing is solved need no process."""
        return self._runner if len(samples) >= FEWEST else InProcess()

    def _included(self) -> tuple[tuple[Outcome, ...], list[bool]]:
        """Return the samples of now, and which of them are not left out."""
        outcomes = tuple(o for o in self._samples.streams.copied().outcomes if o.sample)
        exclude = self._samples.config.samples.exclude
        return outcomes, [o.number not in exclude for o in outcomes]

    def objection(self, outcome: Outcome) -> str:
        """Return that the laser crosses an edge too flatly, once the edge is known."""
        known = self.review
        if outcome.sample is None or known is None or (
                known.solution.degrees_of_freedom < SURE_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, known.solution, self._samples.config)

    def _advise(self, settings: int, refused: list[Array]) -> None:
        """Tell what to do next, as the samples of now say."""
        cleared, config = self._samples.cleared, self._samples.config
        current = self._samples.streams.latest.current(config)
        if current:
            self.seen = extremes(np.concatenate([self.seen, current.points]))
        outcomes, included = self._included()
        samples = sorted((o.sample for o, use in zip(outcomes, included, strict=True)
                          if use and o.sample), key=lambda sample: sample.stamp)
        advice = self._runner_for(samples).run(pipeline.advise, samples, config, self.seen,
                                               refused)
        with self._samples.streams.lock:
            if self._samples.cleared == cleared:
                self.advice, self._advised = advice, settings
                self._known_refused = len(refused)
                self.advised = max((o.number for o in outcomes), default=0)
        self.on_change()


def _same(before: tuple[Outcome, ...] | None, now: tuple[Outcome, ...]) -> bool:
    """Return whether these are samples of the same stops, maybe from more profiles."""
    return before is not None and [(o.number, o.stop.began) for o in before] == [
        (o.number, o.stop.began) for o in now]
