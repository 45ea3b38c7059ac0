# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A running session without ROS: from messages to stored samples.

The way of a message: the drain thread (streams.py) calls add_profile or add_poses, which put it
into the session. A stop that is over, or long enough, waits in `to_evaluate` for the worker, which
has it evaluated in another process, stores it on the disk and puts it into the session; so does a
stored one when settings change. After each such piece of work the worker calls `changed`, which
publishes ~/samples (outputs.py). What is used is stored, and what is stored is used. What
follows from the samples is in answer.py and verification.py.

When ~/take_sample has taken a stop, that is on the disk as a file of its own, synced
(SessionFiles in bags/session_files.py). During a verification no new stop is stored; its result is
a file of its own. Settings and removals are stored as always.

Threads: the drain thread, which calls add_...; one worker, which changes all else; the threads of
ROS (node.py) and of the page, which `ask` the worker and wait for it. Stops are evaluated, and
reviews, solves and verifications computed, in two processes (pool.py); the worker waits for the
stops alone. Locks: `lock` for what messages change, held for one message or a copy; one in
outputs.py, so that nothing is published after the end.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any, TypeVar

from handeye_ros import se3
from handeye_ros.bags.session_files import (
    CONFIGURED,
    OutputFolders,
    REMOVED,
    SessionFiles,
    StoredSession,
)
from handeye_ros.config import Config, SamplesConfig
from handeye_ros.data import AnyProfile, Array, Feature, Reject, Sample, TimedPose
from handeye_ros.errors import (
    DataError,
    FeatureError,
    HandeyeError,
    InputError,
    sentence_and_log,
    UnusableMessageError,
)
from handeye_ros.frames import mount_poses
from handeye_ros.node.answer import ANSWER_KEYS, LiveAnswer, SAMPLE_KEYS, values_of
from handeye_ros.node.pool import Pool, PoolEndedError, result_or_ended, trim_memory
from handeye_ros.node.state import Attempt, MessageCount
from handeye_ros.node.verification import LiveVerification
from handeye_ros.results.scene import StopSnapshot
from handeye_ros.results.table import count_of, sample_summary
from handeye_ros.sampling.features import features_of, result_of
from handeye_ros.sampling.session import Session, silent_poses
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.stream import interpolate

MOST_STOPS = 32  # waiting for evaluation: at most 7 MB each with 1280 points a profile
KEPT_JOINTS = 20_000  # messages with joint values: more than those of the longest stop
KEPT_LATEST = 100  # messages of a kind: one of the two streams may be late
# s without a pose after which the robot may be anywhere, if profiles come: in the last s
LONGEST_POSE_SILENCE, LONGEST_PROFILE_SILENCE = 2.0, 1.0

Result = TypeVar('Result')


class LiveSession:
    """
    Samples of a running node. The drain thread calls the methods add_...; others go through ask.

    What messages change (session, to_evaluate, joints, the latest messages and their counts) is
    used under lock. The stops of the session, and all else, are changed by the worker alone: it
    reads them without, others see them at any time.

    config: the current settings, those of the session
    files, folders: where the session is stored, and where results are
    to_evaluate: stops that wait for the worker, by their stamps
    joints: stamps (ns) and serialised JointState messages
    messages: counts by kind (profile, pose); Streams (streams.py) begins them anew
    troubles: why samples cannot be stored (storing) or computed with (work), a sentence each
    attempt: the last one to take a sample, None before
    running: the long computations in words, '' for a review
    """

    def __init__(self, config: Config, folders: OutputFolders, pool: Pool,
                 changed: Callable[[], object]) -> None:
        """
        Start without samples; raises InputError for a method or target that it cannot have.

        pool: where long computations run; changed: called by the worker after every change.
        """
        self.folders, self.pool, self.lock = folders, pool, Lock()
        self.messages = {kind: MessageCount(kind) for kind in ('profile', 'pose')}
        self._worker, self._changed = ThreadPoolExecutor(1, 'worker'), changed
        self._woken = True  # nothing is due before start()
        self.running: list[str] = []
        self._begin(SessionFiles(folders.folder), Session(config))
        self.answer, self.verification = LiveAnswer(self), LiveVerification(self)

    def _begin(self, files: SessionFiles, session: Session) -> None:
        """Begin with a session, without messages."""
        self.files, self.session = files, session
        self.to_evaluate: dict[int, Stop] = {}  # by their stamps
        self.joints: deque[tuple[int, bytes]] = deque(maxlen=KEPT_JOINTS)
        self._profiles: deque[AnyProfile] = deque(maxlen=KEPT_LATEST)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT_LATEST)
        self._overflowed = 0  # stops that waited too long
        self.troubles: dict[str, str] = {}
        self.attempt: Attempt | None = None

    # messages

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        with self.lock:
            self.messages['profile'].add(profile.stamp)
            self._profiles.append(profile)
            self.session.add_profile(profile)
            self._queue(self.session.completed())

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        with self.lock:
            for pose in poses:
                self.messages['pose'].add(pose.stamp)
                self._poses.append(pose)
                self.session.add_pose(pose)
            ready = self.session.early_stop()
            self._queue([*self.session.completed(), *([ready] if ready else [])])

    def add_joints(self, stamp: int, data: bytes) -> None:
        """Keep a serialised JointState, to be stored with the stop of its time."""
        with self.lock:
            self.joints.append((stamp, data))

    def _queue(self, stops: Iterable[Stop]) -> None:
        """Queue stops, each in place of an earlier part; drop the oldest if too many wait."""
        self.session.keep_waiting(MOST_STOPS)
        for stop in stops:
            self.to_evaluate.pop(stop.stamp, None)
            self.to_evaluate[stop.stamp] = stop
        new = [stamp for stamp, one in self.to_evaluate.items() if not one.reader]
        for stamp in new[:-MOST_STOPS]:
            del self.to_evaluate[stamp]
            self._overflowed += 1
        if self.to_evaluate or self._frame_change:
            self.wake()

    def _evaluate_again(self, stops: Iterable[Stop]) -> None:
        """Queue stops of the session, but those of which a later part waits."""
        with self.lock:
            self._queue(stop for stop in stops if stop.stamp not in self.to_evaluate)

    @property
    def _frame_change(self) -> str:
        """Return in words that a topic has another frame now; '' if that would lose anything."""
        used = self.verification.routine or self.answer.calibration
        return '' if used else self.session.frame_change

    @property
    def pose(self) -> Array | None:
        """Return T_base_flange (4, 4) of the last pose, None before the first."""
        poses = self._poses
        return se3.of_pose(poses[-1]) if poses else None

    def current(self) -> StopSnapshot | None:
        """Return the last profile with poses before and after it; None without a usable one."""
        config = self.config
        with self.lock:
            # of equal stamps, as in a repeated playback, the last pose counts
            poses = [pose for _, pose in sorted({one.stamp: one for one in self._poses}.items())]
            inside = [profile for profile in self._profiles
                      if poses and poses[0].stamp <= profile.stamp <= poses[-1].stamp]
        if len(poses) < 2 or not inside:
            return None
        features: tuple[Feature, ...] = ()
        reason = ''
        try:
            profile = inside[-1].read(config.profile)
            features = features_of(profile, config)
        except UnusableMessageError:
            return None
        except FeatureError as error:
            reason = str(error)
        T, = interpolate(poses, [profile.stamp])
        return StopSnapshot(0, profile.stamp, mount_poses(T, config), profile.points, features,
                            reason)

    # the worker

    def start(self) -> None:
        """Start the worker and the processes."""
        self.pool.start()
        self._woken = False
        self.wake()

    def ask(self, work: Callable[[], Result]) -> Result:
        """Let the worker do something; return its result, or raise its exception."""
        try:
            return self._worker.submit(work).result()
        finally:
            self.wake()

    def wake(self) -> None:
        """Have the worker look for what is due; threads that meet here at worst ask twice."""
        if not self._woken:
            self._woken = True
            self._submit(self._do_what_is_due)

    def _submit(self, work: Callable[..., object], *args: Any) -> None:
        """Have the worker do something; a failure is a trouble until something succeeds."""
        def done() -> None:
            try:
                work(*args)
                self._changed()
                self.troubles.pop('work', None)
            except Exception as error:  # noqa: BLE001 - the thread must go on
                self.troubles['work'] = sentence_and_log('the work on the samples', error)

        self._worker.submit(done)

    def _do_what_is_due(self) -> None:
        """Do what is due, stop by stop: who has asked meanwhile waits for one stop only."""
        self._woken = False
        with self.lock:
            frame_change = self._frame_change
        if frame_change:
            self.clear_samples()
            self.attempt = Attempt(frame_change)
        elif self.process_next():
            self.wake()
        else:
            self.answer.review_if_changed()
        trim_memory()

    def run_job(self, name: str, accept: Callable[[Any], Result],
                function: Callable[..., Any], *args: Any) -> Future[Result]:
        """
        Begin a long computation in another process; return the future of what accept returns.

        name: in words, '' for what nobody waits for: its error is a trouble of the session, as is
        always that of a process that ended.
        accept: called by the worker with the result.
        """
        answered = Future[Result]()

        def finish(job: Future[Any]) -> None:
            self.running.remove(name)
            try:
                answered.set_result(accept(result_or_ended(job)))
            except Exception as error:
                answered.set_exception(error)
                if not (name and isinstance(error, DataError | InputError)):
                    raise
            self.wake()  # samples or settings may have changed meanwhile

        self.running.append(name)
        self.pool.submit(function, *args).add_done_callback(partial(self._submit, finish))
        return answered

    # what others tell of it

    def copied(self) -> Session:
        """Return a copy of the session at this moment."""
        with self.lock:
            return self.session.copied()

    @property
    def config(self) -> Config:
        """Return the current settings."""
        return self.session.config

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""
        return str(self.files.path or '')

    @property
    def working(self) -> str:
        """Return the running tasks in words; empty without any."""
        with self.lock:
            again = any(stop.reader for stop in self.to_evaluate.values())
        text = 'the samples are extracted again from their profiles' if again else ''
        return '; '.join(filter(None, (*self.running, text)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings, one sentence each."""
        routine, left_out = self.verification.routine, self._overflowed
        return tuple(filter(None, (
            f'a verification ({routine.name}) continues: stops are not samples until '
            '~/verify_result' if routine else '',
            f'left {left_out} stops out, the oldest of more than {MOST_STOPS} that waited to be '
            'evaluated: the processor cannot keep up; stop less often, or publish fewer points'
            if left_out else '')))

    # stops

    def process_next(self) -> bool:
        """Evaluate the next stop that waits, new or stored; return whether there was one."""
        with self.lock:
            stop = self.to_evaluate.pop(next(iter(self.to_evaluate), 0), None)
        if stop and not (stop.reader and stop.final_reason):
            with suppress(DataError):  # of a verification
                self._take(stop)
        return stop is not None

    def process_waiting(self) -> None:
        """Evaluate the stops that wait; each is told on its own."""
        while self.process_next():
            self._changed()

    def process_all(self) -> None:
        """
        Evaluate all stops, of which the current one counts as complete.

        Raises InputError where messages have two frames, and there is no sample of one.
        """
        self.process_waiting()
        with self.lock:
            self._queue(self.end_stops())
        self.process_waiting()

    def end_stops(self) -> list[Stop]:
        """Return the stops that have begun; nothing more is taken of them. Under lock."""
        stops = self.session.copied().remaining()  # raises for mixed frames
        for stop in stops:
            self.session.mark_done(stop)
        return stops

    def _take(self, stop: Stop, asked: bool = False) -> str:
        """
        Put a stop with its result into the session, in place of an earlier part or result of it.

        asked: by ~/take_sample, for a sample: DataError is raised where there is none, InputError
        where it cannot be stored, and the session stays as it is. Returns what the stop gave, in
        words. While a verification is running the stop counts for that: see its add_stop. Of one
        that is stored only the result is new.
        """
        if self.verification.routine and not stop.number:
            return self.verification.add_stop(stop)
        is_new = stop.reader is None
        stop = self.session.evaluated(stop, self.result_elsewhere(stop, self.config))
        earlier = next((one for one in self.session.stops if one.number == stop.number), None)
        had_sample = bool(earlier and earlier.sample)
        if asked and stop.sample is None:
            remedy = ': move on, and turn the tool' if stop.final_reason else ''
            raise DataError(f'{sample_summary(stop.result)}{remedy}')
        with self.lock:
            joints = [*self.joints]
        try:
            stop = self._write(self.files.add_stop, stop, self.config, joints) if is_new else stop
        except InputError as error:
            if asked:
                raise
            # an earlier part of the stop has fewer profiles, but is on the disk
            stop = earlier if earlier and earlier.reader else replace(
                stop, result=Reject(stop.result.stamp, str(error), final=True))
        with self.lock:
            self.session.add_stop(stop)
        again = ' again, as the robot has not moved since' if had_sample else ''
        what = (f'sample {stop.number} taken{again}' if stop.sample else
                f'stop {stop.number} gave no sample')
        text = f'{what}: {sample_summary(stop.result)}'
        if is_new and (asked or earlier is None or had_sample != bool(stop.sample)):
            # the same result with more profiles is not reported again
            self.attempt = Attempt(text, stop)
        return text

    def result_elsewhere(self, stop: Stop, config: Config) -> Sample | Reject:
        """Return what a stop gives, evaluated in another process."""
        try:
            return self.pool.run(result_of, stop.trimmed(config), config)
        except (PoolEndedError, InputError) as error:  # its file is gone; or its process, then
            return Reject(stop.stamp, str(error))  # the stop itself will be stored

    def _write(self, write: Callable[..., Result], *args: Any) -> Result:
        """
        Write an event; raises InputError, which is kept as trouble until the next event.

        An event holds the settings. Once one is written, stops that could not be, or could not be
        read, are tried again.
        """
        try:
            result = write(*args)
        except InputError as error:
            self.troubles['storing'] = str(error)
            raise
        if self.troubles.pop('storing', ''):
            self._evaluate_again(stop for stop in self.session.stops if not stop.sample)
        return result

    def retry_storing(self) -> None:
        """
        Store settings and then stops that could not be stored before, if that works now.

        A folder that is gone is found here too: then there is a trouble. Stops whose process ended
        are evaluated again.
        """
        self._evaluate_again(stop for stop in self.session.stops if stop.result == Reject(
            stop.result.stamp, str(PoolEndedError())))
        path = self.files.path
        if 'storing' in self.troubles or path and not path.is_dir():
            self._store_settings()

    def _store_settings(self) -> None:
        with suppress(InputError):  # kept as trouble
            self._write(self.files.add_event, CONFIGURED, self.config)

    def _finish(self, stop: Stop) -> None:
        """Take nothing more of a stop, which may go on."""
        with self.lock:
            self.session.mark_done(stop)
            self.to_evaluate.pop(stop.stamp, None)

    # services

    def take_sample(self) -> str:
        """
        Take a sample at the current stop; return what it shows.

        Raises DataError where there is none, InputError where it cannot be stored.
        """
        poses, profiles = self.messages['pose'], self.messages['profile']
        try:
            if (poses.count and poses.silence > LONGEST_POSE_SILENCE
                    and profiles.silence < LONGEST_PROFILE_SILENCE):
                raise silent_poses(poses.silence)
            with self.lock:
                stop = self.session.stop_on_request()
            text = self._take(stop, asked=True)
        except HandeyeError as error:
            self.attempt = Attempt(str(error))
            raise
        self._finish(stop)
        return text

    def remove_last_sample(self) -> str:
        """
        Forget the last sample.

        Raises DataError without one, InputError where that cannot be stored.
        """
        samples = [stop for stop in self.session.stops if stop.sample]
        if not samples:
            raise DataError('there is no sample to remove', reason='nothing_to_remove')
        last = samples[-1]
        self._write(self.files.add_event, REMOVED, self.config, Stop(0, number=last.number))
        with self.lock:
            self.session.remove(last)
        self._finish(last)
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{len(samples) - 1} left')

    def clear_samples(self) -> str:
        """Forget samples, verification, answer, and all messages; raises InputError."""
        count, files, note = self._sample_count(), self.files, ''
        config = replace(self.config, samples=SamplesConfig())  # numbers begin again
        if files.path:
            note = f'; they are kept in {files.path}' if files.path.is_dir() else ''
            files = files.restarted(config)
        self._switch_to(files, Session(config), 'the samples were cleared')
        return f'{count_of(count, "sample")} removed; bags and clocks may start again{note}'

    def open(self, stored: StoredSession, config: Config) -> str:
        """Continue a session of the disk, and solve; return the message. Raises InputError."""
        files = SessionFiles(self.folders.folder, stored, config)
        self._switch_to(files, stored.session(config), 'a session was opened')
        self.answer.is_wanted = bool(self.session.samples)  # as it probably was before
        now, before = values_of(config, ANSWER_KEYS), values_of(stored.config, ANSWER_KEYS)
        other = ''.join(f'; {key} is {value} now, was {before[key]}'
                        for key, value in now.items() if value != before[key])
        return f'continuing with {count_of(self._sample_count(), "sample")} of {self.path}{other}'

    def _switch_to(self, files: SessionFiles, session: Session, why: str) -> None:
        """Go on with another session; forget what followed from the one before."""
        if files is not self.files:
            self.files.close()
        with self.lock:
            self._begin(files, session)
        self.verification.end()
        self.answer.forget(why)

    def _sample_count(self) -> int:
        return sum(stop.sample is not None for stop in self.session.stops)

    def configure(self, config: Config, other_topics: bool = False) -> None:
        """Apply another configuration, already checked by the node; of other topics no stops."""
        old = self.config
        if other_topics:
            self._switch_to(self.files, Session(config, self.session.last_number),
                            'the topics were changed')
        elif config.offset_ns != old.offset_ns:  # the profiles that wait have the old one
            with suppress(InputError):
                self.process_all()
        with self.lock:
            self.session.configure(config)
        if config.verify.routine != old.verify.routine:
            self.verification.end()
        if config.profile != old.profile:  # what could not be read may be readable now
            self.messages['profile'].forget_malformed()
        if values_of(config, SAMPLE_KEYS) != values_of(old, SAMPLE_KEYS):
            self._evaluate_again(self.session.stops)
        if self.files.path:
            self._store_settings()
