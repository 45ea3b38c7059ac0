"""
Cuts the streams of poses and profiles into stops of the robot, with the profiles of each.

Stops come from the pose stream alone. A stop is complete only when both streams have passed its
end, so the result does not depend on the order of arrival.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
import math
from typing import Self

from handeye_ros.config import Config, UNNAMED_FRAME
from handeye_ros.data import AnyProfile, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.frames import frame_notes
from handeye_ros.sampling.dwells import Dwell, FOREVER, Motion, NS
from handeye_ros.sampling.passes import finder_of
from handeye_ros.sampling.profile_buffer import ProfileBuffer
from handeye_ros.sampling.stops import beside, Stop, stop_of
from handeye_ros.sampling.stream import LARGEST_STEP, Stream

SILENCE = 0.25  # s without a pose, while profiles come: then the robot may be anywhere
LARGEST_POSITION = 50.0  # m: no flange is there, it is another unit


class DwellDetector:
    """Receives poses and profiles and returns each stop of the robot once."""

    def __init__(self, config: Config) -> None:
        """Start with nothing."""
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Forget all that was received."""
        self._finder = finder_of(self._config.sampling)
        self._waiting: list[Dwell] = []
        self._profiles = ProfileBuffer()
        self._taken: set[int] = set()  # start stamps of the stops already returned
        self._passed_by = 0  # stops in manual mode
        self._unseen = 0  # stops dropped while waiting for profiles
        self._largest_position = 0.0
        self._beside = 0.0
        self._pose_stream: Stream[TimedPose] = Stream('pose')
        self._profile_stream: Stream[AnyProfile] = Stream('profile')

    def copied(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other._waiting, other._profiles, other._taken = (
            list(self._waiting), self._profiles.copied(), set(self._taken))
        other._finder, other._pose_stream, other._profile_stream = (
            self._finder.copied(), self._pose_stream.copied(), self._profile_stream.copied())
        return other

    def configure(self, config: Config) -> None:
        """Apply another configuration to all stops and passes that begin from now on."""
        if config.sampling.moving != self._config.sampling.moving:
            self._finder = finder_of(config.sampling)
        self._config, self._finder.sampling = config, config.sampling

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one sentence for each kind of message that was dropped."""
        notes = frame_notes(self._profile_stream.frame, self._beside, self._config)
        return (*self._pose_stream.warnings, *self._profile_stream.warnings,
                *self._profiles.warnings, *self._given_up(), *notes)

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        frame = self._profile_stream.frame
        return '' if frame is None else frame or UNNAMED_FRAME

    @property
    def conflict(self) -> InputError | None:
        """Return the error for a topic with messages in two frames, or None."""
        return self._pose_stream.conflict or self._profile_stream.conflict

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

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        self._take_poses(self._pose_stream.add(pose, pose.parent_frame))

    def _take_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            reach = math.hypot(*pose.translation)
            self._largest_position = max(self._largest_position, reach)
            station = self._finder.add(pose)
            if station and self._by_itself:
                self._waiting.append(station)
            elif station:
                self._passed_by += 1

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        self._profiles.add(self._profile_stream.add(profile, profile.frame_id))

    def keep_waiting(self, most: int) -> None:
        """Limit the number of stops that wait for profiles; the oldest are dropped and counted."""
        excess = len(self._waiting) - most
        if excess > 0:
            self._unseen += excess
            del self._waiting[:excess]

    def _given_up(self) -> Iterator[str]:
        if self._unseen:
            yield f'gave up {self._unseen} stops, the oldest that waited for profiles'

    def passed(self) -> list[Stop]:
        """Return the stops that are complete in both streams and were not returned before."""
        if self._pose_stream.set_back or self._profile_stream.set_back:
            return self._restarted()
        # a sensor that is triggered once at each stop does not send the next profile soon
        now = self._pose_stream.latest
        self._profiles.add(self._profile_stream.believed(now - LARGEST_STEP, now + LARGEST_STEP))
        over = [s for s in self._waiting if self._profile_stream.latest > s.end]
        self._waiting = [s for s in self._waiting if s not in over]
        stops = self._stops(over)
        self._forget_old_profiles()
        return stops

    def _restarted(self) -> list[Stop]:
        """Continue after a clock was set back; return the stops from before."""
        stops = self._rest()
        self._finder = finder_of(self._config.sampling)
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
        self._take_poses(self._pose_stream.believed(0, FOREVER))
        self._profiles.add(self._profile_stream.believed(0, FOREVER))
        return self._rest()

    def _rest(self) -> list[Stop]:
        current = self._finder.current() if self._by_itself else None
        stations, self._waiting = [*self._waiting, *([current] if current else [])], []
        return self._stops(stations)

    def current_stop(self) -> Stop:
        """
        Return the stop at which the robot stands now.

        Raises InputError for two frames on a topic, and DataError without current poses
        (reason no_poses, silent_poses, late_poses) or while the robot moves (moving).
        """
        self._require_one_frame()
        if self._pose_stream.frame is None:
            raise self._no_poses()
        self._require_poses_now()
        station = self._finder.current()
        if station is None:
            how = self.motion.sentence if self.motion else (
                'too few poses have come to measure its motion')
            raise DataError(f'the robot has not stood still for '
                            f'{self._config.sampling.still_time:g} s, {how}: stop it, wait, and '
                            'take the sample again', reason='moving')
        self._profiles.add(self._profile_stream.believed(station.start, station.end))
        return self._stop(station)

    def require_stations(self) -> None:
        """
        Refuse a recording in which the robot never stood still.

        Raises DataError, its reason no_poses, not_asked, position_unit, sparse_poses or no_stops.
        """
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

    def _stops(self, stations: Sequence[Dwell]) -> list[Stop]:
        """Return the stops at dwells, without those that were sampled on request."""
        new = [station for station in stations if station.began not in self._taken]
        self._taken |= {station.began for station in new}
        return [self._stop(station) for station in new]

    def _stop(self, station: Dwell) -> Stop:
        stop = stop_of(station, self._profiles.items, self._config)
        self._beside = max(self._beside, beside(stop, self._config))
        return stop

    @property
    def _by_itself(self) -> bool:
        return self._config.sampling.by_itself

    def _require_poses_now(self) -> None:
        """Raise an error where no current poses arrive: the position of the robot is unknown."""
        poses = self._pose_stream
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

    def _forget_old_profiles(self) -> None:
        """Drop the profiles that no pending or current stop can use."""
        starts = [s.start for s in self._waiting]
        first, last = self._finder.window()
        oldest = min([*starts, first])
        newest = max([*(s.end for s in self._waiting), last])
        self._profiles.keep(oldest, newest)


def silent_poses(seconds: float) -> DataError:
    """Return the refusal of a sample while no pose has come for a time (s)."""
    return DataError(f'no pose has come for {seconds:.1f} s, so the robot position is not known: '
                     'check the robot driver, and take the sample again', reason='silent_poses')
