# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Curves in space through noisy points.

A spline has a knot every few centimetres, or more of them where cross validation finds that the
points bend more. Where the cubic of Wu 2017 (eqs. 7 and 8), a spline without inner knots, is close
to it, that is used.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter

from handeye_ros.arithmetic import rms, robust_std
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.se3 import unit
from handeye_ros.words import count_of
import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

KNOT_SPACING = 0.03  # m between the knots of a spline
PIECES_TRIED = 1, 2, 4  # number of pieces between these knots
STIFF_ONLY = PIECES_TRIED[:1]
CUBIC_ENOUGH = 4e-5  # m RMS between cubic and spline, up to which the cubic is used
OUTLIER_SIGMAS = 3.5  # sigmas of points that are dropped
MIN_SCATTER = 1e-6  # m: the smallest scatter assumed when outliers are removed
LENGTH_POINTS = 2000  # points of a curve for its length


@dataclass(frozen=True, eq=False)
class Curve:
    """
    A cubic B-spline in space; without inner knots it is a cubic.

    bspline: position (m) by the parameter t, roughly a length (m)
    first, last: t at the ends
    covariance: (k, k) of its coefficients, summed over x, y, z (m^2)
    """

    bspline: BSpline
    first: float
    last: float
    covariance: Array

    @property
    def kind(self) -> str:
        """Return the kind of the curve in words: cubic or spline."""
        return 'cubic' if len(self.bspline.c) == 4 else 'spline'

    def position(self, t: float | Array) -> Array:
        """Return the points (..., 3) at t (m)."""
        return np.asarray(self.bspline(t))

    def tangent(self, t: float | Array) -> Array:
        """Return the unit tangents (..., 3) at t."""
        return unit(self.bspline(t, 1))

    def extrapolated(self, t: float) -> tuple[Array, Array]:
        """Return position and tangent (3,) at t, extrapolated a little beyond the ends."""
        inside = float(np.clip(t, self.first, self.last))
        tangent = self.tangent(inside)
        return self.position(inside) + (t - inside) * tangent, tangent

    def simplified(self) -> Curve:
        """Return the nearest cubic, of unknown std, if it is close; else the curve itself."""
        t = np.linspace(self.first, self.last, LENGTH_POINTS)
        points = self.position(t)
        cubic = make_lsq_spline(t, points, np.repeat([self.first, self.last], 4), k=3)
        is_close = rms(np.linalg.norm(cubic(t) - points, axis=1)) < CUBIC_ENOUGH
        unknown = np.full((4, 4), np.nan)
        return replace(self, bspline=cubic, covariance=unknown) if is_close else self

    def std(self, t: Array) -> Array:
        """Return 1 sigma (k,) of the points at t (k,), as a length in space (m)."""
        basis = BSpline.design_matrix(t, self.bspline.t, 3, extrapolate=True).toarray()
        return np.asarray(np.sqrt(np.einsum('ki,ij,kj->k', basis, self.covariance, basis)))

    @property
    def length(self) -> float:
        """Return the length of the curve (m)."""
        return float(self.arc[0][-1])

    @cached_property
    def arc(self) -> tuple[Array, Array]:
        """Return the arc lengths (LENGTH_POINTS,) from the first point (m), and t there."""
        t = np.linspace(self.first, self.last, LENGTH_POINTS)
        points = self.position(t)
        steps = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
        return np.cumsum(steps), t


def spline(t: Array, points: Array, pieces: tuple[int, ...] = PIECES_TRIED) -> Curve:
    """
    Return the smoothing spline through points (n, 3) at increasing t (n,), without outliers.

    pieces: the numbers of pieces between knots that are tried. Generalised cross validation takes
        the best; it counts each coefficient 1.5 times, else it takes too many (Kim and Gu 2004:
        1.4 times).

    Raises DataError for fewer points than a cubic has coefficients.
    """
    inliers = np.ones(len(t), dtype=bool)
    # first a stiff one alone, which does not follow outliers
    for tried in (pieces[:1], pieces[:2], pieces, pieces):
        if inliers.sum() < 4:
            raise DataError(f'{count_of(int(inliers.sum()), "point")} agree on a curve, and it '
                            'needs four: scan more densely, or a longer part of it')
        fits = (_spline_through(t[inliers], points[inliers], count) for count in tried)
        curve = min(fits, key=itemgetter(0))[1]
        distance = np.linalg.norm(curve.position(t) - points, axis=1)
        # a flexible one would follow some wrong points in a row, which widen the mean square
        scatter = (robust_std if len(pieces) > len(STIFF_ONLY) else rms)(distance[inliers])
        inliers = distance <= OUTLIER_SIGMAS * max(scatter, MIN_SCATTER)
    return curve


def _spline_through(t: Array, points: Array, pieces: int) -> tuple[float, Curve]:
    """
    Return the least squares through points (n, 3) at increasing t (n,).

    With its score of generalised cross validation, smaller for a better curve.
    """
    length = np.linalg.norm(np.diff(points[::8], axis=0), axis=1).sum()
    count = int(np.clip(pieces * length / KNOT_SPACING, 1, max(len(t) // 8, 1)))
    # longer pieces at the ends, where no points beyond determine the direction
    inner = np.quantile(t, (np.arange(1, count - 1) + 0.5) / count)
    bspline = make_lsq_spline(t, points, np.concatenate([[t[0]] * 4, inner, [t[-1]] * 4]), k=3)
    B = BSpline.design_matrix(t, bspline.t, 3).toarray()
    freedom = max(len(B) - B.shape[1], 1)
    variance = float(((bspline(t) - points) ** 2).sum()) / freedom
    # RSS / freedom^3 is RSS / (n - 1.5 k)^2 to first order in k / n
    return variance / freedom ** 2, Curve(bspline, float(t[0]), float(t[-1]),
                                          variance * np.linalg.pinv(B.T @ B))
