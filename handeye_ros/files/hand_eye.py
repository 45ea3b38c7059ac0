"""A X = X B, from a file of poses: a camera that sees the whole pose of a target."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.export import input_values, transform_values
from handeye_ros.files.method import Answer, FileMethod, Index, Input, ReadBag
from handeye_ros.identify import mount_frame
from handeye_ros.methods import hand_eye
import numpy as np


@dataclass(frozen=True, eq=False)
class Views:
    """
    Poses (n, 4, 4) of the same moments.

    T_fixed_mount: of what carries the camera (the flange, or with eye_on_base the base) in what
    carries the target; T_camera_target: as seen.
    """

    T_fixed_mount: Array
    T_camera_target: Array


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Views]:
    T_base_flange, T_camera_target = hand_eye.read(path)
    in_hand = config.calibration_type == 'eye_in_hand'
    views = Views(T_base_flange if in_hand else se3.inverse(T_base_flange), T_camera_target)
    return Input(views, config.sensor_frame, (input_values(path),))


def _solve(data: Views, config: Config) -> Answer[Views]:
    found = hand_eye.solve(data.T_fixed_mount, data.T_camera_target, frame=mount_frame(config))
    X, Z = found.T_flange_camera, found.T_base_target
    shifts = hand_eye.residuals(data.T_fixed_mount, data.T_camera_target, (X, Z))[:, :3]
    used = np.isin(np.arange(len(shifts)), found.used)
    target = {'pose': transform_values(Z), 'residual_angle': found.rms[1],
              'left_out_angle': found.holdout_rms[1]}
    return Answer(X, found.covariance, used, np.linalg.norm(shifts, axis=1), found.rms[0],
                  found.holdout_rms[0], _subset(data, found.used), target)


def _samples(data: Views) -> list[tuple[int, str]]:
    return [(row, '') for row in range(1, len(data.T_fixed_mount) + 1)]


def _subset(data: Views, keep: Index) -> Views:
    return Views(data.T_fixed_mount[keep], data.T_camera_target[keep])


def _residuals(data: Views, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    T, seen = data.T_fixed_mount, data.T_camera_target
    Z = se3.mean_pose(T[fitted] @ X @ seen[fitted])
    off = hand_eye.residuals(T[measured], seen[measured], (X, Z))[:, :3]
    return np.asarray(np.linalg.norm(off, axis=1))


HAND_EYE = FileMethod(
    'hand_eye', ('eye_in_hand', 'eye_on_base'),
    'take more poses, turned by 30 degrees or more about two axes',
    _read, _solve, _samples, _subset, _residuals, lambda data: data.T_camera_target[:, :3, 3],
    'the places of the target in the file')
