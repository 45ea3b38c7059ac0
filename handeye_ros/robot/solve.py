# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The corrected arm from its data: recordings and sessions, or a table.

They give samples with the joint values of their time; a table has a row for each configuration,
with the point that the sensor measured there. Both are read (arm_samples_of, read_arm_points),
give the hand-eye transform alone (fit_of_samples, fit_of_points), then the best model of the arm
(select_model), and the answer with its calibration (solve_samples, solve_table).
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

from handeye_ros import pipeline, se3
from handeye_ros.arm import Arm, PRISMATIC, REVOLUTE
from handeye_ros.bags.recording import Recording
from handeye_ros.calibration import assemble_calibration, report_of_row
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.refusals import require_certain, require_samples
from handeye_ros.config import Config
from handeye_ros.csv_tables import ANGLE, CsvTable, LENGTH, require_different
from handeye_ros.data import (
    Array,
    Calibration,
    Indices,
    NS,
    ROBOT_POSITION_ERROR,
    Sample,
    SEED,
)
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.outliers import robust_least_squares
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import robust_solution
from handeye_ros.estimation.solution import cover
from handeye_ros.frames import mount_poses, T_sensor_plane
from handeye_ros.published import jing2020
from handeye_ros.robot.arm_answer import ArmAnswer
from handeye_ros.robot.estimate import (
    ArmFit,
    ArmPoints,
    ArmProfiles,
    MIN_STOPS,
    with_estimated_weights,
)
from handeye_ros.robot.selection import ArmSelection, require_enough, select_model, UNSOLVED
from handeye_ros.sampling.edge_shapes import with_common_edge_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import with_estimated_clocks
from handeye_ros.targets import problem_of_known_poses, target_for
from handeye_ros.targets.profile_target import xyz
from handeye_ros.units import UNITS
from handeye_ros.words import degrees, mm
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import KDTree

# 1 s, between a sample and joint values: these rest at a stop, so it is more than
# sampling.max_pose_gap
MAX_GAP = NS
UNCORRECTED_STD = 5e-4  # 1 sigma of the robot's error before its correction (m)
MAX_X_DIFFERENCE = 0.05  # m and rad: largest difference of X between targets
INACCURATE_RMS = 1e-3  # 1 sigma (m) of the residuals of an inaccurate robot
# by kind of joint (rad, m): tolerance of the limits, which are often stated roughly
MAX_EXTRAPOLATION = {REVOLUTE: 0.35, PRISMATIC: 0.1}
# the same: smallest range of values that determines the error of a joint
UNMOVED_SPREAD = {REVOLUTE: 0.02, PRISMATIC: 0.005}


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

    recording: holds the joint values. Raises InputError, DataError.
    """
    config = replace(config, kinematics='', pose_source='topic', robot_base_frame=arm.base,
                     robot_effector_frame=arm.flange)
    samples = sorted(session.samples, key=lambda sample: sample.stamp)
    require_samples(samples, session.rejects, target_for(config))
    require_enough(len(samples))
    if recording.joints is None:
        raise InputError('the recording was read without an arm, so without its joint values')
    # as pipeline.answer_samples prepares them, none dropped
    samples = with_common_edge_shape(samples)
    samples = with_estimated_clocks(samples, config).samples
    problem = problem_of_known_poses(samples, config)
    q = _joints_at(samples, recording, recording.joints)
    problem = replace(problem, poses=mount_poses(arm.forward(q), config))
    _require_within_limits(arm, recording.joints)
    return ArmSamples(session, samples, problem, q, inputs, (
        *recording.warnings, *session.warnings, *_unmoved_notes(arm, recording.joints)))


def _require_within_limits(arm: Arm, q: Array) -> None:
    """Raise DataError for values (n, joints) beyond the limits of a joint."""
    for joint, low, high in zip(arm.joints, q.min(axis=0), q.max(axis=0), strict=True):
        tolerance = MAX_EXTRAPOLATION[joint.type]
        if low < joint.lower - tolerance or high > joint.upper + tolerance:
            raise DataError(
                f'{joint.name} goes from {low:.4g} to {high:.4g}, and the URDF limits it to '
                f'{joint.lower:.4g} to {joint.upper:.4g} (radians or metres): check unit (degrees '
                'stated as radians?), sign, zero, and order of the joint values, whether it is '
                'counted from the horizontal, and the limits in the URDF')


def _unmoved_notes(arm: Arm, q: Array) -> Iterator[str]:
    """Yield a sentence for each joint whose error values (n, joints) do not determine."""
    for joint, spread in zip(arm.joints, np.ptp(q, axis=0).tolist(), strict=True):
        if spread < UNMOVED_SPREAD[joint.type]:
            size = (degrees if joint.type == REVOLUTE else mm)(spread)
            yield (f'{joint.name} moves by {size} only: these configurations do not determine its '
                   'error')


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
    """Return the hand-eye transform alone, of the stops that agree; raises DataError."""
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
        calibration = replace(first, covariance=cover(first.covariance, covariance))
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
    return replace(calibrations[0], T_flange_sensor=X, covariance=covariance, quality=quality,
                   samples=reports)


# -- a table


def read_arm_points(path: Path, arm: Arm, in_hand: bool
                    ) -> tuple[list[ArmPoints], dict[str, Indices], list[str]]:
    """
    Return the points of a table, target by target, its rows by target, and peculiarities.

    A row for each configuration. Columns: the joints of the URDF with their unit
    (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame; optional: `target`
    names the point where there are several. in_hand: as in ArmPoints. Rows count from 0, a
    peculiarity is a sentence. Raises InputError and DataError.
    """
    table = CsvTable(path)
    kinds = {j.name: LENGTH if j.type == PRISMATIC else ANGLE for j in arm.joints}
    readings = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
                if name in table.columns}
    q, points = arm.joint_values(readings, path), table.values(['x', 'y', 'z'], LENGTH)
    require_different(np.hstack([q, points]))
    _require_within_limits(arm, q)
    labels = table.texts('target') if 'target' in table.columns else ['target'] * len(points)
    rows = {name: np.flatnonzero(np.array(labels) == name) for name in dict.fromkeys(labels)}
    unused = [f'the column {name} is no joint between {arm.base} and {arm.flange}: it is not used'
              for name, (unit, _) in table.columns.items()
              if unit in UNITS[ANGLE] and name not in kinds]
    return ([ArmPoints(q[part], points[part], in_hand) for part in rows.values()], rows,
            [*unused, *_unmoved_notes(arm, q)])


def select_from_points(measured: Sequence[ArmPoints], arm: Arm, limit: float) -> ArmSelection:
    """Return the corrected arm; limit: the largest valid residual (m); raises DataError."""
    stop_count = sum(len(points.q) for points in measured)
    require_enough(stop_count)
    return select_model(fit_of_points(measured, arm), stop_count, limit)


def fit_of_points(measured: Sequence[ArmPoints], arm: Arm) -> ArmFit:
    """Return the hand-eye transform alone, with the arm as stated, whatever its residuals."""
    poses = [points.mount_poses(arm) for points in measured]
    largest = max(range(len(measured)), key=lambda k: len(measured[k].q))
    X, _ = jing2020.fixed_point_linear(poses[largest], measured[largest].points)
    places = [np.median(se3.apply(T @ X, points.points[:, None])[:, 0], axis=0)
              for T, points in zip(poses, measured, strict=True)]
    start = ArmFit.of_arm(arm, measured, X, places, np.full(3, INACCURATE_RMS))
    adjusted = robust_least_squares(start.system, start, MIN_STOPS)
    used = np.isin(np.arange(len(start.q)), adjusted.used)
    return with_estimated_weights(replace(adjusted.state, used=used).solved())


def solve_table(path: Path, arm: Arm, config: Config, inputs: Sequence[dict[str, str]]
                ) -> ArmAnswer:
    """
    Return the corrected arm from a table of joint values and points (read_arm_points).

    inputs: path and sha256 of the files. Raises HandeyeError.
    """
    measured, rows, notes = read_arm_points(path, arm, config.in_hand)
    selection = select_from_points(measured, arm, config.limits.residual)
    fit, covariance = selection.chosen.fit, selection.covariance
    config = replace(config, robot_base_frame=arm.base, robot_effector_frame=arm.flange)
    require_certain(covariance, config, 'move all joints, and bring the target to different '
                    'points of the field of view')
    target = {f'point_{name}': xyz(place)
              for name, place in zip(rows, fit.targets, strict=True)}
    numbered = [(row + 1, name) for name, part in rows.items() for row in part]
    reports = [report_of_row(*of_row, used, distance) for of_row, used, distance in zip(
        numbered, fit.used, fit.distances, strict=True)]
    calibration = assemble_calibration(
        config, 'kinematics', config.sensor_frame, fit.X, covariance,
        fit.residual_rms, selection.chosen.left_out_rms,
        {**target, ROBOT_POSITION_ERROR: selection.robot_smooth},
        sorted(reports, key=attrgetter('stamp')), {'inputs': list(inputs)})
    return ArmAnswer(selection, replace(calibration, name=config.name or calibration.method),
                     (*notes, *selection.notes))
