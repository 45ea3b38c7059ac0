# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from samples of profiles, through the pipeline."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from handeye_ros import pipeline, se3
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import InputError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.solve import covering
from handeye_ros.frames import in_mount
from handeye_ros.robot.answer import Answer, compared
from handeye_ros.robot.causes import (
    cause_of,
    Change,
    ContradictionError,
    joint_notes,
    OTHER_SIDE,
    TooFewConfigurationsError,
)
from handeye_ros.robot.estimate import fit_of, MINIMUM
from handeye_ros.robot.model import Arm, Chain
from handeye_ros.robot.outcome import AGREEING, Outcome, solve
from handeye_ros.robot.profiles import misfit, profiles_of
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

LONGEST_GAP = 1_000_000_000  # ns, between a sample and joint values


@dataclass(frozen=True, eq=False)
class JointRecording:
    """
    A recording of profiles and joint values.

    poses: the flange poses of the arm as stated, at the joint values (n, joints); reported: those
    of the controller, may be empty; warnings, inputs: of the reading.
    """

    profiles: Sequence[AnyProfile]
    poses: Sequence[TimedPose]
    joints: Array
    reported: Sequence[TimedPose]
    warnings: Sequence[str]
    inputs: Sequence[dict[str, str]]


@dataclass(frozen=True, eq=False)
class Source:
    """
    Samples of one target with joint values; their poses are those of the arm as stated.

    joints: (n, joints) at stamps (n,); recording: the source of the samples, None for stops of a
    session; require_same_clock: raises if the clocks explain a contradiction; inputs, warnings: of
    the reading.
    """

    samples: Sequence[Sample]
    rejects: Sequence[Reject]
    frame_id: str
    config: Config
    stamps: NDArray[np.int64]
    joints: Array
    recording: JointRecording | None = None
    require_same_clock: Callable[[Config], None] | None = None
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()

    @classmethod
    def of(cls, samples: Sequence[Sample], rejects: Sequence[Reject], frame_id: str,
           config: Config, chain: Chain, stamps: NDArray[np.int64], joints: Array, **fields: Any
           ) -> Source:
        """Return samples whose settings have the frames of a chain; fields: the others."""
        return cls(samples, rejects, frame_id, _configured(config, chain), stamps, joints,
                   **fields)

    def joints_at(self, samples: Sequence[Sample]) -> Array:
        """Return the joint values (k, joints) at samples; raises InputError."""
        times = np.array([sample.stamp + round(sample.offsets[0] * 1e9) for sample in samples])
        following = np.searchsorted(self.stamps, times)
        gaps = np.minimum(*(np.abs(self.stamps[np.clip(following - k, 0, len(self.stamps) - 1)]
                                   - times) for k in (0, 1)))
        if (gaps > LONGEST_GAP).any():
            raise InputError(
                f'{int((gaps > LONGEST_GAP).sum())} of {len(times)} samples have no joint values '
                'of their time: joint values and profiles must be recorded together, with clocks '
                'that agree')
        return interpolated_joints(times, self.stamps, self.joints)

    def calibrated(self, arm: Arm) -> Calibration:
        """Return the calibration with the poses of a corrected arm; raises DataError."""
        recording = self.recording
        if recording:
            T = arm.forward(recording.joints)
            poses = [replace(pose, translation=p, quaternion=q) for pose, p, q in zip(
                recording.poses, T[:, :3, 3], se3.quaternion(T), strict=True)]
            return pipeline.calibrate(recording.profiles, poses, self.config)
        T = arm.forward(self.joints_at(self.samples))
        stops = [replace(sample, T_base_flange=pose_of_arm, motion=None)
                 for sample, pose_of_arm in zip(self.samples, T, strict=True)]
        return pipeline.solve(stops, self.rejects, self.config, self.frame_id)


def source_of(recording: JointRecording, chain: Chain, config: Config) -> Source:
    """Return the samples of a recording; raises DataError."""
    config = _configured(config, chain)
    stamps = np.array([pose.stamp for pose in recording.poses])
    undetermined = joint_notes(chain, chain.measured_values(recording.joints))
    session = pipeline.gather(recording.profiles, recording.poses, config)
    source = Source(session.samples, session.rejects, session.frame_id, config, stamps,
                    recording.joints, recording, partial(require_same_clock, session),
                    recording.inputs)
    compared = _compared(recording, source, chain) if recording.reported else ''
    return replace(source, warnings=[*filter(None, (
        *recording.warnings, *session.warnings, *undetermined, compared))])


def _configured(config: Config, chain: Chain) -> Config:
    """Return settings with the frames of a chain and poses from joint values."""
    return replace(config, kinematics='', pose_source='topic', robot_base_frame=chain.base,
                   robot_effector_frame=chain.flange)


def solve_sources(sources: Sequence[Source], chain: Chain,
                  inputs: Sequence[dict[str, str]] = ()) -> Answer:
    """
    Return the corrected arm, and the calibration that belongs to it; raises DataError.

    sources: of one sensor on one robot, each with another target or another position of it.
    inputs: further files.
    """
    try:
        outcome = outcome_of(sources, chain)
    except (ContradictionError, TooFewConfigurationsError):
        for source in sources:
            if source.require_same_clock:
                source.require_same_clock(source.config)
        raise
    calibrations = [source.calibrated(outcome.arm) for source in sources]
    inputs = [*(values for source in sources for values in source.inputs), *inputs]
    warnings = list(dict.fromkeys(w for source in sources for w in source.warnings))
    return Answer.of(outcome, _combined(calibrations, outcome), inputs, warnings)


def _combined(calibrations: Sequence[Calibration], outcome: Outcome) -> Calibration:
    """Return one calibration for all targets; the transform of several is that of the outcome."""
    first, covariance = calibrations[0], outcome.covariance[:6, :6]
    if len(calibrations) == 1:
        return replace(first, covariance=covering(first.covariance, covariance))
    qualities = [calibration.quality for calibration in calibrations]
    quality = replace(first.quality, samples_used=sum(q.samples_used for q in qualities),
                      samples_rejected=sum(q.samples_rejected for q in qualities),
                      residual_rms=max(q.residual_rms for q in qualities),
                      holdout_rms=max(q.holdout_rms for q in qualities))
    reports = tuple(report for calibration in calibrations for report in calibration.samples)
    return replace(first, T_flange_sensor=outcome.chosen.fit.state.X, covariance=covariance,
                   quality=quality, samples=reports)


def outcome_of(sources: Sequence[Source], chain: Chain) -> Outcome:
    """Return the corrected arm from stops or a sweep; raises DataError."""
    count = sum(len(source.samples) for source in sources)
    limit = sources[0].config.limits.residual
    if count < MINIMUM:
        raise TooFewConfigurationsError(count, MINIMUM)
    problems, joints = zip(*(_problem(source, chain) for source in sources), strict=True)

    def missed(change: Change) -> float:
        return max(misfit(_changed(problem, chain.forward(q @ change.joints.T), change))
                   for problem, q in zip(problems, joints, strict=True))

    def cause() -> str:
        return cause_of(chain, np.concatenate(joints), problems[0].in_hand, missed)
    data, state = profiles_of(problems, joints, Arm(chain))
    if len(data) < max(MINIMUM, AGREEING * count):
        raise ContradictionError(missed(Change('', np.eye(len(chain.joints)))), limit, cause())
    return solve(fit_of(data, state), limit, cause)


def _problem(source: Source, chain: Chain) -> tuple[Problem, Array]:
    """Return the problem of a source with the arm as stated, and the joint values (n, joints)."""
    ordered, problem = pipeline.at_stops(source.samples, source.config)
    q = source.joints_at(ordered)
    return replace(problem, poses=in_mount(chain.forward(q), source.config)), q


def _changed(problem: Problem, T_base_flange: Array, change: Change) -> Problem:
    """Return a problem with other poses (n, 4, 4) and the calibration_type of a change."""
    config = problem.config
    if change.other_side:
        config = replace(config, calibration_type=OTHER_SIDE[config.calibration_type])
    return replace(problem, poses=in_mount(T_base_flange, config), config=config)


def _compared(recording: JointRecording, source: Source, chain: Chain) -> str:
    """Return in words how the controller's poses differ from those of the URDF, at samples."""
    reported = np.array([pose.stamp for pose in recording.reported])
    times, first = np.unique(reported - reported[0], return_index=True)
    times_of_samples = np.array([sample.stamp for sample in source.samples])
    within = (times_of_samples >= reported[0]) & (times_of_samples <= reported[-1])
    times_of_samples = times_of_samples[within]
    if len(times) < 2 or not len(times_of_samples):
        return 'the reported poses are of another time than the profiles, and are not compared'
    poses = [recording.reported[i] for i in first]
    T = se3.interpolated(times.astype(float), np.array([p.translation for p in poses]),
                         np.array([p.quaternion for p in poses]),
                         (times_of_samples - reported[0]).astype(float))
    return compared(T, chain.forward(interpolated_joints(times_of_samples, source.stamps,
                                                         source.joints)))


def interpolated_joints(times: NDArray[np.int64], stamps: NDArray[np.int64], joints: Array
                        ) -> Array:
    """Return joint values (k, joints) at times (k,) from those (n, joints) at stamps (n,)."""
    knots, first = np.unique(stamps - stamps[0], return_index=True)
    spline = PchipInterpolator(knots * 1e-9, joints[first])
    return np.asarray(spline(np.clip(times - stamps[0], knots[0], knots[-1]) * 1e-9))
