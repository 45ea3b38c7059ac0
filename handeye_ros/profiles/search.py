# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the line or the circles with the most points of a profile among clutter.

Pairs of points vote for a line, triples for a circle, and what wins is fitted again to the points
near it, as RANSAC does (Fischler and Bolles 1981), but with the same points every time.

A line is (3,): offset, slope and -1. Its product with (3, n) 1, x and z is its distance in z from
n points. A circle is (3,): x, z and radius.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

PAIRS, PAIR_SPANS = 48, np.array([3, 8, 20])  # per span; profile length over that of a pair
TRIPLES, TRIPLE_SPANS = 72, np.array([2.5, 4, 8, 16, 32])  # the same of triples
KEPT = 1000  # sizes of profiles whose pairs and triples are kept
VOTERS = 256  # points that vote
SURE = 0.5  # share of a quarter of the voters that decides on a line: no other has more
FIRST_VOTERS, BEST_CIRCLES = 64, 40  # points that vote first; circles on which the others vote
TRIES = 5  # circles tried, in the order of their votes
FEWEST_VOTES = 5
LEAST_SPREAD = 1e-9  # smallest spread of points along x, relative: less is rounding
NARROWEST = 1e-6  # smallest length of a line along x (m)
LEAST_SAGITTA = 4.0  # smallest sagitta of points on a circle, in tolerances: less is a line


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
    points = terms[:3]
    lines = _lines(terms[1], terms[2])
    if not lines.size:
        return None
    step = -(-points.shape[1] // VOTERS)
    for voters in (points[:, ::4 * step], points[:, ::step]):
        votes = _counted(_near(lines, voters, 2 * tolerance))
        if votes.max() > SURE * voters.shape[1]:
            break
    line = lines[:, votes.argmax()]
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


def _counted(near: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the number of true values in each column (n, k), quicker than count_nonzero."""
    votes: NDArray[np.float32] = np.ones(len(near), np.float32) @ near.astype(np.float32)
    return votes


def _lines(x: Array, z: Array) -> Array:
    """Return lines (3, k) through pairs of points, evenly distributed."""
    pairs = _pairs(len(x))
    (x, other_x), (z, other_z) = x.take(pairs), z.take(pairs)
    away = other_x - x
    apart = np.abs(away) > NARROWEST
    slope = (other_z - z)[apart] / away[apart]
    return np.array([z[apart] - slope * x[apart], slope, np.full(len(slope), -1.0)])


@lru_cache(KEPT)
def _pairs(size: int) -> NDArray[np.intp]:
    """Return (2, k) rows of pairs out of a number of points."""
    span = np.maximum(size // PAIR_SPANS, 2)[:, None]
    first = np.arange(PAIRS) * (size - 1 - span) // (PAIRS - 1)
    return np.stack([first.ravel(), (first + span).ravel()])


def circles_among(points: Array, smallest: float, largest: float, tolerance: float
               ) -> Iterator[Array]:
    """
    Yield circles (x, z, r) through many of the points (n, 2), the most points first.

    smallest, largest: of the radius (m). Points of a circle do not vote for later ones.
    """
    circles = _circles(points)
    r = circles[:, 2]
    circles = circles.take(np.flatnonzero((r > smallest) & (r < largest)), axis=0)
    voters = points[::-(-len(points) // VOTERS)]
    if not len(circles):
        return
    some = voters[::max(len(voters) // FIRST_VOTERS, 1)]
    first = _votes_for(_on_circle(circles, some, tolerance), circles, some, tolerance)
    circles = circles[np.argsort(-first, kind='stable')[:BEST_CIRCLES]]
    on = _on_circle(circles, voters, tolerance)
    for _ in range(TRIES):
        votes = _votes_for(on, circles, voters, tolerance)
        best = int(votes.argmax())
        if votes[best] < FEWEST_VOTES:
            return
        yield np.asarray(circles[best])
        on = on & ~on[best]


def _on_circle(circles: Array, points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return (n, k) which points are near which circles."""
    # |d - r| < t is the same as |d^2 - r^2 - t^2| < 2 r t, which is a product of matrices; for r <
    # t every point inside the circle is near
    x, z, r = circles.T
    of_circles = np.stack([-x / r, -z / r, 0.5 / r,
                           (x * x + z * z - r * r - tolerance ** 2) / (2 * r)], axis=1)
    of_points = np.ones((4, len(points)))
    of_points[0], of_points[1] = points[:, 0], points[:, 1]
    of_points[2] = of_points[0] ** 2 + of_points[1] ** 2
    away = of_circles @ of_points
    tiny = np.flatnonzero(r < tolerance)
    if len(tiny):
        away[tiny] = np.maximum(away[tiny], 0.0)
    return np.asarray(np.abs(away, out=away) < tolerance)


def _votes_for(on: NDArray[np.bool_], circles: Array, points: Array, tolerance: float
           ) -> NDArray[np.intp]:
    """Return the number of points on each circle, 0 where a line fits them as well."""
    sums = np.ones((4, len(points)))
    sums[0], sums[1] = points[:, 0], points[:, 1]
    sums[2] = sums[0] ** 2 + sums[1] ** 2
    x, z, squares, votes = (on.astype(float) @ sums.T).T
    count = np.maximum(votes, 1.0)
    # evenly spread points of a chord have this variance
    variance = (squares - (x * x + z * z) / count) / count
    sagitta = 12 * np.maximum(variance, 0.0) / (8 * circles[:, 2])
    return np.where(sagitta > LEAST_SAGITTA * tolerance, votes, 0.0).astype(np.intp)


def _circles(points: Array) -> Array:
    """Return circles (k, 3) through three points each, distributed over the profile."""
    found = _through(*points.take(_triples(len(points)), axis=0))
    return found[np.isfinite(found[:, 2])]  # a radius is finite where the centre is


@lru_cache(KEPT)
def _triples(size: int) -> NDArray[np.intp]:
    """Return (3, k) rows of triples out of a number of points."""
    span = np.maximum((size / TRIPLE_SPANS / 2).astype(int), 1)[:, None]
    first = np.maximum(np.arange(TRIPLES) * (size - 1 - 2 * span) // (TRIPLES - 1), 0)
    rows = (first + np.arange(3)[:, None, None] * span).reshape(3, -1)
    return np.asarray(np.minimum(rows, size - 1))


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    (ux, uz), (vx, vz) = (b - a).T.copy(), (c - a).T.copy()
    cross = 2 * (ux * vz - uz * vx)
    uu, vv = ux * ux + uz * uz, vx * vx + vz * vz
    circles = np.empty((len(a), 3))
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        x, z = (vz * uu - uz * vv) / cross, (ux * vv - vx * uu) / cross
        circles[:, 0], circles[:, 1] = a[:, 0] + x, a[:, 1] + z
        circles[:, 2] = np.sqrt(x * x + z * z)
    return circles
