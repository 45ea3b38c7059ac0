"""How far an answer is from another that is known to be true; metres and radians."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np

STEPS = 13  # points along each side of the field of view


@dataclass(frozen=True)
class Errors:
    """
    The difference between two transforms.

    translation: metres; rotation: radians; mapped_points: RMS over the field of view, metres.
    """

    translation: float
    rotation: float
    mapped_points: float


def errors_against(T_est: Array, T_true: Array) -> Errors:
    """Return the errors of T_flange_sensor (4, 4) against the true one."""
    delta = se3.difference(T_est, T_true)
    return Errors(float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:])),
                  mapped_point_error(T_est, T_true))


def mapped_point_error(T_est: Array, T_true: Array, x: tuple[float, float] = (-0.02, 0.02),
                       z: tuple[float, float] = (0.16, 0.19)) -> float:
    """
    Return the RMS of |(T_est - T_true) p| over a field of view (metres).

    T_est, T_true: (4, 4); p: a grid in the sensor plane, along the line within x and in range
    within z. What a user of the transform meets; the translation alone is dominated by the
    lever arm of the rotation.

    """
    along, across = np.meshgrid(np.linspace(*x, STEPS), np.linspace(*z, STEPS))
    points = np.column_stack([along.ravel(), np.zeros(along.size), across.ravel()])
    difference = se3.apply(T_est, points) - se3.apply(T_true, points)
    return float(np.sqrt((difference ** 2).sum(axis=1).mean()))
