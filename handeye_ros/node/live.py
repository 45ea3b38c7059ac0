# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A running session without ROS: samples, review, advice, answer and verification.

The way of a message: the drain thread (streams.py) calls add_profile or add_poses, which put it
into the session. A stop that is over, or long enough, waits in `waiting` or `early` for the
worker, which has it evaluated in another process, stores it on the disk, puts the outcome into the
session and calls `changed`: this publishes ~/samples (outputs.py). What is used is stored, and
what is stored is used.

Threads: the drain thread; the worker (one, here), the only one that changes anything but what
messages change; the threads of ROS (node.py) and of the page, which ask the worker and wait for
it. Two processes (pool.py): the evaluator, which the worker waits for, and the solver, which it
does not. Locks: `lock` for what messages change, held for at most one message; one in outputs.py,
so that nothing is published after the end; one in node.py, so that settings change one by one.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
import time
from typing import Any, TypeVar

from handeye_ros import pipeline
from handeye_ros.bags.session import (
    CONFIGURED,
    Event,
    OutputFolders,
    REMOVED,
    SessionFiles,
)
from handeye_ros.config import Config, flatten
from handeye_ros.data import AnyProfile, Array, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, FeatureError, HandeyeError, InputError
from handeye_ros.estimation.solve import Solution
from handeye_ros.evidence import Agreement, agreements, count_of, flat_crossing, sample_summary
from handeye_ros.guidance.advice import Advice
from handeye_ros.guidance.score import extremes
from handeye_ros.node.arrivals import Arrivals, Latest
from handeye_ros.node.pool import ENDED, Pool, PoolEndedError, trim_memory, Worker
from handeye_ros.node.state import calibration_summary
from handeye_ros.output import folder_name, write_whole
from handeye_ros.results import calibration_file, exports
from handeye_ros.sampling.features import result_of, sample_of
from handeye_ros.sampling.session import judged, Outcome, Session, silent_poses
from handeye_ros.sampling.stops import Stop
from handeye_ros.verification.session import VerificationSession
from handeye_ros.verification.verify import sentence, time_of, Verification, yaml_text
import numpy as np

# Keys, or prefixes of keys, that affect the sample of a stop, or the answer from given stops.
SAMPLE_KEYS = ('method', 'profile.', 'target.', 'noise.sensor', 'sampling.min_points',
               'sampling.settle_time', 'time_offset', 'rotation_lag_std', 'clock_drift_std')
ANSWER_KEYS = (*SAMPLE_KEYS, 'calibration_type', 'noise.', 'limits.', 'samples.',
               'sampling.min_crossing_angle')
COMPUTED = 'the calibration is computed'
MOST_STOPS = 16  # waiting for evaluation: at most 7 MB each with 1280 points a profile
KEPT_JOINTS = 20_000  # messages with joint values: more than those of the longest stop
SURE_FREEDOM = 6  # smallest degrees of freedom of a review for valid angles at the edges
# s without a pose after which the pose is unknown: while profiles arrive, and if both stop
POSES_SILENT, BOTH_SILENT = 2.0, 30.0
PROFILES_COME = 1.0  # s since the last profile

Result = TypeVar('Result')


@dataclass(frozen=True, eq=False)
class Derived:
    """
    What follows from the samples: their answer, how each agrees with it, and the advice.

    answer: None before the first; agreements: of the samples by their numbers; advised: the number
    of the last sample in the advice, 0 for none; basis: identifies samples and settings that it
    follows from.
    """

    advice: Advice
    advised: int = 0
    answer: pipeline.Answer | None = None
    agreements: Mapping[int, Agreement] = field(default_factory=dict)
    no_review: str = ''
    basis: object = None

    @property
    def solution(self) -> Solution | None:
        """Return the solution of the answer, however uncertain."""
        return self.answer.solution if self.answer else None


def derive(samples: Mapping[int, Sample], excluded: frozenset[int], config: Config, seen: Array,
           refused: Sequence[Array]) -> Derived:
    """
    Return what follows from samples, by their numbers.

    excluded: numbers of those that samples.exclude leaves out; seen, refused: see pipeline.advise.
    """
    used = sorted((sample for number, sample in samples.items() if number not in excluded),
                  key=lambda sample: sample.stamp)
    answer = pipeline.answer(used, (), config)
    found = dict(zip(samples, agreements(answer, list(samples.values()), config), strict=True))
    advice = pipeline.advise(used, config, seen, refused, answer)
    return Derived(advice, max(samples, default=0), answer,
                   {number: one for number, one in found.items() if one},
                   '' if answer.solution else str(answer.refusal))


class LiveSession:
    """
    All functions of the running node.

    Whoever holds lock may use session, waiting, early and joints; all else is changed by the
    worker alone, and read at any time. calibration: the last answer that was not refused; missing:
    why there is none; withdrawn: why the previous one was withdrawn; file: where it was saved, ''
    if it was not; last: the last evaluated outcome; attempt: the last attempt to take a sample
    (accepted, number or 0, text); verdict: of the last verification; extremes: visible points
    (k, 2) at the ends of the field of view.
    """

    def __init__(self, config: Config, folders: OutputFolders, files: SessionFiles,
                 evaluator: Pool, solver: Pool, changed: Callable[[], object]) -> None:
        """
        Start without samples; raises BadValueError for a method that does not exist.

        evaluator, solver: where stops are evaluated, and long computations run; changed: called by
        the worker after every change.
        """
        self.config, self.folders, self.files = config, folders, files
        self.evaluator, self.solver, self._changed = evaluator, solver, changed
        self.lock = Lock()
        self.session = Session(config)
        self.waiting: deque[Stop] = deque()  # complete stops, not yet evaluated
        self.early: Stop | None = None  # the current stop, once it has enough profiles
        self.joints: deque[tuple[int, bytes]] = deque(maxlen=KEPT_JOINTS)
        self.arrivals, self.latest = Arrivals(), Latest(self.lock)
        self._skipped = 0  # number of dropped stops

        self.worker = Worker(changed)
        self._woken = False
        self._works: list[str] = []  # that are running, in words
        self._stale: deque[int] = deque()  # numbers of stops to be evaluated again
        self._unstored: set[int] = set()  # numbers of stops that could not be stored
        self._settings = self._cleared = 0  # how often they were changed, or all was cleared
        self._evaluation_trouble = self._store_trouble = ''

        self.attempt: dict[str, Any] | None = None
        self.last: Outcome | None = None
        self._refused: dict[int, Array] = {}  # T_base_flange of stops without a sample, by start
        self.extremes = np.zeros((0, 2))
        self.derived = Derived(pipeline.advise((), config))
        self._deriving = self._outdated = self._requested = False

        self.calibration: Calibration | None = None
        self.missing = self.withdrawn = self.file = ''
        self._solved: frozenset[tuple[int, ...]] = frozenset()  # samples of the answer
        self._saved: tuple[object, str] = None, ''  # what was saved, and the message
        self._verifying: VerificationSession | None = None
        self.verdict = ''

    # messages

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        self.arrivals.add('profile', profile.stamp)
        self.latest.add(profiles=[profile])
        with self.lock:
            self.session.add_profile(profile)
            self._queue_stops()
            if self._verifying and self._verifying.scans:
                self._verifying.parts[-1].add_profile(profile)

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        self.latest.add(poses=poses)
        with self.lock:
            for pose in poses:
                self.arrivals.add('pose', pose.stamp)
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
        stops = self.session.passed()
        self.waiting.extend(stops)
        while len(self.waiting) > MOST_STOPS:
            self.waiting.popleft()
            self._skipped += 1
        if stops or self.early:
            self._wake()

    # the worker

    def start(self) -> None:
        """Start the worker, and the processes, to finish their imports before the first stop."""
        self.worker.start()
        for pool in (self.evaluator, self.solver):
            pool.submit(trim_memory)
        self._wake()

    def stop(self) -> None:
        """End the worker and the processes."""
        self.worker.stop(self.evaluator, self.solver)

    def _ask(self, work: Callable[..., Result], *args: Any) -> Result:
        """Return the result of something that the worker does; raises its exceptions."""
        return self.worker.ask(self._wake, work, *args)

    def _wake(self) -> None:
        """Have the worker look for what is due."""
        if self.worker.runs and not self._woken:
            self._woken = True
            self.worker.later(self._go_on)

    def _go_on(self) -> None:
        """Evaluate what is due, stop by stop: who has asked meanwhile waits for one stop only."""
        self._woken = False
        if self._evaluate_one():
            self._wake()

    def update(self) -> None:
        """Evaluate all that is due; for a session without a worker."""
        while self._evaluate_one():
            pass
        self._changed()

    def _evaluate_one(self) -> bool:
        """Evaluate one stop, or, if none is due, begin what follows from the samples."""
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
            self._derive()
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
    def working(self) -> str:
        """Return the running tasks in words; empty without any."""
        again = ['the samples are extracted again from their profiles'] * bool(self._stale)
        return '; '.join([*self._works, *again])

    @property
    def troubles(self) -> tuple[str, ...]:
        """Return why samples cannot be stored or computed with, one sentence each."""
        return tuple(filter(None, (self._store_trouble, self.worker.failure)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings, one sentence each."""
        verifying = self._verifying
        continues = '' if verifying is None else (
            f'a verification ({verifying.routine.name}) continues: stops are not samples until '
            '~/verify_result')
        skipped = '' if not self._skipped else (
            f'left {self._skipped} stops out, the oldest of more than {MOST_STOPS} that waited to '
            'be evaluated: the processor cannot keep up; stop less often, or publish fewer points')
        return tuple(filter(None, (continues, skipped, self._evaluation_trouble)))

    @property
    def verification(self) -> str:
        """Return the progress of the verification in words; empty without one."""
        verifying = self._verifying
        return verifying.text if verifying else ''

    def changes(self, session: Session) -> str:
        """Return how the samples of a session differ from those of the answer, or ''."""
        now = _identities(session)
        removed, added = len(self._solved - now), len(now - self._solved)
        if not removed and not added:
            return ''
        differences = ' and '.join([f'{removed} removed'] * bool(removed)
                                   + [f'{added} added'] * bool(added))
        return (f'; it was computed from {count_of(len(self._solved), "sample")}, which have '
                f'changed since ({differences}): call ~/compute_calibration for an answer from '
                f'the current {len(now)}')

    # samples

    def _evaluated(self, function: Callable[..., Result], *args: Any) -> Result:
        """Return the result of a function of a stop; this process helps where the other ends."""
        try:
            result = self.evaluator.run(function, *args)
        except PoolEndedError as error:
            if self.worker.ended:
                raise
            self._evaluation_trouble = f'{error}; the node itself has evaluated the stop'
            return function(*args)  # the sample must not be lost
        self._evaluation_trouble = ''
        return result

    def _result(self, stop: Stop, config: Config | None = None) -> Sample | Reject:
        config = config or self.config
        return self._evaluated(result_of, stop.needed(config), config)

    def _evaluate(self, stop: Stop, over: bool) -> None:
        """Put the outcome of a stop into the session, replacing an earlier one."""
        if not over and self.session.is_taken(stop):
            return
        if self._verifying:
            self._verify(stop, over)
            return
        result = self._result(stop)
        with self.lock:
            outcome = self.session.outcome(stop, result)
            earlier = [o for o in self.session.outcomes if o.number == outcome.number]
        remark = self._objection(outcome)  # no refusal, as in the solution of a recording
        try:
            outcome = self._stored(outcome)
        except InputError as error:
            if earlier and outcome.number not in self._unstored:
                outcome = earlier[0]  # of fewer profiles, but on the disk
            else:
                self._unstored.add(outcome.number)
                outcome = Outcome(outcome.number, stop, Reject(outcome.result.stamp, str(error)),
                                  refused=str(error))
        if outcome.sample is None:
            self._refused[stop.began] = stop.pose(self.config)
        with self.lock:
            self.session.put(outcome, over)
        if earlier and bool(earlier[0].sample) == bool(outcome.sample):
            return  # the same result with more profiles is not reported again
        verdict = (f'sample {outcome.number} taken' if outcome.sample else
                   f'stop {outcome.number} gave no sample')
        self._tell(outcome, '; '.join(filter(None, (
            f'{verdict}: {sample_summary(outcome.result)}', remark))))

    def _tell(self, outcome: Outcome, text: str) -> None:
        """Publish the last attempt to take a sample."""
        self.attempt = {'accepted': outcome.sample is not None, 'number': outcome.number,
                        'text': text}
        self.last = outcome

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
        self._unstored.discard(outcome.number)
        return stored

    def _evaluate_again(self, number: int) -> None:
        """Evaluate a stop by the current settings; one that cannot be stored stays refused."""
        outcome = next((o for o in self.copied().outcomes if o.number == number), None)
        if outcome is None:
            return
        if number in self._unstored:
            result = self._result(outcome.stop)
            with self.lock:
                fresh = self.session.outcome(outcome.stop, result)
            with suppress(InputError):
                # its stop is now that on the disk; the session knows it by the one in memory
                outcome = replace(self._stored(fresh), stop=outcome.stop)
        else:
            bare = replace(outcome, result=Reject(outcome.result.stamp, ''))
            outcome = replace(outcome,
                              result=self._evaluated(judged, bare, self.config).result)
        with self.lock:
            self.session.replace([outcome])

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
        solution = self.derived.solution
        if outcome.sample is None or solution is None or (
                solution.degrees_of_freedom < SURE_FREEDOM):
            return ''
        return flat_crossing(outcome.sample, solution, self.config)

    def take_sample(self) -> str:
        """Take a sample at the current stop; raises DataError, or InputError unstored."""
        return self._ask(self._take)

    def _take(self) -> str:
        silence = self.arrivals.silence('pose')
        limit = POSES_SILENT if self.arrivals.silence('profile') < PROFILES_COME else BOTH_SILENT
        try:
            if self.arrivals.counts['pose'] and silence > limit:
                raise silent_poses(silence)
            with self.lock:
                stop = self.session.current_stop()
            return self._take_for_verification(stop) if self._verifying else self._take_at(stop)
        except HandeyeError as error:
            self.attempt = {'accepted': False, 'number': 0, 'text': str(error)}
            raise

    def _take_at(self, stop: Stop) -> str:
        config = self.config
        try:
            sample = self._evaluated(sample_of, stop.needed(config), config)
        except FeatureError:
            self._refused[stop.began] = stop.pose(config)
            raise
        with self.lock:
            outcome = self.session.outcome(stop, sample)
            repeated = any(o.stop.began == stop.began for o in self.session.outcomes)
        if isinstance(outcome.result, Reject):
            raise DataError(f'{outcome.result.reason}: move on, and turn the tool')
        objection = self._objection(outcome)
        if objection:
            self._refused[stop.began] = stop.pose(config)
            raise DataError(f'{objection}, and take the sample again', reason='flat_crossing')
        outcome = self._stored(outcome)
        with self.lock:
            self.session.put(outcome)
        note = ' again, as the robot has not moved since' if repeated else ''
        text = f'sample {outcome.number} taken{note}: {sample_summary(sample)}'
        self._tell(outcome, text)
        return text

    def remove_last_sample(self) -> str:
        """Forget the last sample; raises DataError when there is none, InputError unstored."""
        return self._ask(self._remove_last)

    def _remove_last(self) -> str:
        last = self.copied().last(self._result)
        if self.files.path:
            self.files.append(Event(REMOVED, self.config, last.number))
        with self.lock:
            self.session.remove(last)
            count = sum(o.sample is not None for o in self.session.outcomes)
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{count} left')

    def clear_samples(self) -> str:
        """Forget samples, verification, answer, and all messages; raises InputError."""
        return self._ask(self._clear)

    def _clear(self) -> str:
        note = ''
        if self.files.path:
            note = f'; they are kept in {self.path}'
            self.files = self.files.restarted(self.config)
        count = self._forget('the samples were cleared')
        return f'{count_of(count, "sample")} removed; bags and clocks may start again{note}'

    def _forget(self, why: str) -> int:
        """Forget stops, messages, and what follows; return the number of samples there were."""
        self.latest.clear()
        with self.lock:
            count = sum(o.sample is not None for o in self.session.outcomes)
            self.session.clear()
            self.waiting.clear()
            self.early = self._verifying = None
        self._cleared += 1
        self.attempt, self._refused, self._unstored = None, {}, set()
        self._stale.clear()
        self._requested = self._outdated = False
        self.derived = Derived(pipeline.advise((), self.config))
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
        self._refused = {outcome.stop.began: outcome.stop.pose(self.config)
                         for outcome in session.outcomes if outcome.sample is None}
        if replace(old_config, session=self.config.session) != self.config:
            self.files.append(Event(CONFIGURED, self.config))
        self._requested = self._outdated = bool(session.samples)
        count = sum(outcome.sample is not None for outcome in session.outcomes)
        return f'continuing with {count_of(count, "sample")} of {self.path}'

    def open(self, files: SessionFiles, session: Session, old_config: Config) -> str:
        """Continue with another session; see restore."""
        def work() -> str:
            self._forget('another session was opened')
            self.files.close()
            self.files = files
            return self.restore(session, old_config)
        return self._ask(work)

    def configure(self, config: Config) -> None:
        """Apply another configuration, already checked by params.changed."""
        self._ask(self._configure, config)

    def _configure(self, config: Config) -> None:
        old, new = flatten(self.config), flatten(config)
        different = tuple(key for key in new if old[key] != new[key])
        with self.lock:
            self.config = config
            self.session.configure(config)
            if 'verify.routine' in different:
                self._verifying = None
        if any(key.startswith(SAMPLE_KEYS) for key in different):
            self._stale = deque(outcome.number for outcome in self.session.outcomes)
        if any(key.startswith(ANSWER_KEYS) for key in different):
            self._outdated = self._requested
        self._settings += any(key.startswith((*ANSWER_KEYS, 'guidance.')) for key in different)
        try:
            if self.files.path:
                self.files.append(Event(CONFIGURED, config))
            self._store_trouble = ''
        except InputError as error:
            self._store_trouble = str(error)

    # review and advice

    def _derive(self) -> None:
        """Begin what follows from the samples, if they or the settings have changed."""
        if self._outdated and COMPUTED not in self._works:
            with suppress(HandeyeError):  # the state reports a refusal
                self._solve(rest=False)
        session = self.copied()
        outcomes = tuple(outcome for outcome in session.outcomes if outcome.sample)
        sampled = {outcome.stop.began for outcome in outcomes}
        refused = [T for began, T in self._refused.items() if began not in sampled]
        basis = (self._cleared, self._settings, len(refused),
                 [(outcome.number, outcome.stop.began) for outcome in outcomes])
        if self._deriving or basis == self.derived.basis:
            return
        current = self.latest.current(self.config)
        if current:
            self.extremes = extremes(np.concatenate([self.extremes, current.points]))
        samples = {outcome.number: outcome.sample for outcome in outcomes if outcome.sample}
        excluded = frozenset(o.number for o in outcomes if session.excludes(o))
        with suppress(PoolEndedError):
            future = self.solver.submit(derive, samples, excluded, self.config, self.extremes,
                                        refused)
            self._deriving = True
            future.add_done_callback(
                lambda done: self.worker.later(self._put_derived, done, basis))

    def _put_derived(self, done: Future[Derived], basis: tuple[Any, ...]) -> None:
        self._deriving = False
        try:
            derived = done.result()
        except ENDED:
            derived = Derived(self.derived.advice, no_review=str(PoolEndedError()))
        if basis[0] == self._cleared:
            self.derived = replace(derived, basis=basis)
        self._derive()  # if the samples have changed meanwhile

    # answer

    def compute_calibration(self) -> str:
        """
        Compute the answer from all samples; return the message about it.

        The current stop counts as complete. Raises DataError or InputError where there is no
        answer; after a DataError the previous answer is withdrawn.
        """
        self._requested = True
        return self._ask(self._solve, True).result()

    def _solve(self, rest: bool) -> Future[str]:
        """Begin to solve; return the future of the message. rest: see _evaluate_all."""
        self._outdated = False
        answered: Future[str] = Future()
        try:
            self._evaluate_all(rest)
            session, config = self.copied(), self.framed
            if session.conflict:
                raise session.conflict
            session.require_stations()
        except HandeyeError as error:
            self._refuse(error)
            raise
        samples = Session(config)  # the messages of the streams stay here
        samples.restore(session.outcomes, session.numbers, session.frame_id)
        cleared = self._cleared
        computed = self.solver.submit(pipeline.calibrate_session, samples, config)
        self._works.append(COMPUTED)
        computed.add_done_callback(
            lambda done: self.worker.later(self._put_answer, done, answered, session, cleared))
        return answered

    def _put_answer(self, computed: Future[Calibration], answered: Future[str], session: Session,
                    cleared: int) -> None:
        self._works.remove(COMPUTED)
        try:
            calibration = computed.result()
        except ENDED:  # no refusal: the previous answer stays
            answered.set_exception(PoolEndedError())
        except HandeyeError as error:
            if cleared == self._cleared:
                self._refuse(error)
            answered.set_exception(error)
        except Exception as error:
            answered.set_exception(error)
            raise
        else:
            if cleared == self._cleared:
                self._put_calibration(calibration, session)
                answered.set_result(calibration_summary(calibration))
            else:
                answered.set_exception(DataError(
                    'the samples were cleared while the calibration was computed, so there is no '
                    'answer: take new samples'))
        self._derive()  # settings may have changed meanwhile

    def _put_calibration(self, calibration: Calibration, session: Session) -> None:
        """Publish an answer, computed from the samples of a session."""
        config = self.config
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        inputs += [{'session': self.path}] * bool(self.path)
        self.calibration = replace(calibration,
                                   provenance={**calibration.provenance, 'inputs': inputs})
        self._solved = _identities(session)
        self.withdrawn = self.missing = self.file = ''

    def _refuse(self, error: HandeyeError) -> None:
        """Withdraw the answer after a refusal; what only disturbs the streams withdraws none."""
        reason = f'the last attempt to compute it was refused ({error})'
        if isinstance(error, DataError):
            self._withdraw(reason)
        elif self.calibration is None:
            self.missing = reason

    def _withdraw(self, reason: str) -> None:
        """Remove the answer, with the reason for its state."""
        self.withdrawn = (f'{reason}; the transform that was published before is not the answer'
                          if self.calibration or self.withdrawn else '')
        self.calibration, self.missing = None, reason

    def save_calibration(self) -> str:
        """Write the answer; return the message. Raises DataError without one, InputError."""
        return self._ask(self._save)

    def _save(self) -> str:
        calibration, config = self.calibration, self.config
        if calibration is None:
            raise DataError('there is no calibration to save: call ~/compute_calibration first, '
                            'and check that it succeeds')
        folder = self.folders.own(config)
        wanted = calibration, folder, config.save.formats
        before, text = self._saved
        if not self.file or before != wanted or not Path(self.file).is_file():
            named = replace(calibration, name=folder_name(config))
            saved = exports.save_all(named, folder, config.save.formats)
            self.file, text = str(saved.files[0]), str(saved)
            self._saved = wanted, text.replace('wrote ', 'saved already: ').partition(';')[0]
        note = (f'; {COMPUTED} again: save it again after that'
                if COMPUTED in self._works else '')
        return f'{text}{self.changes(self.copied())}{note}'

    # verification: stops give no samples until its result

    def verify_start(self) -> str:
        """
        Begin a verification, or the next part (face, ball, pass) of the current one.

        Raises InputError for the settings, DataError without a calibration.
        """
        return self._ask(self._begin_verification)

    def _begin_verification(self) -> str:
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

    def _verify(self, stop: Stop, over: bool) -> Sample | Reject | None:
        """Add a stop to the verification; one that is not over is replaced when it is."""
        verifying = self._verifying
        if over:
            with self.lock:
                self.session.leave(stop)
        if verifying is None or verifying.scans:
            return None
        result = verifying.add(stop, self.config, self._result)
        self._tell(Outcome(0, stop, result),
                   f'verification: {verifying.text}; {sample_summary(result)}')
        return result

    def _take_for_verification(self, stop: Stop) -> str:
        result = self._verify(stop, True)
        if result is None:
            raise DataError(f'{self.verification}: stops do not count, points are taken while the '
                            'robot moves')
        if isinstance(result, Reject):
            raise DataError(result.reason)
        return f'{self.verification}; {sample_summary(result)}'

    def verify_result(self) -> str:
        """
        Write the verdict with its figures; the current stop counts as complete.

        Raises DataError without a verification, a calibration or enough stops, and where it is
        neither pass nor fail: the verification then continues.
        """
        session, calibration, config = self._ask(self._finished_verification)
        self._works.append('the calibration is verified')
        try:
            result = self.solver.run(session.result, calibration, config)
        finally:
            self._works.remove('the calibration is verified')
        return self._ask(self._put_verdict, result)

    def _finished_verification(self) -> tuple[VerificationSession, Calibration, Config]:
        if self._verifying is None:
            raise DataError('no verification was started: call ~/verify_start, and measure the '
                            'artefact')
        self._evaluate_all(rest=True)
        with self.lock:
            return self._verifying.copied(), self._verified(), self.config

    def _put_verdict(self, result: Verification) -> str:
        self.verdict = sentence(result)
        config = self.config
        poses = config.pose_topic if config.pose_source == 'topic' else '/tf'
        file = self.folders.own(config) / f'verification_{result.routine}.yaml'
        previous = exports.set_aside(file.parent, [file.name], {file.name})
        verified = config.verify.calibration
        write_whole(file, yaml_text(replace(
            result, inputs=(config.profile_topic, poses), created=time_of(time.time_ns()),
            calibration_file=calibration_file.input_values(Path(verified).expanduser())
            if verified else {})))
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


def _identities(session: Session) -> frozenset[tuple[int, ...]]:
    """Return what identifies the samples of a session: numbers are never used again."""
    return frozenset((outcome.number, outcome.sample.stamp) for outcome in session.outcomes
                     if outcome.sample and not session.excludes(outcome))
