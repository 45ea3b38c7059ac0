"""How far an answer is from another that is known to be true; metres and radians."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np

STEPS = 13  # points along each side of the field of view
FIELD = 'x within +-20 mm, range 160-190 mm'


@dataclass(frozen=True)
class Errors:
    """
    The difference between two transforms.

    translation: metres; rotation: radians; mapped_points: RMS over the field of view, metres.
    """

    translation: float
    rotation: float
    mapped_points: float


def errors_against(T_est: Array, T_true: Array, field: Array | None = None) -> Errors:
    """
    Return the errors of T_flange_sensor (4, 4) against the true one.

    field: points (k, 3) in the sensor frame that are mapped, field_points when not given.
    """
    delta = se3.difference(T_est, T_true)
    return Errors(float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:])),
                  _mapped(T_est, T_true, field_points() if field is None else field))


def mapped_point_error(T_est: Array, T_true: Array, x: tuple[float, float] = (-0.02, 0.02),
                       z: tuple[float, float] = (0.16, 0.19)) -> float:
    """
    Return the RMS of |(T_est - T_true) p| over a field of view (metres).

    T_est, T_true: (4, 4); p: a grid in the sensor plane, along the line within x and in range
    within z. What a user of the transform meets; the translation alone is dominated by the
    lever arm of the rotation.

    """
    return _mapped(T_est, T_true, field_points(x, z))


def field_points(x: tuple[float, float] = (-0.02, 0.02), z: tuple[float, float] = (0.16, 0.19)
                 ) -> Array:
    """Return a grid (k, 3) in the sensor plane, see mapped_point_error."""
    along, across = np.meshgrid(np.linspace(*x, STEPS), np.linspace(*z, STEPS))
    return np.column_stack([along.ravel(), np.zeros(along.size), across.ravel()])


def _mapped(T_est: Array, T_true: Array, points: Array) -> float:
    difference = se3.apply(T_est, points) - se3.apply(T_true, points)
    return float(np.sqrt((difference ** 2).sum(axis=1).mean()))
