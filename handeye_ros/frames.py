# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Frames that sensor and target are fixed in, poses of one in the other, directions in words."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
import numpy as np


def mount_frame(config: Config) -> str:
    """Return the frame that the sensor is fixed in, in which its transform is given."""
    return config.robot_effector_frame if config.in_hand else config.base_frame


def target_frame(config: Config) -> str:
    """Return the frame that the target is fixed in."""
    return config.base_frame if config.in_hand else config.robot_effector_frame


def mount_poses_of(samples: Sequence[Sample], config: Config) -> Array:
    """
    Return the poses (n, 4, 4) of the mount of the sensor in the frame where the target is fixed.

    That is T_base_flange with eye_in_hand, and T_flange_base with eye_on_base.
    """
    return mount_poses(np.array([s.T_base_flange for s in samples]).reshape(-1, 4, 4), config)


def mount_poses(T_base_flange: Array, config: Config) -> Array:
    """
    Return the poses (..., 4, 4) as in mount_poses_of, from T_base_flange (..., 4, 4).

    It is its own inverse: of poses of the mount it returns T_base_flange.
    """
    return T_base_flange if config.in_hand else se3.inverse(T_base_flange)


def T_sensor_plane(config: Config) -> Array:
    """
    Return T_sensor_plane (4, 4): the frame with x along the laser line and z along the range.

    Identity for the usual profile.axes [x, z].
    """
    x, z = unit_vectors(config.profile.axes).T
    return se3.transform(np.column_stack([x, np.cross(z, x), z]), np.zeros(3))


def unit_vectors(names: Sequence[str]) -> Array:
    """Return the axes (3, n) of names like x and -z."""
    signs = [-1.0 if name[0] == '-' else 1.0 for name in names]
    return np.eye(3)[:, ['xyz'.index(name[-1]) for name in names]] * signs


def direction_in_words(direction: Array, frame: str) -> str:
    """Return a direction (3,) in words: the nearest axis if within 15 degrees, else numbers."""
    direction = se3.unit(direction)
    axis = int(np.argmax(np.abs(direction)))
    away = np.degrees(np.arccos(min(1.0, abs(direction[axis]))))
    if away < 15:
        return f'{frame} {"xyz"[axis]} within {max(1, round(away + 0.5))} degrees'
    return f'the direction ({", ".join(f"{c:.2f}" for c in direction)}) of {frame}'


def weakest_position(covariance: Array, frame: str) -> tuple[str, float]:
    """Return in words where a transform with a covariance (6, 6) is least certain, and 1 sigma."""
    std, direction = se3.weakest_direction(covariance)
    return f'position along {direction_in_words(direction, frame)}', std


def axes_across(direction: Array, frame: str) -> str:
    """Return in words the two axes of a frame with the largest angles to a direction (3,)."""
    names = [name for _, name in sorted(zip(np.abs(direction), 'xyz', strict=True))]
    return f'{frame} {" or ".join(sorted(names[:2]))}'


def frame_mismatch_warning(frame: str, sensor: str) -> str:
    """Return a warning if profiles are of another frame than a calibration's sensor, else ''."""
    if frame in ('', sensor):
        return ''
    return (f'the profiles are of the frame "{frame}", and the calibration is of "{sensor}": '
            'check that it is of this sensor')
