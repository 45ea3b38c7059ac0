# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A X = X B from any number of poses of a robot and of a target that a camera sees (CN105021139A).

The start is a closed form. Least squares over rotation and translation together follow: for each
view the pose of the target predicted by the robot's pose, X and the fixed target Z is compared
with the measured one.

How large the errors of each cause are is estimated too: variance components by restricted maximum
likelihood (Patterson and Thompson 1971, Biometrika 58:545). A weak prior prevents zero variances
from few residuals.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from handeye_ros import orientations, se3
from handeye_ros.checks.refusals import require_rotations
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.estimation.least_squares import (
    adjust,
    Adjusted,
    chi2_isf,
    inverse_roots,
    Rows,
    System,
)
from handeye_ros.frames import mount_frame, mount_poses
from handeye_ros.published.cn105021139a import solve_motions
from handeye_ros.tables import Table
from handeye_ros.tabulated.values import Index, Input, Lists, Misreading, TableAnswer
import numpy as np

PAIRS, SEED = 2000, 0  # of poses, drawn for the closed form
LARGEST_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)
MINIMUM = 5  # fewer do not show how large the noise is
SMALLEST_VARIANCE = 1e-18  # m^2 or rad^2: a smaller scatter is rounding


@dataclass(frozen=True, eq=False)
class Views(Lists):
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
        if len(self) < MINIMUM:
            raise TooFewError('A X = X B', MINIMUM, 'poses', len(self))
        require_rotations(self.robot, mount_frame(self.config), 'the position along it is free')

    def solve(self) -> TableAnswer:
        """Return the least squares, weighted by the noise that its residuals show."""
        state = self.closed_form()
        fit, whiten = self.fit_with_variances(state, _first_variances(self.differences(state),
                                                                      self.causes(state)))
        for _ in range(2):
            fit, whiten = self.fit_with_variances(fit.state, self.variances(fit.state, fit.used))
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
        """Return the fit for variances (3,) of the causes, and what whitens the views."""
        whiten = inverse_roots(np.tensordot(np.maximum(variances, SMALLEST_VARIANCE),
                                            self.causes(state), 1))

        def rows(state: Array) -> Rows:
            return Rows((whiten @ self.differences(state)[..., None]).ravel(),
                        lambda: (whiten @ self.derivatives(state)).reshape(-1, 12))

        system = System(rows, lambda state, step: se3.perturb(state, step.reshape(2, 6)),
                        np.repeat(np.arange(len(whiten)), 6))
        return adjust(system, state, MINIMUM), whiten

    def closed_form(self) -> Array:
        """
        Return the state by pairs of poses, rotation first.

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

    def variances(self, state: Array, used: Index) -> Array:
        """Return the most likely variances (3,) of the causes, from the views that are used."""
        residuals, jacobian = self.differences(state)[used], self.derivatives(state)[used]
        parts = self.causes(state)[:, used]
        start = _first_variances(residuals, parts)

        def unlikely(logarithms: Array) -> float:
            """Return twice the negative logarithm of the restricted likelihood, and the prior."""
            variances = np.exp(logarithms)
            whiten = inverse_roots(np.tensordot(variances, parts, 1))
            Q, R = np.linalg.qr((whiten @ jacobian).reshape(-1, 12))
            whitened = (whiten @ residuals[..., None]).ravel()
            off = whitened - Q @ (Q.T @ whitened)
            determinants = (np.log(np.abs(np.diag(R))).sum()
                            - np.log(np.einsum('nii->ni', whiten)).sum())
            # the prior counts for half a degree of freedom, about the start
            return float(off @ off + 2 * determinants
                         + 0.5 * (logarithms + start / variances).sum())

        from scipy.optimize import minimize  # 0.1 s, only for this target
        found = minimize(unlikely, np.log(start), method='Nelder-Mead',
                         options={'xatol': 1e-2, 'fatol': 1e-3})
        return np.asarray(np.exp(found.x))

    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        Z = se3.mean_pose(self.robot[fitted] @ X @ self.seen[fitted])
        return _lengths(self.subset(measured).differences(np.stack([X, Z])))[:, 0]


def _lengths(differences: Array) -> Array:
    """Return the lengths (n, 2) of translation and rotation of differences (n, 6)."""
    return np.asarray(np.linalg.norm(differences.reshape(-1, 2, 3), axis=2))


def _first_variances(residuals: Array, parts: Array) -> Array:
    """Return half of the variance (c,) that each cause alone would need; some may be wrong."""
    seen = np.median(_lengths(residuals), axis=0) ** 2 / chi2_isf(0.5, 3)
    made = np.einsum('cnii->cni', parts).reshape(len(parts), -1, 2, 3).mean(axis=(1, 3))
    alone = np.divide(seen, made, out=np.full(made.shape, np.inf), where=made > 0)
    return np.asarray(np.maximum(alone.min(axis=1) / 2, 1e-24))


def read(path: Path, config: Config) -> Input:
    """
    Read the columns flange_x ... and target_x ... as in Table.poses, each with its unit.

    target.angles: how a controller writes the poses of the flange. Raises TableError.
    """
    table, stated = Table(path), config.target.angles
    flange, target = table.poses('flange', stated), table.poses('target')

    def views(flange: Array, target: Array = target) -> Views:
        return Views(config, target, mount_poses(flange, config))

    def otherwise() -> Iterator[Misreading]:
        yield Misreading(
            'one of the two lists inverted', 'set calibration_type to the other one, or, if it is '
            'right, give the flange in the base and the target in the camera',
            views(se3.inverse(flange)))
        yield from views(flange).in_other_units()
        order = 'name the columns in the order of their values'
        w_last = bool(stated)  # as abb-quaternion, they were read as w x y z
        yield Misreading(f'flange quaternions as {"x y z w" if w_last else "w x y z"}', order,
                         views(_reordered(flange, w_last)))
        yield Misreading('target quaternions as w x y z', order, views(flange, _reordered(target)))
        yield Misreading('the quaternions of both as w x y z', order,
                         views(_reordered(flange), _reordered(target)))
        for name, remedy, poses in _other_notations(table, stated, flange):
            yield Misreading(f'the flange written as {name}', remedy, views(poses))

    return views(flange).read_from(path, otherwise)


def _other_notations(table: Table, stated: str, read: Array) -> Iterator[tuple[str, str, Array]]:
    """
    Yield notations, the remedy, and the poses (n, 4, 4) of the flange that these give.

    stated: how they were read; read: as that gives them.
    """
    used = orientations.notation_of(stated) if stated else orientations.RPY
    columns, known = used.columns('flange'), [read]
    if not (used.angle and table.has(columns)):
        return
    for name, notation in sorted(orientations.NOTATIONS.items(),
                                 key=lambda item: item[1].labels != used.labels):
        if notation.angle:
            names = notation.columns('flange')
            poses = table.renamed(dict(zip(columns, names, strict=True))).poses('flange', name)
            if not any(np.allclose(poses, one, rtol=0, atol=1e-9) for one in known):
                known.append(poses)
                remedy = f'set target.angles to {name}'
                if names != columns:
                    remedy += f' and name the columns {", ".join(names)}'
                yield name, remedy, poses


def _reordered(T: Array, w_last: bool = False) -> Array:
    """Return the poses (n, 4, 4) with their quaternions read as w x y z, or as x y z w."""
    shift = 1 if w_last else -1
    return se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), shift, axis=1))
