# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets solved from files of measured values: what they have in common, answer and refusals.

A table is read, an estimator answers, and where the values contradict each other, they are tried
as other units and notations would give them: what fits is named, never used.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, KW_ONLY
import math
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

from handeye_ros import se3
from handeye_ros.calibration import assemble_calibration, report_of_row
from handeye_ros.checks.refusals import (
    LARGEST_DROPPED_SHARE,
    require_certain,
    require_left_out,
)
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError, degrees, mm
from handeye_ros.estimation.least_squares import single_threaded
import numpy as np
from numpy.typing import NDArray

LARGEST_RMS, LARGEST_ANGLE = 5e-3, 0.05  # of the residuals of values that agree (m, rad)
CLEAR_SHARE = 0.2  # of the misfit: a misreading with more does not explain the values

Indices: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TableProblem(ABC):
    """
    What is read from the files of a target, and how it is solved.

    A sample is a row of a table, or what a profile shows.

    frame: of the sensor
    inputs: path and sha256 of every file
    warnings: what was lost in reading
    misreadings: the values as other units and notations would give them

    name: of the target
    calibration_types: that it can have
    advice: what makes an answer more certain
    check: what to check where values contradict each other
    over: `field` in words
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
    check: ClassVar[str]
    over: ClassVar[str]

    @classmethod
    @abstractmethod
    def read(cls, path: Path, config: Config) -> Self:
        """Return what a file holds, with all that belongs to it; raises InputError, DataError."""

    @property
    @abstractmethod
    def samples(self) -> Sequence[tuple[int, str]]:
        """Return of each sample its row number, or its stamp (ns), and its kind."""

    @abstractmethod
    def require_determined(self) -> None:
        """Raise DataError for values that leave something of the transform free."""

    @abstractmethod
    def solve(self) -> TableAnswer:
        """Return the answer; raises DataError."""

    @abstractmethod
    def field(self) -> Array:
        """Return points (k, 3) in the frame of the values over which errors are reported (m)."""

    @property
    def axes(self) -> Array:
        """Return T_sensor_values (4, 4), of the frame in which the values and X are."""
        return np.eye(4)


class Misreading(NamedTuple):
    """Values as they would be otherwise: after "with" in words, and the remedy."""

    words: str
    remedy: str
    values: TableProblem


@dataclass(frozen=True, eq=False)
class TableAnswer:
    """
    The transform X (4, 4) from the mount to the frame of the values, with its statistics.

    covariance: (6, 6), x y z rx ry rz in the mount
    used: (n,) whether each sample is used
    off: (n,) residuals of all (m)
    residual_rms, holdout_rms: of the used ones (m), the latter with each predicted without itself
    angle_rms: RMS residual of measured rotations (rad)
    target: other estimates, as plain values
    """

    X: Array
    covariance: Array
    used: NDArray[np.bool_]
    off: Array
    residual_rms: float
    holdout_rms: float
    angle_rms: float = 0.0
    target: Mapping[str, Any] = field(default_factory=dict)

    @property
    def agrees(self) -> bool:
        """Return whether few samples were dropped, and the others fit."""
        return bool(1 - self.used.mean() <= LARGEST_DROPPED_SHARE
                    and self.residual_rms <= LARGEST_RMS and self.angle_rms <= LARGEST_ANGLE)

    @property
    def misfit(self) -> float:
        """Return the residual (m) that most samples stay below, infinite with wrong rotations."""
        off = float(np.quantile(self.off, 1 - LARGEST_DROPPED_SHARE))
        return off if self.angle_rms <= LARGEST_ANGLE else math.inf

    def require_trusted(self, problem: TableProblem) -> None:
        """Raise DataError for an answer beyond the limits of the problem that it is of."""
        require_certain(self.covariance, problem.config, problem.advice)
        require_left_out(self.holdout_rms, self.residual_rms, problem.config.limits.residual)


@single_threaded
def calibrate(problem: TableProblem) -> Calibration:
    """Return the calibration; raises DataError when the files do not determine an answer."""
    answer = solve(problem)
    answer.require_trusted(problem)
    warnings = {'warnings': list(problem.warnings)} if problem.warnings else {}
    return assemble_calibration(
        problem.config, problem.name, problem.frame, answer.X @ se3.inverse(problem.axes),
        answer.covariance, answer.residual_rms, answer.holdout_rms, answer.target,
        [report_of_row(number, kind, used, off) for (number, kind), used, off in zip(
            problem.samples, answer.used, answer.off, strict=True)],
        {'inputs': list(problem.inputs), **warnings})


def solve(problem: TableProblem) -> TableAnswer:
    """
    Return the answer of values that agree; raises DataError.

    It names a misreading that explains the values, if all that do so give the same answer.
    """
    misfit = math.inf
    try:
        problem.require_determined()
        answer = problem.solve()
        if answer.agrees:
            return answer
        misfit = answer.misfit
        turned = f' and {degrees(answer.angle_rms)}' if answer.angle_rms else ''
        refusal = DataError(
            f'no transform brings all samples together: the {answer.used.sum()} of '
            f'{len(answer.used)} that agree best differ by {mm(answer.residual_rms)}{turned} RMS: '
            f'{problem.check}', reason='misfit')
    except DataError as error:
        refusal = error
    explaining = list[tuple[Array, str]]()
    for words, remedy, values in problem.misreadings:
        with suppress(DataError):
            values.require_determined()
            answer = values.solve()
            if answer.agrees and answer.misfit < CLEAR_SHARE * misfit:
                explaining.append((answer.X, f'the values contradict each other, but with {words} '
                                   f'they agree to {mm(answer.misfit)}: {remedy}'))
    if explaining and all(np.allclose(X, explaining[0][0], atol=1e-9) for X, _ in explaining):
        raise DataError(explaining[0][1], reason='convention')
    raise refusal
