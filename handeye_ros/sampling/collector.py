# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From the messages of both topics to complete stops.

Stops come from the pose stream alone. A stop is complete only when both streams have passed its
end, so it does not depend on the order of arrival.
"""
from __future__ import annotations

from collections.abc import Sequence
import math

from handeye_ros.config import Config, UNNAMED_FRAME
from handeye_ros.data import AnyProfile, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.frames import frame_notes
from handeye_ros.sampling.stops import (
    decoded,
    FOREVER,
    Motion,
    NS,
    ProfileBuffer,
    Stop,
    StopFinder,
)
from handeye_ros.sampling.stream import Copied, LARGEST_STEP, Stream
import numpy as np

SILENCE = 0.25  # s without a pose, while profiles come: then the robot may be anywhere
SAME_PLANE = 5e-4  # m: largest difference across the light plane between profiles of one plane
LARGEST_POSITION = 50.0  # m: no flange is there, it is another unit


class StopCollector(Copied):
    """Receives poses and profiles, and returns each stop once."""

    def __init__(self, config: Config) -> None:
        """Start with no messages."""
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Forget all messages."""
        self._finder = StopFinder(self._config.sampling)
        self._waiting: list[Stop] = []  # for profiles
        self._profiles = ProfileBuffer()
        self._taken: set[int] = set()  # start stamps of the stops already returned
        self._passed_by = 0  # stops in manual mode
        self._unseen = 0  # stops dropped while waiting for profiles
        self._largest_position = 0.0
        self._beside: list[float] = []  # of the first profile of each stop
        self._pose_stream: Stream[TimedPose] = Stream('pose')
        self._profile_stream: Stream[AnyProfile] = Stream('profile')

    def configure(self, config: Config) -> None:
        """Apply another configuration to all stops and passes that begin from now on."""
        if config.sampling.moving != self._config.sampling.moving:
            self._finder = StopFinder(config.sampling)
        self._config, self._finder.sampling = config, config.sampling

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        self._take_poses(self._pose_stream.add(pose, pose.parent_frame))

    def _take_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            reach = math.hypot(*pose.translation)
            self._largest_position = max(self._largest_position, reach)
            stop = self._finder.add(pose)
            if stop and self._config.sampling.by_itself:
                self._waiting.append(stop)
            elif stop:
                self._passed_by += 1

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        self._profiles.add(self._profile_stream.add(profile, profile.frame_id))

    def keep_waiting(self, most: int) -> None:
        """Limit the number of stops that wait for profiles; the oldest are dropped and counted."""
        excess = max(len(self._waiting) - most, 0)
        self._unseen += excess
        del self._waiting[:excess]

    def passed(self) -> list[Stop]:
        """Return the stops that are complete in both streams and were not returned before."""
        if self._pose_stream.set_back or self._profile_stream.set_back:
            return self._before_setting_back()
        # a sensor that is triggered once at each stop does not send the next profile soon
        now = self._pose_stream.latest
        self._profiles.add(self._profile_stream.released(now - LARGEST_STEP, now + LARGEST_STEP))
        over = [s for s in self._waiting if self._profile_stream.latest > s.end]
        self._waiting = [s for s in self._waiting if s not in over]
        stops = self._completed(over)
        # only what stops that wait, the current one, and those to come, can use is kept
        first, last = self._finder.window()
        self._profiles.keep(min([first, *(s.start for s in self._waiting)]),
                            max([last, *(s.end for s in self._waiting)]), now)
        return stops

    def _before_setting_back(self) -> list[Stop]:
        """Continue after a clock was set back; return the stops from before."""
        stops = self._remaining()
        self._finder = StopFinder(self._config.sampling)
        if self._pose_stream.set_back:
            self._pose_stream.restart()
        if self._profile_stream.set_back:
            self._profile_stream.restart()
            self._profiles = ProfileBuffer()
        return stops

    def rest(self) -> list[Stop]:
        """
        Return all remaining stops, including the current one.

        Raises InputError when messages of two frames came on one topic.
        """
        self._require_one_frame()
        self._take_poses(self._pose_stream.released(0, FOREVER))
        self._profiles.add(self._profile_stream.released(0, FOREVER))
        return self._remaining()

    def _remaining(self) -> list[Stop]:
        current = self._finder.current() if self._config.sampling.by_itself else None
        stops, self._waiting = [*self._waiting, *([current] if current else [])], []
        return self._completed(stops)

    def _completed(self, stops: Sequence[Stop]) -> list[Stop]:
        """Return stops with their profiles, without those that were returned before."""
        new = [stop for stop in stops if stop.began not in self._taken]
        self._taken |= {stop.began for stop in new}
        return [self._with_profiles(stop) for stop in new]

    def _with_profiles(self, stop: Stop) -> Stop:
        stop = stop.with_profiles(self._profiles.items, self._config)
        for profile in decoded(stop.profiles[:1], self._config):
            self._beside.append(profile.beside)
        return stop

    def is_taken(self, stop: Stop) -> bool:
        """Return whether a stop was already sampled, or is to be ignored."""
        return stop.began in self._taken

    def leave(self, stop: Stop) -> None:
        """Mark a stop as taken, so that it is not returned again."""
        self._taken.add(stop.began)

    def current_stop(self) -> Stop:
        """
        Return the stop at which the robot stands now.

        Raises InputError for two frames on a topic, and DataError without current poses
        (reason no_poses, silent_poses, late_poses) or while the robot moves (moving).
        """
        self._require_one_frame()
        self._require_poses_now()
        stop = self._finder.current()
        if stop is None:
            needed, motion = self._config.sampling.still_time, self.motion
            if motion is None:
                how = 'too few poses have come to measure its motion: wait'
            elif motion.speed * needed <= self._config.sampling.still_translation and (
                    motion.turning * needed <= self._config.sampling.still_rotation):
                missing = max(needed - motion.still, 0.1)
                how = f'but for {motion.still:.1f} s: wait {missing:.1f} s more'
            else:
                how = f'{motion.sentence}: stop it, wait'
            raise DataError(f'the robot has not stood still for {needed:g} s, {how}, and take the '
                            'sample again', reason='moving')
        self._profiles.add(self._profile_stream.released(stop.start, stop.end))
        return self._with_profiles(stop)

    def _require_poses_now(self) -> None:
        """Raise an error where no current poses arrive: the position of the robot is unknown."""
        poses = self._pose_stream
        if poses.frame is None:
            raise self._no_poses()
        if poses.late or poses.latest < 0:
            raise DataError('the poses come with older stamps than those before, so the robot '
                            'position is not known: if the clock was set, wait a second and take '
                            'the sample again; otherwise let only one node publish poses',
                            reason='late_poses')
        silence = (self._profile_stream.latest - poses.latest) / NS
        if max(SILENCE, 5 * poses.period) < silence < LARGEST_STEP / NS:
            raise silent_poses(silence)

    def _no_poses(self) -> DataError:
        where, advice = (self._config.pose_topic, 'pose_topic') if (
            self._config.pose_source == 'topic') else (
            '/tf', 'robot_base_frame and robot_effector_frame')
        return DataError(f'no flange pose was received on {where}: start the robot driver, or set '
                         f'{advice}', reason='no_poses')

    def _require_one_frame(self) -> None:
        if self.conflict:
            raise self.conflict

    def require_stops(self) -> None:
        """
        Refuse a recording in which the robot never stood still.

        Raises DataError, its reason no_poses, not_asked, position_unit, sparse_poses or no_stops,
        and InputError for messages of two frames, or of a light plane tilted in its frame.
        """
        self._require_one_frame()
        if self._taken:
            return
        poses, sampling = self._pose_stream, self._config.sampling
        if not poses.count:
            raise self._no_poses()
        if self.unasked:
            raise DataError(self.unasked, reason='not_asked')
        if self._largest_position > LARGEST_POSITION:
            raise DataError(f'the flange positions reach {self._largest_position:.0f} m: they '
                            'seem to be in mm; publish them in metres', reason='position_unit')
        if poses.period > sampling.max_pose_gap:
            raise DataError(f'the flange poses come only every {poses.period:.2g} s, more than '
                            f'sampling.max_pose_gap ({sampling.max_pose_gap:g} s): publish them '
                            'more often, also while the robot stands still, or raise '
                            'sampling.max_pose_gap', reason='sparse_poses')
        raise DataError(f'the robot never stood still for {sampling.still_time:g} s in '
                        f'{poses.count} poses, but for {self._finder.longest / NS:.2g} s at most: '
                        'stop at each sample, or lower sampling.still_time; if its poses are '
                        'noisy, raise sampling.still_translation and sampling.still_rotation; if '
                        'the robot moves all the time, set sampling.mode to moving',
                        reason='no_stops')

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one sentence for each kind of message that was dropped."""
        dropped = [self._profiles.warning] if self._profiles.warning else []
        if self._unseen:
            dropped.append(f'gave up {self._unseen} stops, the oldest that waited for profiles')
        beside = float(np.abs(self._beside).max(initial=0.0))
        return (*self._pose_stream.warnings, *self._profile_stream.warnings, *dropped,
                *frame_notes(self._profile_stream.frame, beside, self._config))

    @property
    def conflict(self) -> InputError | None:
        """Return the error of contradicting frames, or of a tilted light plane, or None."""
        wanted = self._config.robot_base_frame.lstrip('/')
        if wanted and self.base_frame and wanted != self.base_frame:
            return InputError(f'the poses are given in "{self.base_frame}", but robot_base_frame '
                              f'is "{wanted}": set it to {self.base_frame}, or leave it out; it '
                              'is then that of the poses', reason='base_frame')
        if self._beside and np.ptp(self._beside) > SAME_PLANE:
            along, across = self._config.profile.axes
            return InputError(
                f'the profiles lie between {min(self._beside) * 1e3:.1f} and '
                f'{max(self._beside) * 1e3:.1f} mm beside the plane of {along} and {across} in '
                'their frame, as in a light plane that is tilted against it: let the driver '
                'publish them in a frame of the light plane; a static transform can hold the '
                'tilt', reason='tilted_plane')
        return self._pose_stream.conflict or self._profile_stream.conflict

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
    def late(self) -> tuple[str, ...]:
        """Return which streams (poses, profiles) are dropped because their stamps are too old."""
        late = {'poses': self._pose_stream.late, 'profiles': self._profile_stream.late}
        return tuple(kind for kind, is_late in late.items() if is_late)

    @property
    def motion(self) -> Motion | None:
        """Return the current motion of the robot, None with fewer than two poses."""
        return self._finder.motion()

    @property
    def is_standing(self) -> bool:
        """Return whether the robot has stood still long enough for a sample."""
        return self._finder.current() is not None

    @property
    def unasked(self) -> str:
        """Return in words that the robot stopped but no sample was requested, '' otherwise."""
        if self._taken or not self._passed_by:
            return ''
        return (f'the robot stood still {self._passed_by} times, but no sample was requested: '
                'sampling.mode is manual; call ~/take_sample at each stop, send ~/take, or set '
                'sampling.mode to still')


def silent_poses(seconds: float) -> DataError:
    """Return the refusal of a sample while no pose has come for a time (s)."""
    return DataError(f'no pose has come for {seconds:.1f} s, so the robot position is not known: '
                     'check the robot driver, and take the sample again', reason='silent_poses')
