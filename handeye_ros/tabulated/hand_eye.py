# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A X = X B from any number of poses of a robot and of a target that a camera sees (CN105021139A).

The start is a closed form: rotation from the rotation axes of all pairs of poses, then a linear
translation. Least squares over rotation and translation together follow: for each view the pose
predicted by T_base_flange, X and the fixed target Z is compared with the measured one.

T (n, 4, 4) is the mount of the camera in the frame where the target is fixed: T_base_flange, or
with eye_on_base its inverse. A state is X and Z.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from handeye_ros import orientations, se3
from handeye_ros.checks.refusals import require_rotations
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import DataError, InputError, mm, TooFewError
from handeye_ros.estimation.least_squares import (
    adjust,
    Adjusted,
    first_variances,
    Rows,
    System,
    variance_components,
    White,
)
from handeye_ros.frames import mount_frame
from handeye_ros.results.calibration_file import input_values, transform_values
from handeye_ros.tables import Table
from handeye_ros.tabulated.method import Answer, FileMethod, Index, Input, ReadBag
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NAME = 'A X = X B'
MOST_PAIRS = 2000
LARGEST_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)
LARGEST_DROPPED_SHARE = 0.34
LARGEST_RMS = (1e-2, 0.05)  # largest of a trusted answer (m, rad)
ROUNDS = 2  # of estimating the noise
LOST = 'the position along it is free'
MINIMUM = 3
SMALLEST_NOISE = 1e-9  # m or rad: a smaller scatter is rounding

State: TypeAlias = tuple[Array, Array]
CLEAR = 0.2  # of the misfit is left when a convention error is undone


@dataclass(frozen=True)
class PoseNoise:
    """
    1 sigma per axis: of the target's pose in the camera frame, and of the robot's pose.

    If estimated, target_translation includes the robot's: their effects are the same.
    """

    target_translation: float
    target_rotation: float
    robot_translation: float = 0.0
    robot_rotation: float = 0.0


def residuals(T: Array, T_camera_target: Array, state: State) -> Array:
    """Return the (n, 6) differences of measured and predicted views in the camera frame."""
    X, Z = state
    predicted = se3.inverse(T @ X) @ Z
    turned = T_camera_target[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2)
    return np.concatenate([T_camera_target[:, :3, 3] - predicted[:, :3, 3],
                           se3.log_rotation(turned)], axis=1)


def derivatives(T: Array, state: State, eye_on_base: bool = False) -> tuple[Array, Array]:
    """
    Return the derivatives of the residuals by X and Z (n, 6, 12), and by the poses (n, 6, 6).

    A pose error is a shift and a rotation about the flange, along the axes of T's parent.
    """
    X, Z = state
    to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
    in_mount = se3.apply(se3.inverse(T), Z[None, :3, 3])[:, 0]
    J, G = np.zeros((len(T), 6, 12)), np.zeros((len(T), 6, 6))
    R_t = X[:3, :3].T
    J[:, :3, :3], J[:, :3, 3:6] = R_t, -R_t @ se3.skew(in_mount - X[:3, 3])
    J[:, 3:, 3:6] = R_t
    J[:, :3, 6:9], J[:, 3:, 9:] = -to_camera, -to_camera
    G[:, :3, :3], G[:, 3:, 3:] = to_camera, to_camera
    flange = 0.0 if eye_on_base else T[:, :3, 3]
    G[:, :3, 3:] = -to_camera @ se3.skew(Z[:3, 3] - flange)
    return J, G


def factors(T: Array, state: State, noise: PoseNoise, eye_on_base: bool) -> Array:
    """Return the roots (n, 6, 6), by Cholesky, of the covariances of the residuals."""
    _, G = derivatives(T, state, eye_on_base)
    G = G * np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    own = np.repeat([noise.target_translation, noise.target_rotation], 3)
    return np.linalg.cholesky(G @ np.swapaxes(G, 1, 2) + np.diag(own ** 2))


def system(T: Array, T_camera_target: Array, noise: PoseNoise, eye_on_base: bool
           ) -> System[State]:
    """Return the least-squares system of X and Z; each pose is a block."""
    n = len(T)

    def rows(state: State) -> Rows:
        def white() -> White:
            inverse = np.linalg.inv(factors(T, state, noise, eye_on_base))
            return lambda values: (inverse @ values.reshape(n, 6, -1)).reshape(values.shape)
        return Rows(residuals(T, T_camera_target, state).ravel(),
                    lambda: derivatives(T, state)[0].reshape(6 * n, 12), white)

    def retract(state: State, step: Array) -> State:
        return se3.perturb(state[0], step[:6]), se3.perturb(state[1], step[6:])
    return System(rows, retract, np.repeat(np.arange(n), 6))


def causes(T: Array, state: State, eye_on_base: bool) -> Array:
    """
    Return the covariances (3, n, 6, 6) of the residuals for unit variances of each cause.

    Causes: translation (of target and robot together, as their effects are the same), rotation of
    the target, rotation of the robot (which also shifts the target).
    """
    own = np.broadcast_to(np.eye(6), (len(T), 6, 6))
    by_turn = derivatives(T, state, eye_on_base)[1][:, :, 3:]
    return np.array([own * ([1] * 3 + [0] * 3), own * ([0] * 3 + [1] * 3),
                     by_turn @ np.swapaxes(by_turn, 1, 2)])


def noise_of(variances: Array) -> PoseNoise:
    """Return the noise with the variances (3,) of the causes."""
    shift, turn, robot_turn = np.maximum(np.sqrt(variances), SMALLEST_NOISE).tolist()
    return PoseNoise(shift, turn, robot_rotation=robot_turn)


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """
    The result.

    T_flange_camera, T_base_target: (4, 4), with eye_on_base T_base_camera and T_flange_target;
    covariance: (6, 6) of the first, x y z rx ry rz in its parent; used: indices of the used poses;
    noise: given or estimated; rms: RMS (translation (m), rotation (rad)) of the used views;
    holdout_rms: the same, each view predicted without itself.
    """

    T_flange_camera: Array
    T_base_target: Array
    covariance: Array
    used: NDArray[np.intp]
    noise: PoseNoise
    rms: tuple[float, float]
    holdout_rms: tuple[float, float]


def read_table(path: Path, angles: str = '') -> tuple[Array, Array]:
    """
    Return T_base_flange and T_camera_target (n, 4, 4) of a file.

    Columns flange_x ... and target_x ... as in Table.poses, each with its unit; angles: how a
    controller writes the poses of the flange. Raises TableError.
    """
    table = Table(path)
    return table.poses('flange', angles), table.poses('target')


def solve(T_base_flange: Array, T_camera_target: Array, noise: PoseNoise | None = None,
          eye_on_base: bool = False, frame: str = '') -> HandEyeResult:
    """
    Return the hand-eye transform.

    T_base_flange, T_camera_target: (n, 4, 4), pairwise at the same times; noise: estimated if not
    given; eye_on_base: the camera is fixed to the base, the target to the flange; frame: name of
    the frame that the camera is fixed in, for messages.
    Raises DataError.
    """
    T = se3.inverse(T_base_flange) if eye_on_base else T_base_flange
    if len(T) < MINIMUM:
        raise TooFewError(NAME, MINIMUM, 'poses', len(T))
    frame = frame or ('base' if eye_on_base else 'flange')
    require_rotations(T, frame, LOST)
    start = closed_form(T, T_camera_target)
    fit, noise = _with_noise(T, T_camera_target, start, noise, eye_on_base)
    X, Z = fit.state
    L = factors(T, fit.state, noise, eye_on_base)[fit.used]
    rms = _rms(L, fit.residuals[fit.used])
    _require_agreement(len(T) - len(fit.used), len(T), rms)
    require_rotations(T[fit.used], frame, LOST)
    return HandEyeResult(X, Z, fit.covariance[:6, :6], fit.used, noise, rms,
                         _rms(L, fit.left_out))


def _require_agreement(dropped: int, total: int, rms: tuple[float, float]) -> None:
    if dropped > LARGEST_DROPPED_SHARE * total or rms[0] > LARGEST_RMS[0] or (
            rms[1] > LARGEST_RMS[1]):
        raise DataError(
            f'{NAME} cannot be solved: {dropped} of {total} poses contradict the others, which '
            f'agree to {rms[0] * 1e3:.3g} mm and {np.degrees(rms[1]):.3g} degrees RMS; check '
            'that both lists are of the same moments, that no pose is inverted, and the units')


def _rms(factors: Array, white: Array) -> tuple[float, float]:
    """Return the RMS length of translations and rotations of whitened residuals (n, 6)."""
    plain = np.einsum('nij,nj->ni', factors, white)
    squares = (plain ** 2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    return float(squares[0] ** 0.5), float(squares[1] ** 0.5)


def closed_form(T: Array, T_camera_target: Array) -> State:
    """
    Return X and Z from all pairs of poses (n, 4, 4), rotation first.

    Park and Martin 1994 (IEEE Trans. Robotics and Automation 10:717), least squares throughout.
    """
    i, j = np.triu_indices(len(T), 1)
    some = np.linspace(0, len(i) - 1, min(len(i), MOST_PAIRS)).astype(int)
    A = se3.inverse(T[j[some]]) @ T[i[some]]
    B = T_camera_target[j[some]] @ se3.inverse(T_camera_target[i[some]])
    a, b = se3.log_rotation(A[:, :3, :3]), se3.log_rotation(B[:, :3, :3])
    sure = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)) < LARGEST_ANGLE
    R = se3.nearest_rotation(a[sure].T @ b[sure])
    M = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    t = np.linalg.lstsq(M, (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel(), rcond=None)[0]
    X = se3.transform(R, t)
    return X, se3.mean_pose(T @ X @ T_camera_target)


def _with_noise(T: Array, T_camera_target: Array, start: State, noise: PoseNoise | None,
                eye_on_base: bool) -> tuple[Adjusted[State], PoseNoise]:
    """Return the least-squares state, and the given noise or the noise of its residuals."""
    def adjusted(state: State, noise: PoseNoise) -> Adjusted[State]:
        return adjust(system(T, T_camera_target, noise, eye_on_base), state, MINIMUM)

    if noise is not None:
        return adjusted(start, noise), noise
    r, parts = residuals(T, T_camera_target, start), causes(T, start, eye_on_base)
    fit = adjusted(start, noise_of(first_variances(r, parts)))
    for _ in range(ROUNDS):
        r = residuals(T, T_camera_target, fit.state)[fit.used]
        J = derivatives(T, fit.state)[0][fit.used]
        parts = causes(T, fit.state, eye_on_base)[:, fit.used]
        noise = noise_of(variance_components(r, J, parts, first_variances(r, parts)))
        fit = adjusted(fit.state, noise)
    assert noise
    return fit, noise


@dataclass(frozen=True, eq=False)
class Views:
    """
    Poses (n, 4, 4) at the same times.

    T_fixed_mount: of what carries the camera (the flange, or with eye_on_base the base) in what
    carries the target; T_camera_target: as seen. otherwise: T_fixed_mount as it would be in the
    other notations of controllers, by their names.
    """

    T_fixed_mount: Array
    T_camera_target: Array
    otherwise: Mapping[str, Array] = field(default_factory=dict)


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Views]:
    def read(angles: str) -> tuple[Array, Array]:
        T_base_flange, T_camera_target = read_table(path, angles)
        in_hand = config.calibration_type == 'eye_in_hand'
        return T_base_flange if in_hand else se3.inverse(T_base_flange), T_camera_target
    stated, otherwise = config.target.angles, {}
    views = read(stated)
    for angles in orientations.NOTATIONS if stated else ():
        if orientations.NOTATIONS[angles] is not orientations.of(stated):
            try:
                otherwise[angles] = read(angles)[0]
            except InputError:  # other columns
                continue
    return Input(Views(*views, otherwise), config.sensor_frame, (input_values(path),))


def _found(T_fixed_mount: Array, T_camera_target: Array, config: Config
           ) -> HandEyeResult:
    on_base = config.calibration_type == 'eye_on_base'
    T_base_flange = se3.inverse(T_fixed_mount) if on_base else T_fixed_mount
    return solve(T_base_flange, T_camera_target, eye_on_base=on_base,
                                   frame=mount_frame(config))


def _solve(data: Views, config: Config) -> Answer[Views]:
    try:
        found = _found(data.T_fixed_mount, data.T_camera_target, config)
    except TooFewError:
        raise
    except DataError:
        _name_convention_error(data, config)
        raise
    X, Z = found.T_flange_camera, found.T_base_target
    shifts = residuals(data.T_fixed_mount, data.T_camera_target, (X, Z))[:, :3]
    used = np.isin(np.arange(len(shifts)), found.used)
    target = {'pose': transform_values(Z), 'residual_angle': found.rms[1],
              'left_out_angle': found.holdout_rms[1]}
    return Answer(X, found.covariance, used, np.linalg.norm(shifts, axis=1), found.rms[0],
                  found.holdout_rms[0], _subset(data, found.used), target)


def _name_convention_error(data: Views, config: Config) -> None:
    """Raise DataError if exactly one misreading explains the contradiction of the poses."""
    before, found = _misfit(data.T_fixed_mount, data.T_camera_target), []
    for name, advice, T, seen in _misreadings(data):
        try:
            after = _found(T, seen, config).rms[0]
        except DataError:
            continue
        # lengths in another unit make every residual smaller: it must be small beside the motion
        moved = min(np.std(poses[:, :3, 3], axis=0).max() for poses in (T, seen))
        if after < CLEAR * min(before, moved):
            found.append((name, after, advice))
    if len(found) == 1:
        name, after, advice = found[0]
        raise DataError(f'the poses do not fit, but with {name} the residual falls from '
                        f'{mm(before)} to {mm(after)}: {advice}', reason='convention')


def _misreadings(data: Views) -> Iterator[tuple[str, str, Array, Array]]:
    """Yield in words a possible misreading and its remedy, and both poses as they would be."""
    T, seen = data.T_fixed_mount, data.T_camera_target
    yield ('one of the two lists inverted', 'set calibration_type to the other one, or, if it is '
           'right, give the flange in the base and the target in the camera', se3.inverse(T), seen)
    order = 'name the columns in the order of their values'
    yield 'flange quaternions as w x y z', order, _wxyz(T), seen
    yield 'target quaternions as w x y z', order, T, _wxyz(seen)
    for unit, factor in (('mm', 1e-3), ('m', 1e3)):
        remedy = 'write their unit in the header, as in'
        yield (f'positions of the flange in {unit}', f'{remedy} flange_x [{unit}]',
               _scaled(T, factor), seen)
        yield (f'positions of the target in {unit}', f'{remedy} target_x [{unit}]',
               T, _scaled(seen, factor))
    for name, other in data.otherwise.items():
        yield f'the flange written as {name}', f'set target.angles to {name}', other, seen
        yield (f'the flange written as {name}, in mm', f'set target.angles to {name}, and write '
               'the unit in the header, as in flange_x [mm]', _scaled(other, 1e-3), seen)


def _scaled(T: Array, factor: float) -> Array:
    return se3.transform(T[:, :3, :3], T[:, :3, 3] * factor)


def _wxyz(T: Array) -> Array:
    """Return the poses (n, 4, 4) with their quaternions read in the other order."""
    q = np.roll(se3.quaternion(T), -1, axis=1)
    return se3.transform(Rotation.from_quat(q).as_matrix(), T[:, :3, 3])


def _misfit(T: Array, T_camera_target: Array) -> float:
    state = closed_form(T, T_camera_target)
    off = residuals(T, T_camera_target, state)[:, :3]
    return float(np.sqrt((off ** 2).sum(axis=1).mean()))


def _samples(data: Views) -> list[tuple[int, str]]:
    return [(row, '') for row in range(1, len(data.T_fixed_mount) + 1)]


def _subset(data: Views, keep: Index) -> Views:
    return Views(data.T_fixed_mount[keep], data.T_camera_target[keep])


def _residuals(data: Views, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    T, seen = data.T_fixed_mount, data.T_camera_target
    Z = se3.mean_pose(T[fitted] @ X @ seen[fitted])
    off = residuals(T[measured], seen[measured], (X, Z))[:, :3]
    return np.asarray(np.linalg.norm(off, axis=1))


HAND_EYE = FileMethod(
    'hand_eye', ('eye_in_hand', 'eye_on_base'),
    'take more poses, turned by 30 degrees or more about two axes',
    _read, _solve, _samples, _subset, _residuals, lambda data: data.T_camera_target[:, :3, 3],
    'the positions of the target in the file')
