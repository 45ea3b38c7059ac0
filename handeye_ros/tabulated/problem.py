# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets solved from files of measured values: what they have in common, answer and refusals.

A table is read, an estimator answers, and where the values contradict each other, they are tried
as other units and notations would give them: what fits is named, never used. These refuse, in this
order:

1. `read_table`: a target.type without tables, a method or calibration_type that it does not have
2. reading, of pairs: `CsvTable`; `require_plausible`, for rows that repeat and units of no cell;
   of a tracker: tracker.direction, the bag, a missing file of points, settings without default,
   `read_reflector_points`, and `sweep_from`, for missing profiles and another motion than along
   a line
3. `require_usable`: too few values, without spread or in the wrong order; of a tracker also its
   published answer, and a sweep beside the line
4. `estimate`; of a tracker `require_agreement`: a part or a row is further off than the noise
5. `TableAnswer.agrees`: too many samples were dropped, or the others do not fit
6. `TableAnswer.require_trusted`: the answer is beyond the limits of the configuration

After a refusal of steps 3 to 5 the misreadings are tried, which a tracker has none of.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, KW_ONLY
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from handeye_ros import se3
from handeye_ros.calibration import assemble_calibration, report_of_row
from handeye_ros.checks.refusals import (
    MAX_DROPPED_SHARE,
    require_certain,
    require_predicted,
)
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError
from handeye_ros.results.truth import field_points, FIELD_TEXT
from handeye_ros.threads import single_threaded
from handeye_ros.words import degrees, mm
import numpy as np
from numpy.typing import NDArray

MAX_RMS, MAX_ANGLE = 5e-3, 0.05  # of the residuals of values that agree (m, rad)
MISREADING_RMS = 1e-3  # m: the same of values that are read otherwise, to be named as the cause


@dataclass(frozen=True, eq=False)
class TableProblem(ABC):
    """
    The values measured for a target, as its files hold them, and how they are solved.

    A sample is a row of a table, or what one profile shows of the target.

    frame: frame id of the sensor
    inputs: path and sha256 of every file
    warnings: what was lost in reading
    misreadings: the same values in other units and notations

    name: of the target, as in target.type
    calibration_types: those that the target can have
    advice: what makes an answer more certain
    to_check: what to check where the values contradict each other
    error_points_text: the points of `error_points` in words
    """

    config: Config
    _: KW_ONLY
    frame: str = ''
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()
    misreadings: Sequence[Misreading] = ()

    name: ClassVar[str]
    calibration_types: ClassVar[tuple[str, ...]]
    advice: ClassVar[str]
    to_check: ClassVar[str]
    error_points_text: ClassVar[str] = FIELD_TEXT

    @classmethod
    @abstractmethod
    def read(cls, path: Path, config: Config) -> Self:
        """Return the values in a file, and in those beside it; raises InputError, DataError."""

    @property
    @abstractmethod
    def sample_ids(self) -> Sequence[tuple[int, str]]:
        """Return the number of the row, or the stamp (ns), and the kind of each sample."""

    @abstractmethod
    def require_usable(self) -> None:
        """Raise DataError for values that leave the transform free, or are in the wrong order."""

    @abstractmethod
    def estimate(self) -> TableAnswer:
        """Return the answer, however uncertain; raises DataError."""

    def error_points(self) -> Array:
        """Return the points (k, 3) over which errors are reported, in the plane's frame (m)."""
        return field_points()

    @property
    def T_sensor_plane(self) -> Array:
        """Return the frame of the values (of profiles: their plane) in the sensor (4, 4)."""
        return np.eye(4)


class Misreading(NamedTuple):
    """
    The same measured values, read in another unit or notation.

    description: what is different, after "with"; remedy: what to do if this is right.
    """

    description: str
    remedy: str
    problem: TableProblem


@dataclass(frozen=True, eq=False)
class TableAnswer:
    """
    The transform X (4, 4) of the frame of the values in the mount, with its statistics.

    covariance: (6, 6), x y z rx ry rz in the mount (m, rad)
    used: (n,) whether each sample is used
    residuals: (n,) of all samples (m)
    residual_rms: RMS residual of the used samples (m)
    left_out_rms: RMS residual where each used sample is predicted from the others (m); of a
        tracker its estimate by generalised cross-validation
    angle_rms: RMS residual of measured rotations (rad)
    target: other estimates, as plain values
    """

    X: Array
    covariance: Array
    used: NDArray[np.bool_]
    residuals: Array
    residual_rms: float
    left_out_rms: float
    angle_rms: float = 0.0
    target: Mapping[str, Any] = field(default_factory=dict)

    @property
    def agrees(self) -> bool:
        """Return whether few samples were dropped, and the others fit."""
        return bool(1 - self.used.mean() <= MAX_DROPPED_SHARE
                    and self.residual_rms <= MAX_RMS and self.angle_rms <= MAX_ANGLE)

    def require_trusted(self, problem: TableProblem) -> None:
        """Raise DataError for an answer of a problem that is beyond its limits."""
        require_certain(self.covariance, problem.config, problem.advice)
        require_predicted(self.left_out_rms, self.residual_rms, problem.config.limits.residual)


@single_threaded
def calibrate_table(problem: TableProblem) -> Calibration:
    """Return the calibration; raises DataError when the files do not determine an answer."""
    answer = answer_table(problem)
    answer.require_trusted(problem)
    warnings = {'warnings': list(problem.warnings)} if problem.warnings else {}
    return assemble_calibration(
        problem.config, method=problem.name, sensor_frame=problem.frame,
        T_flange_sensor=answer.X @ se3.inverse(problem.T_sensor_plane),
        covariance=answer.covariance, residual_rms=answer.residual_rms,
        holdout_rms=answer.left_out_rms, target=answer.target,
        reports=[report_of_row(number, kind, used, residual)
                 for (number, kind), used, residual in zip(
                     problem.sample_ids, answer.used, answer.residuals, strict=True)],
        provenance={'inputs': list(problem.inputs), **warnings})


def answer_table(problem: TableProblem) -> TableAnswer:
    """
    Return the answer of values that agree; raises DataError.

    The refusal names a misreading that explains the values, if all that do give the same answer.
    """
    try:
        problem.require_usable()
        answer = problem.estimate()
        if answer.agrees:
            return answer
        turned = f' and {degrees(answer.angle_rms)}' if answer.angle_rms else ''
        refusal = DataError(
            f'no transform brings all samples together: the {answer.used.sum()} of '
            f'{len(answer.used)} that agree best differ by {mm(answer.residual_rms)}{turned} RMS: '
            f'{problem.to_check}', code='misfit')
    except DataError as error:
        refusal = error
    explaining = list[tuple[Array, str]]()
    for description, remedy, misread in problem.misreadings:
        with suppress(DataError):
            misread.require_usable()
            answer = misread.estimate()
            if answer.agrees and answer.residual_rms < MISREADING_RMS:
                explaining.append((
                    answer.X, f'the values contradict each other, but with {description} they '
                    f'agree to {mm(answer.residual_rms)}: {remedy}'))
    if explaining and all(np.allclose(X, explaining[0][0], atol=1e-9) for X, _ in explaining):
        raise DataError(explaining[0][1], code='convention')
    raise refusal
