"""
The answer of a running node, the review of its samples, and the guidance.

Knows no ROS. Review and advice are computed whenever the samples have changed.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from handeye_ros import pipeline
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.checks.review import count_of, FEWEST, flat_crossing, Review, review
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError, HandeyeError, InputError
from handeye_ros.guidance.score import extremes
from handeye_ros.node.errors import NothingToSaveError, WorkerEndedError
from handeye_ros.node.samples import changes, LiveSamples, SAMPLE_KEYS
from handeye_ros.node.state import calibration_summary
from handeye_ros.node.worker import Progress, Runner
from handeye_ros.output import folder_name
from handeye_ros.results import exports
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome
import numpy as np

# Keys, or prefixes of keys, that affect the answer from given stops.
ANSWER_KEYS = (*SAMPLE_KEYS, 'calibration_type', 'noise.', 'limits.', 'samples.',
               'sampling.min_crossing_angle')
COMPUTED = 'the calibration is computed'
SURE_FREEDOM = 6  # smallest degrees of freedom of a review for valid angles at the edges


class Answer:
    """
    The last answer that was not refused, and its samples.

    calibration: None before the first, and after a refusal; missing: why there is none; withdrawn:
    why the previous one was withdrawn; file: where it was saved, '' if it was not; requested:
    whether an answer was ever requested; on_change: called after each change.
    """

    def __init__(self, samples: LiveSamples, runner: Runner, folders: OutputFolders,
                 progress: Progress) -> None:
        """Start with none; runner: runs the solve."""
        self._samples, self._runner, self._folders = samples, runner, folders
        self._progress = progress
        self.calibration: Calibration | None = None
        self.requested = False
        self._outdated = False  # whether it has to be computed again
        self._solved: frozenset[int] = frozenset()  # stamps of its samples
        self.withdrawn = self.missing = self.file = ''
        self.on_change: Callable[[], None] = lambda: None

    def compute(self) -> tuple[Calibration, str]:
        """
        Return the answer from all samples, and the message about it.

        The current stop counts as complete. Raises DataError or InputError where there is no
        answer; the previous answer is then withdrawn.
        """
        self.requested = True
        return self._compute(self._samples.evaluate_rest)

    def update(self) -> None:
        """Compute the answer again if it is outdated; the state reports a refusal."""
        if self._outdated:
            with suppress(DataError, InputError):
                self._compute(self._samples.evaluate_all)

    def _compute(self, evaluate: Callable[[], None]) -> tuple[Calibration, str]:
        """Return the same as compute; evaluate: see LiveSamples.session_after."""
        self._outdated, cleared = False, self._samples.cleared
        try:
            calibration, stamps = self._solve(evaluate)
        except WorkerEndedError:  # no refusal: the previous answer stays
            self._outdated = self.requested
            raise
        except HandeyeError as error:
            self.withdraw(f'the last attempt to compute it was refused ({error})')
            self.on_change()
            raise
        with self._samples.streams.lock:
            if self._samples.cleared != cleared:
                raise DataError('the samples were cleared while the calibration was computed, so '
                                'there is no answer: take new samples', reason='cleared')
            self.calibration, self._solved = calibration, stamps
            self.withdrawn = self.missing = self.file = ''
        self.on_change()
        return calibration, calibration_summary(calibration)

    def _solve(self, evaluate: Callable[[], None]) -> tuple[Calibration, frozenset[int]]:
        """Return the answer from the current samples, and their stamps."""
        session, config = self._samples.session_after(evaluate)
        with self._progress.doing(COMPUTED):
            calibration = pipeline.solve_session(
                session, config, partial(self._runner.run, pipeline.solve, urgent=True))
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        if self._samples.store.path:
            inputs.append({'session': self._samples.store.path})
        provenance = {**calibration.provenance, 'inputs': inputs}
        return replace(calibration, provenance=provenance), stamps_of(session)

    def save(self) -> str:
        """Write the answer; return the message. Raises NothingToSaveError and InputError."""
        calibration, config = self.calibration, self._samples.config
        if calibration is None:
            raise NothingToSaveError
        saved = exports.save_all(replace(calibration, name=folder_name(config)),
                                 self._folders.folder(config), config.save.formats)
        if calibration is self.calibration:  # no other was computed meanwhile
            self.file = str(saved.files[0])
        self.on_change()
        changes = self.changes(stamps_of(self._samples.streams.copied()))
        note = (f'; {COMPUTED} again: save it again after that'
                if COMPUTED in self._progress.text else '')
        return f'{saved}{changes}{note}'

    def restored(self, session: Session) -> None:
        """Request the answer from the samples of an earlier run."""
        self.requested = self._outdated = bool(session.samples)

    def configured(self, old: Config, new: Config) -> None:
        """Request a new answer if changed settings affect it."""
        if changes(old, new, ANSWER_KEYS):
            self._outdated = self.requested

    def withdraw(self, reason: str) -> None:
        """Remove the answer, with the reason for its state."""
        self.withdrawn = (f'{reason}; the transform that was published before is not the answer'
                          if self.calibration or self.withdrawn else '')
        self.calibration, self.missing = None, reason

    def changes(self, stamps: frozenset[int]) -> str:
        """Return how samples with these stamps differ from those of the answer, or ''."""
        solved = self._solved
        removed, added = len(solved - stamps), len(stamps - solved)
        if not removed and not added:
            return ''
        differences = ' and '.join([f'{removed} removed'] * bool(removed)
                                   + [f'{added} added'] * bool(added))
        return (f'; it was computed from {count_of(len(solved), "sample")}, which have changed '
                f'since ({differences}): call ~/compute_calibration for an answer from the '
                f'current {len(stamps)}')


def stamps_of(session: Session) -> frozenset[int]:
    """Return the stamps of the samples of a session, which identify them."""
    return frozenset(sample.stamp for sample in session.samples)


class Reviewer:
    """
    The review of the samples, and the guidance.

    review: None where there is none, no_review: why; reviewed: the samples in the order of the
    agreements of the review; advised: the number of the last sample in the advice, 0 for none;
    extremes: visible points (k, 2) at the ends of the field of view; on_change: called after each
    change.
    """

    def __init__(self, samples: LiveSamples, runner: Runner) -> None:
        """Start with none; runner: runs long computations."""
        self._samples, self._runner = samples, runner
        self.extremes = np.zeros((0, 2))
        self._settings = 1  # number of their changes
        self.on_change: Callable[[], None] = lambda: None
        self.clear()

    def clear(self) -> None:
        """Forget both; the caller holds the lock of the streams."""
        self.review: Review | None = None
        self.no_review = ''
        self.reviewed: tuple[Outcome, ...] = ()
        self.advice = pipeline.advise((), self._samples.config)
        self.advised = 0
        self._basis = 0, 0  # of the advice: changes of settings, stops without a sample
        self._poses: dict[int, Array] = {}  # of stops without a sample, by their start

    def configured(self, old: Config, new: Config) -> None:
        """Note a change of settings."""
        self._settings += changes(old, new, (*ANSWER_KEYS, 'guidance.'))

    def update(self) -> None:
        """Compute review and guidance again if samples or settings have changed."""
        cleared, settings, config = self._samples.cleared, self._settings, self._samples.config
        outcomes, included = self._included()
        samples = [o.sample for o in outcomes if o.sample]
        refused_poses = self._refused()
        basis = settings, len(refused_poses)
        if _stops(self.reviewed) == _stops(outcomes) and self._basis == basis:
            return
        result, reason = None, ''
        try:
            result = self._runner_for(samples).run(review, samples, included, config)
        except DataError as error:
            reason = str(error)
        with self._samples.streams.lock:
            if self._samples.cleared == cleared:
                self.review, self.no_review, self.reviewed = result, reason, outcomes
        self.on_change()
        self._advise(settings, refused_poses)

    def _refused(self) -> list[Array]:
        """Return the poses T_base_flange (4, 4) of stops without a sample."""
        config, outcomes = self._samples.config, self._samples.streams.copied().outcomes
        for outcome in outcomes:
            if outcome.sample is None and outcome.stop.began not in self._poses:
                self._poses[outcome.stop.began] = outcome.stop.pose(config)
        sampled = {outcome.stop.began for outcome in outcomes if outcome.sample}
        return [T for began, T in (self._samples.refused | self._poses).items()
                if began not in sampled]

    def _runner_for(self, samples: Sequence[object]) -> Runner:
        """Return the runner for samples; with too few for a solve this process is faster."""
        return self._runner if len(samples) >= FEWEST else Runner()

    def _included(self) -> tuple[tuple[Outcome, ...], list[bool]]:
        """Return the current samples, and which of them samples.exclude does not contain."""
        outcomes = tuple(o for o in self._samples.streams.copied().outcomes if o.sample)
        exclude = self._samples.config.samples.exclude
        return outcomes, [o.number not in exclude for o in outcomes]

    def objection(self, outcome: Outcome) -> str:
        """Return a sentence if the laser crosses an estimated edge at too small an angle."""
        last = self.review
        if outcome.sample is None or last is None or (
                last.solution.degrees_of_freedom < SURE_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, last.solution, self._samples.config)

    def _advise(self, settings: int, refused_poses: list[Array]) -> None:
        """Compute the guidance from the current samples."""
        cleared, config = self._samples.cleared, self._samples.config
        current = self._samples.streams.latest.current(config)
        if current:
            self.extremes = extremes(np.concatenate([self.extremes, current.points]))
        outcomes, included = self._included()
        samples = sorted((o.sample for o, use in zip(outcomes, included, strict=True)
                          if use and o.sample), key=lambda sample: sample.stamp)
        advice = self._runner_for(samples).run(pipeline.advise, samples, config, self.extremes,
                                               refused_poses)
        with self._samples.streams.lock:
            if self._samples.cleared == cleared:
                self.advice, self._basis = advice, (settings, len(refused_poses))
                self.advised = max((o.number for o in outcomes), default=0)
        self.on_change()


def _stops(outcomes: tuple[Outcome, ...]) -> list[tuple[int, int]]:
    """Return the parts of outcomes that do not change when further profiles arrive."""
    return [(outcome.number, outcome.stop.began) for outcome in outcomes]
