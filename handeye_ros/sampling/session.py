# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The session: from the messages of both topics to complete stops, and what each gives.

The same Session takes the messages of a bag and those of live topics, by `add_pose` and
`add_profile`. A stop, or a pass of a moving robot, then goes through these states; the methods are
in their order:

1. current, while the robot stands: it is cut from the stream of poses alone (StopFinder).
   `early_stop` and `stop_on_request` return it already then: it may come back with more profiles,
   unless `mark_done` forbids it
2. waiting, once the robot has gone on, until the profiles have passed its end, too: so it does not
   depend on the order of arrival. In manual mode no stop waits: it is only counted
   (`unrequested_count`)
3. done: `take_completed` returns it, once, with its profiles. At the end of a recording
   `take_remaining` returns all others, with the current one; `require_any_stop` refuses a
   recording without any
4. evaluated: `result_of` (features.py) makes a Sample or a Reject of it, `without_duplicate`
   rejects a pose that another sample has, `with_result` gives it its number, and `add_stop` stores
   it, for `stops`, `samples` and `rejects`

Why the session cannot use what came is said, in words, by input_faults.py.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

from handeye_ros import targets
from handeye_ros.config import Config, UNNAMED_FRAME
from handeye_ros.data import AnyProfile, NS, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.input_faults import (
    base_frame_error,
    duplicate_pose_reason,
    frame_warnings,
    no_stops_error,
    not_standing_error,
    require_current_poses,
    require_long_rests,
    require_usable_poses,
    stop_warnings,
    tilted_plane_error,
    unrequested_stops_notice,
)
from handeye_ros.sampling.stops import Motion, ProfileBuffer, PROFILES_OF_SAMPLE, Stop, StopFinder
from handeye_ros.sampling.stream import Copyable, LAST_STAMP, REORDER_TIME, Stream
from handeye_ros.sampling.sweep import passes_expanded

# of a stop without any profile, before it is said that it gives no sample
NO_PROFILE_PATIENCE = 2 * NS
LATER_LOOK = 1.4  # ratio of the times after which a stop without a sample is tried again


class Session(Copyable):
    """
    Receives poses and profiles, returns each stop once, and keeps what it gives.

    config: the current settings
    last_number: the largest that a stop has had, also one that was removed
    pose_stream, profile_stream: what the messages of either topic pass through
    flange_distance: of the last pose from the base (m)
    """

    def __init__(self, config: Config, last_number: int = 0,
                 frames: tuple[str | None, str | None] = (None, None)) -> None:
        """
        Start with no messages; raises InputError for a method or target that it cannot have.

        last_number, frames (of the poses, of the profiles): those of a session that goes on.
        """
        targets.target_for(config)
        self.config = config
        self.last_number = last_number
        self._stops: dict[int, Stop] = {}  # the evaluated ones, by their stamps
        self._finder = StopFinder(config.sampling)
        self._waiting: list[Stop] = []  # for profiles
        self._profiles = ProfileBuffer()
        self._done: set[int] = set()  # stamps of stops that are not returned (again)
        self._early_looks = 0  # how often early_stop has looked at the current stop
        self._unrequested_count = 0  # stops in manual mode
        self._expired_count = 0  # stops dropped while waiting for profiles
        self.flange_distance = 0.0  # of the last pose (m)
        self.pose_stream: Stream[TimedPose] = Stream('pose', frames[0])
        self.profile_stream: Stream[AnyProfile] = Stream('profile', frames[1])

    @property
    def streams(self) -> tuple[Stream[TimedPose], Stream[AnyProfile]]:
        """Return the streams of the poses and of the profiles."""
        return self.pose_stream, self.profile_stream

    @property
    def base_frame(self) -> str:
        """Return the frame of the poses, empty before the first one."""
        return (self.pose_stream.frame or '').lstrip('/')

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        frame = self.profile_stream.frame
        return '' if frame is None else frame or UNNAMED_FRAME

    def configure(self, config: Config) -> None:
        """Apply another configuration to what comes from now on, the current stop too."""
        if config.sampling.moving != self.config.sampling.moving:
            self._finder = StopFinder(config.sampling)
        if config.offset_ns != self.config.offset_ns:  # stamps before have the old one
            self._profiles.clear()
            self.profile_stream.restart()
        self.config, self._finder.sampling = config, config.sampling

    def without_messages(self, config: Config) -> Session:
        """Return a copy with other settings, without the messages that wait: they are many."""
        session = self.copied()
        session.config, session._finder = config, StopFinder(config.sampling)
        session._waiting = []
        session._profiles.clear()
        return session

    # messages

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        self._take_poses(self.pose_stream.add(pose, pose.parent_frame))

    def _take_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            self.flange_distance = math.hypot(*pose.translation)
            stop = self._finder.add(pose)
            if stop and self.config.sampling.automatic:
                self._waiting.append(stop)
            elif stop:
                self._unrequested_count += 1

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        self._profiles.add(self.profile_stream.add(profile, profile.frame_id))

    # 1. the current stop

    @property
    def motion(self) -> Motion | None:
        """Return the current motion of the robot, None with fewer than two poses."""
        return self._finder.motion()

    @property
    def is_standing(self) -> bool:
        """Return whether the robot has stood still long enough for a sample."""
        motion = self.motion
        return motion is not None and motion.rest_time >= self.config.sampling.still_time

    def early_stop(self) -> Stop | None:
        """
        Return the current stop as soon as it has enough profiles for a sample, else None.

        It is looked at when the robot has stood for still_time and twice settle_time, and, until
        it gives a sample, each time that this has become LATER_LOOK times longer, as the cause may
        be gone. At first it needs PROFILES_OF_SAMPLE, later one, and none after
        NO_PROFILE_PATIENCE. take_completed() returns it again when it is over.
        """
        sampling, stood = self.config.sampling, self.pose_stream.latest - self._finder.stamp
        first_look = (sampling.still_time + 2 * sampling.settle_time) * NS
        if stood < first_look:  # it has just begun
            self._early_looks = 0
        if sampling.mode != 'still' or stood < first_look * LATER_LOOK ** self._early_looks:
            return None
        fewest = (PROFILES_OF_SAMPLE if self._early_looks == 0 else
                  1 if stood < NO_PROFILE_PATIENCE else 0)
        self._early_looks += 1
        stop, evaluated = self._finder.current(), self._stops.get(self._finder.stamp)
        if stop is None or self.is_done(stop) or (evaluated and evaluated.sample):
            return None
        stop = stop.with_profiles(self._profiles.items, self.config)
        return stop if len(stop.settled_profiles(self.config)) >= fewest else None

    def stop_on_request(self) -> Stop:
        """
        Return the stop at which the robot stands now.

        Raises the conflict of the streams, and DataError without current poses (its code
        no_poses, silent_poses, late_poses or position_unit), or while the robot moves (moving).
        """
        if self.conflict:
            raise self.conflict
        require_usable_poses(self.pose_stream, self.flange_distance, self.config)
        require_current_poses(*self.streams)
        stop = self._finder.current()
        if stop is None:
            raise not_standing_error(self.motion, self.config.sampling)
        self._profiles.add(self.profile_stream.release(stop.start, stop.end))
        return stop.with_profiles(self._profiles.items, self.config)

    # 2. stops that wait for profiles, 3. those that are done

    def limit_waiting(self, most: int) -> None:
        """Limit the number of stops that wait for profiles; the oldest are dropped and counted."""
        too_many = max(len(self._waiting) - most, 0)
        self._expired_count += too_many
        del self._waiting[:too_many]

    def take_completed(self) -> list[Stop]:
        """Return the stops that are over in both streams, each once, with their profiles."""
        if any(stream.step_back for stream in self.streams):
            return self._restart_after_step_back()
        # a sensor that is triggered once at each stop does not send the next profile soon
        now = self.pose_stream.latest
        self._profiles.add(self.profile_stream.release(now - REORDER_TIME, now + REORDER_TIME))
        stops = self._take_out([stop for stop in self._waiting
                                if stop.end < self.profile_stream.latest])
        # keep only the profiles that stops that wait, the current one, and those to come can use
        first, last = self._finder.window()
        self._profiles.keep(self._waiting[0].start if self._waiting else first, last, now)
        return stops

    def _restart_after_step_back(self) -> list[Stop]:
        """Continue after a clock was set back; return the stops from before."""
        stops = self._take_out(self._all_stops())
        self._finder = StopFinder(self.config.sampling)
        if self.profile_stream.step_back:
            self._profiles.clear()
        for stream in self.streams:
            if stream.step_back:
                stream.restart()
        return stops

    def take_remaining(self) -> list[Stop]:
        """
        Return the stops that were not returned yet, the current one as if it were over.

        Raises InputError for another base frame than that of the settings, a tilted light plane
        that earlier samples show (those of these stops: require_any_stop), and two frames on a
        topic, unless there are samples: all are of the first.
        """
        self._require_no_conflict()
        self._take_poses(self.pose_stream.release(0, LAST_STAMP))
        self._profiles.add(self.profile_stream.release(0, LAST_STAMP))
        return self._take_out(self._all_stops())

    def _all_stops(self) -> list[Stop]:
        """Return the stops that wait, and the current one unless stops are taken by hand."""
        current = self._finder.current() if self.config.sampling.automatic else None
        return [*self._waiting, *([current] if current else [])]

    def _take_out(self, stops: Sequence[Stop]) -> list[Stop]:
        """Let stops wait no longer; return those that were not returned before, with profiles."""
        not_returned = [stop for stop in stops if not self.is_done(stop)]
        self._done.update(stop.stamp for stop in stops)
        self._waiting = [stop for stop in self._waiting if not self.is_done(stop)]
        return [stop.with_profiles(self._profiles.items, self.config) for stop in not_returned]

    def is_done(self, stop: Stop) -> bool:
        """Return whether a stop was already returned, or is marked so."""
        return stop.stamp in self._done

    def mark_done(self, stop: Stop) -> None:
        """Mark a stop, so that it is not returned again."""
        self._done.add(stop.stamp)

    @property
    def unrequested_count(self) -> int:
        """Return how often the robot stopped in manual mode, if no sample was requested."""
        return 0 if self._done else self._unrequested_count

    def require_any_stop(self) -> None:
        """
        Refuse a recording in which the robot never stood still, or seldom long enough.

        Raises InputError as take_remaining does, of a tilted light plane by all samples, and
        DataError, its code no_poses, not_asked, late_poses, position_unit, sparse_poses or
        no_stops.
        """
        self._require_no_conflict()
        count = len(self._done)
        require_long_rests(count, self._finder, self.config)
        if count or self.last_number:
            return
        if notice := unrequested_stops_notice(self.unrequested_count):
            raise DataError(notice, code='not_asked')
        require_usable_poses(self.pose_stream, self.flange_distance, self.config)
        raise no_stops_error(self.pose_stream, self._finder)

    # 4. evaluated stops

    def evaluate_remaining(self) -> None:
        """Evaluate and store all remaining stops; raises InputError as take_remaining does."""
        for stop in self.take_remaining():
            self.add_stop(self.with_result(stop, result_of(stop, self.config)))

    def with_result(self, stop: Stop, result: Sample | Reject) -> Stop:
        """Return a stop with its number, by default a new one, and its result if no duplicate."""
        earlier = self._stops.get(stop.stamp)  # of the same stop, with fewer profiles
        number = stop.number or (earlier.number if earlier else self.last_number + 1)
        return replace(stop, number=number, result=self.without_duplicate(stop, result))

    def without_duplicate(self, stop: Stop, result: Sample | Reject) -> Sample | Reject:
        """Return the result of a stop, a reject of a sample whose pose another stop has."""
        if isinstance(result, Reject) or result.moving:
            return result
        others = [other for other in self.stops
                  if other.stamp != stop.stamp and not self.excludes(other)]
        duplicate = duplicate_pose_reason(result, others, self.config)
        return Reject(result.stamp, duplicate, final=True) if duplicate else result

    def add_stop(self, stop: Stop) -> None:
        """Store an evaluated stop, in place of an earlier part of it."""
        self._stops[stop.stamp] = stop
        self.last_number = max(self.last_number, stop.number)

    def remove(self, stop: Stop) -> None:
        """Forget the result of a stop."""
        self._stops.pop(stop.stamp, None)

    @property
    def stops(self) -> tuple[Stop, ...]:
        """Return the evaluated stops in the order of their numbers."""
        return tuple(sorted(self._stops.values(), key=lambda stop: stop.number))

    @property
    def samples(self) -> tuple[Sample, ...]:
        """
        Return the samples without those of samples.exclude; of a pass one per profile.

        Each time with a new trajectory, to which its splines are fitted when they are needed.
        """
        return passes_expanded([stop.sample for stop in self.stops
                               if stop.sample and not self.excludes(stop)])

    @property
    def rejects(self) -> tuple[Reject, ...]:
        """Return the stops without a sample or with an excluded one, with the reasons."""
        return tuple(stop.result if isinstance(stop.result, Reject) else
                     Reject(stop.result.stamp,
                            f'sample {stop.number} is excluded by samples.exclude', final=True)
                     for stop in self.stops if stop.sample is None or self.excludes(stop))

    def excludes(self, stop: Stop) -> bool:
        """Return whether samples.exclude contains the sample of a stop."""
        return stop.number in self.config.samples.exclude

    @property
    def has_samples(self) -> bool:
        """Return whether any stop gave a sample, an excluded one too."""
        return any(stop.sample for stop in self._stops.values())

    def config_with_base_frame(self, config: Config) -> Config:
        """Return settings with the frame of the poses as the base, if they name none."""
        return config if config.robot_base_frame else replace(
            config, robot_base_frame=self.base_frame)

    # what is wrong, see input_faults.py

    @property
    def conflict(self) -> InputError | None:
        """
        Return why the messages contradict the settings or each other, or None.

        Its code is base_frame (another one than in the settings), tilted_plane (of the light)
        or two_frames (on a topic).
        """
        return (base_frame_error(self.base_frame, self.config)
                or tilted_plane_error(self._stops.values(), self.config)
                or self.pose_stream.conflict or self.profile_stream.conflict)

    def _require_no_conflict(self) -> None:
        """Raise the conflict of the streams, but of two frames only before the first sample."""
        conflict = self.conflict  # what has another frame is dropped: samples are all of one
        if conflict and not (conflict.code == 'two_frames' and self.has_samples):
            raise conflict

    @property
    def warnings(self) -> tuple[str, ...]:
        """
        Return one sentence for each kind of message and stop that was dropped.

        And for wrong numbers in samples.exclude, and a frame that is not as it seems.
        """
        stops = self._stops.values()
        return (*self.pose_stream.warnings, *self.profile_stream.warnings,
                *self._profiles.warnings,
                *stop_warnings(self._expired_count, stops, self.last_number, self.config),
                *frame_warnings(self.profile_stream.frame, stops, self.config))
