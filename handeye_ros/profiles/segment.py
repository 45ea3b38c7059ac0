"""
Straight pieces and circular arcs in a laser profile, robust to gross outliers.

Profiles are (n, 2): along the laser line, range; NaN where there was no return. Lines are
z = offset + slope * x, because a profiler's noise is in its range.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
import math
from typing import Any

from handeye_ros.data import Array
from handeye_ros.profiles.line_search import LineSearch, NARROWEST
import numpy as np
from numpy.typing import NDArray

MAX_LINES = 5
FOREIGN_POINTS = 5  # this many points of something else between two of a line part it
STRAY_GAP = 2  # an end point this far from its neighbour is on the line by chance
INLIER_SIGMAS = 4.0
MOST_NOISE = 30.0  # times the configured noise: more is no surface
BEND_POINTS = 5  # at an end, whose mean tells whether it is bent
BEND_SIGMAS = 3.0
LARGEST_BEND = 6  # a bent end has at most one part in so many of the points


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
    x, z = points[:, 0].take(rows), points[:, 1].take(rows)
    tolerance = INLIER_SIGMAS * max(noise_level(z, noise), noise)
    search, segments, free = LineSearch(x, z, tolerance, min_points), [], np.ones(len(x), bool)
    for _ in range(MAX_LINES):
        inliers = search.dominant(free)
        if inliers is None:
            break
        for piece in _pieces(np.flatnonzero(inliers)):
            of_x = x.take(piece)
            if len(piece) >= min_points and float(of_x.max() - of_x.min()) > NARROWEST:
                segments.append(_segment(rows.take(piece), of_x, z.take(piece), noise / 3))
        free &= ~inliers
    return sorted(segments, key=lambda s: s.first)


def returned(points: Array) -> NDArray[np.intp]:
    """Return the rows of points (n, 2) that are finite."""
    finite = np.isfinite(points)
    return np.flatnonzero(finite[:, 0] & finite[:, 1])


def lost(points: Array) -> int:
    """Return how many of points (n, 2) are no returns."""
    return len(points) - len(returned(points))


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
    offset, slope, residual, noise = _fit_with_noise(x, z, inner)
    first, last = (_bent_end(r, max(noise, least_noise)) for r in (residual, residual[::-1]))
    if max(first, last) > margin:
        inner = slice(max(margin, first), len(rows) - max(margin, last))
        offset, slope, _, noise = _fit_with_noise(x, z, inner)
    return Segment(int(rows[0]), int(rows[-1]), rows, offset, slope, max(noise, least_noise),
                   rows[first:len(rows) - last])


def _fit_with_noise(x: Array, z: Array, inner: slice) -> tuple[float, float, Array, float]:
    """Return offset and slope of the inner points, residuals of all, their standard deviation."""
    offset, slope = _fit(x[inner], z[inner])
    residual = z - offset
    residual -= slope * x
    own = residual[inner]
    return offset, slope, residual, math.sqrt(own @ own / max(len(own) - 2, 1))


def _fit(x: Array, z: Array) -> tuple[float, float]:
    """Return offset and slope of the least-squares line."""
    mean_x, mean_z = float(np.add.reduce(x)) / len(x), float(np.add.reduce(z)) / len(z)
    dx = x - mean_x
    spread = float(dx @ dx)
    slope = float(dx @ (z - mean_z)) / spread if spread > 0 else 0.0
    return mean_z - slope * mean_x, slope


def _bent_end(residual: Array, noise: float) -> int:
    """Return how many residuals (n,) from the first on together say that the end is bent."""
    most, least = len(residual) // LARGEST_BEND // BEND_POINTS, BEND_SIGMAS * noise
    if abs(float(np.add.reduce(residual[:BEND_POINTS]))) / BEND_POINTS <= (
            least / BEND_POINTS ** 0.5):
        return 0  # as it is mostly
    sums = np.add.reduce(residual[:most * BEND_POINTS].reshape(most, BEND_POINTS), axis=1)
    off = np.abs(sums / BEND_POINTS) > least / BEND_POINTS ** 0.5
    return BEND_POINTS * (int(off.argmin()) if not off.all() else most)
