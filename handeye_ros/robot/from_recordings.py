# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The corrected arm from recordings and sessions: samples with the joint values of their time.

They are read (arm_samples_of), give the hand-eye transform alone (fit_of_samples), then the best
model of the arm (select_model), and the answer with its calibration (solve_samples).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import pipeline, se3
from handeye_ros.arm import Arm
from handeye_ros.bags.recording import Recording
from handeye_ros.calibration import with_covariance
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.refusals import require_samples
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, NS, Sample, SEED
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import robust_solution
from handeye_ros.estimation.solution import cover
from handeye_ros.frames import mount_poses, T_sensor_plane
from handeye_ros.robot.answer import ArmAnswer
from handeye_ros.robot.fit import ArmFit, ArmProfiles, with_estimated_weights
from handeye_ros.robot.selection import (
    require_enough_stops,
    require_within_limits,
    select_model,
    unmoved_notes,
    UNSOLVED,
)
from handeye_ros.sampling.edge_shapes import with_common_edge_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import with_estimated_clocks
from handeye_ros.targets import problem_of_known_poses, target_for
from handeye_ros.words import mm
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import KDTree

# 1 s, between a sample and joint values: these rest at a stop, so it is more than
# sampling.max_pose_gap
MAX_GAP = NS
UNCORRECTED_STD = 5e-4  # 1 sigma of the robot's error before its correction (m)
MAX_X_DIFFERENCE = 0.05  # m and rad: largest difference of X between targets


@dataclass(frozen=True, eq=False)
class ArmSamples:
    """
    The samples of one target, with joint values.

    session: with the stops that gave none, and the frame of the profiles
    samples: in the order of the stations of the problem
    problem: what they show of the target, with the poses of the arm as stated
    q: (n, joints) the joint values
    inputs, warnings: the files that were read, and the warnings about them
    """

    session: Session
    samples: Sequence[Sample]
    problem: Problem
    q: Array
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()


def arm_samples_of(session: Session, recording: Recording, arm: Arm, config: Config,
                   inputs: Sequence[dict[str, str]] = ()) -> ArmSamples:
    """
    Return the samples of a session with the joint values of their time.

    recording: holds the joint values. Raises DataError for few or no samples and for joint values
    beyond the limits of the URDF, InputError for samples without joint values.
    """
    config = replace(config, kinematics='', pose_source='topic', robot_base_frame=arm.base,
                     robot_effector_frame=arm.flange)
    samples = sorted(session.samples, key=lambda sample: sample.stamp)
    require_samples(samples, session.rejects, target_for(config))
    require_enough_stops(len(samples))
    if recording.joints is None:
        raise InputError('the recording was read without an arm, so without its joint values')
    # as pipeline.answer_samples prepares them, none dropped
    samples = with_common_edge_shape(samples)
    samples = with_estimated_clocks(samples, config).samples
    problem = problem_of_known_poses(samples, config)
    q = _joints_at(samples, recording, recording.joints)
    problem = replace(problem, poses=mount_poses(arm.forward(q), config))
    require_within_limits(arm, recording.joints)
    return ArmSamples(session, samples, problem, q, inputs, (
        *recording.warnings, *session.warnings, *unmoved_notes(arm, recording.joints)))


def _joints_at(samples: Sequence[Sample], recording: Recording, joints: Array) -> Array:
    """Return the joint values (n, joints) at samples, from those (k, joints) of a recording."""
    times = np.array([sample.stamp + round(sample.clock_values.offset * 1e9)
                      for sample in samples])
    stamps, first = np.unique([pose.stamp for pose in recording.poses], return_index=True)
    gaps, _ = KDTree(stamps[:, None]).query(times[:, None])
    if missing := int((gaps > MAX_GAP).sum()):
        raise InputError(
            f'{missing} of {len(times)} samples have no joint values of their time: joint values '
            'and profiles must be recorded together, with clocks that agree')
    spline = PchipInterpolator((stamps - stamps[0]) * 1e-9, joints[first])
    return np.asarray(spline((np.clip(times, stamps[0], stamps[-1]) - stamps[0]) * 1e-9))


def fit_of_samples(parts: Sequence[ArmSamples], arm: Arm) -> ArmFit:
    """
    Return the fit of the hand-eye transform alone, with the arm as stated, of stops that agree.

    Raises DataError where the stops of a part do not agree, or two parts place the sensor apart.
    """
    measured, estimates = list[ArmProfiles](), list[Estimate]()
    for part in parts:
        config = part.problem.config
        noise = replace(config.noise, robot_smooth=UNCORRECTED_STD)
        agreed = robust_solution(replace(part.problem, config=replace(config, noise=noise)),
                                 np.random.default_rng(SEED), subsets=True)
        # the arm's errors and a smooth one of their own stand for robot_smooth from here on
        without_smooth = replace(config, noise=replace(noise, robot_smooth=0.0))
        measured.append(ArmProfiles(part.q[agreed.used_stations],
                                    replace(agreed.problem, config=without_smooth)))
        estimates.append(agreed.estimate)
        apart = se3.difference(estimates[-1].X, estimates[0].X)
        if max(np.linalg.norm(apart[:3]), np.linalg.norm(apart[3:])) > MAX_X_DIFFERENCE:
            raise DataError(
                f'two recordings place the sensor {mm(float(np.linalg.norm(apart[:3])))} '
                'apart: give only recordings of one sensor in one mount, on one robot')
    return with_estimated_weights(ArmFit.of_arm(
        arm, measured, estimates[0].X, [each.state for each in estimates], np.ones(1)).solved())


def solve_samples(parts: Sequence[ArmSamples], arm: Arm, inputs: Sequence[dict[str, str]] = ()
                  ) -> ArmAnswer:
    """
    Return the corrected arm, and the calibration that belongs to it; raises DataError.

    parts: the samples of one sensor on one robot, each with another target or another position
    of the target; inputs: further files.
    """
    try:
        selection = select_model(
            fit_of_samples(parts, arm), sum(len(part.q) for part in parts),
            parts[0].problem.config.limits.residual)
    except DataError as error:
        for part in parts if error.code == UNSOLVED else ():
            require_same_clock(part.session, part.problem.config)
        raise
    calibrations = [_calibrated(part, selection.arm) for part in parts]
    first, covariance = calibrations[0], selection.covariance
    if len(calibrations) == 1:
        calibration = with_covariance(first, cover(first.covariance, covariance))
    else:
        calibration = _combined(calibrations, selection.chosen.fit.X @ se3.inverse(
            T_sensor_plane(parts[0].problem.config)), covariance)
    files = [*(file for part in parts for file in part.inputs), *inputs]
    warnings = dict.fromkeys(warning for part in parts for warning in part.warnings)
    return ArmAnswer(selection, replace(calibration, provenance={
        **calibration.provenance, 'inputs': files}), (*warnings, *selection.notes))


def _calibrated(part: ArmSamples, arm: Arm) -> Calibration:
    """Return the calibration with the poses of a corrected arm; raises DataError."""
    samples = [replace(sample, T_base_flange=T, trajectory=None)
               for sample, T in zip(part.samples, arm.forward(part.q), strict=True)]
    return pipeline.solve(samples, part.session.rejects, part.problem.config,
                          part.session.frame_id)


def _combined(calibrations: Sequence[Calibration], X: Array, covariance: Array) -> Calibration:
    """
    Return one calibration for all targets, with the transform that they have in common.

    It has the name and the target of the first, and the largest residuals.
    """
    qualities = [calibration.quality for calibration in calibrations]
    quality = replace(qualities[0], samples_used=sum(q.samples_used for q in qualities),
                      samples_rejected=sum(q.samples_rejected for q in qualities),
                      residual_rms=max(q.residual_rms for q in qualities),
                      holdout_rms=max(q.holdout_rms for q in qualities))
    reports = tuple(report for calibration in calibrations for report in calibration.samples)
    return with_covariance(replace(calibrations[0], T_flange_sensor=X, quality=quality,
                                   samples=reports), covariance)
