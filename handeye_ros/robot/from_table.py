# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The corrected arm from a table: joint values, and the point that the sensor measured at each.

It is read (read_arm_points), gives the hand-eye transform alone (fit_of_points), then the best
model of the arm (select_from_points), and the answer with its calibration (solve_table).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from handeye_ros import se3
from handeye_ros.arm import Arm, PRISMATIC
from handeye_ros.calibration import assemble_calibration, report_of_row
from handeye_ros.checks.refusals import require_certain
from handeye_ros.config import Config
from handeye_ros.csv_tables import ANGLE, CsvTable, LENGTH, require_different
from handeye_ros.data import Indices, ROBOT_POSITION_ERROR
from handeye_ros.estimation.outliers import robust_least_squares
from handeye_ros.published import jing2020
from handeye_ros.robot.answer import ArmAnswer
from handeye_ros.robot.fit import ArmFit, ArmPoints, MIN_STOPS, with_estimated_weights
from handeye_ros.robot.selection import (
    ArmSelection,
    require_enough_stops,
    require_within_limits,
    select_model,
    unmoved_notes,
)
from handeye_ros.targets.profile_target import xyz
from handeye_ros.units import UNITS
import numpy as np

INACCURATE_RMS = 1e-3  # 1 sigma (m) of the residuals of an inaccurate robot


def read_arm_points(path: Path, arm: Arm, in_hand: bool
                    ) -> tuple[list[ArmPoints], dict[str, Indices], list[str]]:
    """
    Return the points of a table, target by target, its rows by target, and sentences for the user.

    A row for each configuration. Columns: the joints of the URDF with their unit
    (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame; optional: `target`
    names the point where there are several. in_hand: as in ArmPoints. Rows count from 0. Raises
    TableError for a table that cannot be read, InputError for a joint without values, DataError
    for rows that repeat others and for values beyond the limits of a joint.
    """
    table = CsvTable(path)
    kinds = {j.name: LENGTH if j.type == PRISMATIC else ANGLE for j in arm.joints}
    readings = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
                if name in table.columns}
    q, points = arm.joint_values(readings, path), table.values(['x', 'y', 'z'], LENGTH)
    require_different(np.hstack([q, points]))
    require_within_limits(arm, q)
    labels = table.texts('target') if 'target' in table.columns else ['target'] * len(points)
    rows = {name: np.flatnonzero(np.array(labels) == name) for name in dict.fromkeys(labels)}
    unused = [f'the column {name} is no joint between {arm.base} and {arm.flange}: it is not used'
              for name, (unit, _) in table.columns.items()
              if unit in UNITS[ANGLE] and name not in kinds]
    return ([ArmPoints(q[part], points[part], in_hand) for part in rows.values()], rows,
            [*unused, *unmoved_notes(arm, q)])


def select_from_points(measured: Sequence[ArmPoints], arm: Arm, limit: float) -> ArmSelection:
    """Return the best model of the arm; limit: as in select_model; raises DataError."""
    stop_count = sum(len(points.q) for points in measured)
    require_enough_stops(stop_count)
    return select_model(fit_of_points(measured, arm), stop_count, limit)


def fit_of_points(measured: Sequence[ArmPoints], arm: Arm) -> ArmFit:
    """
    Return the fit of the hand-eye transform alone, with the arm as stated, whatever its residuals.

    The linear solution of the target with the most points is the start; stops that contradict the
    others are not used.
    """
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

    inputs: path and sha256 of the files. Raises InputError and DataError, as read_arm_points,
    select_model and require_certain do.
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
        config, method='kinematics', sensor_frame=config.sensor_frame, T_flange_sensor=fit.X,
        covariance=covariance, residual_rms=fit.residual_rms,
        holdout_rms=selection.chosen.left_out_rms,
        target={**target, ROBOT_POSITION_ERROR: selection.robot_smooth},
        reports=sorted(reports, key=attrgetter('stamp')), provenance={'inputs': list(inputs)})
    return ArmAnswer(selection, replace(calibration, name=config.name or calibration.method),
                     (*notes, *selection.notes))
