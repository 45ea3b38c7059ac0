# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A X = X B from any number of poses of a robot and of a target that a camera sees (CN105021139A).

The start is a closed form. Least squares over rotation and translation together follow: for each
view the pose of the target predicted by the robot's pose, X and the fixed target Z is compared
with the measured one.

How large the errors of each cause are is estimated too: variance components by restricted maximum
likelihood (Patterson and Thompson 1971, Biometrika 58:545), by the steps of Zhou et al. 2019 (J.
Computational and Graphical Statistics 28:350). A weak prior prevents zero variances from few
residuals.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from handeye_ros import se3
from handeye_ros.checks.refusals import require_rotations
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.estimation.least_squares import adjust, Adjusted, inverse_roots, Rows, System
from handeye_ros.frames import mount_frame, mount_poses
from handeye_ros.published.cn105021139a import solve_motions
from handeye_ros.results.calibration_file import input_values
from handeye_ros.tables import NOTATIONS, Table
from handeye_ros.tabulated.values import Indices, Misreading, PairedRows, TableAnswer
import numpy as np

PAIRS, SEED = 2000, 0  # of poses, drawn for the closed form
LARGEST_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)
MINIMUM = 5  # fewer do not show how large the noise is
SMALLEST_VARIANCE = 1e-18  # m^2 or rad^2: a smaller scatter is rounding
# of the causes, up to a factor, where nothing is known: 0.1 mm, 1 mrad and 0.3 mrad
TYPICAL_VARIANCES = 1e-8 * np.array([1e-8, 1e-6, 1e-7])
PRIOR_FREEDOM = 0.5  # degrees of freedom of the prior of each variance, about the typical one
LIKELIHOOD_STEPS = 100


@dataclass(frozen=True, eq=False)
class PosePairs(PairedRows):
    """
    Poses (n, 4, 4) at the same times.

    seen: T_camera_target; robot: of what carries the camera (the flange, or with eye_on_base the
    base) in what carries the target. State (2, 4, 4): X, the camera in its mount, and Z, the
    target in the frame where it is fixed.
    """

    name = 'hand_eye'
    calibration_types = ('eye_in_hand', 'eye_on_base')
    advice = 'take more poses, turned by 30 degrees or more about two axes'
    check = 'are both lists of the same moments, is no pose inverted, and which are the units?'
    over = 'the positions of the target in the file'
    prefixes = ('target', 'flange')

    def require_determined(self) -> None:
        """Raise DataError for few poses, and for poses that turn about one axis or none."""
        if len(self) < MINIMUM:
            raise TooFewError('A X = X B', MINIMUM, 'poses', len(self))
        require_rotations(self.robot, mount_frame(self.config), 'the position along it is free')

    def solve(self) -> TableAnswer:
        """Return the least squares, weighted by the noise that its residuals show."""
        fit, whiten = self.fit_with_variances(self.closed_form(), TYPICAL_VARIANCES)
        typical = TYPICAL_VARIANCES * fit.variance_factor
        for _ in range(2):
            fit, whiten = self.fit_with_variances(
                fit.state, self.likeliest_variances(fit.state, fit.used, typical))
        state, used = fit.state, fit.used
        off = _lengths(self.differences(state))
        left_out = _lengths(np.asarray(np.linalg.solve(whiten[used], fit.left_out[..., None])))
        (residual, angle), (holdout, holdout_angle) = (
            np.sqrt((lengths ** 2).mean(axis=0)).tolist() for lengths in (off[used], left_out))
        X, Z = state
        target = {'pose': se3.transform_values(Z), 'residual_angle': angle,
                  'left_out_angle': holdout_angle}
        return TableAnswer(X, self.stated(fit.covariance[:6, :6], used),
                           np.isin(np.arange(len(off)), used), off[:, 0], residual, holdout,
                           angle, target)

    def fit_with_variances(self, state: Array, variances: Array) -> tuple[Adjusted[Array], Array]:
        """
        Return the fit for variances (3,) of the causes, and what whitens the views (n, 6, 6).

        state: (2, 4, 4) to start from.
        """
        whiten = inverse_roots(np.tensordot(variances, self.causes(state), 1))

        def rows(state: Array) -> Rows:
            return Rows((whiten @ self.differences(state)[..., None]).ravel(),
                        lambda: (whiten @ self.derivatives(state)).reshape(-1, 12))

        system = System(rows, lambda state, step: se3.perturb(state, step.reshape(2, 6)),
                        np.repeat(np.arange(len(whiten)), 6))
        return adjust(system, state, MINIMUM), whiten

    def closed_form(self) -> Array:
        """
        Return the state (2, 4, 4) by pairs of poses, rotation first.

        Park and Martin 1994 (IEEE Trans. Robotics and Automation 10:717), least squares
        throughout. Raises SingularError, TooFewError.
        """
        T, seen = self.robot, self.seen
        i, j = np.random.default_rng(SEED).integers(len(T), size=(2, PAIRS))
        A, B = se3.inverse(T[j]) @ T[i], seen[j] @ se3.inverse(seen[i])
        sure = se3.angle(np.stack([A, B])[..., :3, :3]).max(axis=0) < LARGEST_ANGLE
        X = solve_motions(A[sure], B[sure])
        return np.stack([X, se3.mean_pose(T @ X @ seen)])

    def differences(self, state: Array) -> Array:
        """Return the (n, 6) differences of measured and predicted views in the camera frame."""
        return se3.difference(self.seen, se3.inverse(self.robot @ state[0]) @ state[1])

    def derivatives(self, state: Array) -> Array:
        """Return the derivatives (n, 6, 12) of the differences by X and Z."""
        (X, Z), T = state, self.robot
        to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
        target_in_mount = se3.apply(se3.inverse(T), Z[None, :3, 3])[:, 0]
        J, R = np.zeros((len(T), 6, 12)), X[:3, :3].T
        J[:, :3, :3], J[:, :3, 3:6] = R, -R @ se3.skew(target_in_mount - X[:3, 3])
        J[:, 3:, 3:6] = R
        J[:, :3, 6:9], J[:, 3:, 9:] = -to_camera, -to_camera
        return J

    def causes(self, state: Array) -> Array:
        """
        Return the covariances (3, n, 6, 6) of the differences for unit variances of each cause.

        Translation (of target and robot together, as their effects are the same), rotation of the
        target, rotation of the robot about its flange, which also shifts the target.
        """
        (X, Z), T = state, self.robot
        to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
        flange = T[:, :3, 3] if self.config.in_hand else 0.0
        turned = np.concatenate([-to_camera @ se3.skew(Z[:3, 3] - flange), to_camera], axis=1)
        own = np.broadcast_to(np.eye(6), (len(T), 6, 6))
        return np.array([own * ([1] * 3 + [0] * 3), own * ([0] * 3 + [1] * 3),
                         turned @ np.swapaxes(turned, 1, 2)])

    def likeliest_variances(self, state: Array, used: Indices, typical: Array) -> Array:
        """
        Return the most likely variances (3,) of the causes, from the views that are used.

        typical: (3,) about which they are expected, and from which they are sought.
        """
        r, J = self.differences(state)[used], self.derivatives(state)[used]
        parts, variances = self.causes(state)[:, used], typical
        for _ in range(LIKELIHOOD_STEPS):
            weight = np.linalg.inv(np.tensordot(variances, parts, 1))
            weighted = weight @ J
            C = np.linalg.inv(np.einsum('nia,nib->ab', J, weighted))
            # the weighted residuals of the least squares, and what of each part they show
            left = (weight @ r[..., None])[..., 0] - weighted @ (
                C @ np.einsum('nia,ni->a', weighted, r))
            shown = np.einsum('ni,cnij,nj->c', left, parts, left)
            expected = np.einsum('nij,cnji->c', weight, parts) - np.einsum(
                'nia,cnij,nja->c', weighted @ C, parts, weighted)
            variances = np.maximum(SMALLEST_VARIANCE, variances * np.sqrt(
                (shown * variances + PRIOR_FREEDOM * typical / variances)
                / (expected * variances + PRIOR_FREEDOM)))
        return variances

    def residuals(self, X: Array, fitted: Indices, measured: Indices) -> Array:
        Z = se3.mean_pose(self.robot[fitted] @ X @ self.seen[fitted])
        return _lengths(self.subset(measured).differences(np.stack([X, Z])))[:, 0]


def _lengths(differences: Array) -> Array:
    """Return the lengths (n, 2) of translation and rotation of differences (n, 6)."""
    return np.asarray(np.linalg.norm(differences.reshape(-1, 2, 3), axis=2))


def read(path: Path, config: Config) -> PosePairs:
    """
    Read the columns flange_x ... and target_x ... as in Table.poses, each with its unit.

    target.angles: how a controller writes the poses of the flange. Raises TableError.
    """
    def pairs_of(table: Table, config: Config) -> PosePairs:
        flange = table.poses('flange', config.target.angles)
        return PosePairs(config, table.poses('target'), mount_poses(flange, config),
                         frame=config.sensor_frame, inputs=[input_values(path)])

    table = Table(path)
    pairs = pairs_of(table, config)
    pairs.require_plausible()
    inverted = Misreading(
        'one of the two lists inverted', 'set calibration_type to the other one, or, if it is '
        'right, give the flange in the base and the target in the camera',
        replace(pairs, robot=se3.inverse(pairs.robot)))
    w_first = [Misreading(f'{" and ".join(prefixes)} quaternions as w x y z',
                          'name the columns in the order of their values',
                          pairs_of(table.renamed({
                              f'{prefix}_q{old}': f'{prefix}_q{new}' for prefix in prefixes
                              for old, new in zip('xyzw', 'wxyz', strict=True)}), config))
               for prefixes in (('flange',), ('target',), ('flange', 'target'))]
    return replace(pairs, misreadings=[*pairs.in_other_units(), inverted, *w_first,
                                       *_other_notations(table, config, pairs_of)])


def _other_notations(table: Table, config: Config,
                     pairs_of: Callable[[Table, Config], PosePairs]) -> Iterator[Misreading]:
    """Yield the angles of the flange as other controllers mean them, of the same columns first."""
    used = table.notation('flange', config.target.angles)
    columns = used.columns('flange')
    for name, notation in sorted(NOTATIONS.items(), key=lambda one: one[1].labels != used.labels):
        names = notation.columns('flange')
        if used.angle and notation.angle:
            yield Misreading(
                f'the flange written as {name}', f'set target.angles to {name}' + (
                    '' if names == columns else f' and name the columns {", ".join(names)}'),
                pairs_of(table.renamed(dict(zip(columns, names, strict=True))),
                         with_values(config, {'target.angles': name})))
