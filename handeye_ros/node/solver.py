# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What follows from the samples of a running session: answer, review and advice, computed together.

The review begins by itself where samples or settings have changed since the last one; one that
fails is made again after the next work. The answer is computed when it is asked for, and from then
on again whenever settings change that affect it.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TYPE_CHECKING

from handeye_ros import pipeline
from handeye_ros.config import Config, flatten, record_texts
from handeye_ros.data import Agreement, Array, Calibration, Sample
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.guidance.advice import Advice, advise
from handeye_ros.guidance.view import extremes
from handeye_ros.output import folder_name
from handeye_ros.results import calibration_file, exports
from handeye_ros.results.printed import transform_rows
from handeye_ros.review import agreements
from handeye_ros.sampling.session import Session
from handeye_ros.words import count_of
import numpy as np

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession

# Keys, or the sections of keys, that affect the sample of a stop, or the answer from given stops.
SAMPLE_KEYS = ('method', 'profile.', 'target.', 'noise.sensor', 'time_offset',
               'sampling.mode', 'sampling.min_points', 'sampling.settle_time',
               'sampling.max_pose_gap')
ANSWER_KEYS = (*SAMPLE_KEYS, 'calibration_type', 'noise.', 'limits.', 'samples.',
               'time_offset_std', 'rotation_lag_std', 'clock_drift_std',
               'sampling.min_crossing_angle')
COMPUTING = 'the calibration is computed'


class ReviewKey(NamedTuple):
    """The inputs of a review: where two are equal, so are their reviews."""

    answer_settings: Mapping[str, Any]
    session: Session
    guidance_settings: Mapping[str, Any]
    # by number: a stop that goes on gives another sample of the same number
    samples: Sequence[tuple[int, Sample | None]]


@dataclass(frozen=True, eq=False)
class Review:
    """
    The review of the samples: their answer, how each agrees with it, and the advice.

    agreements: of each sample by its number, empty without a solution
    advised: the number of the last sample in the advice, 0 for none
    """

    advice: Advice
    answer: pipeline.Answer
    agreements: Mapping[int, Agreement]
    advised: int


def review_of(session: Session, config: Config, view: Array, with_cause: bool) -> Review:
    """
    Return the review of the samples of a session.

    view: visible points (k, 2) at the ends of the field of view; with_cause: whether the cause of
    a refusal is searched in the stops, which takes long: where somebody waits for the answer, or
    has one.
    """
    in_order = sorted(session.samples, key=lambda sample: sample.stamp)
    answer = pipeline.answer_samples(in_order, session.rejects, config, session.frame_id,
                                     session if with_cause else None)
    failed = [stop.T_base_flange for stop in session.stops if stop.poses and not stop.sample]
    return Review(advise(in_order, config, answer, view, failed), answer,
                  agreements(session, answer),
                  max((stop.number for stop in session.stops if stop.sample), default=0))


class LiveSolver:
    """
    Reviews and solves the samples of a running session; for the worker (see live.py).

    review: the last review of the samples
    calibration: the last answer that was asked for, None where it was refused
    solved_session: the session of the last accepted answer, kept when the answer is withdrawn
    why_missing: why there is no calibration
    saved: the file of the calibration, '' before it is saved
    is_wanted: whether somebody has asked for an answer: other settings then compute it again
    view: visible points (k, 2) at the ends of the field of view
    """

    def __init__(self, live: LiveSession) -> None:
        """Start without an answer."""
        self._live = live
        self.solved_session: Session | None = None
        self.forget('no calibration has been computed yet')

    def forget(self, why: str) -> None:
        """Begin anew with other samples; why: the reason why there is no answer any more."""
        config, self.view = self._live.config, np.zeros((0, 2))
        self.review = review_of(Session(config), config, self.view, with_cause=False)
        self.calibration: Calibration | None = None
        self.why_missing, self.saved, self.is_wanted = why, '', False
        self._review_inputs: ReviewKey | None = None  # of self.review, None without samples
        self._newest_inputs: ReviewKey | None = None  # of the last review that was begun
        self._answer_inputs: ReviewKey | None = None  # of the last answer that was asked for
        self._answer_message = Future[str]()  # about that answer

    def changes_since(self, session: Session) -> str:
        """Return a sentence: how samples of a session differ from those of the answer, or ''."""
        now = _used_samples(session)
        before = _used_samples(self.solved_session or session)
        retaken = [n for n in now.keys() & before.keys() if now[n] != before[n]]
        changes = ' and '.join(f'{len(numbers)} {what}' for numbers, what in (
            (before.keys() - now.keys(), 'removed'), (now.keys() - before.keys(), 'added'),
            (retaken, 'retaken')) if numbers)
        return changes and (
            f'it was computed from {count_of(len(before), "sample")}, which have changed since '
            f'({changes}): call ~/compute_calibration for an answer from the current {len(now)}')

    def require_calibration(self, use: str = 'save') -> Calibration:
        """Return the answer with the current name and record; raises DataError without one."""
        if self.calibration is None:
            raise DataError(f'there is no calibration to {use}: call ~/compute_calibration first, '
                            'and check that it succeeds')
        config, provenance = self._live.config, self.calibration.provenance
        settings = {**provenance['config'], **record_texts(config)}
        return replace(self.calibration, name=folder_name(config),
                       provenance={**provenance, 'config': settings})

    def compute_calibration(self) -> Future[str]:
        """
        Compute the answer from all samples; return the future of the message about it.

        The current stop counts as complete. It, or its future, raises DataError or InputError
        where there is no answer; after a DataError the previous answer is withdrawn. An answer is
        not computed again from the same samples and settings.
        """
        live = self._live
        live.retry_failed()
        self.is_wanted = True
        try:
            live.evaluate_all()
            live.session_copy().require_any_stop()
        except HandeyeError as error:
            self._refuse(error)
            raise
        if self._answer_inputs == self._inputs():
            message = self._answer_message
            if not message.done() or (self.calibration and not message.exception()):
                return message
        return self._begin_review(is_requested=True)

    def review_if_changed(self) -> None:
        """Begin the review, if samples or settings have changed."""
        inputs, before = self._inputs(), self._review_inputs
        if not self._live.worker.running_jobs and inputs != before:
            other_settings = not before or inputs.answer_settings != before.answer_settings
            self._begin_review(is_requested=self.is_wanted and other_settings)

    def _inputs(self) -> ReviewKey:
        """Return the inputs that a review would have now."""
        config, session = self._live.config, self._live.session
        return ReviewKey(settings_of(config, ANSWER_KEYS), session,
                         settings_of(config, ('guidance.',)),
                         [(stop.number, stop.sample) for stop in session.stops])

    def _begin_review(self, is_requested: bool) -> Future[str]:
        """Begin the review, which answers too if requested; return the future of the message."""
        live, inputs = self._live, self._inputs()
        config = live.session.config_with_base_frame(live.config)
        if snapshot := live.current_snapshot():
            self.view = extremes(np.concatenate([self.view, snapshot.points]))
        session = live.session_copy().without_messages(config)
        self._newest_inputs = inputs
        message = live.worker.run_job(
            COMPUTING if is_requested else '',
            partial(self._accept, inputs, session, is_requested),
            review_of, session, config, self.view, is_requested or self.calibration is not None)
        if is_requested:
            self._answer_inputs, self._answer_message = inputs, message
        return message

    def _accept(self, inputs: ReviewKey, session: Session, is_requested: bool, review: Review
                ) -> str:
        """
        Take over a review and, if requested, its answer; return the message about that.

        Raises DataError for a refusal.
        """
        live, answer = self._live, review.answer
        if inputs is self._newest_inputs:  # others may be ready later
            self.review, self._review_inputs = review, inputs
        if not is_requested:
            return ''
        if inputs.session is not live.session:
            raise DataError('the samples were cleared while the calibration was computed, so '
                            'there is no answer: take new samples')
        is_newest = inputs is self._answer_inputs
        if answer.refusal and is_newest:
            self._refuse(answer.refusal)
        calibration = answer.require_calibration()
        if is_newest:  # else the answer is the one that was requested later
            sources = [{'topic': live.config.profile_topic},
                       {'topic': live.config.topic_of_poses}, {'session': live.path}]
            self.calibration = calibration_file.with_origin(replace(
                calibration, provenance={**calibration.provenance, 'inputs': sources}))
            self.solved_session, self.why_missing, self.saved = session, '', ''
        return f'{summary(calibration)}; save it with ~/save_calibration'

    def _refuse(self, error: HandeyeError) -> None:
        """Withdraw the answer after a refusal; what only disturbs the streams withdraws none."""
        if isinstance(error, DataError):
            self.calibration = None
        if self.calibration is None:
            self.why_missing = f'the last attempt to compute it was refused ({error})'

    def save_calibration(self) -> str:
        """Write the answer; return the message. Raises DataError without one, InputError."""
        live, calibration = self._live, self.require_calibration()
        live.retry_failed()
        folder = live.folders.locked_folder(live.config)
        written = exports.save_all(calibration, folder, live.config.save.formats)
        self.saved = str(folder / calibration_file.NAME)
        note = f'{COMPUTING} again: save it again after that'
        return '; '.join(filter(None, (written, self.changes_since(live.session_copy()),
                                       note if COMPUTING in live.worker.running_jobs else '')))


def summary(calibration: Calibration) -> str:
    """Return the transform with its 1 sigma, and the residuals, in words."""
    quality = calibration.quality
    numbers = [f'{value} ± {std}' for _, value, std, _ in transform_rows(calibration)]
    moving = calibration.provenance.get('config', {}).get('sampling.mode') == 'moving'
    used = count_of(quality.samples_used, 'profile' if moving else 'sample')
    warned = ''.join(f'; {text}' for text in calibration.provenance.get('warnings', ()))
    return (f'{calibration.child_frame} in {calibration.parent_frame}: x, y, z = '
            f'{", ".join(numbers[:3])} mm; roll, pitch, yaw = {", ".join(numbers[3:])} degrees; '
            f'residual {quality.residual_rms * 1e3:.3f} mm '
            f'RMS, left out {quality.holdout_rms * 1e3:.3f} mm; {used} used, '
            f'{quality.samples_rejected} not used{warned}')


def _used_samples(session: Session) -> dict[int, tuple[int, int]]:
    """Return stamp and number of profiles of the samples that an answer uses, by their number."""
    return {stop.number: (stop.sample.stamp, stop.sample.profile_count)
            for stop in session.stops if stop.sample and not session.excludes(stop)}


def settings_of(config: Config, keys: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings of keys and of whole sections, whose names end in a dot."""
    return {key: value for key, value in flatten(config).items()
            if key in keys or f'{key.partition(".")[0]}.' in keys}
