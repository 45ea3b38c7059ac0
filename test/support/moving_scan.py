# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A flange that moves evenly over a plane, and what a profiler on it sees."""
from __future__ import annotations

from calibrations import calibration_at
from handeye_ros import se3
from handeye_ros.data import Profile, TimedPose
import numpy as np
from scipy.spatial.transform import Rotation

T0, STEP = 1_700_000_000_000_000_000, 1_000_000


def calibration(covariance=None):
    X = se3.transform(Rotation.from_euler('xyz', [0.3, -0.2, 1.1]).as_matrix(),
                      np.array([0.05, -0.02, 0.11]))
    return calibration_at(X, covariance=np.zeros((6, 6)) if covariance is None else covariance)


def pose_at(ms):
    return TimedPose(T0 + ms * STEP, np.array([0.6, 1e-4 * ms, 0.4]),
                     Rotation.from_euler('x', 1e-4 * ms).as_quat())


def moving(count, rate=5):
    """Return poses of a flange that moves evenly, every rate ms, around count ms."""
    return [pose_at(k * rate) for k in range(count // rate + 2)]


def true_flange(ms):
    return se3.transform(Rotation.from_euler('x', 1e-4 * ms).as_matrix(),
                         np.array([0.6, 1e-4 * ms, 0.4]))


def plane_profile(ms, columns=50):
    """Return the profile of the plane z = 0.1 of the base, half a ms after ms."""
    T = true_flange(ms + 0.5) @ calibration().T_flange_sensor
    x = np.linspace(-0.02, 0.02, columns)
    z = (0.1 - T[2, 3] - T[2, 0] * x) / T[2, 2]
    return Profile(T0 + ms * STEP + STEP // 2, 'laser', np.column_stack([x, z]))


def plane_profiles(count, columns=50):
    """Return profiles, each a ms, of the plane z = 0.1 of the base by the moving flange."""
    return [plane_profile(ms, columns) for ms in range(count)]
