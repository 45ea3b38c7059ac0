# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The best-fit transform, (9): how errors of the sensor's field and of the poses move it.

If the robot's error differs between stations, or the sensor's field is distorted, no single
transform is exact. The best-fit one maps the points of the field of view best, over all stations
and up to a motion of the target. It differs from the transform of the mount by a linear function
of the parameters.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.basis import (
    grid,
    grid_over,
    normalised,
    polynomials,
    rigid_displacements,
    split_by_degree,
)
import numpy as np

if TYPE_CHECKING:
    from handeye_ros.estimation.blocks import ParameterBlock
    from handeye_ros.estimation.problem import Linearisation


def best_fit_motions(linear: Linearisation, blocks: Sequence[ParameterBlock]) -> Array:
    """Return G (6, q), derivatives of the best-fit transform by the parameters of blocks, (9)."""
    motions = [block.best_fit(linear) * block.std if block.best_fit else
               np.zeros((6, block.count)) for block in blocks]
    return np.concatenate([np.zeros((6, 0)), *motions], axis=1)


def field_motions(points: Array, degrees: Sequence[int]) -> list[Array]:
    """
    Return the rigid motion (3, k) of the plane that fits each field of distortion_fields best.

    Rows: along x, along z, and the turn about the origin. It is the best fit over the field of
    view minus the best fit over the points (m, 2). The field of view is 1.25 times the bounding
    box of these points, which are means of bins and lie inside it.
    """
    ticks = np.linspace(-1.25, 1.25, 11)
    over_view, over_points = (
        np.linalg.lstsq(rigid_displacements(places), np.kron(np.eye(2), polynomials(uv, degrees)),
                        rcond=None)[0]
        for places, uv in ((grid_over(points, ticks), grid(ticks)), (points, normalised(points))))
    motions = (over_view - over_points).reshape(3, 2, -1)
    return [motion.reshape(3, -1) for motion in split_by_degree(motions, degrees)]


def plane_motions(X: Array) -> Array:
    """
    Return the increments (6, 3) of X (4, 4), along the axes of the mount, by motions of the plane.

    That of the sensor moves along its x, along its z, and turns about its y at the origin.
    """
    x, y, z = X[:3, :3].T
    none = np.zeros(3)
    return np.column_stack([np.append(x, none), np.append(z, none), np.append(none, y)])


def motions_by_poses(poses: Array, X: Array, view_points: Array, in_hand: bool) -> Array:
    """
    Return the derivatives (6, n, 6) of the best-fit transform by the errors of the poses.

    poses: (n, 4, 4), inverted unless in_hand; view_points: (k, 2) of the sensor plane, over which
    the transform fits best. The error of a pose is as in Linearisation.wrt_pose: in the robot's
    frame, its rotation about the flange.

    Motions of the transform and of the target, common to all stations, shift each point as nearly
    as possible as the error of its own pose does: mount x + target y = robot e_i, in least
    squares; returned is x by each e_i.
    """
    n, R = len(poses), poses[:, None, :3, :3]
    lever = view_points @ X[:3, [0, 2]].T  # from the sensor, then from the mount
    in_mount = lever + X[:3, 3]
    in_base = se3.apply(poses, in_mount)
    mount = R @ se3.perturbation_jacobian(lever)
    target = -se3.perturbation_jacobian(in_base)
    if in_hand:
        robot = se3.perturbation_jacobian(in_base - poses[:, None, :3, 3])
    else:  # the mount is the robot's base
        robot = -R @ se3.perturbation_jacobian(in_mount - se3.inverse(poses)[:, None, :3, 3])
    motions = np.concatenate([mount, target], axis=3).reshape(-1, 12)
    fit = np.linalg.pinv(motions, rcond=3e-5)[:6].reshape(6, n, -1)
    return np.asarray(np.einsum('xnk,nke->xne', fit, robot.reshape(n, -1, 6)))
