# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in two frames from a file: the sensor is beside the robot (Wu 2017)."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, rms
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.estimation.least_squares import adjust, Rows, System
from handeye_ros.results.calibration_file import input_values
from handeye_ros.tables import Table
from handeye_ros.tabulated.values import Indices, Misreading, PairedRows, TableAnswer
import numpy as np
from scipy.spatial.transform import Rotation

MINIMUM = 4
SMALLEST_ANGLE = 0.05  # smallest spread across over spread along (rad)
SMALLEST_SIGMA = 1e-9  # m; the noise is estimated, from this on


@dataclass(frozen=True, eq=False)
class PointPairs(PairedRows):
    """The same points (n, 3) in the frame of the sensor and in the robot's base; metres."""

    name = 'points'
    calibration_types = ('eye_on_base',)
    advice = 'take more points, spread over a larger volume'
    check = 'do both lists hold the same points in the same order, and which are their units?'
    over = 'the points of the file'
    prefixes = ('camera', 'base')

    def require_determined(self) -> None:
        """Raise DataError for few points, and for points that are (nearly) collinear."""
        if len(self) < MINIMUM:
            raise TooFewError('the transform between two sets of points', MINIMUM, 'points',
                              len(self))
        along, across = np.linalg.svd(self.robot - self.robot.mean(axis=0), compute_uv=False)[:2]
        if across < SMALLEST_ANGLE * along:
            raise DataError('the points lie in one line, so a turn about it is free; put some of '
                            'them well outside it')

    def solve(self) -> TableAnswer:
        """Return the least squares of the differences, without outliers."""
        def rows(T: Array) -> Rows:
            turned = self.seen @ T[:3, :3].T
            return Rows((turned + T[:3, 3] - self.robot).ravel() / SMALLEST_SIGMA,
                        lambda: se3.wrt_perturbation(turned).reshape(-1, 6) / SMALLEST_SIGMA)

        every = np.arange(len(self))
        fit = adjust(System(rows, se3.perturb, np.repeat(every, 3)), self.rigid(), MINIMUM)
        off, left_out = (SMALLEST_SIGMA * np.linalg.norm(values, axis=1)
                         for values in (fit.residuals, fit.left_out))
        return TableAnswer(fit.state, self.stated(fit.covariance, fit.used),
                           np.isin(every, fit.used), off, rms(off[fit.used]), rms(left_out),
                           target={'point_noise':
                                   SMALLEST_SIGMA * max(fit.variance_factor, 1.0) ** 0.5})

    def rigid(self) -> Array:
        """Return the transform (4, 4) with the least squares of all points."""
        seen, robot = self.seen.mean(axis=0), self.robot.mean(axis=0)
        R = Rotation.align_vectors(self.robot - robot, self.seen - seen)[0].as_matrix()
        return se3.transform(R, robot - R @ seen)

    def residuals(self, X: Array, fitted: Indices, measured: Indices) -> Array:
        off = se3.apply(X, self.seen[measured]) - self.robot[measured]
        return np.asarray(np.linalg.norm(off, axis=1))


def read(path: Path, config: Config) -> PointPairs:
    """Read the columns camera_x ... and base_x ..., each with its unit; raises TableError."""
    table = Table(path)
    pairs = PointPairs(config, table.points('camera'), table.points('base'),
                       frame=config.sensor_frame, inputs=[input_values(path)])
    pairs.require_plausible()
    mirrored = Misreading('one of the two lists mirrored', 'use right-handed frames: check the '
                          'signs and the order of the axes of both lists',
                          replace(pairs, seen=-pairs.seen))
    return replace(pairs, misreadings=[*pairs.in_other_units(), mirrored])
