# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
CN105021139A (Wang, Li, Liu 2015): circle target with two diameters, line laser and camera.

The image shows a circle's orthogonal diameters AB and CD, its centre O, and the laser stripe
through O. Harmonic conjugates give the vanishing points of AB and CD, these the rotation of the
target; the light plane gives the depth of O; two motions of the robot give A X = X B. `handeye
compare` has the poses of the target from elsewhere, so it uses this last half alone, `motions` and
`park1994.solve_motions`; the first half is complete as published, for images, and tests use it.

What is wrong in print, and what is done here:

- the last row of the camera's extrinsic matrices is printed 1 0; it is 0 1.
- B_cw is called the pose of the camera in the target; B_cc' = B_c'w inv(B_cw) and A X = X B
  need it the other way round: p_camera = B_cw p_target (`target_pose`).
- how the two measured directions become a rotation is only hinted at (Rodrigues). Each is
  turned in their common plane by half of what is missing to 90 degrees, which gives the rotation
  nearest to them.
- how the two equations are solved is not said: as by Park and Martin 1994.
- that the stripe runs through O is taken for granted; here it must pass within `MAX_MISS`
  pixels.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count, SingularError
from handeye_ros.published.park1994 import solve_motions
import numpy as np

NAME = 'CN105021139A'

MAX_MISS = 5.0
"""Pixels by which the stripe may miss the centre."""


@dataclass(frozen=True, eq=False)
class View:
    """
    What one image shows, pixels.

    points: (5, 2), A, B, C, D and O; stripe: (n, 2), the laser line on the target, n >= 2.
    """

    points: Array
    stripe: Array


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera matrix (3, 3), and the light plane n . p = d in its frame: (4,) n and d."""

    matrix: Array
    light_plane: Array


def vanishing_point(a: Array, b: Array, o: Array) -> Array:
    """
    Return the harmonic conjugate of o with respect to a and b: homogeneous (3,).

    a, b, o: (2,) images of the ends and the middle of a diameter. With o = alpha a + beta b it is
    beta b - alpha a, which also points from a to b, and is finite or not as it may be.
    """
    ends = np.column_stack([np.append(a, 1.0), np.append(b, 1.0)])
    alpha, beta = np.linalg.lstsq(ends, np.append(o, 1.0), rcond=None)[0]
    return np.asarray(beta * ends[:, 1] - alpha * ends[:, 0])


def target_rotation(points: Array, camera_matrix: Array) -> Array:
    """Return R_camera_target (3, 3), x along AB and y along CD, from points (5, 2)."""
    a, b, c, d, o = points
    x, y = (np.linalg.solve(camera_matrix, vanishing_point(*ends, o)) for ends in ((a, b), (c, d)))
    x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
    middle, across = (x + y) / np.linalg.norm(x + y), (y - x) / np.linalg.norm(y - x)
    x, y = (middle - across) / np.sqrt(2.0), (middle + across) / np.sqrt(2.0)
    return np.column_stack([x, y, np.cross(x, y)])


def target_centre(view: View, camera: Camera) -> Array:
    """
    Return the centre (3,) of the circle in the camera frame (metres).

    The point of the stripe's line nearest to O, cut with the light plane. Raises SingularError.
    """
    o, mean = view.points[4], view.stripe.mean(axis=0)
    along = np.linalg.svd(view.stripe - mean, full_matrices=False)[2][0]
    foot = mean + along * (along @ (o - mean))
    miss = float(np.linalg.norm(foot - o))
    if miss > MAX_MISS:
        raise SingularError(NAME, f'the stripe misses the centre by {miss:.1f} pixels')
    ray = np.linalg.solve(camera.matrix, np.append(foot, 1.0))
    slope = camera.light_plane[:3] @ ray
    if abs(slope) < 1e-6 * np.linalg.norm(ray):
        raise SingularError(NAME, 'the centre is seen along the light plane')
    return np.asarray(ray * camera.light_plane[3] / slope)


def target_pose(view: View, camera: Camera) -> Array:
    """Return T_camera_target (4, 4), B_cw of steps one and two. Raises SingularError."""
    return se3.transform(target_rotation(view.points, camera.matrix), target_centre(view, camera))


def motions(T_base_flange: Array, T_camera_target: Array) -> tuple[Array, Array]:
    """Return A and B (n - 1, 4, 4) of the moves from each of n poses to the next (steps 3-7)."""
    A = se3.inverse(T_base_flange[1:]) @ T_base_flange[:-1]
    B = T_camera_target[1:] @ se3.inverse(T_camera_target[:-1])
    return A, B


def solve(T_base_flange: Array, views: tuple[View, ...], camera: Camera) -> Array:
    """
    Return T_flange_camera (4, 4) from three or more views.

    T_base_flange: (n, 4, 4), one per view. Raises TooFewError, SingularError.
    """
    require_count(NAME, 3, 'views', len(views))
    T_camera_target = np.array([target_pose(view, camera) for view in views])
    return solve_motions(*motions(T_base_flange, T_camera_target))
