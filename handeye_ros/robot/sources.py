# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from recordings and sessions: samples with the joint values of their time."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import pipeline, se3
from handeye_ros.arm import Arm
from handeye_ros.bags.bag import Recording
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.estimation.problem import linearise, Problem
from handeye_ros.estimation.search import robust_solution
from handeye_ros.estimation.solve import cover
from handeye_ros.frames import mount_poses, T_sensor_plane
from handeye_ros.robot.arm_answer import ArmAnswer
from handeye_ros.robot.estimate import ArmProfiles, ArmState, ArmStops, first_fit, lengths
from handeye_ros.robot.selection import ArmProblem, joint_notes, require_enough, solve, UNSOLVED
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import problem_of_known_poses, with_estimated_clocks
import numpy as np
from scipy.interpolate import PchipInterpolator

LONGEST_GAP = 1_000_000_000  # ns, between a sample and joint values
UNCORRECTED_STD = 5e-4  # 1 sigma of the robot's error before its correction (m)
LARGEST_APART = 0.05  # m and rad: largest difference of X between targets
SEED = 0


@dataclass(frozen=True, eq=False)
class Source:
    """
    The samples of one target, with joint values.

    samples: in the order of the stops of the problem, whose poses are those of the arm as stated
    q: (n, joints)
    inputs, warnings: of the reading
    """

    session: Session
    samples: Sequence[Sample]
    problem: Problem
    q: Array
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()


def source_of(session: Session, read: Recording, arm: Arm, config: Config,
              inputs: Sequence[dict[str, str]] = ()) -> Source:
    """
    Return the samples of a session with the joint values of their time.

    read: with the joint values. Raises InputError, DataError.
    """
    config = replace(config, kinematics='', pose_source='topic', robot_base_frame=arm.base,
                     robot_effector_frame=arm.flange)
    require_enough(len(session.samples))
    assert read.joints is not None
    # as pipeline.answer_samples prepares them, none dropped
    samples = with_common_shape(sorted(session.samples, key=lambda sample: sample.stamp))
    samples = with_estimated_clocks(samples, config).samples
    problem = problem_of_known_poses(samples, config)
    q = _joints_at(samples, read, read.joints)
    warnings = (*read.warnings, *session.warnings, *joint_notes(arm, read.joints))
    return Source(session, samples, replace(problem, poses=mount_poses(arm.forward(q), config)), q,
                  inputs, warnings)


def _joints_at(samples: Sequence[Sample], read: Recording, joints: Array) -> Array:
    """Return the joint values (n, joints) at samples, from those (k, joints) of the poses read."""
    times = np.array([sample.stamp + round(sample.clock_values[0] * 1e9) for sample in samples])
    stamps, first = np.unique([pose.stamp for pose in read.poses], return_index=True)
    after = np.searchsorted(stamps, times)
    gaps = np.minimum(*(np.abs(stamps[np.clip(after - k, 0, len(stamps) - 1)] - times)
                        for k in (0, 1)))
    missing = int((gaps > LONGEST_GAP).sum())
    if missing:
        raise InputError(
            f'{missing} of {len(times)} samples have no joint values of their time: joint values '
            'and profiles must be recorded together, with clocks that agree')
    spline = PchipInterpolator((stamps - stamps[0]) * 1e-9, joints[first])
    return np.asarray(spline((np.clip(times, stamps[0], stamps[-1]) - stamps[0]) * 1e-9))


def arm_problem_of(sources: Sequence[Source], arm: Arm) -> ArmProblem:
    """Return the samples that agree, with the arm as stated; raises DataError."""
    measured, states, q = [], [], []
    for source in sources:
        config = source.problem.config
        noise = replace(config.noise, robot_smooth=UNCORRECTED_STD)
        agreed = robust_solution(replace(source.problem, config=replace(config, noise=noise)),
                                 np.random.default_rng(SEED), subsets=True)
        exact = replace(config, noise=replace(noise, robot_smooth=0.0))
        measured.append(ArmProfiles(replace(agreed.problem, config=exact)))
        states.append(agreed.estimate)
        q.append(source.q[agreed.used])
        apart = se3.difference(agreed.estimate.X, states[0].X)
        if max(np.linalg.norm(apart[:3]), np.linalg.norm(apart[3:])) > LARGEST_APART:
            raise DataError(
                f'two recordings place the sensor {mm(float(np.linalg.norm(apart[:3])))} '
                'apart: give only recordings of one sensor in one mount, on one robot')
    stops = ArmStops.of(np.concatenate(q), tuple(measured))
    state = ArmState(states[0].X, tuple(found.state for found in states), arm, np.zeros(0))
    fit = first_fit(stops, state, np.ones(len(stops), dtype=bool))
    limit = sources[0].problem.config.limits.residual
    return ArmProblem(fit, limit, np.concatenate([source.q for source in sources]),
                      lambda joints: max(_median_residual(source, arm, joints)
                                         for source in sources))


def _median_residual(source: Source, arm: Arm, joints: Array) -> float:
    """Return the median residual (m) of the stops; see residual_with of ArmProblem."""
    poses = mount_poses(arm.forward(source.q @ joints.T), source.problem.config)
    agreed = robust_solution(replace(source.problem, poses=poses), np.random.default_rng(SEED))
    residuals = linearise(agreed.full_problem, agreed.estimate).residuals
    return float(np.median(lengths(residuals, agreed.full_problem.observations.station)))


def solve_sources(sources: Sequence[Source], arm: Arm, inputs: Sequence[dict[str, str]] = ()
                  ) -> ArmAnswer:
    """
    Return the corrected arm, and the calibration that belongs to it; raises DataError.

    sources: of one sensor on one robot, each with another target or another position of it.
    inputs: further files.
    """
    try:
        outcome = solve(arm_problem_of(sources, arm))
    except DataError as error:
        for source in sources if error.reason == UNSOLVED else ():
            require_same_clock(source.session, source.problem.config)
        raise
    calibrations = [_calibrated(source, outcome.arm) for source in sources]
    first, covariance = calibrations[0], outcome.covariance[:6, :6]
    if len(calibrations) == 1:
        calibration = replace(first, covariance=cover(first.covariance, covariance))
    else:
        calibration = _combined(calibrations, outcome.chosen.fit.state.X @ se3.inverse(
            T_sensor_plane(sources[0].problem.config)), covariance)
    files = [*(file for source in sources for file in source.inputs), *inputs]
    warnings = dict.fromkeys(words for source in sources for words in source.warnings)
    return ArmAnswer(outcome, replace(calibration, provenance={
        **calibration.provenance, 'inputs': files}), (*warnings, *outcome.notes))


def _calibrated(source: Source, arm: Arm) -> Calibration:
    """Return the calibration with the poses of a corrected arm; raises DataError."""
    samples = [replace(sample, T_base_flange=T, trajectory=None)
               for sample, T in zip(source.samples, arm.forward(source.q), strict=True)]
    return pipeline.solve(samples, source.session.rejects, source.problem.config,
                          source.session.frame_id)


def _combined(calibrations: Sequence[Calibration], X: Array, covariance: Array) -> Calibration:
    """Return one calibration for all targets, with the transform that they have in common."""
    qualities = [calibration.quality for calibration in calibrations]
    quality = replace(qualities[0], samples_used=sum(q.samples_used for q in qualities),
                      samples_rejected=sum(q.samples_rejected for q in qualities),
                      residual_rms=max(q.residual_rms for q in qualities),
                      holdout_rms=max(q.holdout_rms for q in qualities))
    reports = tuple(report for calibration in calibrations for report in calibration.samples)
    return replace(calibrations[0], T_flange_sensor=X, covariance=covariance, quality=quality,
                   samples=reports)
