"""What people get wrong in a pose stream; each changes translations (n, 3), quaternions (n, 4)."""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np
from scipy.spatial.transform import Rotation

PoseMap = Callable[[Array, Array], tuple[Array, Array]]


def _inverted(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    T = se3.inverse(se3.from_quaternion(translation, quaternion))
    return T[:, :3, 3], se3.quaternion(T)


def _wxyz(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    return translation, np.roll(quaternion, 1, axis=1)


def _millimetres(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    return translation * 1e3, quaternion


def _euler(quaternion: Array, read_as: str, factor: float) -> Array:
    angles = Rotation.from_quat(quaternion).as_euler('xyz') * factor
    return np.asarray(Rotation.from_euler(read_as, angles).as_quat())


def _degrees(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    return translation, _euler(quaternion, 'xyz', 180 / np.pi)


def _intrinsic(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    return translation, _euler(quaternion, 'XYZ', 1.0)


CONVENTION_ERRORS: dict[str, PoseMap] = {
    'inverted': _inverted,  # base in flange for flange in base
    'wxyz': _wxyz,  # quaternions sent as w x y z
    'millimetres': _millimetres,  # positions in mm
    'degrees': _degrees,  # roll, pitch, yaw in degrees taken for radians
    'intrinsic': _intrinsic,  # fixed-axes roll, pitch, yaw taken for moving-axes angles
}
