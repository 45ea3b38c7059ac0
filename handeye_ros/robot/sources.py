# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from recordings and sessions: samples with the joint values of their time."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handeye_ros import pipeline, se3
from handeye_ros.arm import Arm, Chain
from handeye_ros.bags.bag import read_poses, Recording
from handeye_ros.bags.session import Stored
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, HandeyeError, InputError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.solve import covering
from handeye_ros.frames import in_mount
from handeye_ros.robot.answer import Answer, compared
from handeye_ros.robot.estimate import fit_of, MINIMUM
from handeye_ros.robot.outcome import (
    AGREEING,
    cause_of,
    Change,
    contradiction,
    joint_notes,
    OTHER_SIDE,
    Outcome,
    solve,
    too_few,
    UNSOLVED,
)
from handeye_ros.robot.profiles import misfit, profiles_of
from handeye_ros.sampling.session import Session
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

LONGEST_GAP = 1_000_000_000  # ns, between a sample and joint values


@dataclass(frozen=True, eq=False)
class Source:
    """
    Samples of one target with joint values; their poses are those of the arm as stated.

    config: with the frames of the chain. joints: (n, joints) at stamps (n,). recording, session:
    where the samples are from, None where there is none; inputs, warnings: of the reading.
    """

    samples: Sequence[Sample]
    rejects: Sequence[Reject]
    frame_id: str
    config: Config
    stamps: NDArray[np.int64]
    joints: Array
    recording: Recording | None = None
    session: Session | None = None
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()

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
        if self.recording:
            T = arm.forward(self.joints)
            poses = [replace(pose, translation=p, quaternion=q) for pose, p, q in zip(
                self.recording.poses, T[:, :3, 3], se3.quaternion(T), strict=True)]
            return pipeline.calibrate(self.recording.profiles, poses, self.config)
        T = arm.forward(self.joints_at(self.samples))
        stops = [replace(sample, T_base_flange=pose_of_arm, motion=None)
                 for sample, pose_of_arm in zip(self.samples, T, strict=True)]
        return pipeline.solve(stops, self.rejects, self.config, self.frame_id)


def of_recording(recording: Recording, reported: Sequence[TimedPose], chain: Chain, config: Config
                 ) -> Source:
    """
    Return the samples of a recording that holds joint values; raises DataError.

    reported: the poses of the controller, may be empty.
    """
    assert recording.joints is not None
    config, joints = _configured(config, chain), recording.joints
    notes = joint_notes(chain, chain.measured_values(joints))
    session = pipeline.gather(recording.profiles, recording.poses, config)
    source = Source(session.samples, session.rejects, session.frame_id, config,
                    np.array([pose.stamp for pose in recording.poses]), joints, recording, session,
                    recording.inputs)
    if reported:
        notes.append(_compared(reported, source, chain))
    return replace(source, warnings=[*recording.warnings, *session.warnings, *notes])


def of_session(stored: Stored, chain: Chain, config: Config) -> Source:
    """Return the samples of a stored session with their joint values; raises InputError."""
    session = stored.session(config)
    values = read_poses(stored.path, replace(config, kinematics=''), Arm(chain))
    assert values.joints is not None
    return Source(session.samples, session.rejects, session.frame_id, _configured(config, chain),
                  np.array([pose.stamp for pose in values.poses]), values.joints,
                  session=session, inputs=[{'path': str(stored.path)}], warnings=session.warnings)


def reported_poses(path: Path, config: Config) -> Sequence[TimedPose]:
    """Return the poses of the controller in a bag, none if it holds none."""
    try:
        return read_poses(path, replace(config, kinematics='')).poses
    except HandeyeError:
        return ()


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
    except DataError as error:
        for source in sources if error.reason == UNSOLVED else ():
            if source.session:
                require_same_clock(source.session, source.config)
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
    if count < MINIMUM:
        raise too_few(count)
    problems, joints = zip(*(_problem(source, chain) for source in sources), strict=True)

    def missed(change: Change) -> float:
        return max(misfit(_changed(problem, chain.forward(q @ change.joints.T), change))
                   for problem, q in zip(problems, joints, strict=True))

    def cause() -> str:
        return cause_of(chain, np.concatenate(joints), problems[0].in_hand, missed)
    limit = sources[0].config.limits.residual
    data, state = profiles_of(problems, joints, Arm(chain))
    if len(data) < max(MINIMUM, AGREEING * count):
        raise contradiction(missed(Change('', np.eye(len(chain.joints)))), limit, cause())
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


def _compared(poses: Sequence[TimedPose], source: Source, chain: Chain) -> str:
    """Return in words how the controller's poses differ from those of the URDF, at samples."""
    stamps = np.array([pose.stamp for pose in poses])
    times, first = np.unique(stamps - stamps[0], return_index=True)
    at = np.array([sample.stamp for sample in source.samples])
    at = at[(at >= stamps[0]) & (at <= stamps[-1])]
    if len(times) < 2 or not len(at):
        return 'the reported poses are of another time than the profiles, and are not compared'
    T = se3.interpolated(times.astype(float), np.array([poses[i].translation for i in first]),
                         np.array([poses[i].quaternion for i in first]),
                         (at - stamps[0]).astype(float))
    return compared(T, chain.forward(interpolated_joints(at, source.stamps, source.joints)))


def interpolated_joints(times: NDArray[np.int64], stamps: NDArray[np.int64], joints: Array
                        ) -> Array:
    """Return joint values (k, joints) at times (k,) from those (n, joints) at stamps (n,)."""
    knots, first = np.unique(stamps - stamps[0], return_index=True)
    spline = PchipInterpolator(knots * 1e-9, joints[first])
    return np.asarray(spline(np.clip(times - stamps[0], knots[0], knots[-1]) * 1e-9))
