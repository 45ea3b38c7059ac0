# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The fixed point from different poses: the baseline of Jing 2020, section 2 and eqs. 3 and 4.

A ball of known radius R stands still; each profile cuts it in a circle (x_c, z_c, r_c), so its
centre in the sensor is (x_c, y_c, z_c) with y_c = +-sqrt(R^2 - r_c^2), and all of these are one
point of the base. As A x = b that is linear in the twelve elements of the hand-eye matrix.

What is wrong in print, and what is done here:

- the column of Table 1 headed r_c holds negative numbers, so it must be z; y stands beside it
  with its sign, which comes from knowing on which side of the ball the laser was: `sides`.
- how A x = b is formed is not said; the common centre is eliminated by taking the mean off.
- x of A x = b is no rotation; `solve_linear` returns the nearest one.
- the printed p_y = 0 of all three trials is no measurement: an arm with one axis of rotation
  leaves t along it free, and the solution of least norm puts 0 there.
"""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
import numpy as np

MINIMUM = 4
"""Fewest profiles of the linear solution: three equations each, less three for the centre."""

LENGTH_UNIT = 0.1
"""Metres per unit of length in A x = b: what the rank is judged by."""


def ball_centres(circles: Array, radii: Array, radius: float, sides: Array) -> Array:
    """
    Return the centres (n, 3) of the ball in the sensor frame (metres).

    circles: (n, 2) centres x, z; radii: (n,); radius: the ball's; sides: (n,) sign of the
    centre's y. A circle that noise made larger than the ball counts as a cut through its centre.
    """
    y = sides * np.sqrt(np.maximum(radius ** 2 - radii ** 2, 0.0))
    return np.column_stack([circles[:, 0], y, circles[:, 1]])


def solve_linear(T_base_flange: Array, centres: Array) -> tuple[Array, Array]:
    """
    Return T_flange_sensor (4, 4) and the ball's centre (3,) in the base: eqs. 3 and 4.

    T_base_flange: (n, 4, 4); centres: (n, 3) from `ball_centres`. The solution of least norm, with
    the nearest rotation. Raises TooFewError.
    """
    if len(centres) < MINIMUM:
        raise TooFewError('the fixed point', MINIMUM, 'profiles', len(centres))
    R, a = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3] / LENGTH_UNIT
    A = np.concatenate([R * c for c in (*centres.T[:, :, None, None] / LENGTH_UNIT, 1.0)], axis=2)
    mean_A, mean_a = A.mean(axis=0), a.mean(axis=0)
    x = np.linalg.lstsq((A - mean_A).reshape(-1, 12), (mean_a - a).ravel(), rcond=1e-10)[0]
    R = se3.nearest_rotation(x[:9].reshape(3, 3).T)
    return se3.transform(R, x[9:] * LENGTH_UNIT), (mean_A @ x + mean_a) * LENGTH_UNIT


def solve_least_squares(T_base_flange: Array, centres: Array) -> Array:
    """
    Return the T_flange_sensor (4, 4) that brings the centres together best.

    Arguments and errors as `solve_linear`, whose answer is the start. Gauss-Newton with steps of
    least norm: what the data leave free stays as it was at the start.
    """
    T, ball = solve_linear(T_base_flange, centres)
    base = T_base_flange[:, :3, :3]
    for _ in range(100):
        residuals = se3.apply(T_base_flange @ T, centres[:, None])[:, 0] - ball
        arms = se3.skew(centres @ T[:3, :3].T)
        J = np.concatenate([base * LENGTH_UNIT, -base @ arms,
                            np.broadcast_to(-np.eye(3) * LENGTH_UNIT, base.shape)], axis=2)
        step = np.linalg.lstsq(J.reshape(-1, 9), -residuals.ravel(), rcond=1e-6)[0]
        T = se3.perturb(T, np.append(step[:3] * LENGTH_UNIT, step[3:6]))
        ball = ball + step[6:] * LENGTH_UNIT
        if np.linalg.norm(step) < 1e-12:
            break
    return T
