# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Space curves through noisy points, with position and tangent at t.

The cubic is that of Wu 2017 (eqs. 7 and 8). Where it does not fit, a spline with a knot every few
centimetres is used.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.published import wu2017
import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

KNOT_SPACING = 0.03  # m between the knots of a spline
CUT = 3.5  # sigmas of points that are left out
FINEST = 1e-6  # m: the smallest scatter assumed when outliers are removed
FINE = 2000  # points of a curve for its length
SAME = 4e-5  # m RMS between cubic and spline, up to which the cubic is used


@dataclass(frozen=True, eq=False)
class Curve:
    """
    A curve in space, over t from first to last.

    kind: cubic or spline; position(t): points (..., 3); advance(t): unit tangents (..., 3);
    std(t): 1 sigma of the points (k,) by the scatter about the curve, in 3 dimensions; zero for a
    cubic.
    """

    kind: str
    first: float
    last: float
    position: Callable[[float | Array], Array]
    advance: Callable[[float | Array], Array]
    std: Callable[[Array], Array] = np.zeros_like

    def sampled(self, count: int = FINE) -> tuple[Array, Array]:
        """Return count evenly spaced values of t, and the points (count, 3) there."""
        t = np.linspace(self.first, self.last, count)
        return t, self.position(t)

    def by_length(self, lengths: Array) -> Array:
        """Return t (n,) at arc lengths (n,) from the first point."""
        t, p = self.sampled()
        return np.interp(lengths, arc_length(p), t)

    @property
    def length(self) -> float:
        """Return the length of the curve (m)."""
        return float(arc_length(self.sampled()[1])[-1])


def arc_length(points: Array) -> Array:
    """Return the arc length (n,) of a polyline (n, 3) at each point."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def cubic(points: Array) -> Curve:
    """Return the cubic of Wu 2017 through points (k, 3) at t = 1 to k."""
    c = wu2017.fit_cubic(points)
    return Curve('cubic', 1.0, float(len(points)), lambda t: wu2017.position(c, t),
                 lambda t: wu2017.advance(c, t))


def spline(t: Array, points: Array) -> Curve:
    """
    Return the smoothing spline through points (n, 3) at increasing t (n,).

    Least squares over knots that lie KNOT_SPACING apart; outliers are left out.
    """
    inliers = np.ones(len(t), dtype=bool)
    for _ in range(4):
        knots = _knots(t[inliers], points[inliers])
        fitted = make_lsq_spline(t[inliers], points[inliers], knots, k=3)
        distance = np.linalg.norm(fitted(t) - points, axis=1)
        inliers = distance <= CUT * max(float(np.sqrt((distance[inliers] ** 2).mean())), FINEST)
    tangent = fitted.derivative()
    B = BSpline.design_matrix(t[inliers], knots, 3).toarray()
    variance = float((distance[inliers] ** 2).sum()) / max(len(B) - B.shape[1], 1)
    C = variance * np.linalg.pinv(B.T @ B)

    def std(parameter: Array) -> Array:
        b = BSpline.design_matrix(parameter, knots, 3, extrapolate=True).toarray()
        return np.asarray(np.sqrt(np.einsum('ki,ij,kj->k', b, C, b)))

    def advance(parameter: float | Array) -> Array:
        derivative = tangent(parameter)
        return np.asarray(derivative / np.linalg.norm(derivative, axis=-1, keepdims=True))

    return Curve('spline', float(t[0]), float(t[-1]),
                 lambda parameter: np.asarray(fitted(parameter)), advance, std)


def _knots(t: Array, points: Array) -> Array:
    """Return knots of a cubic spline with points between all of them."""
    count = int(np.clip(np.linalg.norm(np.diff(points[::8], axis=0), axis=1).sum()
                        / KNOT_SPACING, 1, max(len(t) // 8, 1)))
    # longer pieces at the ends, where no points beyond determine the direction
    inner = np.quantile(t, (np.arange(1, count - 1) + 0.5) / count)
    return np.concatenate([[t[0]] * 4, inner, [t[-1]] * 4])


def through(points: Array) -> Curve:
    """Return the cubic through points (k, 3) if it is close to the spline, else the spline."""
    t = np.arange(1.0, len(points) + 1.0)
    simple, flexible = cubic(points), spline(t, points)
    difference = simple.position(t) - flexible.position(t)
    return simple if np.sqrt((difference ** 2).sum(axis=1).mean()) < SAME else flexible


def averaged(values: Array, reach: int = 10) -> Array:
    """Return the means of neighbouring rows."""
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    index = np.arange(len(values))
    half_width = np.minimum(np.minimum(index, len(values) - 1 - index), reach)
    return np.asarray((total[index + half_width + 1] - total[index - half_width])
                      / (2 * half_width + 1)[:, None])
