# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the line or the circles with the most points of a profile among clutter.

Pairs of points vote for a line, triples for a circle, and what wins is fitted again to the points
near it, as RANSAC does (Fischler and Bolles 1981), but with the same points every time.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from handeye_ros.data import Array, Indices
import numpy as np
from numpy.typing import NDArray

PAIR_COUNT, PAIR_SPANS = 48, (3, 8, 20)  # per span; profile length over that of a pair
TRIPLE_COUNT, TRIPLE_SPANS = 72, (2.5, 4, 8, 16, 32)  # the same of triples
VOTER_COUNT = 256  # points that vote
DECISIVE_SHARE = 0.5  # share of a quarter of the voters that decides on a line: no other has more
LINE_FIT_WIDTHS = (2.0, 1.5, 1.0)  # of successive lines, in tolerances
MAX_CIRCLES = 8  # circles tried, in the order of their votes
MIN_VOTES = 5
MIN_SPREAD = 1e-9  # smallest spread of points along x, relative: less is rounding
MIN_LINE_WIDTH = 1e-6  # smallest length of a line along x (m)
MIN_CIRCLE_SAGITTA = 4.0  # smallest sagitta of points on a circle, in tolerances: less is a line


def dominant_line_inliers(x: Array, z: Array, tolerance: float, fewest: int
                          ) -> NDArray[np.bool_] | None:
    """
    Return which points (n,) are on the line with the most points; None if these are too few.

    tolerance: largest distance of a point from the line in z (m); fewest: points of a line.
    """
    n = len(x)
    if n < fewest:
        return None
    x, z = x - x[n // 2], z - z[n // 2]  # avoids loss of digits
    # the sums of these over some points give their line
    terms = np.stack([np.ones(n), x, z, x * x, x * z])
    pairs = _subsets(n, 2, PAIR_COUNT, PAIR_SPANS)
    (x, x_after), (z, z_after) = x.take(pairs), z.take(pairs)
    width = x_after - x
    width[np.abs(width) < MIN_LINE_WIDTH] = np.inf
    slopes = (z_after - z) / width
    lines = np.column_stack([z - slopes * x, slopes, np.full(len(x), -1.0)])
    step = -(-n // VOTER_COUNT)
    for voters in (terms[:3, ::4 * step], terms[:3, ::step]):
        votes = _near(lines, voters, 2 * tolerance).sum(axis=1, dtype=np.int16)
        if votes.max() > DECISIVE_SHARE * voters.shape[1]:
            break
    line = lines[votes.argmax()]
    for width in LINE_FIT_WIDTHS:
        count, sx, sz, sxx, sxz = (terms @ _near(line, terms[:3], width * tolerance)).tolist()
        if count < fewest:
            return None
        spread = sxx - sx * sx / count
        slope = (sxz - sx * sz / count) / spread if spread > MIN_SPREAD * sxx else 0.0
        line = np.array([(sz - slope * sx) / count, slope, -1.0])
    return _near(line, terms[:3], tolerance)


def circles_among(points: Array, smallest: float, largest: float, tolerance: float
                  ) -> Iterator[Array]:
    """
    Yield circles (x, z, r) through many of the points (n, 2), the most points first.

    smallest, largest: of the radius (m). Points of a circle do not vote for later ones.
    """
    circles = _through(*points.take(_subsets(len(points), 3, TRIPLE_COUNT, TRIPLE_SPANS), axis=0))
    r = circles[:, 2]
    circles = circles[(r > max(smallest, tolerance)) & (r < largest)]
    if not len(circles):
        return
    x, z = points[::-(-len(points) // VOTER_COUNT)].T
    terms = np.stack([np.ones(len(x)), x, z, x * x + z * z])
    # |d - r| < t is the same as |d^2 - r^2 - t^2| < 2 r t, which is a product of matrices
    x, z, r = circles.T
    shapes = np.column_stack([(x * x + z * z - r * r - tolerance ** 2) / (2 * r), -x / r, -z / r,
                              0.5 / r])
    near = _near(shapes, terms, tolerance)
    for _ in range(MAX_CIRCLES):
        votes, x, z, squares = terms @ near.T.astype(float)
        # evenly spread points of a chord have this variance: a line may fit them as well
        count = np.maximum(votes, 1.0)
        variance = (squares - (x * x + z * z) / count) / count
        votes[12 * variance / (8 * r) < MIN_CIRCLE_SAGITTA * tolerance] = 0
        best = int(votes.argmax())
        if votes[best] < MIN_VOTES:
            return
        yield np.asarray(circles[best])
        near &= ~near[best]


def _near(shapes: Array, terms: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return which points (n,) or (k, n), by their terms, are near shapes (u,) or (k, u)."""
    distances = shapes @ terms  # products of matrices are by far the quickest way to multiply
    near: NDArray[np.bool_] = np.abs(distances, out=distances) < tolerance
    return near


@lru_cache(1000)  # sizes of profiles
def _subsets(size: int, members: int, count: int, spans: tuple[float, ...]) -> Indices:
    """
    Return rows (members, k) of subsets of the points of a profile, distributed over it.

    size: number of points; members: points in a subset; count: subsets of each span.
    """
    step = np.maximum(size / np.array(spans) / (members - 1), 1).astype(int)[:, None]
    first = np.arange(count) * (size - 1 - (members - 1) * step) // (count - 1)
    rows = np.maximum(first, 0) + np.arange(members)[:, None, None] * step
    return np.asarray(np.minimum(rows, size - 1).reshape(members, -1))


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    (ux, uz), (vx, vz) = (b - a).T, (c - a).T
    cross = 2 * (ux * vz - uz * vx)
    uu, vv = ux * ux + uz * uz, vx * vx + vz * vz
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        x, z = (vz * uu - uz * vv) / cross, (ux * vv - vx * uu) / cross
        return np.column_stack([a[:, 0] + x, a[:, 1] + z, np.hypot(x, z)])
