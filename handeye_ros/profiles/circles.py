# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fits circles to points, and takes the points of an arc without its rims."""
from __future__ import annotations

from collections.abc import Sequence
import math

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

TINY = 1e-12
SMALLEST = float(np.finfo(float).tiny)
CONVERGED = 1e-6  # step of a converged fit, as a share of the radius
STEEP = 0.5  # an arc that ends at a larger angle of incidence (rad) ends at its rim
RIM_WIDTH = 0.24  # angle of the arc before its rim that is not used (rad)
RIM_COSINE = 0.5  # smallest cosine of the incidence of a usable point: the rim is bad
FEWEST_FITTED = 5  # fewest points for another fit of a circle
WIDTHS = (3.0, 2.0, 1.0, 1.0)  # of successive fits from a guessed circle, in tolerances
REFIT_WIDTHS = (2.0, 1.0)  # the same from a fitted circle


def fit_circle(points: Array, steps: int = 4) -> Array:
    """
    Return the circle (x, z, r) with the least squared radial distances to (n, 2) points.

    steps: of Gauss-Newton from the algebraic fit (Kasa 1976), which is biased for short arcs.
    """
    n, (x, z) = len(points), points.T
    mean_x, mean_z = float(np.add.reduce(x)) / n, float(np.add.reduce(z)) / n
    x, z = x - mean_x, z - mean_z
    q = x * x + z * z
    xz = 2 * (x @ z)
    x_c, z_c = _solved(np.array([[2 * (x @ x), xz], [xz, 2 * (z @ z)]]),
                       np.array([x @ q, z @ q]))
    r = math.sqrt(float(np.add.reduce(q)) / n + x_c * x_c + z_c * z_c)
    J = np.ones((3, n))
    for _ in range(steps):
        dx, dz = x - x_c, z - z_c
        distance = np.sqrt(dx * dx + dz * dz)
        away = np.maximum(distance, TINY)  # a point may equal the centre
        np.divide(dx, away, out=J[0])
        np.divide(dz, away, out=J[1])
        by_x, by_z, by_r = _solved(J @ J.T, J @ (distance - r))
        x_c, z_c, r = x_c + by_x, z_c + by_z, r + by_r
        if max(abs(by_x), abs(by_z), abs(by_r)) < CONVERGED * r:
            break
    return np.array([x_c + mean_x, z_c + mean_z, r])


def _solved(A: Array, b: Array) -> list[float]:
    """Return the solution of normal equations, near the minimum norm if they are singular."""
    diagonal = A.ravel()[::len(b) + 1]
    diagonal += TINY * float(diagonal.sum()) + SMALLEST
    solution: list[float] = dgesv(A, b)[2].tolist()  # a third of the time of numpy's solve
    return solution


def off_circle(points: Array, circle: Array) -> Array:
    """Return the distances (n,) of points (n, 2) outside of a circle, negative inside."""
    x, z = (points - circle[:2]).T
    return np.asarray(np.sqrt(x * x + z * z) - circle[2])


def arc_points(points: Array, circle: Array, tolerance: float,
               widths: Sequence[float] = WIDTHS) -> NDArray[np.bool_]:
    """
    Return which points (n, 2) are on a circle refitted to them, without its rims.

    widths: of successive fits, in tolerances: nearer points are used for the next circle.
    """
    used = on = np.zeros(len(points), dtype=bool)
    x, z = points.T.copy()
    for width in widths:
        rows = used.nonzero()[0]
        if len(rows) >= FEWEST_FITTED:
            circle = fit_circle(points.take(rows, axis=0), steps=1)
        along, away = x - circle[0], z - circle[1]
        distance = np.sqrt(along * along + away * away)
        on = np.abs(distance - circle[2]) < width * tolerance
        # the light falls on one side of a ball only
        towards = away if away @ on > 0 else -away
        on &= towards > 0
        used = on & (towards > RIM_COSINE * distance)
        if np.count_nonzero(used) < FEWEST_FITTED:
            break
    return used & ~_rim(points, on, circle)


def _rim(points: Array, on: NDArray[np.bool_], circle: Array) -> NDArray[np.bool_]:
    """
    Return which points are near an end of the arc, at grazing incidence.

    Few returns come from near the rim, and then none. The angle at which they end depends on the
    tilt across the profile, which is unknown; so the end of the arc is used instead.
    """
    if not on.any():
        return on
    along, away = points[:, 0] - circle[0], points[:, 1] - circle[1]
    turn = np.arctan2(along, away if away @ on > 0 else -away)
    sorted_turns = np.sort(turn[on])
    stray = len(sorted_turns) // 200
    first, last = sorted_turns[stray], sorted_turns[-1 - stray]
    left = (turn < first + RIM_WIDTH) & (first < -STEEP)
    return np.asarray(left | ((turn > last - RIM_WIDTH) & (last > STEEP)))
