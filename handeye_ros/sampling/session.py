"""
Stations: when the robot stood still, what was seen meanwhile, and where it stood.

The same Session takes the messages of a bag and those of live topics. Stations come from the
pose stream alone, and a station is closed only when both streams have passed its end, so the
samples do not depend on how poses and profiles were interleaved on arrival.
"""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace

from handeye_ros import methods, se3
from handeye_ros.config import Config, flipped_range, UNNAMED_FRAME
from handeye_ros.data import Feature, Profile, Reject, Sample, TimedPose
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.sampling import station_features
from handeye_ros.sampling.errors import (
    MovingError,
    NoPosesError,
    NoProfilesError,
    NoStationsError,
    NothingToRemoveError,
    PositionUnitError,
    SparsePosesError,
    TwoFramesError,
)
from handeye_ros.sampling.frame_notes import frame_notes
from handeye_ros.sampling.stations import FOREVER, interpolate, NS, Station, StationFinder
from handeye_ros.sampling.stream import LARGEST_STEP, Stream
import numpy as np

MOST_PROFILES = 300  # of one stop, evenly spread: more adds nothing but time
LARGEST_POSITION = 50.0  # of a flange in metres: more is another unit


class Session:
    """Takes poses and profiles as they come; gives a sample, or a reject, per station."""

    def __init__(self, config: Config) -> None:
        """Start with no samples."""
        self._config = config
        self._method = methods.of(config)
        self.clear()

    def clear(self) -> None:
        """Forget all samples and all that was received."""
        self._outcomes: list[Sample | Reject] = []
        self._finder = StationFinder(self._config.sampling)
        self._waiting: list[Station] = []
        self._profiles: list[Profile] = []
        self._taken: set[int] = set()  # when the stops began of which there is an outcome
        self._largest_position = 0.0
        self._beside = 0.0
        self._pose_stream: Stream[TimedPose] = Stream('pose')
        self._profile_stream: Stream[Profile] = Stream('profile')

    def set_auto(self, auto: bool) -> None:
        """Take a sample at every stop of the robot from now on, or only when asked."""
        sampling = replace(self._config.sampling, auto=auto)
        self._config = replace(self._config, sampling=sampling)
        self._finder.sampling = sampling

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Return the samples taken so far."""
        return tuple(o for o in self._outcomes if isinstance(o, Sample))

    @property
    def rejects(self) -> tuple[Reject, ...]:
        """Return the stations that gave no sample, with the reasons."""
        return tuple(o for o in self._outcomes if isinstance(o, Reject))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what was dropped on the way, one sentence each."""
        notes = frame_notes(self._profile_stream.frame, self._beside, self._config)
        return (*self._pose_stream.warnings, *self._profile_stream.warnings, *notes)

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        frame = self._profile_stream.frame
        return '' if frame is None else frame or UNNAMED_FRAME

    @property
    def conflict(self) -> TwoFramesError | None:
        """Return the error of a topic with messages of two frames, None if there is none."""
        return self._pose_stream.conflict or self._profile_stream.conflict

    @property
    def late(self) -> tuple[str, ...]:
        """Return what comes with stamps older than before, and is dropped: poses, profiles."""
        late = {'poses': self._pose_stream.late, 'profiles': self._profile_stream.late}
        return tuple(kind for kind, is_late in late.items() if is_late)

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        self._take_poses(self._pose_stream.add(pose, pose.parent_frame))

    def _take_poses(self, poses: Sequence[TimedPose]) -> None:
        for pose in poses:
            reach = float(np.linalg.norm(pose.translation))
            self._largest_position = max(self._largest_position, reach)
            station = self._finder.add(pose)
            if station and self._config.sampling.auto:
                self._waiting.append(station)

    def add_profile(self, profile: Profile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        self._beside = max(self._beside, abs(profile.beside))
        self._profiles += self._profile_stream.add(profile, profile.frame_id)

    def collect(self) -> list[Sample | Reject]:
        """Return what became of the stations that both streams have passed since the last call."""
        # a sensor that is triggered once at each stop does not send the next profile soon
        now = self._pose_stream.latest
        self._profiles += self._profile_stream.believed(now - LARGEST_STEP, now + LARGEST_STEP)
        passed = [s for s in self._waiting if self._profile_stream.latest > s.end]
        self._waiting = [s for s in self._waiting if s not in passed]
        outcomes = self._judged(passed)
        self._forget_old_profiles()
        return outcomes

    def finish(self) -> list[Sample | Reject]:
        """
        Return what became of all stations left, the one the robot stands in included.

        Raises TwoFramesError when messages of two frames came on one topic.
        """
        self._require_one_frame()
        self._take_poses(self._pose_stream.believed(0, FOREVER))
        self._profiles += self._profile_stream.believed(0, FOREVER)
        current = self._finder.current()
        if current and self._config.sampling.auto:
            self._waiting.append(current)
        outcomes, self._waiting = self._judged(self._waiting), []
        return outcomes

    def _judged(self, stations: Sequence[Station]) -> list[Sample | Reject]:
        """Return what becomes of stations, and keep it; not of those taken by hand."""
        new = [station for station in stations if station.began not in self._taken]
        outcomes = [self._outcome(station) for station in new]
        self._taken |= {station.began for station in new}
        self._outcomes += outcomes
        return outcomes

    def require_stations(self) -> None:
        """
        Refuse a recording in which the robot never stood still.

        Raises NoPosesError, PositionUnitError, SparsePosesError or NoStationsError.
        """
        if self._outcomes or self._taken:  # or what was taken has been removed
            return
        poses, sampling = self._pose_stream, self._config.sampling
        if not poses.count:
            raise self._no_poses()
        if self._largest_position > LARGEST_POSITION:
            raise PositionUnitError(self._largest_position)
        if poses.period > sampling.max_pose_gap:
            raise SparsePosesError(poses.period, sampling.max_pose_gap)
        raise NoStationsError(poses.count, sampling.still_time)

    def take_sample(self) -> Sample:
        """
        Return a sample of the station that the robot stands in now.

        Raises MovingError, NoPosesError, or a NoProfilesError or FeatureError with the reason.
        """
        self._require_one_frame()
        if self._pose_stream.frame is None:
            raise self._no_poses()
        station = self._finder.current()
        if station is None:
            raise MovingError(self._config.sampling.still_time)
        self._profiles += self._profile_stream.believed(station.start, station.end)
        sample = self._sample(station)
        self._outcomes = [o for o in self._outcomes if o.stamp < station.began] + [sample]
        self._taken.add(station.began)
        return sample

    def remove_last(self) -> Sample:
        """
        Forget the last sample and return it; the stop the robot stands in counts as taken.

        Raises NothingToRemoveError when there is none.
        """
        standing, began = self._standing()
        if standing:
            self._taken.add(began)
            return standing
        if not self.samples:
            raise NothingToRemoveError
        last = self.samples[-1]
        self._outcomes.remove(last)
        return last

    def _standing(self) -> tuple[Sample | None, int]:
        """Return the sample that the present stop will give, if any, and when it began."""
        station = self._finder.current()
        if station is None or not self._finder.sampling.auto or station.began in self._taken:
            return None, 0
        outcome = self._outcome(station)
        return (outcome if isinstance(outcome, Sample) else None), station.began

    def _no_poses(self) -> NoPosesError:
        by_topic = self._config.pose_source == 'topic'
        return NoPosesError(self._config.pose_topic if by_topic else None)

    def _require_one_frame(self) -> None:
        if self.conflict:
            raise self.conflict

    def _outcome(self, station: Station) -> Sample | Reject:
        try:
            return self._sample(station)
        except (FeatureError, NoProfilesError) as error:
            seen = self._seen(station)
            return Reject(station.start, str(error), self._flipped(seen[0]) if seen else ())

    def _seen(self, station: Station) -> list[Profile]:
        """Return the profiles taken while the robot stood still in a station."""
        settle = round(self._config.sampling.settle_time * NS)
        return [p for p in self._profiles
                if station.start + settle <= p.stamp <= station.end - settle]

    def _sample(self, station: Station) -> Sample:
        seen = self._seen(station)
        if not seen:
            raise NoProfilesError((station.end - station.start) / NS)
        if len(seen) > MOST_PROFILES:
            seen = [seen[i] for i in np.linspace(0, len(seen) - 1, MOST_PROFILES).astype(int)]
        used, combined = station_features.of_station(
            seen, lambda points: self._method.extract(points, self._config))
        poses = interpolate(station.poses, [p.stamp for p in used])
        return Sample(used[0].stamp, se3.mean_pose(poses), combined, len(used),
                      self._flipped(used[0]))

    def _flipped(self, profile: Profile) -> tuple[Feature, ...]:
        """Return what a profile shows with profile.range_sign the other way."""
        if not self._method.edges:
            return ()
        try:
            return self._method.extract(profile.points, flipped_range(self._config))
        except FeatureError:
            return ()

    def _forget_old_profiles(self) -> None:
        """Keep only what a station that is waiting, or not yet over, can still need."""
        starts = [s.start for s in self._waiting]
        first, last = self._finder.window()
        oldest = min([*starts, first])
        newest = max([*(s.end for s in self._waiting), last])
        del self._profiles[bisect_right(self._profiles, newest, key=lambda p: p.stamp):]
        del self._profiles[:bisect_left(self._profiles, oldest, key=lambda p: p.stamp)]
