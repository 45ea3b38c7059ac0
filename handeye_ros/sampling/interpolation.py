# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Poses between two reported ones.

At a stop the robot stands, so that a line and a slerp between the two suffice, and no pose further
away has a part in it. A moving robot has a spline (trajectory.py): it averages the errors of its
poses, and gives velocities.
"""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.sampling.stream import by_stamp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def poses_around(poses: Sequence[TimedPose], stamps: Sequence[int]) -> list[TimedPose]:
    """Return the poses next to each stamp, the first and the last: enough for interpolate."""
    last = len(poses) - 1
    indices = {0, last}
    for stamp in stamps:
        indices.add(max(bisect_right(poses, stamp, key=by_stamp) - 1, 0))
        indices.add(min(bisect_left(poses, stamp, key=by_stamp), last))
    return [poses[index] for index in sorted(indices)]


def interpolate(poses: Sequence[TimedPose], stamps: Sequence[int]) -> Array:
    """
    Return the poses T_base_flange (n, 4, 4) at n stamps within the time of the given poses.

    Linear in the translation, slerp in the rotation. Raises ValueError outside.
    """
    poses = poses_around(poses, stamps)
    pose_times = np.array([pose.stamp - poses[0].stamp for pose in poses], dtype=float)
    times = np.array([stamp - poses[0].stamp for stamp in stamps], dtype=float)
    rotations = Rotation.from_quat([pose.quaternion for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    return se3.transform(
        Slerp(pose_times, rotations)(times).as_matrix(),
        np.column_stack([np.interp(times, pose_times, axis) for axis in translations.T]))
