# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The session: from the messages of both topics to complete stops, and what each gives.

The same Session takes the messages of a bag and those of live topics. A stop passes through

1. the current stop, while the robot stands: it is cut from the stream of poses alone (StopFinder)
2. waiting, once the robot has gone on, until the profiles have passed its end, too: so it does not
   depend on the order of arrival. In manual mode no stop waits: it is only counted
3. done: `take_completed` returns it, once, with its profiles (at the end of a recording
   `take_remaining`, with the current one). `stop_on_request` and `early_stop` return the current
   stop already while the robot stands: it may come back with more profiles, unless `mark_done`
   forbids it
4. evaluated: `result_of` (features.py) makes a Sample or a Reject of it, `numbered` gives it a
   number, and `add_stop` stores it
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
import math

from handeye_ros import se3, targets
from handeye_ros.config import Config, UNNAMED_FRAME
from handeye_ros.data import AnyProfile, Array, NS, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.frames import frame_notes
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.stops import Motion, ProfileBuffer, PROFILES_OF_SAMPLE, Stop, StopFinder
from handeye_ros.sampling.stream import Copyable, LAST_STAMP, REORDER_TIME, Stream
from handeye_ros.sampling.sweep import passes_expanded
from handeye_ros.words import count_of
import numpy as np

POSES_MISSING_TIME = 0.25  # s without a pose, while profiles come: then the robot may be anywhere
SAME_PLANE = 5e-4  # m: largest difference across the light plane between profiles of one plane
MIN_TILTED, TILT_REST = 8, 0.03  # stops that show a tilted plane; what it leaves unexplained
MAX_REPEATS = 20  # of one stamp in a row: its clock stands still
MAX_FLANGE_DISTANCE = 50.0  # m: no flange is there, it is another unit
# of a stop without any profile, before it is said that it gives no sample
NO_PROFILE_PATIENCE = 2 * NS
LATER_LOOK = 1.4  # ratio of the times after which a stop without a sample is tried again


def duplicate_pose_reason(sample: Sample, others: Iterable[Stop], config: Config) -> str:
    """Return in words which of other stops has the pose of a sample, '' if none."""
    limits = config.sampling
    for other in others:
        if other.sample:
            T = se3.inverse(other.sample.T_base_flange) @ sample.T_base_flange
            away, angle = math.hypot(*T[:3, 3]), float(se3.angle(T[:3, :3]))
            if away < limits.new_translation and angle < limits.new_rotation:
                return (f'{away * 1e3:.0f} mm and {np.degrees(angle):.1f} degrees from '
                        f'sample {other.number}: it brings nothing new')
    return ''


class Session(Copyable):
    """
    Receives poses and profiles, returns each stop once, and keeps what it gives.

    config: the current settings
    last_number: the last one assigned
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
        self._flange_distance = 0.0  # of the last pose (m)
        self._pose_stream: Stream[TimedPose] = Stream('pose', frames[0])
        self._profile_stream: Stream[AnyProfile] = Stream('profile', frames[1])

    @property
    def _streams(self) -> tuple[Stream[TimedPose], Stream[AnyProfile]]:
        return self._pose_stream, self._profile_stream

    def configure(self, config: Config) -> None:
        """Apply another configuration to what comes from now on, the current stop too."""
        if config.sampling.moving != self.config.sampling.moving:
            self._finder = StopFinder(config.sampling)
        if config.offset_ns != self.config.offset_ns:  # stamps before have the old one
            self._profiles.clear()
            self._profile_stream.restart()
        self.config, self._finder.sampling = config, config.sampling

    def without_messages(self, config: Config) -> Session:
        """Return a copy with other settings, without the messages that wait: they are many."""
        session = self.copied()
        session.config, session._finder = config, StopFinder(config.sampling)
        session._waiting = []
        session._profiles.clear()
        return session

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        self._take_poses(self._pose_stream.add(pose, pose.parent_frame))

    def _take_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            self._flange_distance = math.hypot(*pose.translation)
            stop = self._finder.add(pose)
            if stop and self.config.sampling.automatic:
                self._waiting.append(stop)
            elif stop:
                self._unrequested_count += 1

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        self._profiles.add(self._profile_stream.add(profile, profile.frame_id))

    def limit_waiting(self, most: int) -> None:
        """Limit the number of stops that wait for profiles; the oldest are dropped and counted."""
        too_many = max(len(self._waiting) - most, 0)
        self._expired_count += too_many
        del self._waiting[:too_many]

    def take_completed(self) -> list[Stop]:
        """Return the stops that are over in both streams, each once, with their profiles."""
        if any(stream.step_back for stream in self._streams):
            return self._restart_after_step_back()
        # a sensor that is triggered once at each stop does not send the next profile soon
        now = self._pose_stream.latest
        self._profiles.add(self._profile_stream.release(now - REORDER_TIME, now + REORDER_TIME))
        stops = self._take_out([stop for stop in self._waiting
                                if stop.end < self._profile_stream.latest])
        # keep only the profiles that stops that wait, the current one, and those to come can use
        first, last = self._finder.window()
        self._profiles.keep(self._waiting[0].start if self._waiting else first, last, now)
        return stops

    def _restart_after_step_back(self) -> list[Stop]:
        """Continue after a clock was set back; return the stops from before."""
        stops = self._take_out(self._all_stops())
        self._finder = StopFinder(self.config.sampling)
        if self._profile_stream.step_back:
            self._profiles.clear()
        for stream in self._streams:
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
        self._take_poses(self._pose_stream.release(0, LAST_STAMP))
        self._profiles.add(self._profile_stream.release(0, LAST_STAMP))
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

    def stop_on_request(self) -> Stop:
        """
        Return the stop at which the robot stands now.

        Raises the conflict of the streams, and DataError without current poses (its code
        no_poses, silent_poses, late_poses or position_unit), or while the robot moves (moving).
        """
        if self.conflict:
            raise self.conflict
        self._require_usable_poses()
        poses, stop = self._pose_stream, self._finder.current()
        if poses.late:
            raise DataError('the robot position is not known: its poses have older stamps than '
                            'those before', code='late_poses')
        # of stamps: more than REORDER_TIME may be clocks that differ; the node asks its own clock
        silence = (self._profile_stream.latest - poses.latest) / NS
        if max(POSES_MISSING_TIME, 5 * poses.period) < silence < REORDER_TIME / NS:
            raise silent_poses_error(silence)
        if stop is None:
            if self.config.sampling.moving:
                raise DataError('the pass has just begun: sweep on, and take the sample in a '
                                'second', code='moving')
            motion = self.motion.sentence if self.motion else 'too few poses have come'
            raise DataError(f'the robot must stand still for {self.config.sampling.still_time:g} '
                            f's, and {motion}: wait, and take the sample again', code='moving')
        self._profiles.add(self._profile_stream.release(stop.start, stop.end))
        return stop.with_profiles(self._profiles.items, self.config)

    @property
    def unusable_poses_error(self) -> DataError | None:
        """Return the error of poses whose clock stands still, or in another unit, or None."""
        if self._pose_stream.repeats >= MAX_REPEATS:
            return DataError('all poses have the same stamp: the clock of their driver stands '
                             'still; with use_sim_time, /clock must be published',
                             code='late_poses')
        if self._flange_distance > MAX_FLANGE_DISTANCE:
            return DataError(f'the flange is {self._flange_distance:.0f} m from the base of the '
                             'robot: the positions seem to be in mm; publish them in metres',
                             code='position_unit')
        return None

    def _require_usable_poses(self) -> None:
        if self.unusable_poses_error:
            raise self.unusable_poses_error
        if self._pose_stream.frame is None:  # one that is held was received too
            keys = self.config.key_of_poses or 'robot_base_frame and robot_effector_frame'
            raise DataError(f'no flange pose was received on {self.config.topic_of_poses}: start '
                            f'the robot driver, or set {keys}', code='no_poses')

    def _require_no_conflict(self) -> None:
        """Raise the conflict of the streams, but of two frames only before the first sample."""
        conflict = self.conflict  # what has another frame is dropped: samples are all of one
        if conflict and not (conflict.code == 'two_frames' and self._has_samples):
            raise conflict

    @property
    def _has_samples(self) -> bool:
        return any(stop.sample for stop in self._stops.values())

    def require_any_stop(self) -> None:
        """
        Refuse a recording in which the robot never stood still, or seldom long enough.

        Raises InputError as take_remaining does, of a tilted light plane by all samples, and
        DataError, its code no_poses, not_asked, late_poses, position_unit, sparse_poses or
        no_stops.
        """
        self._require_no_conflict()
        poses, sampling, count = self._pose_stream, self.config.sampling, len(self._done)
        if sampling.mode == 'still' and self._finder.short_rest_count > count and (
                0 < count < targets.target_for(self.config).min_samples):
            raise DataError(f'the robot stood still for {sampling.still_time:g} s only '
                            f'{count_of(count, "time")}, and {self._finder.short_rest_count} '
                            'times for less: stay longer at each stop, or lower '
                            'sampling.still_time', code='no_stops')
        if count or self.last_number:
            return
        if self.unrequested_stops_notice:
            raise DataError(self.unrequested_stops_notice, code='not_asked')
        self._require_usable_poses()
        if poses.period > sampling.max_pose_gap:
            raise DataError(
                'the flange poses, or the joint values that give them, come only every '
                f'{poses.period:.2g} s, more than sampling.max_pose_gap '
                f'({sampling.max_pose_gap:g} s): publish them more often, also while the robot '
                'stands still, or raise sampling.max_pose_gap', code='sparse_poses')
        if sampling.moving:
            raise DataError(f'the {poses.count} poses make no sweep: nowhere are there '
                            f'{min(sampling.still_time, 1.0):g} s of them without a gap: record '
                            'a longer sweep', code='no_stops')
        raise DataError(f'the robot never stood still for {sampling.still_time:g} s in '
                        f'{poses.count} poses, but for {self._finder.longest_rest_ns / NS:.2g} s '
                        'at most: stop at each sample, and let its poses be sent while it stands, '
                        'too, or lower sampling.still_time; if its poses are noisy, raise '
                        'sampling.still_translation and sampling.still_rotation; if the robot '
                        'moves all the time, set sampling.mode to moving',
                        code='no_stops')

    @property
    def warnings(self) -> tuple[str, ...]:
        """
        Return one sentence for each kind of message and stop that was dropped.

        And for wrong numbers in samples.exclude, and a frame that is not as it seems.
        """
        sentences = [f'gave up {count_of(self._expired_count, "stop")}, the oldest that waited '
                     'for profiles'] if self._expired_count else []
        # a sample that was removed had a number
        missing = [n for n in self.config.samples.exclude if n > self.last_number]
        if missing and self._stops:
            sentences.append(f'samples.exclude names no stop of these: {missing}')
        out_of_plane = max((abs(float(across)) for across, *_ in self._centroids), default=0.0)
        return (*self._pose_stream.warnings, *self._profile_stream.warnings,
                *self._profiles.warnings, *sentences,
                *frame_notes(self._profile_stream.frame, out_of_plane, self.config))

    @property
    def conflict(self) -> InputError | None:
        """
        Return why the messages contradict the settings or each other, or None.

        Its code is base_frame (another one than in the settings), tilted_plane (of the light)
        or two_frames (on a topic).
        """
        wanted = self.config.robot_base_frame.lstrip('/')
        if wanted and self.base_frame and wanted != self.base_frame:
            return InputError(f'the poses are given in "{self.base_frame}", but robot_base_frame '
                              f'is "{wanted}": set it to {self.base_frame}, or leave it out; it '
                              'is then that of the poses', code='base_frame')
        return (_tilted_plane_error(self._centroids, self.config.profile.axes)
                or self._pose_stream.conflict or self._profile_stream.conflict)

    @property
    def _centroids(self) -> list[Array]:
        return [stop.sample.centroid for stop in self._stops.values()
                if stop.sample and stop.sample.centroid is not None]

    @property
    def frame_change_notice(self) -> str:
        """Return in words that another frame replaced the first, which gave no sample; or ''."""
        for stream in self._streams:
            if stream.successor and not self._has_samples:
                return (f'only {stream.kind}s of frame "{stream.successor}" come now, and none of '
                        f'"{stream.frame}" gave a sample: the session begins anew')
        return ''

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        frame = self._profile_stream.frame
        return '' if frame is None else frame or UNNAMED_FRAME

    @property
    def base_frame(self) -> str:
        """Return the frame of the poses, empty before the first one."""
        return (self._pose_stream.frame or '').lstrip('/')

    @property
    def late_streams(self) -> tuple[str, ...]:
        """Return which streams (poses, profiles) are dropped because their stamps are too old."""
        return tuple(f'{stream.kind}s' for stream in self._streams if stream.late)

    @property
    def motion(self) -> Motion | None:
        """Return the current motion of the robot, None with fewer than two poses."""
        return self._finder.motion()

    @property
    def is_standing(self) -> bool:
        """Return whether the robot has stood still long enough for a sample."""
        motion = self.motion
        return motion is not None and motion.rest_time >= self.config.sampling.still_time

    @property
    def unrequested_stops_notice(self) -> str:
        """Return in words that the robot stopped but no sample was requested, '' otherwise."""
        if self._done or not self._unrequested_count:
            return ''
        return (f'the robot stood still {count_of(self._unrequested_count, "time")}, but no '
                'sample was requested: sampling.mode is manual; call ~/take_sample at each stop, '
                'send ~/take, or set sampling.mode to still')

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

    def config_with_base_frame(self, config: Config) -> Config:
        """Return settings with the frame of the poses as the base, if they name none."""
        return config if config.robot_base_frame else replace(
            config, robot_base_frame=self.base_frame)

    def evaluate_remaining(self) -> None:
        """Evaluate and store all remaining stops; raises InputError as take_remaining does."""
        for stop in self.take_remaining():
            self.add_stop(self.numbered(stop, result_of(stop, self.config)))

    def early_stop(self) -> Stop | None:
        """
        Return the current stop as soon as it has enough profiles for a sample, else None.

        It is looked at when the robot has stood for still_time and twice settle_time, and, until
        it gives a sample, each time that this has become LATER_LOOK times longer, as the cause may
        be gone. At first it needs PROFILES_OF_SAMPLE, later one, and none after
        NO_PROFILE_PATIENCE. take_completed() returns it again when it is over.
        """
        sampling, stood = self.config.sampling, self._pose_stream.latest - self._finder.stamp
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

    def numbered(self, stop: Stop, result: Sample | Reject) -> Stop:
        """Return a stop with its number and result; a duplicate pose gives no sample."""
        earlier = self._stops.get(stop.stamp)  # of the same stop, with fewer profiles
        others = [other for other in self.stops
                  if other is not earlier and not self.excludes(other)]
        duplicate = '' if isinstance(result, Reject) or result.moving else duplicate_pose_reason(
            result, others, self.config)
        return replace(stop, number=earlier.number if earlier else self.last_number + 1,
                       result=Reject(result.stamp, duplicate, final=True) if duplicate else result)

    def add_stop(self, stop: Stop) -> None:
        """Store an evaluated stop, in place of an earlier part of it."""
        self._stops[stop.stamp] = stop
        self.last_number = max(self.last_number, stop.number)

    def remove(self, stop: Stop) -> None:
        """Forget the result of a stop."""
        self._stops.pop(stop.stamp, None)


def _tilted_plane_error(centroids: Sequence[Array], axes: Sequence[str]) -> InputError | None:
    """
    Return the error of profiles in a plane that is tilted against their axes, None if it is not.

    centroids: of the samples, see Sample. Of a tilted plane the distance across it follows from
    the other coordinates; an encoder's position does not.
    """
    if len(centroids) < MIN_TILTED:
        return None
    across, along, distance = np.transpose(centroids)
    if np.ptp(across) < SAME_PLANE:
        return None
    plane = np.column_stack([along, distance, np.ones(len(across))])
    residual = across - plane @ np.linalg.lstsq(plane, across, rcond=None)[0]
    if not np.std(residual) < TILT_REST * np.std(across):
        return None
    return InputError(
        f'the profiles lie between {across.min() * 1e3:.1f} and {across.max() * 1e3:.1f} mm '
        f'beside the plane of {" and ".join(axes)} in their frame, as in a light plane that is '
        'tilted against it: let the driver publish them in a frame of the light plane; a static '
        'transform can hold the tilt', code='tilted_plane')


def silent_poses_error(seconds: float) -> DataError:
    """Return the refusal of a sample while no pose has come for a time (s)."""
    return DataError(f'no pose has come for {seconds:.1f} s, so the robot position is not known: '
                     'check the robot driver, and take the sample again', code='silent_poses')
