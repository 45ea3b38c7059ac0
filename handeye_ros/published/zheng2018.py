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
- the step norm Er = 1e-3 (mm, and cosines beside it) is far from converged; see `STEP`.
- Powell's test has lost a square and a factor: (f0 - 2 f1 + f2)(f0 - f1 - Max)^2 <
  0.5 Max (f0 - f2)^2 and f2 < f0 are used.
- the start is not said. It is the mounting's nominal transform, and the line fitted to the
  points it gives; 20 mm and 10 degrees off still converge.
- the sensor's calibration and the profile filter (sections 1.2, 1.3, whose formulas are lost) are
  not here: points come from the package's own features.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count
import numpy as np
from scipy.optimize import golden

MIN_POINTS = 5
"""Fewest points: two equations each for ten unknowns (four of them the line's)."""

LENGTH_UNIT = 0.1
"""Metres per unit of length inside the search, so that cosines and lengths weigh alike."""

FACTOR = 1e-2
"""The first penalty factor u0."""

STEP = 1e-9
"""Er: the search ends when a round of Powell moves the parameters by less (in LENGTH_UNIT)."""

MAX_ROUNDS, FIRST_ADVANCE = 2000, 0.05
"""Of Powell for one factor; the first step of a line search, as a share of its direction."""

ENOUGH = 1e-18
"""Err1: the penalty rounds end when M is less (LENGTH_UNIT^2); or when u has settled."""

T_plane_x_plane_y = se3.transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
                                  np.zeros(3))
"""From the right: turns the answer into that of a sensor with x along the line and y = 0."""

_CONSTRAINTS = ((0, 0, 1.0), (3, 3, 1.0), (0, 3, 0.0), (12, 12, 1.0))


@dataclass(frozen=True, eq=False)
class _Problem:
    """p_i = A_i x[:9] + a_i (eq. 7), in LENGTH_UNIT, the base's origin moved to the mean a."""

    A: Array
    a: Array

    def offsets(self, x: Array) -> Array:
        """Return p_i - c (n, 3), the points from the one of the line at parameters x (15,)."""
        return self.A @ x[:9] + self.a - x[9:12]

    def along(self, x: Array, D: Array, factor: float) -> list[float]:
        """
        Return M(x + s D) as the five coefficients of a polynomial in s, lowest first.

        Each distance and constraint is quadratic in s, so the line search need not touch the
        points again.
        """
        e, g = self.offsets(x), self.A @ D[:9] - D[9:12]
        d, h = se3.skew(x[12:]), se3.skew(D[12:])  # e @ d is e x d, several times faster
        parts = [(e @ d, e @ h + g @ d, g @ h)]
        for i, j, value in _CONSTRAINTS:
            p, q, r, s = x[i:i + 3], x[j:j + 3], D[i:i + 3], D[j:j + 3]
            weight = factor ** -0.5
            parts.append((weight * (p @ q - value), weight * (p @ s + r @ q), weight * (r @ s)))
        total = np.zeros(5)
        for c0, c1, c2 in parts:
            total += [np.vdot(c0, c0), 2 * np.vdot(c0, c1),
                      np.vdot(c1, c1) + 2 * np.vdot(c0, c2), 2 * np.vdot(c1, c2),
                      np.vdot(c2, c2)]
        return [float(c) for c in total]


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
        x = minimise(problem, x, factor)
        M = problem.along(x, np.zeros(15), factor)[0]
        following = 0.5 * M / k + 0.1 * factor
        if M < ENOUGH or abs(following - factor) < 1e-3 * factor:
            break
        factor = following
    return x


def minimise(problem: _Problem, x: Array, factor: float) -> Array:
    """Return where M(., factor) is least, by the modified Powell method, steps (1) to (7)."""
    directions = np.eye(len(x))
    for _ in range(MAX_ROUNDS):
        start, values = x, [problem.along(x, directions[0], factor)[0]]
        for direction in directions:
            line = problem.along(x, direction, factor)
            s = line_search(line)
            x = x + s * direction
            values.append(min(quartic(line, s), values[-1]))
        D = x - start
        line = problem.along(x, D, factor)
        last = x + line_search(line) * D
        if np.linalg.norm(last - start) < STEP:
            return last
        drops = -np.diff(values)
        best = int(np.argmax(drops))
        f0, f1, f2 = values[0], values[-1], quartic(line, 1.0)
        curved = (f0 - 2 * f1 + f2) * (f0 - f1 - drops[best]) ** 2
        if f2 < f0 and curved < 0.5 * drops[best] * (f0 - f2) ** 2:
            directions[best] = D / np.linalg.norm(D)
            x = last
        else:
            x = last if f1 < f2 else x + D
    return x


def quartic(coefficients: Sequence[float], s: float) -> float:
    """Return the value at s of a polynomial of degree four, lowest coefficient first."""
    c0, c1, c2, c3, c4 = coefficients
    return (((c4 * s + c3) * s + c2) * s + c1) * s + c0


def line_search(line: Sequence[float]) -> float:
    """Return where a quartic is least near 0: advance and retreat, then the 0.618 method."""
    try:
        s = float(golden(lambda s: quartic(line, s), brack=(0.0, FIRST_ADVANCE), maxiter=45))
    except RuntimeError:  # it falls to neither side
        return 0.0
    return s if quartic(line, s) < line[0] else 0.0
