"""
Samples of a robot that moves: each a single profile, with the pose of its own time.

A recording is cut into passes, two seconds of motion each. A pass is kept, numbered and left out
as a stop is.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

from handeye_ros import targets
from handeye_ros.config import Config, SamplingConfig
from handeye_ros.data import AnyProfile, Feature, Profile, Sample, TimedPose
from handeye_ros.errors import DataError, UnusableMessageError
from handeye_ros.sampling.dwells import DwellFinder, interpolate, NS
from handeye_ros.sampling.errors import NoProfilesError
from handeye_ros.sampling.station_features import evenly, features_of_each, flipped_features
from handeye_ros.sampling.trajectory import joined, Trajectory, trajectory_of

PASS = 2 * NS  # of motion
MOST_SINGLE = 32  # profiles of a pass that are looked at, twice as many where few show the target
FLIPPED = 8  # of each so many samples it is told what they show with the range the other way


class PassFinder(DwellFinder):
    """Cuts a stream of poses into passes, whether the robot moves or stands."""

    def _continues(self, pose: TimedPose) -> bool:
        first, gap = self._run[0].stamp, self.sampling.max_pose_gap * NS
        return pose.stamp - first <= PASS and pose.stamp - self._latest <= gap


def finder_of(sampling: SamplingConfig) -> DwellFinder:
    """Return what cuts poses into stops, or into passes of a robot that moves."""
    return (PassFinder if sampling.moving else DwellFinder)(sampling)


def pass_sample(poses: Sequence[TimedPose], messages: Sequence[AnyProfile], config: Config
                ) -> Sample:
    """Return the sample of a pass; raises NoProfilesError or FeatureError with the reason."""
    found, why = _found(evenly(messages, MOST_SINGLE), config)
    if 2 * len(found) < MOST_SINGLE < len(messages):
        found, why = _found(evenly(messages, 2 * MOST_SINGLE), config)
    if not found:
        raise why or NoProfilesError((poses[-1].stamp - poses[0].stamp) / NS)
    T = interpolate(poses, [profile.stamp for profile, _ in found])
    single = tuple(
        Sample(profile.stamp, pose, features,
               flipped=() if k % FLIPPED else flipped_features(profile, config))
        for k, ((profile, features), pose) in enumerate(zip(found, T, strict=True)))
    return replace(single[len(single) // 2], profiles=len(single), single=single,
                   motion=trajectory_of(poses, config.sampling.max_pose_gap))


def _found(messages: Iterable[AnyProfile], config: Config
           ) -> tuple[list[tuple[Profile, tuple[Feature, ...]]], DataError | None]:
    """Return the profiles that show the target with its features; why the last other does not."""
    profiles, found, why = [], [], None
    for message in messages:
        with suppress(UnusableMessageError):
            profiles.append(message.read(config.profile))
    seen = features_of_each(profiles, targets.method_for(config), config)
    for profile, features in zip(profiles, seen, strict=True):
        if isinstance(features, DataError):
            why = features
        else:
            found.append((profile, features))
    return found, why


def single_samples(samples: Sequence[Sample]) -> tuple[Sample, ...]:
    """Return the samples of passes one by one, with the motion of all; others as they are."""
    passes = [sample for sample in samples if sample.single]
    if not passes:
        return tuple(samples)
    motion = joined([s.motion for s in passes if isinstance(s.motion, Trajectory)])
    return tuple(replace(one, motion=motion) if sample.single else one
                 for sample in samples for one in sample.single or (sample,))
