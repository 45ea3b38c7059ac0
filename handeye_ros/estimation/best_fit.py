"""
The best-fit transform under model error, (9) of estimator.md.

Where a robot errs differently from station to station, or a sensor's field is bent, no transform
is right. The one that maps the points of the field of view best, at all stations and but for a
motion of the target, is another than that of the mount. How far it lies from the answer follows
from the nuisance parameters, and it is part of the reported covariance.
"""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.linearise import Problem
import numpy as np


def of_mount(X: Array) -> Array:
    """Return the motion (6, 3) of the mount by one of the sensor plane: along x, z, and turned."""
    x, y, z = X[:3, :3].T
    none = np.zeros(3)
    return np.column_stack([np.append(x, none), np.append(z, none), np.append(none, y)])


def motions_by_poses(problem: Problem, X: Array, field: Array) -> Array:
    """
    Return by how much (6, n, 6) the best-fit transform moves with errors of the poses.

    field: (k, 2) points of the sensor plane over which it fits best. The error of a pose is
    as in Linear.by_pose: of the robot, in its base frame, about the flange.
    """
    R, a = problem.poses[:, None, :3, :3], problem.poses[:, None, :3, 3]
    lever = field @ X[:3, [0, 2]].T
    p, shift = se3.apply(problem.poses, lever + X[:3, 3]), np.eye(3)
    mount = R @ np.concatenate([np.broadcast_to(shift, (len(lever), 3, 3)), -se3.skew(lever)],
                               axis=2)
    every = np.broadcast_to(shift, (*p.shape, 3))
    target = np.concatenate([-every, se3.skew(p)], axis=3)
    if problem.config.calibration_type == 'eye_in_hand':
        robot = np.concatenate([every, -se3.skew(p - a)], axis=3)
    else:  # the poses are those of the base in the flange; the robot errs in its base
        about = lever + X[:3, 3] + (np.swapaxes(R, 2, 3) @ a[..., None])[..., 0]
        robot = -R @ np.concatenate([every, -se3.skew(about)], axis=3)
    A = np.concatenate([mount, target], axis=3).reshape(len(R), -1, 12)
    scale = np.sqrt((A ** 2).sum(axis=(0, 1)))
    A = A / scale
    every_row = A.reshape(-1, 12)
    inverse = np.linalg.pinv(every_row.T @ every_row, rcond=1e-9, hermitian=True)
    by_robot = np.swapaxes(A, 1, 2) @ robot.reshape(len(R), -1, 6)
    mounts = (inverse[:6] / scale[:6, None]) @ by_robot
    return np.asarray(mounts.swapaxes(0, 1))
