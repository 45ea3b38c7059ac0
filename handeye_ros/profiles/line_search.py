"""
Finds the line with the most points of a profile among clutter.

A line is (3,): offset, slope and -1. Its product with (3, n) 1, x and z is its distance in z from
n points. Pairs of points vote, and the best line is fitted again to the points near it, as RANSAC
does (Fischler and Bolles 1981), but with the same pairs every time.
"""
from __future__ import annotations

from functools import lru_cache

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

HYPOTHESES = 48  # pairs of points tried per span and search for a line
SPANS = np.array([3, 8, 20])  # profile length over the distance of a pair
KEPT_PAIRS = 1000  # profile sizes whose pairs are cached
SEARCH_POINTS = 256  # points that vote for a hypothesis
FIRST_VOTERS = 64  # points that vote first
BEST_HYPOTHESES = 24  # lines on which the other points vote
SURE = 0.5  # share of the first votes that decides at once: no other line has more
LEAST_SPREAD = 1e-9  # smallest spread of points along x, relative: less is rounding
NARROWEST = 1e-6  # smallest length of a line along x (m)


def line_terms(x: Array, z: Array) -> Array:
    """
    Return (5, n): 1, x, z, xx and xz of points relative to their centroid.

    Sums over some of the points give their line. The centroid avoids loss of digits.
    """
    terms = np.empty((5, len(x)))
    ones, dx, dz, squares, products = terms
    ones.fill(1.0)
    np.subtract(x, float(np.add.reduce(x)) / len(x), out=dx)
    np.subtract(z, float(np.add.reduce(z)) / len(z), out=dz)
    np.multiply(dx, dx, out=squares)
    np.multiply(dx, dz, out=products)
    return terms


def dominant_line(terms: Array, tolerance: float, min_points: int) -> NDArray[np.bool_] | None:
    """
    Return which points are on the line with the most points; None if these are too few.

    terms: (5, n) of the points, see line_terms; tolerance: largest distance of a point from the
    line (m); min_points: fewest points of a line.
    """
    lines = _hypotheses(terms[1], terms[2])
    if not lines.size:
        return None
    first, others = _voters(terms.shape[1])
    voters = terms[:3].take(first, axis=1)
    votes = _votes(lines, voters, 2 * tolerance)
    if len(others) and votes.max() < SURE * len(first):
        best = (-votes).argsort()[:BEST_HYPOTHESES]
        lines, votes = lines.take(best, axis=1), votes.take(best)
        votes += _votes(lines, terms[:3].take(others, axis=1), 2 * tolerance)
    return _refined(terms, lines[:, votes.argmax()], tolerance, min_points)


def _refined(terms: Array, line: Array, tolerance: float, min_points: int
             ) -> NDArray[np.bool_] | None:
    """Return which points are on a line (3,) refitted to them, None if too few."""
    points = terms[:3]
    before: tuple[float, list[float]] = (0.0, [])
    for width in (2.0, 1.5, 1.0, 1.0):
        near = _near(line, points, width * tolerance)
        sums = (terms @ near).tolist()
        if sums[0] < min_points:
            return None
        if before == (width, sums):
            return near  # it would be fitted to the same points
        line, before = _fitted(*sums), (width, sums)
    return _near(line, points, tolerance)


def _fitted(n: float, x: float, z: float, xx: float, xz: float) -> Array:
    """Return the least-squares line (3,) from sums of the terms of its points."""
    spread = xx - x * x / n
    slope = (xz - x * z / n) / spread if spread > LEAST_SPREAD * xx else 0.0
    return np.array([(z - slope * x) / n, slope, -1.0])


def _near(lines: Array, points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return (n,) or (n, k): which points (3, n), 1, x and z, are near lines (3,) or (3, k)."""
    # products of matrices are by far the quickest way to multiply, and to count
    away = points.T @ lines
    near: NDArray[np.bool_] = np.abs(away, out=away) < tolerance
    return near


def _votes(lines: Array, voters: Array, tolerance: float) -> NDArray[np.float32]:
    """Return the number of points (3, n), 1, x and z, on each of the lines (3, k)."""
    near = _near(lines, voters, tolerance)
    votes: NDArray[np.float32] = _ones(voters.shape[1]) @ near.astype(np.float32)
    return votes


@lru_cache(KEPT_PAIRS)
def _voters(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the points that vote first, and those that vote on the best lines only."""
    voters = np.arange(0, size, -(-size // SEARCH_POINTS))
    if len(voters) <= 2 * FIRST_VOTERS:
        return voters, voters[:0]
    first = np.arange(len(voters)) % (len(voters) // FIRST_VOTERS) == 0
    return voters[first], voters[~first]


@lru_cache(KEPT_PAIRS)
def _ones(size: int) -> NDArray[np.float32]:
    return np.ones(size, np.float32)


def _hypotheses(x: Array, z: Array) -> Array:
    """Return lines (3, k) through pairs of points, evenly distributed."""
    pairs = _pairs(len(x))
    (x, other_x), (z, other_z) = x.take(pairs), z.take(pairs)
    dx, dz = other_x - x, other_z - z
    apart = np.abs(dx) > NARROWEST
    if np.count_nonzero(apart) < len(apart):
        x, z, dx, dz = x[apart], z[apart], dx[apart], dz[apart]
    lines = np.empty((3, len(x)))
    lines[2] = -1.0
    slope = np.divide(dz, dx, out=lines[1])
    np.subtract(z, slope * x, out=lines[0])
    return lines


@lru_cache(KEPT_PAIRS)
def _pairs(size: int) -> NDArray[np.intp]:
    """Return the first and the second points (2, k) of pairs."""
    span = np.maximum(size // SPANS, 2)[:, None]
    first = np.arange(HYPOTHESES) * (size - 1 - span) // (HYPOTHESES - 1)
    return np.stack([first.ravel(), (first + span).ravel()])
