# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets solved from files of measured values: their common interface, answer and refusals.

A table is read, an estimator answers, and where the values contradict each other, other units and
notations are tried: the one that fits is named, never used.
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from handeye_ros import __version__, se3
from handeye_ros.checks.refusals import require_certain, require_left_out
from handeye_ros.config import Config, flatten
from handeye_ros.data import Array, Calibration, Quality, SampleReport
from handeye_ros.errors import DataError, degrees, mm, TooFewError
from handeye_ros.estimation.least_squares import single_threaded
from handeye_ros.frames import mount_frame, name_direction, sensor_axes
import numpy as np
from numpy.typing import NDArray

LARGEST_DROPPED_SHARE = 0.34
LARGEST_RMS, LARGEST_ANGLE = 5e-3, 0.05  # of the residuals of values that agree (m, rad)
CLEAR = 0.2  # of misfit and of spread: a misreading with more does not explain the values

Index: TypeAlias = NDArray[np.intp]


class Values(ABC):
    """The values of a file. A sample is a row of a table, or a profile."""

    @property
    @abstractmethod
    def samples(self) -> Sequence[tuple[int, str]]:
        """Return of each sample its row number, or its stamp, and its kind."""

    @abstractmethod
    def subset(self, samples: Index) -> Values:
        """Return some samples (ascending indices)."""

    @abstractmethod
    def require_determined(self, config: Config) -> None:
        """Raise DataError for values that leave something of the transform free."""

    @abstractmethod
    def solve(self, config: Config) -> TableAnswer:
        """Return the answer; raises DataError."""

    @abstractmethod
    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        """Return distances (m) of `measured` samples for X, the target fitted to `fitted` ones."""

    @abstractmethod
    def field(self) -> Array:
        """Return points (k, 3) in the sensor frame over which errors are reported."""

    def spread(self) -> float:
        """Return the extent of the positions (m), 1 sigma, the smaller one of two lists."""
        return np.inf

    def misreadings(self) -> Iterable[Misreading]:
        """Return these values as they would be with other units and notations."""
        return ()


class Misreading(NamedTuple):
    """Values as they would be otherwise: after "with" in words, and the remedy."""

    words: str
    remedy: str
    values: Values


@dataclass(frozen=True, eq=False)
class TableAnswer:
    """
    The transform X (4, 4) from the mount to the frame of the values, with its statistics.

    covariance: (6, 6), x y z rx ry rz in the mount; used: (n,) whether each sample is used; off:
    (n,) residuals of all (m); residual_rms, holdout_rms: of the used ones (m), the latter with
    each predicted without itself; agreed: the values that are used; angle_rms: RMS residual of
    measured rotations (rad); target: other estimates, as plain values.
    """

    X: Array
    covariance: Array
    used: NDArray[np.bool_]
    off: Array
    residual_rms: float
    holdout_rms: float
    agreed: Values
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


@dataclass(frozen=True, eq=False)
class Input:
    """
    What was read.

    frame: of the sensor; inputs: path and sha256 of every file; warnings: what was lost.
    """

    values: Values
    frame: str
    inputs: tuple[dict[str, str], ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class FileMethod:
    """
    A target.

    mounts: supported calibration types; advice: what makes an answer more certain; check: what to
    check where values contradict each other; over: Values.field in words; read: returns the
    input, raises InputError, DataError; profiles: whether values are points in the sensor plane.
    """

    name: str
    mounts: tuple[str, ...]
    advice: str
    check: str
    over: str
    read: Callable[[Path, Config], Input]
    profiles: bool = False


@single_threaded
def calibrate(method: FileMethod, given: Input, config: Config) -> Calibration:
    """Return the calibration; raises DataError when the files do not determine an answer."""
    answer = solve(method, given.values, config)
    require_trusted(method, answer, config)
    std, direction = se3.worst_translation(answer.covariance)
    frame, used = mount_frame(config), int(answer.used.sum())
    quality = Quality(used, len(answer.used) - used, answer.residual_rms, answer.holdout_rms,
                      f'position along {name_direction(direction, frame)} (m)', std)
    reports = tuple(
        SampleReport(stamp, bool(good), kind, float(off), '' if good else 'contradicts the others')
        for (stamp, kind), good, off in zip(given.values.samples, answer.used, answer.off,
                                            strict=True))
    provenance = {'version': __version__, 'inputs': list(given.inputs), 'config': flatten(config)}
    if given.warnings:
        provenance['warnings'] = list(given.warnings)
    return Calibration(
        config.name or config.target.type, method.name, frame, given.frame,
        answer.X @ se3.inverse(plane_axes(method, config)), answer.covariance, answer.target,
        quality, reports, provenance)


def plane_axes(method: FileMethod, config: Config) -> Array:
    """Return T_sensor_plane (4, 4), identity where the values are not of profiles."""
    return sensor_axes(config) if method.profiles else np.eye(4)


def solve(method: FileMethod, values: Values, config: Config) -> TableAnswer:
    """Return the answer of values that agree; raises DataError, which names a misreading."""
    answer = None
    try:
        values.require_determined(config)
        answer = values.solve(config)
        if not answer.agrees:
            turned = f' and {degrees(answer.angle_rms)}' if answer.angle_rms else ''
            raise DataError(
                f'{np.sum(~answer.used)} of {len(answer.used)} samples contradict the others, '
                f'which agree to {mm(answer.residual_rms)}{turned} RMS: {method.check}',
                reason='misfit')
        answer.agreed.require_determined(config)
    except TooFewError:
        raise
    except DataError:
        _name_misreading(values, answer.misfit if answer else math.inf, config)
        raise
    return answer


def _name_misreading(values: Values, before: float, config: Config) -> None:
    """Raise DataError if exactly one other reading explains values of a misfit before (m)."""
    explaining = []
    for words, remedy, others in values.misreadings():
        # lengths in another unit make every residual smaller: it must be small beside the spread
        try:
            others.require_determined(config)
            answer = others.solve(config)
        except DataError:
            continue
        if answer.agrees and answer.misfit < CLEAR * min(before, others.spread()):
            explaining.append((words, remedy, answer.misfit))
    if len(explaining) == 1:
        (words, remedy, after), = explaining
        raise DataError(f'the values contradict each other, but with {words} they agree to '
                        f'{mm(after)}: {remedy}', reason='convention')


def require_trusted(method: FileMethod, answer: TableAnswer, config: Config) -> None:
    """Raise DataError for an answer beyond the limits."""
    require_certain(answer.covariance, config, method.advice)
    require_left_out(answer.holdout_rms, answer.residual_rms, config.limits.residual)


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt((values ** 2).mean()))
