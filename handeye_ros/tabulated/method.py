# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets solved from files: their common interface, and the calibration from an answer.

The refusals and the report are the same for all of them.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

from handeye_ros import __version__, se3
from handeye_ros.checks.refusals import require_certain, require_left_out
from handeye_ros.config import Config, flatten
from handeye_ros.data import AnyProfile, Array, Calibration, Quality, SampleReport, TimedPose
from handeye_ros.estimation.least_squares import single_threaded
from handeye_ros.frames import mount_frame, name_direction, sensor_axes
from handeye_ros.se3 import worst_translation
import numpy as np
from numpy.typing import NDArray

D = TypeVar('D')

Index: TypeAlias = NDArray[np.intp]


class Recorded(Protocol):
    """The contents of a bag; see ros.bag.Recording."""

    @property
    def profiles(self) -> Sequence[AnyProfile]:
        """Return the profiles in the order of their stamps."""

    @property
    def poses(self) -> Sequence[TimedPose]:
        """Return the flange poses in the order of their stamps."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one sentence for each kind of lost message."""

    @property
    def inputs(self) -> tuple[dict[str, str], ...]:
        """Return path and sha256 of every file."""


ReadBag: TypeAlias = Callable[[Path, Config], Recorded]


@dataclass(frozen=True, eq=False)
class Input(Generic[D]):
    """
    The values read, with their files.

    frame: of the sensor; inputs: path and sha256 of every file; warnings: what was lost.
    """

    data: D
    frame: str
    inputs: tuple[dict[str, str], ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Answer(Generic[D]):
    """
    The transform X (4, 4) from the mount to the frame of the values, with its statistics.

    covariance: (6, 6), x y z rx ry rz in the mount; used: (n,) whether each sample is used; off:
    (n,) their residuals (m); residual_rms, holdout_rms: of the used samples (m), the latter with
    each predicted without itself. agreed: the data without outliers. target: other estimates, as
    plain values.
    """

    X: Array
    covariance: Array
    used: NDArray[np.bool_]
    off: Array
    residual_rms: float
    holdout_rms: float
    agreed: D
    target: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FileMethod(Generic[D]):
    """
    Reader and estimator of one target, as functions.

    mounts: supported calibration types; advice: what makes an answer more certain.
    read(path, config, read_bag): the input; raises InputError, DataError.
    solve(data, config): the answer; raises DataError.
    samples(data): of each sample its stamp, or its row number in a file, and its kind.
    subset(data, indices (ascending)): the data of these samples.
    residuals(data, X, fitted, measured, config): distances (k,) in metres of the samples
    `measured` for X, the target fitted to the samples `fitted` (both are indices).
    field(data): points (k, 3) in the sensor frame over which errors are reported; over: in words.
    profiles: whether the values are points of profiles in the sensor plane.
    """

    name: str
    mounts: tuple[str, ...]
    advice: str
    read: Callable[[Path, Config, ReadBag], Input[D]]
    solve: Callable[[D, Config], Answer[D]]
    samples: Callable[[D], Sequence[tuple[int, str]]]
    subset: Callable[[D, Index], D]
    residuals: Callable[[D, Array, Index, Index, Config], Array]
    field: Callable[[D], Array]
    over: str
    profiles: bool = False


@single_threaded
def calibrate(method: FileMethod[Any], given: Input[Any], config: Config) -> Calibration:
    """Return the calibration; raises DataError when the files do not determine an answer."""
    answer = method.solve(given.data, config)
    require_trusted(method, answer, config)
    provenance = {'version': __version__, 'inputs': list(given.inputs),
                  'config': flatten(config)}
    if given.warnings:
        provenance['warnings'] = list(given.warnings)
    return Calibration(
        config.name or config.target.type, method.name, mount_frame(config), given.frame,
        answer.X @ se3.inverse(plane_axes(method, config)), answer.covariance, answer.target,
        _quality(answer, config), _reports(method, given.data, answer), provenance)


def plane_axes(method: FileMethod[Any], config: Config) -> Array:
    """Return T_sensor_plane (4, 4), identity where the values are not of profiles."""
    return sensor_axes(config) if method.profiles else np.eye(4)


def require_trusted(method: FileMethod[Any], answer: Answer[Any], config: Config) -> None:
    """Raise DataError for an answer beyond the limits."""
    require_certain(answer.covariance, config, method.advice)
    require_left_out(answer.holdout_rms, answer.residual_rms, config.limits.residual)


def _quality(answer: Answer[Any], config: Config) -> Quality:
    std, direction = worst_translation(answer.covariance)
    used = int(answer.used.sum())
    return Quality(used, len(answer.used) - used, answer.residual_rms, answer.holdout_rms,
                   f'position along {name_direction(direction, mount_frame(config))} (m)', std)


def _reports(method: FileMethod[Any], data: Any, answer: Answer[Any]
             ) -> tuple[SampleReport, ...]:
    """Return the outcome of each sample; a row of a file has its number as the stamp."""
    reports = []
    for (stamp, kind), used, off in zip(method.samples(data), answer.used, answer.off,
                                        strict=True):
        reason = '' if used else 'contradicts the others'
        reports.append(SampleReport(stamp, bool(used), kind, float(off), reason))
    return tuple(reports)
