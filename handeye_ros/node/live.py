# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A running session without ROS: samples, review, advice, answer and verification.

The way of a message: the drain thread (streams.py) calls add_profile or add_poses, which put it
into the session. A stop that is over, or long enough, waits in `waiting` or `early` for the
worker, which has it evaluated in another process, stores it on the disk, puts the outcome into the
session and calls `changed`: this publishes ~/samples (outputs.py). What is used is stored, and
what is stored is used.

Threads: the drain thread; the worker (one, here), which changes all but what messages change, and
but the note that a verdict is being computed; the threads of ROS (node.py) and of the page, which
ask the worker and wait for it. Stops are evaluated, and reviews, solves and verifications
computed, in two processes (pool.py); the worker waits for the stops alone. Locks: `lock` for what
messages change, held for at most one message; one in outputs.py, so that nothing is published
after the end; one in node.py, so that settings change one by one.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from threading import Lock
import time
from typing import Any, Concatenate, ParamSpec, TypeVar

from handeye_ros import pipeline, se3
from handeye_ros.agreement import Agreement, agreements, count_of, flat_crossing, sample_summary
from handeye_ros.bags.session import (
    CONFIGURED,
    Event,
    OutputFolders,
    REMOVED,
    SessionFiles,
)
from handeye_ros.config import Config, flatten
from handeye_ros.data import (
    AnyProfile,
    Array,
    Calibration,
    Feature,
    Reject,
    Sample,
    TimedPose,
)
from handeye_ros.errors import (
    DataError,
    FeatureError,
    HandeyeError,
    InputError,
    UnusableMessageError,
)
from handeye_ros.estimation.solve import Solution
from handeye_ros.guidance.advice import Advice, advise
from handeye_ros.guidance.view import extremes
from handeye_ros.node.pool import Pool, PoolEndedError, result_or_ended, trim_memory, Worker
from handeye_ros.node.state import calibration_summary, MessageCount
from handeye_ros.output import folder_name, write_whole
from handeye_ros.results import calibration_file, exports
from handeye_ros.sampling.collector import silent_poses
from handeye_ros.sampling.features import features_of, result_of
from handeye_ros.sampling.session import Outcome, Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.stream import interpolate
from handeye_ros.verification.session import VerificationSession
from handeye_ros.verification.verify import sentence, time_of, Verification, yaml_text
import numpy as np

# Keys, or prefixes of keys, that affect the sample of a stop, or the answer from given stops.
SAMPLE_KEYS = ('method', 'profile.', 'target.', 'noise.sensor', 'sampling.min_points',
               'sampling.settle_time', 'time_offset', 'rotation_lag_std', 'clock_drift_std')
ANSWER_KEYS = (*SAMPLE_KEYS, 'calibration_type', 'noise.', 'limits.', 'samples.',
               'sampling.min_crossing_angle')
COMPUTED, VERIFIED = 'the calibration is computed', 'the calibration is verified'
MOST_STOPS = 16  # waiting for evaluation: at most 7 MB each with 1280 points a profile
KEPT_JOINTS = 20_000  # messages with joint values: more than those of the longest stop
KEPT_LATEST = 100  # messages of a kind: one of the two streams may be late
SURE_FREEDOM = 6  # smallest degrees of freedom of a review for valid angles at the edges
# s without a pose after which the pose is unknown: while profiles arrive, and if both stop
POSES_SILENT, BOTH_SILENT = 2.0, 30.0
PROFILES_COME = 1.0  # s since the last profile

Arguments = ParamSpec('Arguments')
Result = TypeVar('Result')


def by_worker(method: Callable[Concatenate[LiveSession, Arguments], Result]
              ) -> Callable[Concatenate[LiveSession, Arguments], Result]:
    """Let the worker run a method, and wait for its result or exception."""
    @wraps(method)
    def asked(live: LiveSession, /, *args: Arguments.args, **named: Arguments.kwargs) -> Result:
        try:
            return live.worker.ask(partial(method, live, *args, **named))
        finally:
            live.wake()
    return asked


@dataclass(frozen=True, eq=False)
class Review:
    """
    What follows from the samples: their answer, how each agrees with it, and the advice.

    answer: None before the first; agreements: of the samples by their numbers; no_agreements: why
    there are none; advised: the number of the last sample in the advice, 0 for none; basis:
    identifies samples and settings that it follows from.
    """

    advice: Advice
    answer: pipeline.Answer | None = None
    agreements: Mapping[int, Agreement] = field(default_factory=dict)
    no_agreements: str = ''
    advised: int = 0
    basis: object = None

    @property
    def solution(self) -> Solution | None:
        """Return the solution of the answer, however uncertain."""
        return self.answer.solution if self.answer else None


def review_of(session: Session, config: Config, seen: Array, refused: Sequence[Array],
              asked: bool) -> Review:
    """
    Return what follows from the samples of a session.

    seen, refused: see advise; asked: whether somebody waits for the answer: then the
    cause of a refusal is searched in the stops.
    """
    answer = pipeline.answer(session.samples, session.rejects, config, session.frame_id,
                             session if asked else None)
    samples = {one.number: one.sample for one in session.outcomes if one.sample}
    found = dict(zip(samples, agreements(answer, list(samples.values()), config), strict=True))
    in_order = sorted(session.samples, key=lambda sample: sample.stamp)
    return Review(advise(in_order, config, answer, seen, refused), answer,
                  {number: one for number, one in found.items() if one},
                  '' if answer.solution else str(answer.refusal), max(samples, default=0))


@dataclass(frozen=True, eq=False)
class Attempt:
    """An attempt to take a sample; number: of the sample or the stop, 0 where it has none."""

    text: str
    number: int = 0
    sample: Sample | None = None


@dataclass(frozen=True, eq=False)
class Current:
    """
    The current points (n, 2) and features in the sensor plane, at T_base_flange (4, 4).

    reason: why there are no features, empty where there are some.
    """

    T_base_flange: Array
    points: Array
    features: tuple[Feature, ...]
    reason: str = ''


class LiveSession:
    """
    All functions of the running node.

    Whoever holds lock may use session, waiting, early, joints and the latest messages; all else is
    changed by the worker alone, and read at any time. calibration: the last answer that was not
    refused; missing: why there is none; withdrawn: whether there was one that is not valid any
    more; attempt: the last one; verdict: of the last verification; seen: visible points (k, 2) at
    the ends of the field of view.
    """

    def __init__(self, config: Config, folders: OutputFolders, files: SessionFiles, pool: Pool,
                 changed: Callable[[], object]) -> None:
        """
        Start without samples; raises BadValueError for a method that does not exist.

        pool: where long computations run; changed: called by the worker after every change.
        """
        self.config, self.folders, self.files = config, folders, files
        self.pool, self._changed = pool, changed
        self.lock = Lock()
        self.session = Session(config)
        self.waiting: deque[Stop] = deque()  # complete stops, not yet evaluated
        self.early: Stop | None = None  # the current stop, once it has enough profiles
        self.joints: deque[tuple[int, bytes]] = deque(maxlen=KEPT_JOINTS)
        self._profiles: deque[AnyProfile] = deque(maxlen=KEPT_LATEST)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT_LATEST)
        self.messages = {kind: MessageCount(kind) for kind in ('profile', 'pose')}
        self._left_out = 0  # stops that waited too long

        self.worker = Worker(changed)
        self._woken = False
        self._running: list[str] = []  # long computations in words, '' for a review
        self._stale: deque[int] = deque()  # numbers of stops to be evaluated again
        self._store_trouble = ''

        self.attempt: Attempt | None = None
        self._refused: dict[int, Array] = {}  # T_base_flange of stops without a sample, by start
        self.seen = np.zeros((0, 2))
        self.review = Review(advise((), config))

        self.calibration: Calibration | None = None
        self.missing, self.withdrawn = '', False
        self._asked_with: object = None  # settings of the last attempt to compute it, if any
        self._solved: set[int] = set()  # numbers of its samples
        self._wanted: tuple[Any, ...] = ()  # folder, formats and answer that were saved last,
        self._saved: exports.Saved | None = None  # and the files
        self._verifying: VerificationSession | None = None
        self.verdict = ''

    # messages

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        with self.lock:
            self.messages['profile'].add(profile.stamp)
            self._profiles.append(profile)
            self.session.add_profile(profile)
            self._queue_stops()
            if self._verifying and self._verifying.scans:
                self._verifying.parts[-1].add_profile(profile)

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        with self.lock:
            for pose in poses:
                self.messages['pose'].add(pose.stamp)
                self._poses.append(pose)
                self.session.add_pose(pose)
            self.early = self.session.early() or self.early
            self._queue_stops()
            if self._verifying and self._verifying.scans:
                self._verifying.parts[-1].add_poses(poses)

    def add_joints(self, stamp: int, data: bytes) -> None:
        """Keep a serialised JointState, to be stored with the stop of its time."""
        with self.lock:
            self.joints.append((stamp, data))

    def _queue_stops(self) -> None:
        """Queue stops for evaluation; drop the oldest if too many wait."""
        self.session.keep_waiting(MOST_STOPS)
        self.waiting.extend(self.session.passed())
        while len(self.waiting) > MOST_STOPS:
            self.waiting.popleft()
            self._left_out += 1
        if self.waiting or self.early:
            self.wake()

    @property
    def pose(self) -> Array | None:
        """Return T_base_flange (4, 4) of the last pose, None before the first."""
        with self.lock:
            last = self._poses[-1] if self._poses else None
        return None if last is None else se3.from_quaternion(last.translation, last.quaternion)

    def current(self) -> Current | None:
        """Return the last usable profile with poses before and after it; None without one."""
        config = self.config
        with self.lock:
            profiles = list(self._profiles)
            # of equal stamps, as in a repeated playback, the last pose counts
            by_stamp = {pose.stamp: pose for pose in self._poses}
        poses = sorted(by_stamp.values(), key=lambda pose: pose.stamp)
        inside = [p for p in profiles if poses and poses[0].stamp <= p.stamp <= poses[-1].stamp]
        if len(poses) < 2 or not inside:
            return None
        try:
            profile = inside[-1].read(config.profile)
        except UnusableMessageError:
            return None
        (T,) = interpolate(poses, [profile.stamp])
        try:
            return Current(T, profile.points, features_of(profile, config))
        except FeatureError as error:
            return Current(T, profile.points, (), str(error))

    # the worker

    def start(self) -> None:
        """Start the worker and the processes."""
        self.worker.start()
        self.pool.start()
        self.wake()

    def wake(self) -> None:
        """Have the worker look for what is due."""
        if self.worker.runs and not self._woken:
            self._woken = True
            self.worker.later(self._go_on)

    def _go_on(self) -> None:
        """Evaluate what is due, stop by stop: who has asked meanwhile waits for one stop only."""
        self._woken = False
        if self._evaluate_one():
            self.wake()

    def update(self) -> None:
        """Evaluate all that is due; for a session without a worker."""
        while self._evaluate_one():
            pass
        self._changed()

    def _evaluate_one(self) -> bool:
        """Evaluate one stop, or, if none is due, begin the review of the samples."""
        with self.lock:
            over = bool(self.waiting)
            stop = self.waiting.popleft() if over else self.early
            self.early = self.early if over else None
        if stop:
            self._evaluate(stop, over)
            self.files.sync()
            trim_memory()
        elif self._stale:
            self._evaluate_again(self._stale.popleft())
        else:
            self._begin_review()
            return False
        return True

    # what others tell of it

    def copied(self) -> Session:
        """Return a copy of the session at this moment."""
        with self.lock:
            return self.session.copied()

    @property
    def framed(self) -> Config:
        """Return the current settings with the frame of the poses as the base frame."""
        return self.session.with_base(self.config)

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""
        return str(self.files.path or '')

    @property
    def pose_topic(self) -> str:
        """Return where the poses come from."""
        return self.config.pose_topic if self.config.pose_source == 'topic' else '/tf'

    @property
    def working(self) -> str:
        """Return the running tasks in words; empty without any."""
        again = 'the samples are extracted again from their profiles' if self._stale else ''
        return '; '.join(filter(None, (*self._running, again)))

    @property
    def troubles(self) -> tuple[str, ...]:
        """Return why samples cannot be stored or computed with, one sentence each."""
        return tuple(filter(None, (self._store_trouble, self.worker.failure)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings, one sentence each."""
        warnings = []
        if self._verifying:
            warnings.append(f'a verification ({self._verifying.routine.name}) continues: stops '
                            'are not samples until ~/verify_result')
        if self._left_out:
            warnings.append(f'left {self._left_out} stops out, the oldest of more than '
                            f'{MOST_STOPS} that waited to be evaluated: the processor cannot keep '
                            'up; stop less often, or publish fewer points')
        return tuple(warnings)

    @property
    def verification(self) -> str:
        """Return the progress of the verification in words; empty without one."""
        return self._verifying.text if self._verifying else ''

    @property
    def saved(self) -> str:
        """Return the file of the current answer, empty before it is saved."""
        if self._saved is None or self._wanted[-1] is not self.calibration:
            return ''
        return str(self._saved.files[0])

    def changes(self, session: Session) -> str:
        """Return how the samples of a session differ from those of the answer, or ''."""
        now = _numbers(session)
        removed, added = len(self._solved - now), len(now - self._solved)
        if not removed and not added:
            return ''
        differences = ' and '.join([f'{removed} removed'] * bool(removed)
                                   + [f'{added} added'] * bool(added))
        return (f'; it was computed from {count_of(len(self._solved), "sample")}, which have '
                f'changed since ({differences}): call ~/compute_calibration for an answer from '
                f'the current {len(now)}')

    # samples

    def _result(self, stop: Stop, config: Config) -> Sample | Reject:
        """Return what a stop gives."""
        needed = stop if stop.source else stop.needed(config)
        try:
            return self.pool.run(result_of, needed, config)
        except PoolEndedError as error:  # nothing is lost: the stop itself will be stored
            return Reject(stop.began, str(error))

    def _outcome(self, stop: Stop) -> Outcome:
        """Return the outcome of a stop, not yet in the session."""
        return self.session.outcome(stop, self._result(stop, self.config))

    def _put(self, outcome: Outcome, over: bool = True) -> None:
        """Put an outcome into the session, in place of an earlier one of its stop."""
        with self.lock:
            self.session.put(outcome, over)

    def _stored(self, outcome: Outcome) -> Outcome:
        """Store an outcome; return the stored form. Raises InputError, kept as trouble."""
        with self.lock:
            joints = list(self.joints)
        try:
            stored = self.files.add(outcome, self.config, joints)
        except InputError as error:
            self._store_trouble = str(error)
            raise
        self._store_trouble = ''
        return stored

    def _evaluate(self, stop: Stop, over: bool) -> None:
        """Put the outcome of a stop into the session, replacing an earlier one."""
        if not over and self.session.is_taken(stop):
            return
        if self._verifying:
            with suppress(DataError):
                self._verify(stop, over)
            return
        outcome = self._outcome(stop)
        earlier = next((o for o in self.session.outcomes if o.number == outcome.number), None)
        remark = self._objection(outcome)  # no refusal, as in the solution of a recording
        try:
            outcome = self._stored(outcome)
        except InputError as error:
            if earlier and earlier.stop.source:
                outcome = earlier  # of fewer profiles, but on the disk
            else:
                outcome = Outcome(outcome.number, stop, Reject(outcome.result.stamp, str(error)),
                                  refused=str(error))
        if outcome.sample is None:
            self._refused[stop.began] = stop.pose(self.config)
        self._put(outcome, over)
        if earlier and bool(earlier.sample) == bool(outcome.sample):
            return  # the same result with more profiles is not reported again
        verdict = (f'sample {outcome.number} taken' if outcome.sample else
                   f'stop {outcome.number} gave no sample')
        self.attempt = Attempt('; '.join(filter(None, (
            f'{verdict}: {sample_summary(outcome.result)}', remark))),
            outcome.number, outcome.sample)

    def _evaluate_again(self, number: int) -> None:
        """Evaluate a stop by the current settings; one that cannot be stored stays refused."""
        outcome = next((o for o in self.session.outcomes if o.number == number), None)
        if outcome and not outcome.stop.source:  # it could not be stored before
            with suppress(InputError):
                self._put(self._stored(self._outcome(outcome.stop)), over=False)
        elif outcome and not outcome.refused:
            result = self._result(outcome.stop, self.config)
            self._put(replace(outcome, result=result), over=False)

    def _evaluate_all(self, rest: bool) -> None:
        """Evaluate all stops that wait; rest: the current stop counts as complete."""
        while self._stale:
            self._evaluate_again(self._stale.popleft())
        with self.lock:
            last = self.session.copied().rest() if rest else []  # raises for mixed frames
            stops, self.early = [*self.waiting, *last], None
            self.waiting.clear()
        for stop in stops:
            self._evaluate(stop, True)

    def _objection(self, outcome: Outcome) -> str:
        """Return a sentence if the laser crosses an estimated edge at too small an angle."""
        solution = self.review.solution
        if outcome.sample is None or solution is None or (
                solution.degrees_of_freedom < SURE_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, solution, self.config)

    @by_worker
    def take_sample(self) -> str:
        """Take a sample at the current stop; raises DataError, or InputError unstored."""
        silence = self.messages['pose'].silence
        limit = POSES_SILENT if self.messages['profile'].silence < PROFILES_COME else BOTH_SILENT
        try:
            if self.messages['pose'].count and silence > limit:
                raise silent_poses(silence)
            with self.lock:
                stop = self.session.current_stop()
            return self._verify(stop, True) if self._verifying else self._take_at(stop)
        except HandeyeError as error:
            self.attempt = Attempt(str(error))
            raise

    def _take_at(self, stop: Stop) -> str:
        outcome = self._outcome(stop)
        if outcome.refused:
            raise DataError(f'{outcome.refused}: move on, and turn the tool')
        objection = self._objection(outcome)
        if objection or outcome.sample is None:
            self._refused[stop.began] = stop.pose(self.config)
            raise DataError(f'{objection}, and take the sample again' if objection else
                            sample_summary(outcome.result))
        again = any(o.stop.began == stop.began for o in self.session.outcomes)
        self._put(self._stored(outcome))
        note = ' again, as the robot has not moved since' if again else ''
        text = f'sample {outcome.number} taken{note}: {sample_summary(outcome.sample)}'
        self.attempt = Attempt(text, outcome.number, outcome.sample)
        return text

    @by_worker
    def remove_last_sample(self) -> str:
        """Forget the last sample; raises DataError when there is none, InputError unstored."""
        samples = [outcome for outcome in self.session.outcomes if outcome.sample]
        if not samples:
            raise DataError('there is no sample to remove', reason='nothing_to_remove')
        last = samples[-1]
        self.files.append(Event(REMOVED, self.config, last.number))
        with self.lock:
            self.session.remove(last)
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{len(samples) - 1} left')

    @by_worker
    def clear_samples(self) -> str:
        """Forget samples, verification, answer, and all messages; raises InputError."""
        note = ''
        if self.files.path:
            note = f'; they are kept in {self.path}'
            self.files = self.files.restarted(self.config)
        count = self._forget('the samples were cleared')
        return f'{count_of(count, "sample")} removed; bags and clocks may start again{note}'

    def _forget(self, why: str) -> int:
        """Forget stops, messages, and what follows; return the number of samples there were."""
        count = sum(outcome.sample is not None for outcome in self.session.outcomes)
        with self.lock:
            for messages in (self._profiles, self._poses, self.waiting, self._stale):
                messages.clear()
            self.session.clear()
            self.early = self._verifying = None
        self.attempt, self._refused, self._asked_with = None, {}, None
        self.review = Review(advise((), self.config))
        self._withdraw(why)
        return count

    def restore(self, session: Session, old_config: Config) -> str:
        """
        Continue with the stops of an earlier run, and solve; return the message.

        old_config: its settings; the current ones are stored if they differ. Raises
        UnwritableError.
        """
        with self.lock:
            self.session = session
        if replace(old_config, session=self.config.session) != self.config:
            self.files.append(Event(CONFIGURED, self.config))
        self._asked_with = {} if session.samples else None  # as with other settings: solve again
        count = sum(outcome.sample is not None for outcome in session.outcomes)
        return f'continuing with {count_of(count, "sample")} of {self.path}'

    @by_worker
    def open(self, files: SessionFiles, session: Session, old_config: Config) -> str:
        """Continue with another session; see restore."""
        self._forget('another session was opened')
        self.files.close()
        self.files = files
        return self.restore(session, old_config)

    @by_worker
    def configure(self, config: Config) -> None:
        """Apply another configuration, already checked by the node."""
        old = self.config
        with self.lock:
            self.config = config
            self.session.configure(config)
            if config.verify.routine != old.verify.routine:
                self._verifying = None
        if _values(config, SAMPLE_KEYS) != _values(old, SAMPLE_KEYS):
            self._stale = deque(outcome.number for outcome in self.session.outcomes)
        try:
            if self.files.path:
                self.files.append(Event(CONFIGURED, config))
            self._store_trouble = ''
        except InputError as error:
            self._store_trouble = str(error)

    # review and answer: computed by the solver, together

    def compute_calibration(self) -> str:
        """
        Compute the answer from all samples; return the message about it.

        The current stop counts as complete. Raises DataError or InputError where there is no
        answer; after a DataError the previous answer is withdrawn.
        """
        return self._solve().result()

    @by_worker
    def _solve(self) -> Future[str]:
        """Begin to solve; return the future of the message."""
        self._asked_with = _values(self.config, ANSWER_KEYS)
        try:
            self._evaluate_all(rest=True)
            session = self.copied()
            if session.conflict:
                raise session.conflict
            session.require_stations()
        except HandeyeError as error:
            self._refuse(error)
            raise
        return self._submit(asked=True)

    def _basis(self) -> tuple[object, ...]:
        """Return what identifies samples and settings; a session by its files."""
        return (self.files, _values(self.config, (*ANSWER_KEYS, 'guidance.')), len(self._refused),
                [(o.number, o.stop.began) for o in self.session.outcomes if o.sample])

    def _begin_review(self) -> None:
        """Begin the review, if samples or settings have changed."""
        outdated = self._asked_with not in (None, _values(self.config, ANSWER_KEYS))
        if not self._running and (outdated or self._basis() != self.review.basis):
            self._submit(asked=outdated)

    def _submit(self, asked: bool) -> Future[str]:
        """Begin the review; return the future of the message. asked: whether for the answer."""
        current, config, now = self.current(), self.framed, self.session
        if current:
            self.seen = extremes(np.concatenate([self.seen, current.points]))
        if asked:
            self._asked_with = _values(config, ANSWER_KEYS)
        session = Session(config)  # the messages of the streams stay here
        session.restore(now.outcomes, now.numbers, now.frame_id)
        sampled = {outcome.stop.began for outcome in now.outcomes if outcome.sample}
        refused = [T for began, T in self._refused.items() if began not in sampled]
        basis, answered = self._basis(), Future[str]()
        job = self.pool.submit(review_of, session, config, self.seen, refused, asked)
        self._running.append(COMPUTED if asked else '')
        job.add_done_callback(lambda done: self.worker.later(
            self._put_review, done, basis, session, asked, answered))
        return answered

    def _put_review(self, job: Future[Review], basis: tuple[object, ...], session: Session,
                    asked: bool, answered: Future[str]) -> None:
        self._running.remove(COMPUTED if asked else '')
        try:
            review = result_or_ended(job)
            if basis[0] is not self.files:
                raise DataError('the samples were cleared while the calibration was computed, so '
                                'there is no answer: take new samples')
            self.review = replace(review, basis=basis)
            answered.set_result(self._put_answer(review, session) if asked else '')
        except Exception as error:
            answered.set_exception(error)
            if isinstance(error, PoolEndedError):  # no refusal: the previous answer stays
                self.review = replace(self.review, no_agreements=str(error), basis=basis)
            elif not isinstance(error, HandeyeError):
                raise
        self._begin_review()  # samples or settings may have changed meanwhile

    def _put_answer(self, review: Review, session: Session) -> str:
        """Publish an answer, and return the message about it; raises DataError for a refusal."""
        assert review.answer is not None
        try:
            calibration = review.answer.required()
        except DataError as error:
            self._refuse(error)
            raise
        inputs = [{'topic': self.config.profile_topic}, {'topic': self.pose_topic}]
        inputs += [{'session': self.path}] * bool(self.path)
        self.calibration = replace(calibration,
                                   provenance={**calibration.provenance, 'inputs': inputs})
        self._solved = _numbers(session)
        self.missing, self.withdrawn = '', False
        return calibration_summary(calibration)

    def _refuse(self, error: HandeyeError) -> None:
        """Withdraw the answer after a refusal; what only disturbs the streams withdraws none."""
        reason = f'the last attempt to compute it was refused ({error})'
        if isinstance(error, DataError):
            self._withdraw(reason)
        elif self.calibration is None:
            self.missing = reason

    def _withdraw(self, reason: str) -> None:
        """Remove the answer, with the reason for its state."""
        self.withdrawn = self.withdrawn or self.calibration is not None
        self.calibration, self.missing = None, reason

    @by_worker
    def save_calibration(self) -> str:
        """Write the answer; return the message. Raises DataError without one, InputError."""
        calibration, config = self.calibration, self.config
        if calibration is None:
            raise DataError('there is no calibration to save: call ~/compute_calibration first, '
                            'and check that it succeeds')
        folder = self.folders.own(config)
        wanted = folder, config.save.formats, calibration
        if self._saved and self._wanted == wanted and self._saved.files[0].is_file():
            text = f'saved already: {", ".join(map(str, self._saved.files))}'
        else:
            self._saved = exports.save_all(replace(calibration, name=folder_name(config)), folder,
                                           config.save.formats)
            self._wanted, text = wanted, str(self._saved)
        note = (f'; {COMPUTED} again: save it again after that'
                if COMPUTED in self._running else '')
        return f'{text}{self.changes(self.copied())}{note}'

    # verification: stops give no samples until its result

    @by_worker
    def verify_start(self) -> str:
        """
        Begin a verification, or the next part (face, ball, pass) of the current one.

        Raises InputError for the settings, DataError without a calibration.
        """
        self._evaluate_all(rest=False)
        verifying = self._verifying
        if verifying is None or verifying.is_full:
            verifying = VerificationSession(self.config)
            self._verified()  # may read a file
        else:
            verifying.go_on()
        with self.lock:
            for stop in self.session.copied().rest():  # they began before
                self.session.leave(stop)
            self._verifying = verifying
        advice = 'scan the gauge' if verifying.scans else 'move on, and stop with other tilts'
        return (f'{verifying.text}; {advice}: what begins from now on counts, until '
                '~/verify_result')

    def _verify(self, stop: Stop, over: bool) -> str:
        """Add a stop, and again when it is over; return the progress. Raises DataError."""
        verifying = self._verifying
        assert verifying
        if over:
            with self.lock:
                self.session.leave(stop)
        if verifying.scans:
            raise DataError(f'{verifying.text}: stops do not count, points are taken while the '
                            'robot moves')
        result = verifying.add(stop, self.config, self._result)
        text = f'{verifying.text}; {sample_summary(result)}'
        if isinstance(result, Reject):
            self.attempt = Attempt(f'verification: {text}')
            raise DataError(result.reason)
        self.attempt = Attempt(f'verification: {text}', sample=result)
        return text

    def verify_result(self) -> str:
        """
        Write the verdict with its figures; the current stop counts as complete.

        Raises DataError without a verification, a calibration or enough stops, and where it is
        neither pass nor fail: the verification then continues.
        """
        session, calibration, config = self._measured()
        self._running.append(VERIFIED)
        try:
            result = self.pool.run(session.result, calibration, config)
        finally:
            self._running.remove(VERIFIED)
            self.wake()
        return self._put_verdict(result)

    @by_worker
    def _measured(self) -> tuple[VerificationSession, Calibration, Config]:
        if self._verifying is None:
            raise DataError('no verification was started: call ~/verify_start, and measure the '
                            'artefact')
        self._evaluate_all(rest=True)
        with self.lock:
            return self._verifying.copied(), self._verified(), self.config

    @by_worker
    def _put_verdict(self, result: Verification) -> str:
        self.verdict, verified = sentence(result), self.config.verify.calibration
        file = self.folders.own(self.config) / f'verification_{result.routine}.yaml'
        previous = exports.set_aside(file.parent, [file.name], {file.name})
        write_whole(file, yaml_text(replace(
            result, inputs=(self.config.profile_topic, self.pose_topic),
            created=time_of(time.time_ns()), calibration_file=calibration_file.input_values(
                Path(verified).expanduser()) if verified else {})))
        text = f'{self.verdict}; {exports.Saved((file,), previous)}'
        if result.verdict not in ('pass', 'fail'):
            raise DataError(f'{result.verdict}: ' + '; '.join((*result.reasons, text)))
        self._verifying = None
        return text

    def _verified(self) -> Calibration:
        """Return the calibration of verify.calibration, or the answer; raises HandeyeError."""
        file = self.config.verify.calibration
        if file:
            return calibration_file.read_calibration(Path(file).expanduser())
        if self.calibration is None:
            raise DataError('there is no calibration to verify: call ~/compute_calibration, or '
                            'set verify.calibration to the file of one')
        return self.calibration


def _numbers(session: Session) -> set[int]:
    """Return the numbers of the samples that an answer uses; none is ever used again."""
    return {outcome.number for outcome in session.outcomes
            if outcome.sample and not session.excludes(outcome)}


def _values(config: Config, keys: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings whose keys begin with some of these."""
    return {key: value for key, value in flatten(config).items() if key.startswith(keys)}
