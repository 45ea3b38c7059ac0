# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in two frames from a file: the sensor is beside the robot (Wu 2017)."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.estimation.least_squares import adjust, BELIEVED_SHARE, Rows, System
from handeye_ros.results.calibration_file import input_values
from handeye_ros.tables import Table
from handeye_ros.tabulated.method import (
    FileMethod,
    Index,
    Input,
    Misreading,
    rms,
    TableAnswer,
    Values,
)
import numpy as np
from scipy.spatial.transform import Rotation

MINIMUM = 4
SMALLEST_ANGLE = 0.05  # smallest spread across over spread along (rad)
SIGMA = 1e-9  # m; the noise is estimated, from this on


@dataclass(frozen=True, eq=False)
class Pairs(Values):
    """The same points (n, 3) in the frame of the sensor and in the robot's base; metres."""

    in_camera: Array
    in_base: Array

    @property
    def samples(self) -> list[tuple[int, str]]:
        return [(row, '') for row in range(1, len(self.in_base) + 1)]

    def subset(self, samples: Index) -> Pairs:
        return Pairs(self.in_camera[samples], self.in_base[samples])

    def require_determined(self, config: Config) -> None:
        """Raise for few points, and for points that are (nearly) collinear."""
        if len(self.in_base) < MINIMUM:
            raise TooFewError('the transform between two sets of points', MINIMUM, 'points',
                              len(self.in_base))
        along, across = np.linalg.svd(self.in_base - self.in_base.mean(axis=0),
                                      compute_uv=False)[:2]
        if across < SMALLEST_ANGLE * along:
            raise DataError('the points lie in one line, so a turn about it is free; put some of '
                            'them well outside it')

    def solve(self, config: Config) -> TableAnswer:
        """Return the least squares of the differences, without outliers."""
        def rows(T: Array) -> Rows:
            turned = self.in_camera @ T[:3, :3].T
            by_shift = np.tile(np.eye(3), (len(turned), 1, 1))
            J = np.concatenate([by_shift, -se3.skew(turned)], axis=2)
            return Rows((turned + T[:3, 3] - self.in_base).ravel() / SIGMA,
                        lambda: J.reshape(-1, 6) / SIGMA)

        every = np.arange(len(self.in_base))
        # the best start leaves out one point: in a few points a wrong one bends that of all
        start = min((self.subset(np.delete(every, k)).rigid() for k in every),
                    key=lambda T: np.quantile(self.residuals(T, every, every), BELIEVED_SHARE))
        fit = adjust(System(rows, se3.perturb, np.repeat(every, 3)), start, MINIMUM)
        off = SIGMA * np.linalg.norm(fit.residuals, axis=1)
        left_out = SIGMA * np.linalg.norm(fit.left_out, axis=1)
        return TableAnswer(fit.state, fit.covariance, np.isin(every, fit.used), off,
                      rms(off[fit.used]), rms(left_out), self.subset(fit.used),
                      target={'point_noise': SIGMA * max(fit.variance_factor, 1.0) ** 0.5})

    def rigid(self) -> Array:
        """Return the transform (4, 4) with the least squares of all points."""
        camera, base = self.in_camera.mean(axis=0), self.in_base.mean(axis=0)
        R = Rotation.align_vectors(self.in_base - base, self.in_camera - camera)[0].as_matrix()
        return se3.transform(R, base - R @ camera)

    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        off = se3.apply(X, self.in_camera[measured]) - self.in_base[measured]
        return np.asarray(np.linalg.norm(off, axis=1))

    def field(self) -> Array:
        return self.in_camera

    def spread(self) -> float:
        return float(min(np.std(points, axis=0).max() for points in (self.in_camera,
                                                                     self.in_base)))

    def misreadings(self) -> Iterator[Misreading]:
        remedy = ('correct the unit in the header of camera_x, camera_y, camera_z, or of base_x, '
                  'base_y, base_z')
        yield Misreading('the points of the camera 1000 times smaller', remedy,
                         Pairs(1e-3 * self.in_camera, self.in_base))
        yield Misreading('the points of the base 1000 times smaller', remedy,
                         Pairs(self.in_camera, 1e-3 * self.in_base))


def _read(path: Path, config: Config) -> Input:
    """Read the columns camera_x ... and base_x ..., each with its unit; raises TableError."""
    table = Table(path)
    return Input(Pairs(table.points('camera'), table.points('base')), config.sensor_frame,
                 (input_values(path),))


POINTS = FileMethod(
    'points', ('eye_on_base',), 'take more points, spread over a larger volume',
    'do both lists hold the same points in the same order, and which are their units?',
    'the points of the file', _read)
