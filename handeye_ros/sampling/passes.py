# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Samples of a moving robot: single profiles with the poses at their own times.

A recording is cut into passes: two seconds of motion each, or one rest. Passes are stored,
numbered and left out like stops. Their poses depend on the unknown time offset.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial

from handeye_ros import targets
from handeye_ros.config import Config, SamplingConfig
from handeye_ros.data import (
    AnyProfile,
    Array,
    Feature,
    Profile,
    ROTATION_LAG,
    Sample,
    TIME_OFFSET,
    TimedPose,
)
from handeye_ros.errors import DataError, FeatureError, UnusableMessageError
from handeye_ros.estimation.basis import process_in_time
from handeye_ros.estimation.blocks import Blocks, ParameterBlock
from handeye_ros.estimation.noise import TURN_LENGTH
from handeye_ros.estimation.problem import Linear, PoseModel, Problem
from handeye_ros.frames import mounted
from handeye_ros.sampling.dwells import DwellFinder, NS
from handeye_ros.sampling.station_features import evenly, features_of_each, flipped_features
from handeye_ros.sampling.stream import interpolate
from handeye_ros.sampling.trajectory import Instants, joined, Trajectory, trajectory_of
import numpy as np
from numpy.typing import NDArray

PASS = 2 * NS  # of motion
MOST_SINGLE = 32  # profiles of a pass that are evaluated, twice as many if few show the target


class PassFinder(DwellFinder):
    """Cuts a stream of poses into passes of a fixed duration, moving or at rest."""

    def _continues(self, pose: TimedPose) -> bool:
        first, gap = self._run[0].stamp, self.sampling.max_pose_gap * NS
        if pose.stamp - first <= PASS and pose.stamp - self._latest <= gap:
            return True
        return super()._continues(pose)  # a robot at rest shows nothing new


def finder_of(sampling: SamplingConfig) -> DwellFinder:
    """Return the finder of stops, or of passes where sampling.mode is moving."""
    return (PassFinder if sampling.moving else DwellFinder)(sampling)


def pass_sample(poses: Sequence[TimedPose], messages: Sequence[AnyProfile], config: Config
                ) -> Sample:
    """Return the sample of a pass; raises FeatureError with the reason."""
    found, why = _found(evenly(messages, MOST_SINGLE), config)
    if 2 * len(found) < MOST_SINGLE < len(messages):
        found, why = _found(evenly(messages, 2 * MOST_SINGLE), config)
    if not found:
        raise why or no_profiles(poses)
    T = interpolate(poses, [profile.stamp for profile, _ in found])
    single = tuple(
        Sample(profile.stamp, pose, features,
               flipped=() if k % 8 else flipped_features(profile, config))  # some suffice
        for k, ((profile, features), pose) in enumerate(zip(found, T, strict=True)))
    return replace(single[len(single) // 2], profiles=len(single), single=single,
                   motion=trajectory_of(poses, config.sampling.max_pose_gap))


def no_profiles(poses: Sequence[TimedPose]) -> FeatureError:
    """Return the refusal of a stop or a pass without a profile of the time of its poses."""
    seconds = (poses[-1].stamp - poses[0].stamp) / NS
    return FeatureError(f'no profile has a stamp of the {seconds:.1f} s during which the robot '
                        'stood still here: either the sensor sent none, or its clock is not that '
                        'of the robot', reason='no_profiles')


def _found(messages: Iterable[AnyProfile], config: Config
           ) -> tuple[list[tuple[Profile, tuple[Feature, ...]]], DataError | None]:
    """Return the profiles that show the target, their features, and the last error of others."""
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
    """Return one sample per profile of passes, with their common trajectory; others unchanged."""
    passes = [sample for sample in samples if sample.single]
    if not passes:
        return tuple(samples)
    motion = joined([s.motion for s in passes if isinstance(s.motion, Trajectory)])
    return tuple(replace(one, motion=motion) if sample.single else one
                 for sample in samples for one in sample.single or (sample,))


@dataclass(frozen=True, eq=False)
class Pairing:
    """
    Poses of n samples as a function of the time offset; those of stops are constant.

    T_base_flange: (n, 4, 4) with the stamps as they are; moving: (n,) whether the robot moved.
    """

    T_base_flange: Array
    stamps: NDArray[np.int64]
    moving: NDArray[np.bool_]
    motion: Trajectory

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Pairing:
        """Return the pairing of samples, at least one of them of a moving robot."""
        return cls(np.array([sample.T_base_flange for sample in samples]),
                   np.array([sample.stamp for sample in samples]),
                   np.array([sample.motion is not None for sample in samples]),
                   next(s.motion for s in samples if isinstance(s.motion, Trajectory)))

    def at(self, offset: float, lag: float = 0.0) -> Instants:
        """Return the flange at each sample for a time offset and a lag of the rotation (s)."""
        found = self.motion.at(self.stamps[self.moving] + round(offset * 1e9), lag)
        n = len(self.stamps)
        every = Instants(self.T_base_flange.copy(), np.zeros((n, 6)), np.ones(n, dtype=bool))
        for name in ('T_base_flange', 'twists', 'inside'):
            getattr(every, name)[self.moving] = getattr(found, name)
        return every

    def poses_and_twists(self, values: Array) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and twists (n, 6, k) for an offset and a lag; see PoseModel."""
        return _evaluated(self, tuple(values.tolist()))


@lru_cache(maxsize=8)  # poses, then twists, are requested for the same values
def _evaluated(pairing: Pairing, values: tuple[float, ...]) -> tuple[Array, Array]:
    poses = pairing.at(*values)
    twists = np.stack([poses.twists] * len(values), axis=2)
    twists[:, :3, 1:] = 0.0
    return poses.T_base_flange, twists


def problem_of(samples: Sequence[Sample], config: Config) -> Problem:
    """Return the problem of samples; for a moving robot with the time offset as an unknown."""
    method = targets.method_for(config)
    problem = Problem(method, mounted(samples, config), method.observe(samples), config)
    if not any(sample.motion for sample in samples):
        return problem
    pairing = Pairing.of(samples)
    stds = np.array([config.time_offset_std, config.rotation_lag_std])
    stds = stds[stds > 0]
    white = np.array([config.noise.stamps, 0.0])[:len(stds)]
    model = PoseModel(pairing.poses_and_twists, (TIME_OFFSET, ROTATION_LAG)[:len(stds)],
                      (1,) * len(stds), tuple(stds.tolist()), least=1.0,
                      blocks=partial(errors_in_motion, pairing.stamps), white=white)
    values = np.array([*next(s.offsets for s in samples if s.motion), 0.0])[:len(stds)]
    return replace(problem, pose_model=model, pose_values=values)


def errors_in_motion(stamps: NDArray[np.int64], linear: Linear) -> Blocks:
    """Yield the blocks of errors of a moving robot: smooth in time, and of the exposure."""
    size, model = linear.problem.config.noise.robot_smooth, linear.problem.pose_model
    assert model is not None
    own = stamps if model.stations is None else stamps[model.stations]
    functions = process_in_time((own - stamps[0]) * 1e-9)
    for name, axes, std in (('tracking_position', slice(0, 3), size),
                            ('tracking_rotation', slice(3, 6), size / TURN_LENGTH)):
        twists = np.einsum('xa,nk->nxak', np.eye(6)[:, axes], functions)
        twists = twists.reshape(len(functions), 6, -1)
        yield ParameterBlock(name, linear.by_twists(twists) * std, std, twists=twists,
                             report=f'{name}_error')
    if linear.problem.config.profile.exposure:
        yield _exposure(linear)


def _exposure(linear: Linear) -> ParameterBlock:
    """
    Return the block of the apparent shortening of faces during an exposure.

    A profile averages over the exposure, and shows a face only while the face is seen. So an end
    shifts by up to half the exposure times the velocity across the edge, always inwards.
    """
    problem, std = linear.problem, linear.problem.config.profile.exposure / 2
    assert problem.pose_model is not None
    twists = problem.pose_model.at(problem.pose_values)[1][:, :, :1]
    inwards = np.sign(problem.method.feature_errors(linear))
    return ParameterBlock('exposure', inwards * np.abs(linear.by_twists(twists)) * std, std)
