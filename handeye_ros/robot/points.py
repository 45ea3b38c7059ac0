# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from a table: joint values, and points that the sensor measured there."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handeye_ros import se3
from handeye_ros.arm import Arm, PRISMATIC
from handeye_ros.calibration import assemble_calibration, report_of_row
from handeye_ros.checks.refusals import require_certain
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import adjust
from handeye_ros.published import jing2020
from handeye_ros.robot.arm_answer import ArmAnswer
from handeye_ros.robot.estimate import ArmFit, ArmPoints, MINIMUM, with_estimated_weights
from handeye_ros.robot.selection import ArmOutcome, joint_notes, require_enough, solve
from handeye_ros.tables import ANGLE, LENGTH, Table
from handeye_ros.targets.target import xyz
import numpy as np
from numpy.typing import NDArray

INACCURATE_RMS = 1e-3  # 1 sigma (m) of the residuals of an inaccurate robot


@dataclass(frozen=True, eq=False)
class PointRows:
    """
    The rows of a table, target by target.

    q: (n, joints) reported values of all joints
    points: (n, 3) in the sensor frame
    target: (n,) index of each in names, ascending
    number: (n,) of the row
    in_hand: whether the sensor is on the flange
    """

    q: Array
    points: Array
    target: NDArray[np.intp]
    names: tuple[str, ...]
    number: NDArray[np.intp]
    in_hand: bool = True


def read_table(path: Path, arm: Arm, in_hand: bool) -> tuple[PointRows, list[str]]:
    """
    Return the contents of a table, and a sentence for each peculiarity.

    A row for each configuration. Columns: the joints of the URDF with their unit
    (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame; optional: `target`
    names the point where there are several. Raises InputError and DataError.
    """
    table = Table(path)
    kinds = {j.name: LENGTH if j.kind == PRISMATIC else ANGLE for j in arm.joints}
    readings = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
                if table.has([name])}
    q, points = arm.positions(readings, path), table.values(['x', 'y', 'z'], LENGTH)
    labels = table.text('target') if table.has(['target']) else ['target'] * len(points)
    names = tuple(dict.fromkeys(labels))
    target = np.array([names.index(label) for label in labels], dtype=np.intp)
    order = np.argsort(target, kind='stable')
    unused = [f'the column {name} is no joint between {arm.base} and {arm.flange}: it is not used'
              for name in table.names if table.kind(name) == ANGLE and name not in kinds]
    return (PointRows(q[order], points[order], target[order], names, order + 1, in_hand),
            [*unused, *joint_notes(arm, q)])


def solve_rows(rows: PointRows, arm: Arm, limit: float) -> ArmOutcome:
    """Return the corrected arm; limit: the largest valid residual (m); raises DataError."""
    require_enough(len(rows.q))
    return solve(_alone(rows, arm), rows.q, limit, lambda joints: _alone(
        replace(rows, q=rows.q @ joints.T), arm).residual_rms)


def _alone(rows: PointRows, arm: Arm) -> ArmFit:
    """Return the hand-eye transform alone, with the arm as stated, whatever its residuals."""
    parts = [rows.target == k for k in range(len(rows.names))]
    T = arm.forward(rows.q)
    T = T if rows.in_hand else se3.inverse(T)
    most = max(parts, key=np.count_nonzero)
    X, _ = jing2020.fixed_point_linear(T[most], rows.points[most])
    places = se3.apply(T @ X, rows.points[:, None])[:, 0]
    start = ArmFit.of_arm(
        arm, [ArmPoints(rows.q[part], rows.points[part], rows.in_hand) for part in parts], X,
        [np.median(places[part], axis=0) for part in parts], np.full(3, INACCURATE_RMS))
    adjusted = adjust(start.system, start, MINIMUM)
    used = np.isin(np.arange(len(rows.q)), adjusted.used)
    return with_estimated_weights(replace(adjusted.state, used=used).solved())


def solve_table(path: Path, arm: Arm, config: Config, inputs: Sequence[dict[str, str]]
                ) -> ArmAnswer:
    """
    Return the corrected arm from a table of joint values and points (read_table).

    inputs: path and sha256 of the files. Raises HandeyeError.
    """
    rows, notes = read_table(path, arm, config.in_hand)
    outcome = solve_rows(rows, arm, config.limits.residual)
    fit, covariance = outcome.chosen.fit, outcome.covariance
    config = replace(config, robot_base_frame=arm.base, robot_effector_frame=arm.flange)
    require_certain(covariance, config, 'move all joints, and bring the target to different '
                    'points of the field of view')
    target = {f'point_{name}': xyz(place)
              for name, place in zip(rows.names, fit.targets, strict=True)}
    calibration = assemble_calibration(
        config, 'kinematics', config.sensor_frame, fit.X, covariance,
        fit.residual_rms, outcome.chosen.left_out_rms,
        {**target, 'robot_position_error': outcome.smooth},
        [report_of_row(rows.number[k], rows.names[rows.target[k]], fit.used[k], fit.distances[k])
         for k in np.argsort(rows.number)], {'inputs': list(inputs)})
    return ArmAnswer(outcome, replace(calibration, name=config.name or calibration.method),
                     (*notes, *outcome.notes))
