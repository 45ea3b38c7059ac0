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
- the profile filter (section 1.3): a median filter, the slope from differences widened to +-4
  neighbours, and the extremum of the second derivative, likewise widened, as the feature point.
  Its formulas are lost, the text names the neighbours i +- 1 to i +- 4; used are the differences
  summed over them, both exact on parabolas:

    slope_i = sum (z_{i+j} - z_{i-j}) / 20,    second_i = sum (z_{i+j} + z_{i-j} - 2 z_i) / 30.

- the paper picks among the extrema by how the plate lies to the sensor. The plate is the nearer
  side, so its last point is where the range turns up most: the maximum.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
import numpy as np
from scipy.ndimage import median_filter

MINIMUM = 5
"""Fewest points: two equations each for ten unknowns (four of them the line's)."""

LENGTH = 0.1
"""Metres per unit of length inside the search, so that cosines and lengths weigh alike."""

FACTOR = 1e-2
"""The first penalty factor u0."""

STEP = 1e-9
"""Er: the search ends when a round of Powell moves the parameters by less (units of LENGTH)."""

ENOUGH = 1e-18
"""Err1: the penalty rounds end when M is less (LENGTH^2); or when u has settled."""

T_plane_x_plane_y = se3.transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
                                  np.zeros(3))
"""From the right: turns the answer into that of a sensor with x along the line and y = 0."""

_GOLDEN = (5.0 ** 0.5 - 1.0) / 2.0
_CONSTRAINTS = ((0, 0, 1.0), (3, 3, 1.0), (0, 3, 0.0), (12, 12, 1.0))


@dataclass(frozen=True, eq=False)
class Result:
    """
    What the search found.

    T_flange_sensor: (4, 4), sensor plane x = 0, with the nearest rotation; point, direction:
    (3,) of the line in the base; distances: (n,) of the points to it (metres); rounds: of the
    penalty; factor: the last u.
    """

    T_flange_sensor: Array
    point: Array
    direction: Array
    distances: Array
    rounds: int
    factor: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """p_i = A_i x[:9] + a_i (eq. 7), in units of LENGTH, the base's origin moved to the mean a."""

    A: Array
    a: Array

    def offsets(self, x: Array) -> Array:
        return self.A @ x[:9] + self.a - x[9:12]

    def along(self, x: Array, D: Array, factor: float) -> list[float]:
        """
        Return M(x + s D) as the five coefficients of a polynomial in s, lowest first.

        Each distance and constraint is quadratic in s, so the line search need not touch the
        points again.
        """
        e, g = self.offsets(x), self.A @ D[:9] - D[9:12]
        d, h = x[12:], D[12:]
        parts = [(np.cross(e, d), np.cross(e, h) + np.cross(g, d), np.cross(g, h))]
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


def solve(T_base_flange: Array, points: Array, T_flange_sensor: Array) -> Result:
    """
    Return the hand-eye transform from the points of one straight edge.

    T_base_flange: (n, 4, 4); points: (n, 2), y and z in the sensor plane x = 0 (metres);
    T_flange_sensor: (4, 4), the nominal mounting to start from. Raises TooFewError.
    """
    if len(points) < MINIMUM:
        raise TooFewError('Zheng 2018', MINIMUM, 'points on the edge', len(points))
    R, a = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3] / LENGTH
    origin = a.mean(axis=0)
    y, z = (points[:, k, None, None] / LENGTH for k in (0, 1))
    problem = _Problem(np.concatenate([R * y, R * z, R], axis=2), a - origin)
    x, rounds, factor = _penalty(problem, _start(problem, T_flange_sensor), len(points))
    columns = np.column_stack([np.cross(x[:3], x[3:6]), x[:3], x[3:6]])
    d = x[12:] / np.linalg.norm(x[12:])
    distances = np.linalg.norm(np.cross(problem.offsets(x), d), axis=1)
    T = se3.transform(se3.nearest_rotation(columns), x[6:9] * LENGTH)
    return Result(T, (x[9:12] + origin) * LENGTH, d, distances * LENGTH, rounds, factor)


def _start(problem: _Problem, T_flange_sensor: Array) -> Array:
    """Return the fifteen parameters of the nominal transform and the line fitted with it."""
    x = np.zeros(15)
    x[:9] = T_flange_sensor[:3, 1:].T.ravel()
    x[6:9] /= LENGTH
    p = problem.offsets(x)
    x[9:12] = p.mean(axis=0)
    x[12:] = np.linalg.svd(p - x[9:12])[2][0]
    return x


def _penalty(problem: _Problem, x: Array, k: int) -> tuple[Array, int, float]:
    """Return parameters, rounds and last factor of the penalty method (section 1.4)."""
    factor, rounds = FACTOR, 0
    while rounds < 40:
        rounds += 1
        x = minimise(problem, x, factor)
        M = problem.along(x, np.zeros(15), factor)[0]
        following = 0.5 * M / k + 0.1 * factor
        if M < ENOUGH or abs(following - factor) < 1e-3 * factor:
            break
        factor = following
    return x, rounds, factor


def minimise(problem: _Problem, x: Array, factor: float, limit: int = 2000) -> Array:
    """Return the minimum of M(., factor) by the modified Powell method, steps (1) to (7)."""
    directions = np.eye(len(x))
    for _ in range(limit):
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


def line_search(line: Sequence[float], step: float = 0.05) -> float:
    """Return the minimum of a quartic near 0: advance and retreat, then the 0.618 method."""
    low, high = _bracket(line, step)
    tolerance = 1e-9 * (high - low)
    s1, s2 = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f1, f2 = quartic(line, s1), quartic(line, s2)
    while high - low > tolerance:
        if f1 < f2:
            high, s2, f2 = s2, s1, f1
            s1 = high - _GOLDEN * (high - low)
            f1 = quartic(line, s1)
        else:
            low, s1, f1 = s1, s2, f2
            s2 = low + _GOLDEN * (high - low)
            f2 = quartic(line, s2)
    s = 0.5 * (low + high)
    return s if quartic(line, s) < line[0] else 0.0


def _bracket(line: Sequence[float], step: float) -> tuple[float, float]:
    """Return an interval that holds a minimum: try both sides, then double the step."""
    if quartic(line, step) >= line[0]:
        step = -step
        if quartic(line, step) >= line[0]:
            return step, -step
    behind = 0.0
    for _ in range(40):
        if quartic(line, 2 * step) >= quartic(line, step):
            break
        behind, step = step, 2 * step
    return min(behind, 2 * step), max(behind, 2 * step)


# The sensor and its profile filter.

NEIGHBOURS = 4
FEWEST = 2 * NEIGHBOURS + 1


@dataclass(frozen=True)
class Sensor:
    """
    The sensor's parameters, metres.

    L: lens to light plane; H: from the foot of L to the origin; f: focal length (lens to image
    plane); pitch: of the pixels, along x_i and y_i; centre: the pixel on the optical axis.
    """

    L: float
    H: float
    f: float
    pitch: tuple[float, float] = (1.0, 1.0)
    centre: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_tilt(cls, theta: float, distance: float, f: float,
                  pitch: tuple[float, float] = (1.0, 1.0),
                  centre: tuple[float, float] = (0.0, 0.0)) -> Sensor:
        """Return a sensor from its tilt (radians) and the distance from lens to origin."""
        return cls(distance * np.sin(theta), distance * np.cos(theta), f, pitch, centre)

    @property
    def theta(self) -> float:
        """The angle (radians) between the optical axis and the light plane."""
        return float(np.arctan2(self.L, self.H))

    @property
    def T_camera_sensor(self) -> Array:
        """The (4, 4) transform of eqs. 1 and 2: shift O_l, half a turn about x, -theta about y."""
        shift = se3.transform(np.eye(3), np.array([self.L, 0.0, -self.H]))
        half_turn = np.diag([1.0, -1.0, -1.0])
        tilt = se3.exp_rotation(np.array([0.0, -self.theta, 0.0]))
        return np.asarray(se3.transform(tilt @ half_turn, np.zeros(3)) @ shift)


def to_plane(pixels: Array, sensor: Sensor) -> Array:
    """
    Return (n, 2) y and z in the sensor plane (metres) of (n, 2) pixels along x_i and y_i.

    A pixel on or beyond the image of the light plane's horizon gives NaN: nothing of the plane
    in front of the camera is seen there.
    """
    x, y = ((pixels - sensor.centre) * sensor.pitch).T
    D = np.hypot(sensor.L, sensor.H)
    scale = sensor.f * sensor.L - sensor.H * x
    scale = np.where(scale > 0.0, scale, np.nan)
    return np.column_stack([sensor.L * D * y / scale, -D ** 2 * x / scale])


def derivatives(z: Array) -> tuple[Array, Array]:
    """Return slope and second derivative (n,) of a range (n,) by sample; NaN in the border."""
    slope, second = np.full((2, len(z)), np.nan)
    middle = slice(NEIGHBOURS, len(z) - NEIGHBOURS)
    slope[middle] = second[middle] = 0.0
    for j in range(1, NEIGHBOURS + 1):
        ahead = z[NEIGHBOURS + j:len(z) - NEIGHBOURS + j]
        behind = z[NEIGHBOURS - j:len(z) - NEIGHBOURS - j]
        slope[middle] += (ahead - behind) / 20.0
        second[middle] += (ahead + behind - 2.0 * z[middle]) / 30.0
    return slope, second


def edge_point(points: Array, width: int = 5, range_sign: int = 1) -> Array:
    """
    Return the feature point (2,) of a profile (n, 2): the plate's last point at the step.

    points: along the line and range (metres), rows with NaN are left out; width: of the
    median filter (samples); range_sign: -1 when the range grows towards the sensor.
    Raises TooFewError. A profile without a step has an extremum too: the paper takes it.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < FEWEST:
        raise TooFewError('the profile filter of Zheng 2018', FEWEST, 'points', len(points))
    z = median_filter(points[:, 1], size=width, mode='nearest')
    _, second = derivatives(range_sign * z)
    i = int(np.nanargmax(second))
    return np.array([points[i, 0], z[i]])
