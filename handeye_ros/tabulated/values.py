# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets solved from files of measured values: what they have in common, answer and refusals.

A table is read, an estimator answers, and where the values contradict each other, they are tried
as other units and notations would give them: what fits is named, never used.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from handeye_ros.errors import DataError, degrees, mm, TooFewError
from handeye_ros.estimation.least_squares import chi2_isf, single_threaded
from handeye_ros.results.calibration_file import input_values
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

LARGEST_RMS, LARGEST_ANGLE = 5e-3, 0.05  # of the residuals of values that agree (m, rad)
SHORTEST_REACH, LONGEST_REACH = 0.02, 50.0  # m: what a sensor or a robot reaches lies between them
REGION_PROBABILITY = 0.99  # probability of the region that a covariance from few rows is to hold
CLEAR_SHARE = 0.2  # of the misfit: a misreading with more does not explain the values

Index: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Values(ABC):
    """
    The values of a target's files. A sample is a row of a table, or a profile.

    name: of the target
    calibration_types: supported calibration types
    advice: what makes an answer more certain
    check: what to check where values contradict each other
    over: `field` in words
    """

    config: Config

    name: ClassVar[str]
    calibration_types: ClassVar[tuple[str, ...]]
    advice: ClassVar[str]
    check: ClassVar[str]
    over: ClassVar[str]

    @property
    @abstractmethod
    def samples(self) -> Sequence[tuple[int, str]]:
        """Return of each sample its row number, or its stamp, and its kind."""

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.samples)

    @abstractmethod
    def subset(self, samples: Index) -> Values:
        """Return some samples (ascending indices)."""

    @abstractmethod
    def require_determined(self) -> None:
        """Raise DataError for values that leave something of the transform free."""

    @abstractmethod
    def solve(self) -> TableAnswer:
        """Return the answer; raises DataError."""

    @abstractmethod
    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        """Return distances (m) of `measured` samples for X, the target fitted to `fitted` ones."""

    @abstractmethod
    def field(self) -> Array:
        """Return points (k, 3) in the frame of the values over which errors are reported."""

    @property
    def axes(self) -> Array:
        """Return T_sensor_values (4, 4), of the frame in which the values and X are."""
        return np.eye(4)


@dataclass(frozen=True, eq=False)
class Lists(Values):
    """
    Points (n, 3) or poses (n, 4, 4), as the sensor sees them and by the robot, row by row.

    prefixes: of the columns of both
    """

    seen: Array
    robot: Array

    prefixes: ClassVar[tuple[str, str]]

    @property
    def samples(self) -> Sequence[tuple[int, str]]:
        return [(row, '') for row in range(1, len(self.seen) + 1)]

    def subset(self, samples: Index) -> Self:
        return replace(self, seen=self.seen[samples], robot=self.robot[samples])

    def field(self) -> Array:
        return _positions(self.seen)

    @property
    def reach(self) -> tuple[float, ...]:
        """Return the typical distances (m) of both lists from the origins of their frames."""
        return tuple(float(np.median(np.linalg.norm(_positions(values), axis=1)))
                     for values in (self.seen, self.robot))

    def read_from(self, path: Path, otherwise: Callable[[], Iterator[Misreading]]) -> Input:
        """Return what was read; raises DataError for lists that no sensor and robot can give."""
        rows = np.hstack([values.reshape(len(self), -1) for values in (self.seen, self.robot)])
        first = np.unique(rows, axis=0, return_index=True)[1]
        if len(first) < len(self):
            again = np.setdiff1d(np.arange(len(self)), first) + 1
            raise DataError(f'{len(again)} rows repeat others to the last digit, first row '
                            f'{again[0]}: the answer would seem more certain than it is; keep '
                            'each row once')
        if max(self.reach) < SHORTEST_REACH or min(self.reach) > LONGEST_REACH:
            (seen, robot), (near, far) = self.prefixes, self.reach
            raise DataError(f'the positions of the {seen} are typically {near:.3g} m from the '
                            f'origin, those of the {robot} {far:.3g} m, as in no cell: '
                            f'{_unit_of(seen, robot)}', reason='convention')
        return Input(self, self.config.sensor_frame, (input_values(path),), tuple(otherwise()))

    def stated(self, covariance: Array, used: Index) -> Array:
        """
        Return a covariance (6, 6) with the region that holds, by Fisher's F.

        Its noise is from the residuals of the rows that are used, three each of a kind, of which
        the transform takes six.
        """
        freedom = 3 * len(used) - 6
        return np.asarray(covariance * 6 * fdtri(6, freedom, REGION_PROBABILITY)
                          / chi2_isf(1 - REGION_PROBABILITY, 6))

    def in_other_units(self) -> Iterator[Misreading]:
        """Yield the values with one list in another unit, as far as they then are of a cell."""
        first, second = self.prefixes
        for factor, words in ((1e3, 'larger'), (1e-3, 'smaller')):
            for prefix, seen, robot in ((first, factor, 1.0), (second, 1.0, factor)):
                other = replace(self, seen=scaled(self.seen, seen),
                                robot=scaled(self.robot, robot))
                if SHORTEST_REACH < min(other.reach) and max(other.reach) < LONGEST_REACH:
                    yield Misreading(f'the positions of the {prefix} 1000 times {words}',
                                     _unit_of(prefix), other)


def _positions(values: Array) -> Array:
    return values if values.ndim == 2 else values[:, :3, 3]


def _unit_of(*prefixes: str) -> str:
    return 'correct the unit in the header of ' + ', and of '.join(
        ', '.join(f'{prefix}_{axis}' for axis in 'xyz') for prefix in prefixes)


def scaled(values: Array, factor: float) -> Array:
    """Return points (n, 3) or poses (n, 4, 4) with their positions times a factor."""
    if values.ndim == 2:
        return factor * values
    return se3.transform(values[:, :3, :3], factor * values[:, :3, 3])


class Misreading(NamedTuple):
    """Values as they would be otherwise: after "with" in words, and the remedy."""

    words: str
    remedy: str
    values: Lists


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
        return bool(1 - self.used.mean() <= LARGEST_DROPPED_SHARE) and self.fits

    @property
    def fits(self) -> bool:
        """Return whether the used samples fit."""
        return self.residual_rms <= LARGEST_RMS and self.angle_rms <= LARGEST_ANGLE

    @property
    def misfit(self) -> float:
        """Return the residual (m) that most samples stay below, infinite with wrong rotations."""
        off = float(np.quantile(self.off, 1 - LARGEST_DROPPED_SHARE))
        return off if self.angle_rms <= LARGEST_ANGLE else math.inf

    def require_trusted(self, values: Values) -> None:
        """Raise DataError for an answer beyond the limits of the values that it is of."""
        require_certain(self.covariance, values.config, values.advice)
        require_left_out(self.holdout_rms, self.residual_rms, values.config.limits.residual)


@dataclass(frozen=True, eq=False)
class Input:
    """
    What was read.

    frame: of the sensor
    inputs: path and sha256 of every file
    otherwise: what the values would be with other units and notations
    warnings: what was lost
    """

    values: Values
    frame: str
    inputs: tuple[dict[str, str], ...]
    otherwise: tuple[Misreading, ...] = ()
    warnings: tuple[str, ...] = ()


@single_threaded
def calibrate(given: Input) -> Calibration:
    """Return the calibration; raises DataError when the files do not determine an answer."""
    values = given.values
    answer = solve(values, given.otherwise)
    answer.require_trusted(values)
    warnings = {'warnings': list(given.warnings)} if given.warnings else {}
    return assemble_calibration(
        values.config, values.name, given.frame, answer.X @ se3.inverse(values.axes),
        answer.covariance, answer.residual_rms, answer.holdout_rms, answer.target,
        [report_of_row(number, kind, used, off) for (number, kind), used, off in zip(
            values.samples, answer.used, answer.off, strict=True)],
        {'inputs': list(given.inputs), **warnings})


def solve(values: Values, otherwise: Sequence[Misreading] = ()) -> TableAnswer:
    """Return the answer of values that agree; raises DataError, which names a misreading."""
    misfit = math.inf
    try:
        values.require_determined()
        answer = values.solve()
        misfit = answer.misfit
        if not answer.agrees:
            turned = f' and {degrees(answer.angle_rms)}' if answer.angle_rms else ''
            off, dropped = f'{mm(answer.residual_rms)}{turned} RMS', np.sum(~answer.used)
            raise DataError(
                (f'{dropped} of {len(values)} samples contradict the others, which agree to {off}'
                 if answer.fits else f'no transform brings {len(values) - dropped} of '
                 f'{len(values)} samples together better than {off}') + f': {values.check}',
                reason='misfit')
        values.subset(np.flatnonzero(answer.used)).require_determined()
    except TooFewError:
        raise
    except DataError as error:
        raise _misreading(otherwise, misfit) or error from None
    return answer


def _misreading(otherwise: Sequence[Misreading], before: float) -> DataError | None:
    """Return what to say if exactly one other reading explains values of a misfit before (m)."""
    explaining = []
    for words, remedy, values in otherwise:
        try:
            values.require_determined()
            answer = values.solve()
        except DataError:
            continue
        if answer.agrees and answer.misfit < CLEAR_SHARE * before:
            explaining.append(f'the values contradict each other, but with {words} they agree to '
                              f'{mm(answer.misfit)}: {remedy}')
    return DataError(explaining[0], reason='convention') if len(explaining) == 1 else None
