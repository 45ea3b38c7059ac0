"""
How uncertain a point in the base is: calibration, sensor, robot and its poses together.

A point s = (x, 0, z) of the sensor lies at R_fs s + t_fs of the flange. The variance of its
position is a polynomial of second degree in x and z, the same at every pose of the robot.
"""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.config import NoiseConfig
from handeye_ros.data import Array, Calibration
import numpy as np


def variance_polynomial(calibration: Calibration, noise: NoiseConfig) -> Array:
    """
    Return the matrix V (3, 3) with variance [x z 1] V [x z 1]'.

    The variance is the mean squared length of the position's error (m^2), that is the trace of
    its covariance: of the calibration (6x6), of the range, and of single poses.
    """
    lever = _lever(calibration.T_flange_sensor)
    C = calibration.covariance
    V = _turned(lever, C[3:, 3:])
    # E|dt + dr x l|^2 = tr(C_tt) + 2 l . E[dt x dr] + l' (tr(C_rr) I - C_rr) l
    twist = np.array([C[1, 5] - C[2, 4], C[2, 3] - C[0, 5], C[0, 4] - C[1, 3]])
    V[2] += twist @ lever
    V[:, 2] += twist @ lever
    V[2, 2] += np.trace(C[:3, :3]) + noise.sensor ** 2
    robot = np.array([[noise.robot_translation, noise.robot_rotation]])
    return np.asarray(V + pose_variances(calibration.T_flange_sensor, robot)[0])


def pose_variances(T_flange_sensor: Array, std: Array) -> Array:
    """Return the same (n, 3, 3) of poses with 1 sigma std (n, 2) of each axis (m, rad)."""
    place = _lever(T_flange_sensor)
    place[:, 2] += T_flange_sensor[:3, 3]
    V = std[:, 1, None, None] ** 2 * _turned(place, np.eye(3))
    V[:, 2, 2] += 3 * std[:, 0] ** 2
    return np.asarray(V)


def _lever(T: Array) -> Array:
    """Return R s by (x, z, 1)."""
    return np.column_stack([T[:3, 0], T[:3, 2], np.zeros(3)])


def _turned(lever: Array, C: Array) -> Array:
    return np.asarray(lever.T @ (np.trace(C) * np.eye(3) - C) @ lever)


def point_std(V: Array, points: Array) -> Array:
    """Return 1 sigma (n,) of points (n, 2) of the sensor plane, as the length of a vector."""
    x, z = points.T
    square = (V[0, 0] * x + 2 * (V[0, 1] * z + V[0, 2])) * x + (
        V[1, 1] * z + 2 * V[1, 2]) * z + V[2, 2]
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def sensor_in_base(T_base_flange: Array, T_flange_sensor: Array, eye_on_base: bool) -> Array:
    """Return the sensor's poses (k, 4, 4) in the base, or in the flange that moves before it."""
    T = se3.inverse(T_base_flange) if eye_on_base else T_base_flange
    return np.asarray(T @ T_flange_sensor)
