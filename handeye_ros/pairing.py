"""
Stations: when the robot stood still, what was seen meanwhile, and where it stood.

The same Session takes the messages of a bag and those of live topics. Stations come from the
pose stream alone, and a station is closed only when both streams have passed its end, so the
samples do not depend on how poses and profiles were interleaved on arrival.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import features, methods, se3
from handeye_ros.config import Config, flipped_range, SamplingConfig
from handeye_ros.data import Array, Feature, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import (
    FeatureError,
    MovingError,
    NoPosesError,
    NoProfilesError,
    NoStationsError,
    NothingToRemoveError,
    PositionUnitError,
    TwoFramesError,
)
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

NS = 1_000_000_000
MAX_STATION = 10 * NS  # more of one stop adds nothing but memory
FOREVER = 2**63
LARGEST_POSITION = 50.0  # of a flange in metres: more is another unit


@dataclass(frozen=True, eq=False)
class Station:
    """A time during which the robot stood still; poses in order of their stamps."""

    poses: tuple[TimedPose, ...]

    @property
    def start(self) -> int:
        """Return the stamp of the first pose."""
        return self.poses[0].stamp

    @property
    def end(self) -> int:
        """Return the stamp of the last pose."""
        return self.poses[-1].stamp


class StationFinder:
    """Cuts a stream of poses into the times during which the robot stood still."""

    def __init__(self, sampling: SamplingConfig) -> None:
        """Start with no poses."""
        self.sampling = sampling
        self._run: list[TimedPose] = []
        self._latest = -1

    def add(self, pose: TimedPose) -> Station | None:
        """Take the next pose; return the station that it ends, if it ends one."""
        continues = bool(self._run) and self._continues(pose)
        self._latest = pose.stamp
        if continues:
            self._extend(pose)
            return None
        ended, self._run = self._run, [pose]
        return self._station(ended)

    def current(self) -> Station | None:
        """Return the station that the robot stands in now, if it has stood still for long."""
        return self._station(self._run)

    def window(self) -> tuple[int, int]:
        """Return the first and last stamp that can still matter to this stop of the robot."""
        if not self._run:
            return 0, FOREVER
        limited = self.sampling.auto
        return self._run[0].stamp, self._run[0].stamp + MAX_STATION if limited else FOREVER

    def _extend(self, pose: TimedPose) -> None:
        """Let a long stop use its first seconds, or its last when samples are asked for."""
        if pose.stamp - self._run[0].stamp <= MAX_STATION:
            self._run.append(pose)
        elif not self.sampling.auto:
            self._run = [p for p in self._run[1:] if pose.stamp - p.stamp <= MAX_STATION]
            self._run.append(pose)

    def _continues(self, pose: TimedPose) -> bool:
        first, limits = self._run[0], self.sampling
        moved = np.linalg.norm(pose.translation - first.translation)
        # |q1 - q2| is half the angle between close orientations
        turned = 2 * min(np.linalg.norm(pose.quaternion - first.quaternion),
                         np.linalg.norm(pose.quaternion + first.quaternion))
        return bool(moved <= limits.still_translation and turned <= limits.still_rotation
                    and pose.stamp - self._latest <= limits.max_pose_gap * NS)

    def _station(self, run: Sequence[TimedPose]) -> Station | None:
        still = bool(run) and run[-1].stamp - run[0].stamp >= self.sampling.still_time * NS
        return Station(tuple(run)) if still else None


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
        self._taken_until = -1
        self._pose_count = 0
        self._largest_position = 0.0
        self._last_stamp = {'pose': -1, 'profile': -1}
        self._frames: dict[str, str] = {}
        self._conflict: TwoFramesError | None = None
        self._warnings: Counter[str] = Counter()

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
        return tuple(f'{text} ({count} times)' for text, count in self._warnings.items())

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        return self._frames.get('profile', '')

    def add_pose(self, pose: TimedPose) -> None:
        """Take a pose of the flange; one that cannot be used is dropped with a warning."""
        if self._accept('pose', pose.stamp, pose.parent_frame):
            self._pose_count += 1
            reach = float(np.linalg.norm(pose.translation))
            self._largest_position = max(self._largest_position, reach)
            station = self._finder.add(pose)
            if station and self._config.sampling.auto:
                self._waiting.append(station)

    def add_profile(self, profile: Profile) -> None:
        """Take a laser profile; one that cannot be used is dropped with a warning."""
        if self._accept('profile', profile.stamp, profile.frame_id):
            self._profiles.append(profile)

    def collect(self) -> list[Sample | Reject]:
        """Return what became of the stations that both streams have passed since the last call."""
        passed = [s for s in self._waiting if self._last_stamp['profile'] > s.end]
        self._waiting = [s for s in self._waiting if s not in passed]
        outcomes = [self._outcome(s) for s in passed if s.start > self._taken_until]
        self._outcomes.extend(outcomes)
        self._forget_old_profiles()
        return outcomes

    def finish(self) -> list[Sample | Reject]:
        """
        Return what became of all stations left, the one the robot stands in included.

        Raises TwoFramesError when messages of two frames came on one topic.
        """
        if self._conflict:
            raise self._conflict
        current = self._finder.current()
        if current and self._config.sampling.auto:
            self._waiting.append(current)
        outcomes = [self._outcome(s) for s in self._waiting if s.start > self._taken_until]
        if self._waiting:
            self._taken_until = max(self._taken_until, self._waiting[-1].end)
        self._waiting = []
        self._outcomes.extend(outcomes)
        return outcomes

    def require_stations(self) -> None:
        """
        Refuse a recording in which the robot never stood still.

        Raises NoPosesError, PositionUnitError or NoStationsError.
        """
        if self._outcomes:
            return
        if not self._pose_count:
            raise NoPosesError(self._config.pose_topic)
        if self._largest_position > LARGEST_POSITION:
            raise PositionUnitError(self._largest_position)
        raise NoStationsError(self._pose_count, self._config.sampling.still_time)

    def take_sample(self) -> Sample:
        """
        Return a sample of the station that the robot stands in now.

        Raises MovingError, NoPosesError, or a NoProfilesError or FeatureError with the reason.
        """
        if self._last_stamp['pose'] < 0:
            raise NoPosesError(self._config.pose_topic)
        station = self._finder.current()
        if station is None:
            raise MovingError(self._config.sampling.still_time)
        if station.start <= self._taken_until:
            self._outcomes = [o for o in self._outcomes if o.stamp < station.start]
        sample = self._sample(station)
        self._outcomes.append(sample)
        self._taken_until = station.end
        return sample

    def remove_last(self) -> Sample:
        """
        Forget the last sample and return it; the stop the robot stands in counts as taken.

        Raises NothingToRemoveError when there is none.
        """
        standing = self._standing()
        if standing:
            self._taken_until = standing.stamp
            return standing
        if not self.samples:
            raise NothingToRemoveError
        last = self.samples[-1]
        self._outcomes.remove(last)
        return last

    def _standing(self) -> Sample | None:
        """Return the sample that the present stop will give, if it gives one."""
        station = self._finder.current()
        if station is None or not self._finder.sampling.auto or (
                station.start <= self._taken_until):
            return None
        outcome = self._outcome(station)
        return outcome if isinstance(outcome, Sample) else None

    def _accept(self, kind: str, stamp: int, frame: str) -> bool:
        first = self._frames.setdefault(kind, frame)
        if frame != first:
            self._conflict = TwoFramesError(kind, first, frame)
            self._warnings[f'dropped a {kind} of frame "{frame}"'] += 1
            return False
        if stamp <= self._last_stamp[kind]:
            self._warnings[f'dropped a {kind} whose stamp is not later than the one before: '
                           'clear the samples if a bag was started again'] += 1
            return False
        self._last_stamp[kind] = stamp
        return True

    def _outcome(self, station: Station) -> Sample | Reject:
        try:
            return self._sample(station)
        except (FeatureError, NoProfilesError) as error:
            return Reject(station.start, str(error))

    def _sample(self, station: Station) -> Sample:
        settle = round(self._config.sampling.settle_time * NS)
        seen = [p for p in self._profiles
                if station.start + settle <= p.stamp <= station.end - settle]
        if not seen:
            raise NoProfilesError((station.end - station.start) / NS)
        used, combined = self._features(seen)
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

    def _features(self, profiles: Sequence[Profile]
                  ) -> tuple[list[Profile], tuple[Feature, ...]]:
        """Return the profiles that show the target, and their features combined."""
        used, found, reasons = [], [], Counter[str]()
        for profile in profiles:
            try:
                found.append(self._method.extract(profile.points, self._config))
                used.append(profile)
            except FeatureError as error:
                reasons[str(error)] += 1
        if not found or 2 * len(found) < len(profiles):
            raise FeatureError(reasons.most_common(1)[0][0])
        return used, features.combine(found)

    def _forget_old_profiles(self) -> None:
        """Keep only what a station that is waiting, or not yet over, can still need."""
        starts = [s.start for s in self._waiting]
        first, last = self._finder.window()
        oldest = min([*starts, first])
        newest = max([*(s.end for s in self._waiting), last])
        self._profiles = [p for p in self._profiles if oldest <= p.stamp <= newest]


def interpolate(poses: Sequence[TimedPose], stamps: Sequence[int]) -> Array:
    """
    Return the poses T_base_flange (n, 4, 4) at n stamps within the time of the given poses.

    Linear in the translation, slerp in the rotation. Raises ValueError outside.
    """
    times = np.array([p.stamp - poses[0].stamp for p in poses], dtype=float)
    at = np.array([s - poses[0].stamp for s in stamps], dtype=float)
    if at.min() < times[0] or at.max() > times[-1]:
        raise ValueError('a stamp lies outside the time of the poses')
    translations = np.array([p.translation for p in poses])
    rotations = Slerp(times, Rotation.from_quat([p.quaternion for p in poses]))(at)
    translation = np.column_stack([np.interp(at, times, column) for column in translations.T])
    return se3.transform(rotations.as_matrix(), translation)
