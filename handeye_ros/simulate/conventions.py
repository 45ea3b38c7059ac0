"""How drivers and robots state what they measure: frames, settings, errors of convention."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate.scenario import Scenario, SphereTarget
from handeye_ros.simulate.stations import lift
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Frame:
    """
    A published frame.

    T_standard_sensor: (4, 4) pose of the published frame in the standard one (x along the laser
    line, z the range, y = 0). axes: of the published frame, along the line and range.
    range_sign: -1 where the published range falls with the distance.
    """

    T_standard_sensor: Array
    axes: tuple[str, str] = ('x', 'z')
    range_sign: int = 1


def _rotation(*columns: tuple[float, float, float], x: float = 0.0, z: float = 0.0) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(columns).T, [x, 0.0, z]
    return T


FRAMES = {
    'standard': Frame(np.eye(4)),
    'z_up': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), z=0.2), range_sign=-1),
    # zero in the middle of the range, which is counted upwards, and at the left of a wide field
    'off_centre': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), x=-0.07, z=0.275),
                        range_sign=-1),
    'x_reversed': Frame(_rotation((-1, 0, 0), (0, -1, 0), (0, 0, 1))),
    'y_along_line': Frame(_rotation((0, -1, 0), (1, 0, 0), (0, 0, 1)), axes=('y', 'z')),
}


def published(frame: Frame, points: Array) -> Array:
    """Return points (..., 2) of the standard sensor plane along the axes of the published one."""
    R, t = frame.T_standard_sensor[:3, :3], frame.T_standard_sensor[:3, 3]
    in_frame = (lift(points) - t) @ R
    return np.asarray(in_frame[..., ['xyz'.index(axis) for axis in frame.axes]])


def settings(scenario: Scenario) -> dict[str, Any]:
    """Return the configuration, by dotted key, that reads the recordings of a scenario."""
    frame, target = FRAMES[scenario.layout.frame], scenario.target
    values: dict[str, Any] = {
        'calibration_type': scenario.calibration_type, 'target.type': scenario.scene,
        'profile.axes': list(frame.axes), 'profile.range_sign': frame.range_sign,
        'noise.sensor': scenario.sensor.noise,
        'noise.robot_translation': scenario.robot.repeatability[0],
        'noise.robot_rotation': scenario.robot.repeatability[1]}
    if isinstance(target, SphereTarget):
        values['target.radius'] = target.radius
    return values | dict(scenario.stated)


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
