# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Zheng, Zhang, Luo et al. 2018: hand-eye calibration based on space linear constraints.

Transactions of the China Welding Institution 39(8), 108-113. Points of one straight edge, seen
from many poses, lie on one line of the base frame. Fifteen parameters: r2, r3 and t of the
hand-eye matrix, a point c and the direction d of the line; penalty function with a dynamic
factor; modified Powell with 0.618 line search. The sensor plane is x = 0, points are (y, z).

What is lost or wrong in print, and what is done here:

- eqs. 8, 11 and 13 (constraints, penalty) are not in the stored text. Used: |r2| = |r3| = |d| = 1
  and r2 . r3 = 0, squared and summed; distances |(p - c) x d| (eq. 10 with eq. 11).
- the factor's update, u = 0.5 M / k + 0.1 u, makes it fall with M. As a multiplier of the
  constraints it would let d = 0 win, and did; so the constraints are divided by it.
- the step norm Er = 1e-3 (mm, and cosines beside it) is far from converged; see `OPTIONS`.
- Powell's test has lost a square and a factor. scipy's Powell has both, and Brent's line search in
  place of the 0.618 method: both find the minimum of the same line.
- the start is not said. It is the mounting's nominal transform, and the line fitted to the
  points it gives; 20 mm and 10 degrees off still converge.
- the sensor's calibration and the profile filter (sections 1.2, 1.3, whose formulas are lost) are
  not here: points come from the package's own features.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count
import numpy as np
from scipy.optimize import minimize

MIN_POINTS = 5
"""Fewest points: two equations each for ten unknowns (four of them the line's)."""

LENGTH_UNIT = 0.1
"""Metres per unit of length inside the search, so that cosines and lengths weigh alike."""

FACTOR = 1e-2
"""The first penalty factor u0."""

OPTIONS = {'xtol': 1e-9, 'ftol': 1e-12, 'maxiter': 2000, 'maxfev': 1_000_000}
"""Of Powell for one factor: far below Er = 1e-3, so that the answer is that of the penalty."""

ENOUGH = 1e-18
"""Err1: the penalty rounds end when M is less (LENGTH_UNIT^2); or when u has settled."""

T_plane_x_plane_y = se3.transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
                                  np.zeros(3))
"""From the right: turns the answer into that of a sensor with x along the line and y = 0."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """p_i = A_i x[:9] + a_i (eq. 7), in LENGTH_UNIT, the base's origin moved to the mean a."""

    A: Array
    a: Array

    def offsets(self, x: Array) -> Array:
        """Return p_i - c (n, 3), the points from the one of the line at parameters x (15,)."""
        return self.A @ x[:9] + self.a - x[9:12]

    def objective(self, x: Array, factor: float) -> float:
        """Return M: the squared distances from the line (10) and the constraints over a factor."""
        r2, r3, direction = x[:3], x[3:6], x[12:]
        crossed = self.offsets(x) @ se3.skew(direction)  # a third of the time of numpy's cross
        violated = np.array([r2 @ r2 - 1.0, r3 @ r3 - 1.0, r2 @ r3, direction @ direction - 1.0])
        return float(np.vdot(crossed, crossed) + violated @ violated / factor)


def solve(T_base_flange: Array, points: Array, T_flange_sensor: Array) -> Array:
    """
    Return T_flange_sensor (4, 4) from the points of one straight edge; the nearest rotation.

    T_base_flange: (n, 4, 4); points: (n, 2), y and z in the sensor plane x = 0 (metres);
    T_flange_sensor: (4, 4), the nominal mounting to start from. Raises TooFewError.
    """
    require_count('Zheng 2018', MIN_POINTS, 'points on the edge', len(points))
    R, a = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3] / LENGTH_UNIT
    y, z = (points[:, k, None, None] / LENGTH_UNIT for k in (0, 1))
    problem = _Problem(np.concatenate([R * y, R * z, R], axis=2), a - a.mean(axis=0))
    x = _penalty(problem, _start(problem, T_flange_sensor), len(points))
    columns = np.column_stack([np.cross(x[:3], x[3:6]), x[:3], x[3:6]])
    return se3.transform(se3.nearest_rotation(columns), x[6:9] * LENGTH_UNIT)


def _start(problem: _Problem, T_flange_sensor: Array) -> Array:
    """Return the fifteen parameters of the nominal transform and the line fitted with it."""
    x = np.zeros(15)
    x[:9] = T_flange_sensor[:3, 1:].T.ravel()
    x[6:9] /= LENGTH_UNIT
    p = problem.offsets(x)
    x[9:12] = p.mean(axis=0)
    x[12:] = np.linalg.svd(p - x[9:12])[2][0]
    return x


def _penalty(problem: _Problem, x: Array, k: int) -> Array:
    """Return the parameters by the penalty method (section 1.4)."""
    factor = FACTOR
    for _ in range(40):
        fit = minimize(problem.objective, x, (factor,), 'Powell', options=OPTIONS)
        x, M = fit.x, fit.fun
        following = 0.5 * M / k + 0.1 * factor
        if M < ENOUGH or abs(following - factor) < 1e-3 * factor:
            break
        factor = following
    return x
