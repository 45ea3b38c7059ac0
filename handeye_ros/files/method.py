"""What a target is that is solved from files of measured values: the few functions it takes."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, TimedPose
import numpy as np
from numpy.typing import NDArray

D = TypeVar('D')

Index: TypeAlias = NDArray[np.intp]


class Recorded(Protocol):
    """What a bag holds; see ros.bag.Recording."""

    @property
    def profiles(self) -> Sequence[AnyProfile]:
        """Return the profiles in the order of their stamps."""

    @property
    def poses(self) -> Sequence[TimedPose]:
        """Return the flange poses in the order of their stamps."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence for each thing that was lost."""

    @property
    def inputs(self) -> tuple[dict[str, str], ...]:
        """Return path and sha256 of every file."""


ReadBag: TypeAlias = Callable[[Path, Config], Recorded]


@dataclass(frozen=True, eq=False)
class Input(Generic[D]):
    """
    What was read.

    frame: of the sensor; inputs: path and sha256 of every file; warnings: what was lost.
    """

    data: D
    frame: str
    inputs: tuple[dict[str, str], ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Answer(Generic[D]):
    """
    The transform from the mount to what the measured values are of, X (4, 4), and its judgement.

    covariance: (6, 6), x y z rx ry rz in the mount; used: (n,) of the samples; off: (n,) by which
    each misses (m); residual_rms, holdout_rms: of the used (m), the latter each against the
    answer without it. agreed: what of the data is believed. target: what else was estimated, as
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
    One target's reader and estimator, as plain functions.

    mounts: the calibration types it can be of; advice: what makes an answer more certain.
    read(path, config, how to read a bag): the input; raises InputError, DataError.
    solve(data, config): the answer; raises DataError.
    samples(data): for each sample its stamp, or the number of its row in a file, and its kind.
    subset(data, indices of samples (ascending)): these alone.
    residuals(data, X, indices fitted, indices measured, config): the distances (k,) in metres of
    the latter with a transform, the target fitted to the former.
    field(data): points (k, 3) in the sensor frame over which errors are reported; over: in words.
    profiles: whether the values are of profiles, in their plane.
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
