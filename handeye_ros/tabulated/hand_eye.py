# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A X = X B from any number of poses of a robot and of a target that a camera sees (CN105021139A).

The start is a closed form. Least squares over rotation and translation together follow: for each
view the pose of the target predicted by the robot's pose, X and the fixed target Z is compared
with the measured one. How large the errors of each cause are is estimated too.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from handeye_ros import orientations, se3
from handeye_ros.checks.refusals import require_rotations
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import InputError, TooFewError
from handeye_ros.estimation.least_squares import (
    adjust,
    Adjusted,
    first_variances,
    inverse_roots,
    Rows,
    System,
    variance_components,
)
from handeye_ros.frames import in_mount, mount_frame
from handeye_ros.published.cn105021139a import solve_motions
from handeye_ros.results.calibration_file import input_values, transform_values
from handeye_ros.tables import Table
from handeye_ros.tabulated.method import FileMethod, Index, Input, Misreading, TableAnswer, Values
import numpy as np

MOST_PAIRS = 2000
LARGEST_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)
MINIMUM = 3
SMALLEST_VARIANCE = 1e-18  # m^2 or rad^2: a smaller scatter is rounding

State: TypeAlias = tuple[Array, Array]
"""X: the camera in its mount; Z: the target in the frame where it is fixed, (4, 4)."""


@dataclass(frozen=True, eq=False)
class Views(Values):
    """
    Poses (n, 4, 4) at the same times.

    T: of what carries the camera (the flange, or with eye_on_base the base) in what carries the
    target; T_camera_target: as seen; otherwise: T as it would be in the other notations of
    controllers, by their names.
    """

    T: Array
    T_camera_target: Array
    otherwise: Mapping[str, Array] = field(default_factory=dict)

    @property
    def samples(self) -> list[tuple[int, str]]:
        return [(row, '') for row in range(1, len(self.T) + 1)]

    def subset(self, samples: Index) -> Views:
        return Views(self.T[samples], self.T_camera_target[samples])

    def require_determined(self, config: Config) -> None:
        if len(self.T) < MINIMUM:
            raise TooFewError('A X = X B', MINIMUM, 'poses', len(self.T))
        require_rotations(self.T, mount_frame(config), 'the position along it is free')

    def solve(self, config: Config) -> TableAnswer:
        """Return the least squares, weighted by the noise that its residuals show."""
        on_base = config.calibration_type == 'eye_on_base'
        state = self.closed_form()
        r, parts = self.differences(state), self.causes(state, on_base)
        fit, whiten = self.adjusted(state, first_variances(r, parts), on_base)
        for _ in range(2):
            r, J = self.differences(fit.state)[fit.used], self.derivatives(fit.state)[fit.used]
            parts = self.causes(fit.state, on_base)[:, fit.used]
            variances = variance_components(r, J, parts, first_variances(r, parts))
            fit, whiten = self.adjusted(fit.state, variances, on_base)
        off = _lengths(self.differences(fit.state))
        plain = np.linalg.solve(whiten[fit.used], fit.left_out[..., None])
        left_out = _lengths(np.asarray(plain))
        (rms, angle), (holdout, holdout_angle) = (
            np.sqrt((lengths ** 2).mean(axis=0)).tolist() for lengths in (off[fit.used], left_out))
        X, Z = fit.state
        target = {'pose': transform_values(Z), 'residual_angle': angle,
                  'left_out_angle': holdout_angle}
        return TableAnswer(X, fit.covariance[:6, :6], np.isin(np.arange(len(off)), fit.used),
                      off[:, 0], rms, holdout, self.subset(fit.used), angle, target)

    def adjusted(self, state: State, variances: Array, on_base: bool
                 ) -> tuple[Adjusted[State], Array]:
        """Return the fit for variances (3,) of the causes, and what whitens the views."""
        whiten = inverse_roots(np.tensordot(np.maximum(variances, SMALLEST_VARIANCE),
                                            self.causes(state, on_base), 1))

        def rows(state: State) -> Rows:
            return Rows((whiten @ self.differences(state)[..., None]).ravel(),
                        lambda: (whiten @ self.derivatives(state)).reshape(-1, 12))

        def retract(state: State, step: Array) -> State:
            return se3.perturb(state[0], step[:6]), se3.perturb(state[1], step[6:])

        system = System(rows, retract, np.repeat(np.arange(len(whiten)), 6))
        return adjust(system, state, MINIMUM), whiten

    def closed_form(self) -> State:
        """
        Return the state by all pairs of poses, rotation first.

        Park and Martin 1994 (IEEE Trans. Robotics and Automation 10:717), least squares
        throughout. Raises SingularError, TooFewError.
        """
        T, seen = self.T, self.T_camera_target
        i, j = np.triu_indices(len(T), 1)
        some = np.linspace(0, len(i) - 1, min(len(i), MOST_PAIRS)).astype(int)
        i, j = i[some], j[some]
        A, B = se3.inverse(T[j]) @ T[i], seen[j] @ se3.inverse(seen[i])
        turns = [se3.angle(moves[:, :3, :3]) for moves in (A, B)]
        sure = np.maximum(*turns) < LARGEST_ANGLE
        X = np.asarray(solve_motions(A[sure], B[sure]))
        return X, se3.mean_pose(T @ X @ seen)

    def differences(self, state: State) -> Array:
        """Return the (n, 6) differences of measured and predicted views in the camera frame."""
        predicted = se3.inverse(self.T @ state[0]) @ state[1]
        seen = self.T_camera_target
        turned = seen[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2)
        return np.concatenate([seen[:, :3, 3] - predicted[:, :3, 3], se3.log_rotation(turned)],
                              axis=1)

    def derivatives(self, state: State) -> Array:
        """Return the derivatives (n, 6, 12) of the differences by X and Z."""
        (X, Z), T = state, self.T
        to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
        target_in_mount = se3.apply(se3.inverse(T), Z[None, :3, 3])[:, 0]
        J, R = np.zeros((len(T), 6, 12)), X[:3, :3].T
        J[:, :3, :3], J[:, :3, 3:6] = R, -R @ se3.skew(target_in_mount - X[:3, 3])
        J[:, 3:, 3:6] = R
        J[:, :3, 6:9], J[:, 3:, 9:] = -to_camera, -to_camera
        return J

    def causes(self, state: State, on_base: bool) -> Array:
        """
        Return the covariances (3, n, 6, 6) of the differences for unit variances of each cause.

        Translation (of target and robot together, as their effects are the same), rotation of the
        target, rotation of the robot about its flange, which also shifts the target.
        """
        (X, Z), T = state, self.T
        to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
        flange = 0.0 if on_base else T[:, :3, 3]
        turned = np.concatenate([-to_camera @ se3.skew(Z[:3, 3] - flange), to_camera], axis=1)
        own = np.broadcast_to(np.eye(6), (len(T), 6, 6))
        return np.array([own * ([1] * 3 + [0] * 3), own * ([0] * 3 + [1] * 3),
                         turned @ np.swapaxes(turned, 1, 2)])

    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        Z = se3.mean_pose(self.T[fitted] @ X @ self.T_camera_target[fitted])
        return _lengths(self.subset(measured).differences((X, Z)))[:, 0]

    def field(self) -> Array:
        return self.T_camera_target[:, :3, 3]

    def spread(self) -> float:
        return float(min(np.std(poses[:, :3, 3], axis=0).max()
                         for poses in (self.T, self.T_camera_target)))

    def misreadings(self) -> Iterator[Misreading]:
        yield Misreading(
            'one of the two lists inverted', 'set calibration_type to the other one, or, if it is '
            'right, give the flange in the base and the target in the camera',
            replace(self, T=se3.inverse(self.T)))
        in_header = 'write their unit in the header, as in'
        for name, key in (('flange', 'T'), ('target', 'T_camera_target')):
            poses = getattr(self, key)
            for words, remedy, otherwise in (
                    (f'{name} quaternions as w x y z', 'name the columns in the order of their '
                     'values', _wxyz(poses)),
                    (f'positions of the {name} in mm', f'{in_header} {name}_x [mm]',
                     _scaled(poses, 1e-3)),
                    (f'positions of the {name} in m', f'{in_header} {name}_x [m]',
                     _scaled(poses, 1e3))):
                changed: dict[str, Any] = {key: otherwise}
                yield Misreading(words, remedy, replace(self, **changed))
        for name, other in self.otherwise.items():
            words, remedy = f'the flange written as {name}', f'set target.angles to {name}'
            yield Misreading(words, remedy, replace(self, T=other))
            yield Misreading(f'{words}, in mm', f'{remedy}, and write the unit in the header, as '
                             'in flange_x [mm]', replace(self, T=_scaled(other, 1e-3)))


def _lengths(differences: Array) -> Array:
    """Return the lengths (n, 2) of translation and rotation of differences (n, 6)."""
    return np.asarray(np.linalg.norm(differences.reshape(-1, 2, 3), axis=2))


def _scaled(T: Array, factor: float) -> Array:
    return se3.transform(T[:, :3, :3], T[:, :3, 3] * factor)


def _wxyz(T: Array) -> Array:
    """Return the poses (n, 4, 4) with their quaternions read in the other order."""
    return se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), -1, axis=1))


def _read(path: Path, config: Config) -> Input:
    """
    Read the columns flange_x ... and target_x ... as in Table.poses, each with its unit.

    target.angles: how a controller writes the poses of the flange. Raises TableError.
    """
    table, stated = Table(path), config.target.angles
    otherwise = {}
    for angles, notation in orientations.NOTATIONS.items() if stated else ():
        if notation is not orientations.of(stated):
            with suppress(InputError):  # it has other columns
                otherwise[angles] = in_mount(table.poses('flange', angles), config)
    flange = in_mount(table.poses('flange', stated), config)
    return Input(Views(flange, table.poses('target'), otherwise), config.sensor_frame,
                 (input_values(path),))


HAND_EYE = FileMethod(
    'hand_eye', ('eye_in_hand', 'eye_on_base'),
    'take more poses, turned by 30 degrees or more about two axes',
    'are both lists of the same moments, is no pose inverted, and which are the units?',
    'the positions of the target in the file', _read)
