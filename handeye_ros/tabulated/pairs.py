# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Points or poses in two frames, row by row: of the sensor, and of the robot.

Points: the same ones in the frames of a sensor and of the robot's base. Poses: of a target in a
camera, and of the robot (A X = X B). A closed form is the start of the least squares of all
unknowns together, which compare what the sensor measured in each row with what that of the robot
predicts.

The variance of each cause of errors is estimated too, by restricted maximum likelihood (Patterson
and Thompson 1971, Biometrika 58:545) with the steps of Zhou et al. 2019 (J. Computational and
Graphical Statistics 28:350). A weak prior prevents zero variances from few residuals.
"""
from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

from handeye_ros import se3
from handeye_ros.checks.refusals import require_rotations
from handeye_ros.config import Config, with_values
from handeye_ros.csv_tables import CsvTable, require_different
from handeye_ros.data import Array, Indices, SEED
from handeye_ros.errors import DataError, require_count
from handeye_ros.estimation.least_squares import chi2_isf, Evaluation, inverse_roots, LeastSquares
from handeye_ros.estimation.outliers import robust_least_squares, RobustFit
from handeye_ros.frames import mount_frame, mount_poses
from handeye_ros.notations import NOTATIONS
from handeye_ros.published.park1994 import solve_motions
from handeye_ros.results.file_values import input_provenance
from handeye_ros.tabulated.problem import Misreading, TableAnswer, TableProblem
import numpy as np
from scipy.special import fdtri

MIN_REACH, MAX_REACH = 0.02, 50.0  # m: what a sensor or a robot reaches lies between them
REGION_PROBABILITY = 0.99  # probability of the region that a covariance from few rows is to hold
MIN_VARIANCE = 1e-18  # m^2 or rad^2: a smaller scatter is rounding
PRIOR_FREEDOM = 0.5  # degrees of freedom of the prior of each variance, about the typical one
LIKELIHOOD_STEPS = 100
MIN_WIDTH_RATIO = 0.05  # of points: smallest spread across their line over that along it
PAIR_COUNT = 2000  # of pairs of poses, drawn for the closed form
MAX_SURE_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)


@dataclass(frozen=True, eq=False)
class PairedRows(TableProblem):
    """
    Points (n, 3) or poses (n, 4, 4) as seen by the sensor and as reported by the robot (m).

    The unknowns of the least squares are transforms, a state (k, 4, 4): X, of the sensor in its
    mount, and of poses also that of the target where it is fixed.

    prefixes: of the columns of both lists
    fewest: rows; fewer do not show how large the noise is
    typical_variances: (c,) of the causes of errors, where nothing is known. Their ratios count;
        all are far smaller than any real noise, as no row within the stated one is dropped
    """

    seen: Array
    robot: Array

    prefixes: ClassVar[tuple[str, str]]
    fewest: ClassVar[int]
    typical_variances: ClassVar[Array]

    @classmethod
    @abstractmethod
    def from_table(cls, table: CsvTable, config: Config) -> Self:
        """Return the rows of a table, whose columns state their units; raises TableError."""

    @abstractmethod
    def in_other_notations(self, table: CsvTable) -> Iterator[Misreading]:
        """Yield the rows of the table as they would read in other notations."""

    @abstractmethod
    def closed_form(self) -> Array:
        """Return X (4, 4) to start from; raises SingularError, TooFewError."""

    @abstractmethod
    def state_of(self, X: Array) -> Array:
        """Return the state (k, 4, 4) that fits X (4, 4) best."""

    @abstractmethod
    def linearised(self, state: Array) -> tuple[Array, Array, Array]:
        """
        Return the differences of measured and predicted rows at a state (k, 4, 4), linearised.

        The differences (n, d), d = 3 or 6 (m, rad); their derivatives (n, d, 6 k) by perturbations
        of the transforms; their covariances (c, n, d, d) if each of the c causes of errors has
        variance 1.
        """

    @classmethod
    def read(cls, path: Path, config: Config) -> Self:
        """Return the rows of a table; raises TableError, DataError."""
        table = CsvTable(path)
        rows = replace(cls.from_table(table, config), frame=config.sensor_frame,
                       inputs=[input_provenance(path)])
        rows.require_plausible()
        return replace(rows, misreadings=[*rows.in_other_units(), *rows.in_other_notations(table)])

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.seen)

    @property
    def sample_ids(self) -> list[tuple[int, str]]:
        return [(row, '') for row in range(1, len(self) + 1)]

    def subset(self, rows: Indices) -> Self:
        """Return the problem of some rows (ascending indices)."""
        return replace(self, seen=self.seen[rows], robot=self.robot[rows])

    def error_points(self) -> Array:
        return _positions(self.seen)

    @property
    def reaches(self) -> list[float]:
        """Return the median distances (m) of both lists from the origins of their frames."""
        return [float(np.median(np.linalg.norm(_positions(values), axis=1)))
                for values in (self.seen, self.robot)]

    def require_plausible(self) -> None:
        """Raise DataError for repeated rows, and for positions that are of no cell."""
        rows = np.hstack([values.reshape(len(self), -1) for values in (self.seen, self.robot)])
        require_different(rows)
        if max(self.reaches) < MIN_REACH or min(self.reaches) > MAX_REACH:
            (seen, robot), (near, far) = self.prefixes, self.reaches
            raise DataError(
                f'the positions of the {seen} are typically {near:.3g} m from the origin, those '
                f'of the {robot} {far:.3g} m, as in no cell: correct the units in the header, of '
                f'{seen}_x, {seen}_y, {seen}_z and {robot}_x, {robot}_y, {robot}_z',
                code='convention')

    def in_other_units(self) -> Iterator[Misreading]:
        """Yield the values with one list in another unit, as far as they then are of a cell."""
        for factor, words in ((1e3, 'larger'), (1e-3, 'smaller')):
            for prefix, attribute in zip(self.prefixes, ('seen', 'robot'), strict=True):
                scaled = getattr(self, attribute).copy()
                _positions(scaled)[:] *= factor
                values = replace(self, **{attribute: scaled})
                if MIN_REACH < min(values.reaches) <= max(values.reaches) < MAX_REACH:
                    yield Misreading(
                        f'the positions of the {prefix} 1000 times {words}', 'correct the unit in '
                        f'the header of {prefix}_x, {prefix}_y, {prefix}_z', values)

    def estimate(self) -> TableAnswer:
        """Return the least squares, weighted by the noise that its residuals show."""
        variances = self.typical_variances
        fit, whiten = self.fit_with_variances(self.state_of(self.closed_form()), variances)
        typical = variances * fit.variance_factor
        for _ in range(2):
            variances = self.likeliest_variances(fit.state, fit.used, typical)
            fit, whiten = self.fit_with_variances(fit.state, variances)
        residuals = _lengths(self.linearised(fit.state)[0])
        left_out = _lengths(np.asarray(np.linalg.solve(
            whiten[fit.used], fit.left_out[..., None])[..., 0]))
        (residual_rms, angle_rms), (left_out_rms, left_out_angle_rms) = (
            np.sqrt((lengths ** 2).mean(axis=0)).tolist()
            for lengths in (residuals[fit.used], left_out))
        # The region that holds, by Fisher's F: the noise is from the residuals of the rows that
        # are used, three each of a kind, of which the transform takes six. The covariance is of
        # the normal distribution with the same region.
        region = 6 * fdtri(6, 3 * len(fit.used) - 6, REGION_PROBABILITY)
        target: dict[str, Any] = {'point_noise': float(variances[0]) ** 0.5}
        if len(fit.state) > 1:
            target = {'pose': se3.transform_values(fit.state[1]), 'residual_angle': angle_rms,
                      'left_out_angle': left_out_angle_rms}
        return TableAnswer(
            fit.state[0], fit.covariance[:6, :6] * region / chi2_isf(1 - REGION_PROBABILITY, 6),
            np.isin(np.arange(len(self)), fit.used), residuals[:, 0], residual_rms,
            left_out_rms, angle_rms, target)

    def fit_with_variances(self, start: Array, variances: Array) -> tuple[RobustFit[Array], Array]:
        """
        Return the fit for variances (c,) of the causes, and what whitens each row (n, d, d).

        start: state (k, 4, 4).
        """
        whiten = inverse_roots(np.tensordot(variances, self.linearised(start)[2], 1))

        def evaluate(state: Array) -> Evaluation:
            differences, derivatives, _ = self.linearised(state)
            return Evaluation((whiten @ differences[..., None]).ravel(),
                              lambda: (whiten @ derivatives).reshape(-1, 6 * len(state)))

        system = LeastSquares(evaluate, lambda T, step: se3.perturb(T, step.reshape(-1, 6)),
                              np.repeat(np.arange(len(self)), whiten.shape[1]))
        return robust_least_squares(system, start, self.fewest), whiten

    def likeliest_variances(self, state: Array, used: Indices, typical: Array) -> Array:
        """
        Return the most likely variances (c,) of the causes, from the rows that are used.

        typical: (c,) about which they are expected, and from which they are sought.
        """
        differences, J, covariances = self.subset(used).linearised(state)
        variances = typical
        for _ in range(LIKELIHOOD_STEPS):
            weight = np.linalg.inv(np.tensordot(variances, covariances, 1))
            weighted_J = weight @ J
            C = np.linalg.inv(np.einsum('nia,nib->ab', J, weighted_J))
            # the weighted residuals of the least squares; their squares by cause, as they are and
            # as they are expected
            residuals = (weight @ differences[..., None])[..., 0] - weighted_J @ (
                C @ np.einsum('nia,ni->a', weighted_J, differences))
            squares = np.einsum('ni,cnij,nj->c', residuals, covariances, residuals)
            expected = np.einsum('nij,cnji->c', weight, covariances) - np.einsum(
                'nia,cnij,nja->c', weighted_J @ C, covariances, weighted_J)
            variances = np.maximum(MIN_VARIANCE, variances * np.sqrt(
                (squares * variances + PRIOR_FREEDOM * typical / variances)
                / (expected * variances + PRIOR_FREEDOM)))
        return variances

    def residuals(self, X: Array, fitted: Indices, measured: Indices) -> Array:
        """
        Return the distances (m) of the rows `measured` for X (4, 4).

        What else is unknown is fitted to the rows `fitted`.
        """
        state = self.subset(fitted).state_of(X)
        return _lengths(self.subset(measured).linearised(state)[0])[:, 0]


def _positions(values: Array) -> Array:
    """Return the positions (n, 3) of points or poses, a view of them."""
    return values if values.ndim == 2 else values[:, :3, 3]


def _lengths(differences: Array) -> Array:
    """Return the lengths (n, 2) of translation and rotation of differences (n, 3) or (n, 6)."""
    padded = np.pad(differences, ((0, 0), (0, 6 - differences.shape[1])))
    return np.asarray(np.linalg.norm(padded.reshape(-1, 2, 3), axis=2))


@dataclass(frozen=True, eq=False)
class PointPairs(PairedRows):
    """The same points (n, 3) in the frame of the sensor and the robot's base, as in Wu 2017."""

    name = 'points'
    calibration_types = ('eye_on_base',)
    advice = 'take more points, spread over a larger volume'
    to_check = 'do both lists hold the same points in the same order, and which are their units?'
    error_points_text = 'the points of the file'
    prefixes = ('camera', 'base')
    fewest = 4
    typical_variances = np.array([1e-18])

    @classmethod
    def from_table(cls, table: CsvTable, config: Config) -> Self:
        return cls(config, *map(table.points, cls.prefixes))

    def in_other_notations(self, table: CsvTable) -> Iterator[Misreading]:
        yield Misreading('one of the two lists mirrored', 'use right-handed frames: check the '
                         'signs and the order of the axes of both lists',
                         replace(self, seen=-self.seen))

    def require_usable(self) -> None:
        """Raise DataError for few points, and for points that are (nearly) collinear."""
        require_count('the transform between two sets of points', self.fewest, 'points',
                      len(self))
        along, across = np.linalg.svd(self.robot - self.robot.mean(axis=0), compute_uv=False)[:2]
        if across < MIN_WIDTH_RATIO * along:
            raise DataError('the points lie in one line, so a turn about it is free; put some of '
                            'them well outside it')

    def closed_form(self) -> Array:
        return se3.align_points(self.seen, self.robot)

    def state_of(self, X: Array) -> Array:
        return X[None]

    def linearised(self, state: Array) -> tuple[Array, Array, Array]:
        turned = self.seen @ state[0, :3, :3].T
        return (turned + state[0, :3, 3] - self.robot, se3.perturbation_jacobian(turned),
                np.broadcast_to(np.eye(3), (1, len(self), 3, 3)))


@dataclass(frozen=True, eq=False)
class PosePairs(PairedRows):
    """
    Poses (n, 4, 4) at the same times, as in CN105021139A.

    seen: T_camera_target; robot: of what carries the camera (the flange, or with eye_on_base the
    base) in what carries the target. State (2, 4, 4): X, of the camera in its mount, and Z, of the
    target in the frame where it is fixed.
    """

    name = 'hand_eye'
    calibration_types = ('eye_in_hand', 'eye_on_base')
    advice = 'take more poses, turned by 30 degrees or more about two axes'
    to_check = 'are both lists of the same moments, is no pose inverted, and which are the units?'
    error_points_text = 'the positions of the target in the file'
    prefixes = ('target', 'flange')
    fewest = 5
    typical_variances = 1e-8 * np.array([1e-8, 1e-6, 1e-7])  # as 0.1 mm, 1 mrad and 0.3 mrad

    @classmethod
    def from_table(cls, table: CsvTable, config: Config) -> Self:
        flange = table.poses('flange', config.target.angles)
        return cls(config, table.poses('target'), mount_poses(flange, config))

    def in_other_notations(self, table: CsvTable) -> Iterator[Misreading]:
        yield Misreading('one of the two lists inverted', 'set calibration_type to the other one, '
                         'or, if it is right, give the flange in the base and the target in the '
                         'camera', replace(self, robot=se3.inverse(self.robot)))
        for prefixes in (('flange',), ('target',), ('flange', 'target')):
            new_names = {f'{prefix}_q{old}': f'{prefix}_q{new}' for prefix in prefixes
                         for old, new in zip('xyzw', 'wxyz', strict=True)}
            yield Misreading(f'{" and ".join(prefixes)} quaternions as w x y z',
                             'name the columns in the order of their values',
                             self.from_table(table.renamed(new_names), self.config))
        # angles of the flange as other controllers mean them, of the same columns first
        notation = table.notation('flange', self.config.target.angles)
        columns = notation.columns('flange')
        others = {name: other.columns('flange') for name, other in NOTATIONS.items()
                  if notation.angle_unit and other.angle_unit}
        for name, names in sorted(others.items(), key=lambda item: item[1] != columns):
            yield Misreading(
                f'the flange written as {name}', f'set target.angles to {name}' + (
                    '' if names == columns else f' and name the columns {", ".join(names)}'),
                self.from_table(table.renamed(dict(zip(columns, names, strict=True))),
                                with_values(self.config, {'target.angles': name})))

    def require_usable(self) -> None:
        """Raise DataError for few poses, and for poses that turn about one axis or none."""
        require_count('A X = X B', self.fewest, 'poses', len(self))
        require_rotations(self.robot, mount_frame(self.config), 'the position along it is free')

    def closed_form(self) -> Array:
        """Return X (4, 4) by the closed form of Park and Martin 1994, of pairs of poses."""
        T, seen = self.robot, self.seen
        i, j = np.random.default_rng(SEED).integers(len(T), size=(2, PAIR_COUNT))
        A, B = se3.inverse(T[j]) @ T[i], seen[j] @ se3.inverse(seen[i])
        has_axis = se3.angle(np.stack([A, B])[..., :3, :3]).max(axis=0) < MAX_SURE_ANGLE
        return solve_motions(A[has_axis], B[has_axis])

    def state_of(self, X: Array) -> Array:
        return np.stack([X, se3.mean_pose(self.robot @ X @ self.seen)])

    def linearised(self, state: Array) -> tuple[Array, Array, Array]:
        """
        Return the differences of the target's poses in the camera; see PairedRows.

        Causes of errors: translation (of target and robot together, as their effects are the
        same), rotation of the target, rotation of the robot about its flange, which also shifts
        the target.
        """
        (X, Z), T, n = state, self.robot, len(self)
        to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
        target_in_mount = se3.apply(se3.inverse(T), Z[None, :3, 3])[:, 0]
        J, R = np.zeros((n, 6, 12)), X[:3, :3].T
        J[:, :3, :3], J[:, :3, 3:6] = R, -R @ se3.skew(target_in_mount - X[:3, 3])
        J[:, 3:, 3:6] = R
        J[:, :3, 6:9], J[:, 3:, 9:] = -to_camera, -to_camera
        flange = T[:, :3, 3] if self.config.in_hand else 0.0
        turned = np.concatenate([-to_camera @ se3.skew(Z[:3, 3] - flange), to_camera], axis=1)
        covariances = np.array([
            np.broadcast_to(np.diag([1.0] * 3 + [0.0] * 3), (n, 6, 6)),
            np.broadcast_to(np.diag([0.0] * 3 + [1.0] * 3), (n, 6, 6)),
            turned @ np.swapaxes(turned, 1, 2)])
        return se3.difference(self.seen, se3.inverse(T @ X) @ Z), J, covariances
