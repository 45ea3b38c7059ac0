"""A X = X B from a file of poses: a camera that measures the full pose of a target."""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from handeye_ros import orientations, se3
from handeye_ros.checks.errors import ConventionError
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import DataError, InputError, mm, TooFewError
from handeye_ros.frames import mount_frame
from handeye_ros.results.calibration_file import input_values, transform_values
from handeye_ros.tabulated import hand_eye_estimate
from handeye_ros.tabulated.method import Answer, FileMethod, Index, Input, ReadBag
import numpy as np
from scipy.spatial.transform import Rotation

CLEAR = 0.2  # of the misfit is left when a convention error is undone


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
        T_base_flange, T_camera_target = hand_eye_estimate.read(path, angles)
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
           ) -> hand_eye_estimate.HandEyeResult:
    on_base = config.calibration_type == 'eye_on_base'
    T_base_flange = se3.inverse(T_fixed_mount) if on_base else T_fixed_mount
    return hand_eye_estimate.solve(T_base_flange, T_camera_target, eye_on_base=on_base,
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
    shifts = hand_eye_estimate.residuals(data.T_fixed_mount, data.T_camera_target, (X, Z))[:, :3]
    used = np.isin(np.arange(len(shifts)), found.used)
    target = {'pose': transform_values(Z), 'residual_angle': found.rms[1],
              'left_out_angle': found.holdout_rms[1]}
    return Answer(X, found.covariance, used, np.linalg.norm(shifts, axis=1), found.rms[0],
                  found.holdout_rms[0], _subset(data, found.used), target)


def _name_convention_error(data: Views, config: Config) -> None:
    """Raise ConventionError if exactly one misreading explains the contradiction of the poses."""
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
        raise ConventionError(f'the poses do not fit, but with {name} the residual falls from '
                              f'{mm(before)} to {mm(after)}: {advice}')


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
    state = hand_eye_estimate.closed_form(T, T_camera_target)
    off = hand_eye_estimate.residuals(T, T_camera_target, state)[:, :3]
    return float(np.sqrt((off ** 2).sum(axis=1).mean()))


def _samples(data: Views) -> list[tuple[int, str]]:
    return [(row, '') for row in range(1, len(data.T_fixed_mount) + 1)]


def _subset(data: Views, keep: Index) -> Views:
    return Views(data.T_fixed_mount[keep], data.T_camera_target[keep])


def _residuals(data: Views, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    T, seen = data.T_fixed_mount, data.T_camera_target
    Z = se3.mean_pose(T[fitted] @ X @ seen[fitted])
    off = hand_eye_estimate.residuals(T[measured], seen[measured], (X, Z))[:, :3]
    return np.asarray(np.linalg.norm(off, axis=1))


HAND_EYE = FileMethod(
    'hand_eye', ('eye_in_hand', 'eye_on_base'),
    'take more poses, turned by 30 degrees or more about two axes',
    _read, _solve, _samples, _subset, _residuals, lambda data: data.T_camera_target[:, :3, 3],
    'the positions of the target in the file')
