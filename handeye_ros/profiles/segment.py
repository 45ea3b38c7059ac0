"""
Straight pieces and circular arcs in a laser profile, robust to gross outliers.

Profiles are (n, 2): along the laser line, range; NaN where there was no return. Lines are
z = offset + slope * x, because a profiler's noise is in its range.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
import math
from typing import Any

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

MAX_LINES = 5
HYPOTHESES = 48  # pairs of points tried per span and search for a line
SPANS = np.array([3, 8, 20])  # of the pairs, parts of the profile
KEPT_PAIRS = 1000  # sizes of profiles whose pairs are remembered
SEARCH_POINTS = 256  # points that vote for a hypothesis
FIRST_VOTERS = 64  # of these that vote first, and
BEST_HYPOTHESES = 24  # how many hypotheses all of them vote on
FOREIGN_POINTS = 5  # this many points of something else between two of a line part it
STRAY_GAP = 2  # an end point this far from its neighbour is on the line by chance
INLIER_SIGMAS = 4.0
MOST_NOISE = 30.0  # times the configured noise: more is no surface
BEND_POINTS = 5  # at an end, whose mean tells whether it is bent
BEND_SIGMAS = 3.0
LARGEST_BEND = 6  # a bent end has at most one part in so many of the points
NARROWEST = 1e-6  # part of the laser line that points of a line lie on (m)


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A straight piece of a profile: z = offset + slope * x.

    first, last: its first and last point, as rows of the profile; rows: (k,) all its points;
    noise: the standard deviation of its points in range; straight: rows without the ends
    that are bent.
    """

    first: int
    last: int
    rows: NDArray[np.intp]
    offset: float
    slope: float
    noise: float
    straight: NDArray[np.intp]

    def height(self, x: Any) -> Any:
        """Return the range of its line at x, a number or an array."""
        return self.offset + self.slope * x


def noise_level(z: Array, configured: float) -> float:
    """
    Return the range noise of consecutive valid points, within sight of the configured one.

    With a third of gross outliers a third of the second differences is still free of them.
    """
    if len(z) < 8:
        return configured
    second = np.abs(z[:-2] - 2 * z[1:-1] + z[2:])
    rank = len(second) // 5
    level = float(np.partition(second, rank)[rank]) / 0.2533 / 6 ** 0.5
    return float(np.clip(level, configured / 3, MOST_NOISE * configured))


def straight_segments(points: Array, noise: float, min_points: int) -> list[Segment]:
    """
    Return the straight pieces of a profile, in the order of its rows.

    points: (n, 2); noise: configured range noise (1 sigma); min_points: fewest of a piece.
    """
    rows = returned(points)
    if len(rows) < min_points:
        return []
    x, z = points[rows, 0], points[rows, 1]
    tolerance = INLIER_SIGMAS * max(noise_level(z, noise), noise)
    segments, free, free_x, free_z = [], np.arange(len(rows)), x, z
    for _ in range(MAX_LINES):
        inliers = _dominant_line(free_x, free_z, tolerance, min_points)
        if inliers is None:
            break
        segments += [
            _segment(rows[piece], x[piece], z[piece], noise / 3)
            for piece in _pieces(free[inliers])
            if len(piece) >= min_points and float(x[piece].max() - x[piece].min()) > NARROWEST]
        others = np.flatnonzero(~inliers)
        free, free_x, free_z = free[others], free_x[others], free_z[others]
    return sorted(segments, key=lambda s: s.first)


def returned(points: Array) -> NDArray[np.intp]:
    """Return the rows of points (n, 2) that are finite."""
    finite = np.isfinite(points)
    return np.flatnonzero(finite[:, 0] & finite[:, 1])


def _dominant_line(x: Array, z: Array, tolerance: float, min_points: int
                   ) -> NDArray[np.bool_] | None:
    """Return which points lie on the line with the most points, None if these are too few."""
    if len(x) < min_points:
        return None
    step = -(-len(x) // SEARCH_POINTS)
    slope, offset = _hypotheses(x, z)
    if not len(slope):
        return None
    voters = np.stack([x[::step], z[::step]])
    if voters.shape[1] > 2 * FIRST_VOTERS:
        some = voters[:, ::voters.shape[1] // FIRST_VOTERS]
        best = np.argsort(-_votes(slope, offset, some, 2 * tolerance))[:BEST_HYPOTHESES]
        slope, offset = slope[best], offset[best]
    chosen = int(np.argmax(_votes(slope, offset, voters, 2 * tolerance)))
    return _refined(x, z, (float(offset[chosen]), float(slope[chosen])), tolerance, min_points)


def _refined(x: Array, z: Array, line: tuple[float, float], tolerance: float, min_points: int
             ) -> NDArray[np.bool_] | None:
    """Return which points lie on a line, fitted again to these, None if these are too few."""
    before, rows = 0.0, np.zeros(0, dtype=np.intp)
    for width in (2.0, 1.5, 1.0, 1.0):
        found = np.flatnonzero(_near(x, z, line, width * tolerance))
        if len(found) < min_points:
            return None
        if width == before and np.array_equal(found, rows):
            break  # it would be fitted to the same points
        line, before, rows = _fit(x[found], z[found]), width, found
    return _near(x, z, line, tolerance)


def _near(x: Array, z: Array, line: tuple[float, float], tolerance: float) -> NDArray[np.bool_]:
    away = z - line[0]
    away -= line[1] * x
    return np.asarray(np.abs(away, out=away) < tolerance)


def _votes(slope: Array, offset: Array, points: Array, tolerance: float) -> NDArray[np.intp]:
    """Return how many of the points (2, n) lie on each of the lines (k,)."""
    # products of matrices are by far the quickest way to multiply, and to count
    lines, voters = np.empty((len(slope), 3)), np.empty((3, points.shape[1]))
    lines[:, 0], lines[:, 1], lines[:, 2] = slope, offset, -1.0
    voters[0], voters[1], voters[2] = points[0], 1.0, points[1]
    away = lines @ voters
    near = np.abs(away, out=away) < tolerance
    return np.asarray(near.astype(np.float32) @ np.ones(len(voters[0]), np.float32)
                      ).astype(np.intp)


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


def _fit(x: Array, z: Array) -> tuple[float, float]:
    """Return offset and slope of the least-squares line."""
    mean_x, mean_z = float(np.add.reduce(x)) / len(x), float(np.add.reduce(z)) / len(z)
    dx = x - mean_x
    spread = float(dx @ dx)
    slope = float(dx @ (z - mean_z)) / spread if spread > 0 else 0.0
    return mean_z - slope * mean_x, slope


def _pieces(members: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Part the members of a line where points of something else lie between them."""
    cuts = np.flatnonzero(members[1:] - members[:-1] > FOREIGN_POINTS) + 1
    for begin, end in pairwise([0, *cuts.tolist(), len(members)]):
        piece = members[begin:end]
        first, last = 0, len(piece)
        while last - first > 2 and piece[first + 1] - piece[first] > STRAY_GAP:
            first += 1
        while last - first > 2 and piece[last - 1] - piece[last - 2] > STRAY_GAP:
            last -= 1
        yield piece[first:last]


def _segment(rows: NDArray[np.intp], x: Array, z: Array, least_noise: float) -> Segment:
    """
    Return the line through the points x, z of rows.

    least_noise: a sensor that rounds may show no noise where there is some.
    """
    # the last points at an end are the worst: the line is fitted without them
    margin = min(max(2, len(rows) // 50), (len(rows) - 3) // 2)
    inner = slice(margin, len(rows) - margin)
    offset, slope, noise = _fit_with_noise(x[inner], z[inner])
    residual = z - offset - slope * x
    first, last = (_bent_end(r, max(noise, least_noise)) for r in (residual, residual[::-1]))
    if max(first, last) > margin:
        inner = slice(max(margin, first), len(rows) - max(margin, last))
        offset, slope, noise = _fit_with_noise(x[inner], z[inner])
    return Segment(int(rows[0]), int(rows[-1]), rows, offset, slope, max(noise, least_noise),
                   rows[first:len(rows) - last])


def _fit_with_noise(x: Array, z: Array) -> tuple[float, float, float]:
    offset, slope = _fit(x, z)
    residual = z - offset - slope * x
    return offset, slope, math.sqrt(residual @ residual / max(len(residual) - 2, 1))


def _bent_end(residual: Array, noise: float) -> int:
    """Return how many residuals (n,) from the first on together say that the end is bent."""
    most = len(residual) // LARGEST_BEND // BEND_POINTS
    sums = np.add.reduce(residual[:most * BEND_POINTS].reshape(most, BEND_POINTS), axis=1)
    off = np.abs(sums / BEND_POINTS) > BEND_SIGMAS * noise / BEND_POINTS ** 0.5
    return BEND_POINTS * (int(off.argmin()) if not off.all() else most)
