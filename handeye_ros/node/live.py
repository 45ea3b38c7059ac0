# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The session of a running node, without ROS: from messages to stored samples.

From a message to ~/samples:
1. The thread `streams` (streams.py) reads the message and calls add_profile or add_poses, which
   give it to the session (sampling/session.py). A stop that is over, or long enough for a sample,
   then waits in `to_evaluate`.
2. The thread `worker` takes it from there (`evaluate_next`), has it evaluated in another process,
   writes it to the disk (SessionFiles in bags/session_files.py) and adds it to the session: what
   is not stored is not used.
3. After each such piece of work, and before a service answers (~/auto_sample: soon after), the
   worker calls `publish_changes`, which is `HandeyeNode._publish_changes` (node.py, then
   outputs.py) and publishes ~/samples. When no stop waits, it begins the review in another process
   (solver.py).

Threads:
- only `streams` calls add_profile, add_poses and add_joints;
- `worker` makes all other changes, one after the other;
- those of the executor of ROS (EXECUTOR_THREADS in calibrate.py: services, timers, parameters)
  and of the page (page/server.py: WORKER_COUNT for requests, others that collect its events) pass
  a function to `Worker.call` and wait for its result; what they only show, they read themselves.
Processes: two (pool.py), each with a thread that waits for it. They evaluate stops and those of a
session that is opened, for which the worker waits, and make reviews, answers and verifications,
for which it does not (`Worker.run_job`). Also the report, for which the page waits
(page/contents.py).
Locks: `lock` guards what messages change, and is held for one message or one copy. Another, in
outputs.py, keeps the node from publishing after its end; one in page/contents.py is held while the
page reads and sets samples.exclude.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from threading import Lock
from typing import Any, TypeVar

from handeye_ros import se3
from handeye_ros.bags.session_files import (
    CONFIGURED,
    read_session,
    REMOVED,
    SessionFiles,
    StoredSession,
)
from handeye_ros.config import Config, SamplesConfig
from handeye_ros.data import AnyProfile, Array, Reject, Sample, StopSnapshot, TimedPose
from handeye_ros.errors import (
    DataError,
    FeatureError,
    HandeyeError,
    InputError,
    UnusableMessageError,
)
from handeye_ros.frames import mount_poses
from handeye_ros.node.folders import OutputFolders
from handeye_ros.node.message_counts import new_counts
from handeye_ros.node.pool import Pool, PoolEndedError
from handeye_ros.node.solver import ANSWER_KEYS, LiveSolver, SAMPLE_KEYS, settings_of
from handeye_ros.node.state import Attempt
from handeye_ros.node.verification import LiveVerification
from handeye_ros.node.worker import Worker
from handeye_ros.results.printed import sample_summary
from handeye_ros.sampling.features import features_of, result_of
from handeye_ros.sampling.input_faults import frame_change_notice, silent_poses_error
from handeye_ros.sampling.interpolation import interpolate
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.words import count_of

MAX_STOPS = 32  # waiting for evaluation: at most 7 MB each with 1280 points a profile
KEPT_JOINTS = 20_000  # messages with joint values: more than those of the longest stop
KEPT_LATEST = 100  # messages of a kind: one of the two streams may be late
MAX_POSE_SILENCE = 2.0  # s without a pose, while profiles come: the robot may be anywhere
MAX_PROFILE_SILENCE = 1.0  # s: profiles come as long as the last one is not older
EVALUATING = 'a stop is evaluated'

Result = TypeVar('Result')


class LiveSession:
    """
    The samples of a running node, their review and answer; for the threads see the module.

    config: the current settings, those of the session
    files, folders: where the session is stored, and where results are
    session, to_evaluate, joints: the session; stops that wait for the worker, by their stamps;
        stamps (ns) and serialised JointState messages. Messages change them: use them under lock.
        The evaluated stops of the session are changed by the worker alone, which reads them
        without
    message_counts: by kind (profile, pose), of the topics of now; Streams (streams.py) adds those
        that cannot be used
    solver, verification: compute what follows from samples, and a verification
    worker: the thread, and its long computations
    storing_trouble: why samples cannot be stored, a sentence; '' where they can
    attempt: the last one to take a sample, None before
    restart_streams: makes the subscriptions accept messages of any time, as those of another
        session
    """

    def __init__(self, config: Config, folders: OutputFolders, pool: Pool,
                 publish_changes: Callable[[], object]) -> None:
        """
        Start without samples; raises InputError for a method or target that it cannot have.

        pool: where long computations run; publish_changes: see Worker.
        """
        self.folders, self.pool, self.lock = folders, pool, Lock()
        self.message_counts = new_counts()
        self.worker = Worker(pool, self._do_due_work, publish_changes)
        self._publish_changes = publish_changes
        self.restart_streams: Callable[[], object] = lambda: None  # none before there are streams
        self._begin(SessionFiles(folders.folder), Session(config))
        self.solver, self.verification = LiveSolver(self), LiveVerification(self)

    def _begin(self, files: SessionFiles, session: Session) -> None:
        """Begin with a session, without messages."""
        self.files, self.session = files, session
        self.to_evaluate: dict[int, Stop] = {}
        self.joints: deque[tuple[int, bytes]] = deque(maxlen=KEPT_JOINTS)
        self._profiles: deque[AnyProfile] = deque(maxlen=KEPT_LATEST)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT_LATEST)
        self._dropped_stops = 0  # which waited too long
        self._interrupted = set[int]()  # stamps of stops whose process ended
        self.storing_trouble = ''
        self.attempt: Attempt | None = None

    # from messages to stops that wait: the thread `streams`

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        with self.lock:
            self.message_counts['profile'].add(profile.stamp)
            self._profiles.append(profile)
            self.session.add_profile(profile)
            self._queue_stops(self.session.take_completed())

    def add_poses(self, poses: Sequence[TimedPose]) -> None:
        """Add poses."""
        with self.lock:
            for pose in poses:
                self.message_counts['pose'].add(pose.stamp)
                self._poses.append(pose)
                self.session.add_pose(pose)
            early_stop = self.session.early_stop()
            self._queue_stops([*self.session.take_completed(),
                               *([early_stop] if early_stop else [])])

    def add_joints(self, stamp: int, data: bytes) -> None:
        """Keep a serialised JointState, to be stored with the stop of its time."""
        with self.lock:
            self.joints.append((stamp, data))

    def _queue_stops(self, stops: Iterable[Stop]) -> None:
        """
        Queue stops, each in place of an earlier part; drop the oldest new ones if too many wait.

        Under lock.
        """
        self.session.limit_waiting(MAX_STOPS)
        for stop in stops:
            self.to_evaluate.pop(stop.stamp, None)
            self.to_evaluate[stop.stamp] = stop
        not_stored = [stamp for stamp, stop in self.to_evaluate.items() if not stop.load_messages]
        for stamp in not_stored[:-MAX_STOPS]:
            del self.to_evaluate[stamp]
            self._dropped_stops += 1
        if self.to_evaluate or self._frame_change_notice:
            self.worker.schedule()

    # the worker

    def start(self) -> None:
        """Start the processes and the worker."""
        self.pool.start()
        self.worker.start()

    def _do_due_work(self) -> None:
        """
        Do the due work, stop by stop: whoever calls meanwhile waits for one stop only.

        A new session begins where another frame has replaced one that gave no sample
        (`frame_change_notice` in sampling/input_faults.py).
        """
        with self.lock:
            notice = self._frame_change_notice
        if notice:
            self.clear_samples()
            self.attempt = Attempt(notice)
        elif self.evaluate_next():
            self.worker.schedule()
        else:
            self.solver.review_if_changed()

    # what is shown of it, from any thread

    def session_copy(self) -> Session:
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
        """Return a sentence on the running tasks; empty without any."""
        with self.lock:
            again = any(stop.load_messages for stop in self.to_evaluate.values())
        text = 'the samples are extracted again from their profiles' if again else ''
        return '; '.join(filter(None, (*self.worker.running_jobs, text)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings, one sentence each."""
        routine, count = self.verification.routine, self._dropped_stops
        return tuple(filter(None, (
            f'a verification ({routine.name}) continues: stops are not samples until '
            '~/verify_result' if routine else '',
            f'dropped {count} stops, the oldest of more than {MAX_STOPS} that waited to be '
            'evaluated: the processor cannot keep up; stop less often, or publish fewer points'
            if count else '')))

    @property
    def last_pose(self) -> Array | None:
        """Return T_base_flange (4, 4) of the last pose, None before the first."""
        poses = self._poses
        return se3.of_pose(poses[-1]) if poses else None

    def current_snapshot(self) -> StopSnapshot | None:
        """Return the last profile with poses before and after it; None without a usable one."""
        config = self.config
        with self.lock:
            # of equal stamps, as in a repeated playback, the last pose counts
            by_stamp = {pose.stamp: pose for pose in self._poses}
            poses = [pose for _, pose in sorted(by_stamp.items())]
            profiles = [profile for profile in self._profiles
                        if poses and poses[0].stamp <= profile.stamp <= poses[-1].stamp]
        if len(poses) < 2 or not profiles:
            return None
        try:
            profile = profiles[-1].read(config.profile)
            features, reason = features_of(profile, config), ''
        except UnusableMessageError:
            return None
        except FeatureError as error:
            features, reason = (), str(error)
        T_base_flange, = interpolate(poses, [profile.stamp])
        return StopSnapshot(0, profile.stamp, mount_poses(T_base_flange, config), profile.points,
                            features, reason)

    # from stops that wait to samples

    def evaluate_next(self) -> bool:
        """Evaluate the next stop that waits, new or stored; return whether there was one."""
        with self.lock:
            stop = self.to_evaluate.pop(next(iter(self.to_evaluate), 0), None)
        if stop and not stop.load_messages:
            with suppress(DataError):  # of a verification
                self._evaluate_new(stop)
        elif stop and not stop.final_reason:
            result = self.evaluate_in_process(stop, self.config)
            with self.lock:
                self.session.add_stop(self.session.with_result(stop, result))
        return stop is not None

    def evaluate_waiting(self) -> None:
        """Evaluate the stops that wait; each is published on its own."""
        while self.evaluate_next():
            self._publish_changes()

    def evaluate_all(self) -> None:
        """
        Evaluate all stops, of which the current one counts as complete.

        Raises InputError where messages have two frames, and there is no sample of one.
        """
        self.evaluate_waiting()
        with self.lock:
            self._queue_stops(self._end_stops())
        self.evaluate_waiting()

    def _end_stops(self) -> list[Stop]:
        """Return the stops that have begun; nothing more is taken of them. Under lock."""
        stops = self.session.copied().take_remaining()  # raises for mixed frames
        for stop in stops:
            self.session.mark_done(stop)
        return stops

    def discard_begun_stops(self) -> None:
        """Make no sample of a new stop that has begun, or waits; raises InputError."""
        with self.lock:
            self.to_evaluate = {stamp: stop for stamp, stop in self.to_evaluate.items()
                                if stop.load_messages}
            self._end_stops()

    def _evaluate_new(self, stop: Stop, is_requested: bool = False) -> str:
        """
        Evaluate a stop, store it, add it to the session; return what it gave, as a sentence.

        It replaces an earlier part of the same stop. During a verification it counts for that
        instead (LiveVerification.add_stop), unless it began before. is_requested: by
        ~/take_sample: where it gives no sample DataError is raised, where it cannot be stored
        InputError, and the session stays as it is. Otherwise it is a reject then.
        """
        if self.verification.routine and not stop.number:
            return self.verification.add_stop(stop)
        earlier = next((s for s in self.session.stops if s.stamp == stop.stamp), None)
        had_sample = bool(earlier and earlier.sample)
        stop = self.session.with_result(stop, self.evaluate_in_process(stop, self.config))
        if is_requested and stop.sample is None:
            remedy = ': move on, and turn the tool' if stop.final_reason else ''
            raise DataError(f'{sample_summary(stop.result)}{remedy}')
        stop = self._stored(stop, earlier, is_requested)
        with self.lock:
            self.session.add_stop(stop)
        again = ' again, of the same stop' if had_sample else ''
        outcome = (f'sample {stop.number} taken{again}' if stop.sample else
                   f'stop {stop.number} gave no sample')
        text = f'{outcome}: {sample_summary(stop.result)}'
        if is_requested or earlier is None or had_sample != bool(stop.sample):
            # the same result with more profiles is not reported again
            self.attempt = Attempt(text, stop)
        return text

    def _stored(self, stop: Stop, earlier: Stop | None, is_requested: bool) -> Stop:
        """
        Store an evaluated stop; return it as it is on the disk.

        Where that fails InputError is raised if it was requested; else it is a reject, or the
        earlier part of it, which has fewer profiles, but is on the disk.
        """
        with self.lock:
            joints = [*self.joints]
        try:
            return self._store(self.files.add_stop, stop, self.config, joints)
        except InputError as error:
            if is_requested:
                raise
            return earlier if earlier and earlier.load_messages else replace(
                stop, result=Reject(stop.result.stamp, str(error), final=True))

    def evaluate_in_process(self, stop: Stop, config: Config) -> Sample | Reject:
        """Return what a stop gives, evaluated in another process."""
        self._interrupted.discard(stop.stamp)
        self.worker.running_jobs.append(EVALUATING)
        try:
            return self.pool.submit(result_of, stop.trimmed(config), config).result()
        # InputError: its file is gone. PoolEndedError: the process was killed; the stop is stored
        # as a reject, to be tried again
        except (PoolEndedError, InputError) as error:
            if isinstance(error, PoolEndedError):
                self._interrupted.add(stop.stamp)
            return Reject(stop.stamp, str(error))
        finally:
            self.worker.running_jobs.remove(EVALUATING)

    def _evaluate_again(self, stops: Iterable[Stop]) -> None:
        """Queue stops of the session to be evaluated again, unless a later part of them waits."""
        with self.lock:
            self._queue_stops(stop for stop in stops if stop.stamp not in self.to_evaluate)

    def _close(self, stop: Stop) -> None:
        """Take nothing more of a stop, which may go on."""
        with self.lock:
            self.session.mark_done(stop)
            self.to_evaluate.pop(stop.stamp, None)

    # the disk

    def _store(self, write: Callable[..., Result], *args: Any) -> Result:
        """
        Write an event; raises InputError, which is a trouble until the next event is written.

        An event holds the settings. Once one is written, stops that could not be, or could not be
        read, are evaluated again.
        """
        try:
            result = write(*args)
        except InputError as error:
            self.storing_trouble = str(error)
            raise
        if self.storing_trouble:
            self.storing_trouble = ''
            self._evaluate_again(stop for stop in self.session.stops if not stop.sample)
        return result

    def retry_failed(self) -> None:
        """
        Queue the stops whose process ended, and store what could not be stored, if that works now.

        A folder that is gone is found here too: then there is a trouble.
        """
        self._evaluate_again(s for s in self.session.stops if s.stamp in self._interrupted)
        path = self.files.path
        if self.storing_trouble or path and not path.is_dir():
            with suppress(InputError):  # a trouble now
                self._store(self.files.add_event, CONFIGURED, self.config)

    # services

    def take_sample(self) -> str:
        """
        Take a sample at the current stop; return a sentence on its features.

        On return the stop is on the disk: a file of its own, synced, with its profiles (of many
        some), poses, joint values, result and the settings (SessionFiles.add_event). If it is
        taken again, both files stay, and the later one counts. During a verification nothing is
        stored.
        Raises DataError where there is no sample, InputError where it cannot be stored.
        """
        poses, profiles = self.message_counts['pose'], self.message_counts['profile']
        try:
            # by the clock of this machine: stop_on_request compares stamps, and takes a silence of
            # more than a second for clocks that differ
            if (poses.count and poses.silence > MAX_POSE_SILENCE
                    and profiles.silence < MAX_PROFILE_SILENCE):
                raise silent_poses_error(poses.silence)
            with self.lock:
                stop = self.session.stop_on_request()
            text = self._evaluate_new(stop, is_requested=True)
        except HandeyeError as error:
            self.attempt = Attempt(str(error))
            raise
        self._close(stop)
        return text

    def remove_last_sample(self, number: int | None = None) -> str:
        """
        Forget the last sample; number: of that which whoever asks takes for the last.

        Raises DataError without one, or if another is the last, InputError where that cannot be
        stored.
        """
        samples = [stop for stop in self.session.stops if stop.sample]
        if not samples:
            raise DataError('there is no sample to remove', code='nothing_to_remove')
        last = samples[-1]
        if number not in (None, last.number):
            raise DataError(f'sample {last.number} is the last now: look at it, then remove it')
        self._store(self.files.add_event, REMOVED, self.config, Stop(0, number=last.number))
        with self.lock:
            self.session.remove(last)
        self._close(last)
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{len(samples) - 1} left')

    def clear_samples(self) -> str:
        """Begin a new session; the files of the old one stay. Raises InputError."""
        count, files, note = self._sample_count(), self.files, ''
        config = replace(self.config, samples=SamplesConfig())  # numbers begin again
        if files.path:
            note = f'; they are kept in {files.path}' if files.path.is_dir() else ''
            files = SessionFiles(self.folders.folder)
            try:
                files.add_event(CONFIGURED, config)  # so that `last` names it
            except InputError:
                files.discard()
                raise
        self._replace_session(files, Session(config), 'the samples were cleared')
        return f'{count_of(count, "sample")} removed; bags and clocks may start again{note}'

    def open_session(self, stored: StoredSession, config: Config) -> str:
        """Continue a session of the disk, and solve; return the message. Raises HandeyeError."""
        files = SessionFiles(self.folders.folder, stored, config)
        try:  # again, now that no other node writes it
            session = self.pool.submit(read_session(stored.path).session, config).result()
        except BaseException:
            files.close()
            raise
        self._replace_session(files, session, 'a session was opened')
        self.solver.is_wanted = bool(self.session.samples)  # as it probably was before
        now, before = settings_of(config, ANSWER_KEYS), settings_of(stored.config, ANSWER_KEYS)
        changes = ''.join(f'; {key} is {value} now, was {before[key]}'
                          for key, value in now.items() if value != before[key])
        count = count_of(self._sample_count(), 'sample')
        return f'continuing with {count} of {self.path}{changes}'

    def _replace_session(self, files: SessionFiles, session: Session, why: str) -> None:
        """Go on with another session; forget what followed from the one before."""
        if files is not self.files:
            self.files.close()
        with self.lock:
            self._begin(files, session)
        self.restart_streams()
        self.verification.end()
        self.solver.forget(why)

    def _sample_count(self) -> int:
        """Return the number of stops of the session that gave a sample."""
        return sum(stop.sample is not None for stop in self.session.stops)

    @property
    def _frame_change_notice(self) -> str:
        """Return a sentence that a topic has another frame now; '' if a result would be lost."""
        in_use = self.verification.routine or self.solver.calibration
        return '' if in_use else frame_change_notice(
            self.session.streams, self.session.has_samples)

    # settings

    def configure(self, config: Config, other_topics: bool = False) -> None:
        """
        Apply changed settings, already checked by the node (`_apply_settings`, node.py).

        They are stored first, and refused (InputError) if that fails. name and output_dir hold for
        results at once, for samples from the next session on. Then, as they differ:
        - other topics: a session without messages begins, which goes on with its numbers;
        - time_offset: stops from before end with the old one;
        - verify.routine: a verification ends without a result;
        - profile: messages that could not be read are not counted any more;
        - SAMPLE_KEYS (solver.py): all stops are evaluated again, from their files;
        - ANSWER_KEYS: the worker reviews the samples again, and computes the answer again if one
          was asked for (`review_if_changed` in solver.py).
        """
        old = self.config
        if not other_topics and config.offset_ns != old.offset_ns:
            with suppress(InputError):
                self.evaluate_all()
        if self.files.path:
            try:
                self._store(self.files.add_event, CONFIGURED, config)
            except InputError:
                # another place for the next session is what helps where this one is full
                if self.folders.folder(config) == self.folders.folder(old):
                    raise
        if other_topics:
            self._replace_session(self.files, Session(config, self.session.last_number),
                                  'the topics were changed')
        with self.lock:
            self.session.configure(config)
        if config.verify.routine != old.verify.routine:
            self.verification.end()
        if config.profile != old.profile:
            self.message_counts['profile'].forget_malformed()
        if settings_of(config, SAMPLE_KEYS) != settings_of(old, SAMPLE_KEYS):
            self._evaluate_again(self.session.stops)
