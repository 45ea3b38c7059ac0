"""
The line that most points of a profile lie on, among points of anything else.

Lines are z = offset + slope * x. Pairs of points vote, and the best pair is fitted again to the
points near it, as RANSAC does (Fischler and Bolles 1981), but with the same pairs every time.
"""
from __future__ import annotations

from functools import lru_cache

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

HYPOTHESES = 48  # pairs of points tried per span and search for a line
SPANS = np.array([3, 8, 20])  # of the pairs, parts of the profile
KEPT_PAIRS = 1000  # sizes of profiles whose pairs are remembered
SEARCH_POINTS = 256  # points that vote for a hypothesis
FIRST_VOTERS = 64  # of these that vote first, and
BEST_HYPOTHESES = 24  # how many hypotheses all of them vote on
LEAST_SPREAD = 1e-9  # of points along x, as a share of that from the middle: less is rounding
NARROWEST = 1e-6  # part of the laser line that points of a line lie on (m)


class LineSearch:
    """The search for lines among the points of a profile."""

    def __init__(self, x: Array, z: Array, tolerance: float, min_points: int) -> None:
        """x, z: (n,); tolerance: of a point on a line; min_points: fewest of a line."""
        self.x, self.z = x, z
        self.tolerance, self.min_points = tolerance, min_points
        # what is summed up for a line: from the middle, or the sums would cancel each other
        self.middle = (float(np.add.reduce(x)) / len(x), float(np.add.reduce(z)) / len(z))
        self.summed = np.ones((5, len(x)))
        _, dx, dz, squares, products = self.summed
        np.subtract(x, self.middle[0], out=dx)
        np.subtract(z, self.middle[1], out=dz)
        np.multiply(dx, dx, out=squares)
        np.multiply(dx, dz, out=products)

    def dominant(self, free: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return which free points lie on the line with the most; None if these are too few."""
        rows = np.flatnonzero(free)
        if len(rows) < self.min_points:
            return None
        x, z = self.x.take(rows), self.z.take(rows)
        slope, offset = _hypotheses(x, z)
        if not len(slope):
            return None
        step = -(-len(x) // SEARCH_POINTS)
        voters = np.ones((3, -(-len(x) // step)))
        voters[0], voters[2] = x[::step], z[::step]
        if voters.shape[1] > 2 * FIRST_VOTERS:
            some = voters[:, ::voters.shape[1] // FIRST_VOTERS].copy()
            best = np.argsort(-_votes(slope, offset, some, 2 * self.tolerance))[:BEST_HYPOTHESES]
            slope, offset = slope[best], offset[best]
        chosen = int(np.argmax(_votes(slope, offset, voters, 2 * self.tolerance)))
        return self._refined((float(offset[chosen]), float(slope[chosen])), free)

    def _refined(self, line: tuple[float, float], free: NDArray[np.bool_]
                 ) -> NDArray[np.bool_] | None:
        """Return which free points lie on a line, fitted again to these, None if too few."""
        before: tuple[float, list[float]] = (0.0, [])
        for width in (2.0, 1.5, 1.0, 1.0):
            near = _near(self.x, self.z, line, width * self.tolerance) & free
            sums = (self.summed @ near).tolist()
            if sums[0] < self.min_points:
                return None
            if before == (width, sums):
                return near  # it would be fitted to the same points
            line, before = self._fitted(*sums), (width, sums)
        return _near(self.x, self.z, line, self.tolerance) & free

    def _fitted(self, n: float, x: float, z: float, xx: float, xz: float) -> tuple[float, float]:
        """Return offset and slope of the least-squares line, of sums from the middle."""
        spread = xx - x * x / n
        slope = (xz - x * z / n) / spread if spread > LEAST_SPREAD * xx else 0.0
        return self.middle[1] + z / n - slope * (self.middle[0] + x / n), slope


def _near(x: Array, z: Array, line: tuple[float, float], tolerance: float) -> NDArray[np.bool_]:
    away = z - line[0]
    away -= line[1] * x
    return np.asarray(np.abs(away, out=away) < tolerance)


def _votes(slope: Array, offset: Array, voters: Array, tolerance: float) -> NDArray[np.float32]:
    """Return how many of the points (3, n), x, 1 and z, lie on each of the lines (k,)."""
    # products of matrices are by far the quickest way to multiply, and to count
    lines = np.empty((len(slope), 3))
    lines[:, 0], lines[:, 1], lines[:, 2] = slope, offset, -1.0
    away = lines @ voters
    near = np.abs(away, out=away) < tolerance
    return np.asarray(near.astype(np.float32) @ _ones(voters.shape[1]))


@lru_cache(KEPT_PAIRS)
def _ones(size: int) -> NDArray[np.float32]:
    return np.ones(size, np.float32)


def _hypotheses(x: Array, z: Array) -> tuple[Array, Array]:
    """Return slopes and offsets (k,) of lines through pairs of points, evenly spread."""
    first, second = _pairs(len(x))
    dx = x[second] - x[first]
    apart = np.abs(dx) > NARROWEST
    if not apart.all():
        first, second, dx = first[apart], second[apart], dx[apart]
    slope = (z[second] - z[first]) / dx
    return slope, z[first] - slope * x[first]


@lru_cache(KEPT_PAIRS)
def _pairs(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the second points (k,) of pairs out of so many."""
    span = np.maximum(size // SPANS, 2)[:, None]
    first = np.arange(HYPOTHESES) * (size - 1 - span) // (HYPOTHESES - 1)
    return first.ravel(), (first + span).ravel()
