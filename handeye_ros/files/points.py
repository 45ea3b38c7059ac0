"""Points in two frames, from a file: the sensor stands beside the robot (Wu 2017)."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.files import points_estimate
from handeye_ros.files.method import Answer, FileMethod, Index, Input, ReadBag
from handeye_ros.results.calibration_file import input_values
import numpy as np


@dataclass(frozen=True, eq=False)
class Pairs:
    """The same points (n, 3) as the sensor sees them and in the robot's base; metres."""

    in_camera: Array
    in_base: Array


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Pairs]:
    return Input(Pairs(*points_estimate.read(path)), config.sensor_frame, (input_values(path),))


def _solve(data: Pairs, config: Config) -> Answer[Pairs]:
    found = points_estimate.solve(data.in_camera, data.in_base)
    used = np.isin(np.arange(len(data.in_base)), found.used)
    return Answer(found.T_base_camera, found.covariance, used, found.residuals, found.rms,
                  found.holdout_rms, _subset(data, found.used), {'point_noise': found.noise})


def _samples(data: Pairs) -> list[tuple[int, str]]:
    return [(row, '') for row in range(1, len(data.in_base) + 1)]


def _subset(data: Pairs, keep: Index) -> Pairs:
    return Pairs(data.in_camera[keep], data.in_base[keep])


def _residuals(data: Pairs, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    off = se3.apply(X, data.in_camera[measured]) - data.in_base[measured]
    return np.asarray(np.linalg.norm(off, axis=1))


POINTS = FileMethod(
    'points', ('eye_on_base',), 'take more points, spread over a larger volume',
    _read, _solve, _samples, _subset, _residuals, lambda data: data.in_camera,
    'the points of the file')
