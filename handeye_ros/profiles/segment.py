# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
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
from handeye_ros.profiles.search import dominant_line, line_terms, NARROWEST
import numpy as np
from numpy.typing import NDArray

MAX_LINES = 5
FOREIGN_POINTS = 5  # largest number of other points between two of a line; more split it
STRAY_GAP = 2  # an end point further than this from its neighbour is on the line by chance
INLIER_SIGMAS = 4.0
MOST_NOISE = 30.0  # times the configured noise: more is no surface
STEEPEST = 4.0  # slope of a surface from which light still comes back
MOST_JUMPS = 0.1  # largest share of jumps from point to point in a profile without clutter
NEIGHBOURS, FEWEST_NEIGHBOURS = 5, 4  # compared on either side; fewest of all at a similar range
END_POINTS = 5  # points of a group whose mean shows a bent end
ROUNDED_SIGMAS = 3.0
LARGEST_END = 6  # a bent end has at most one part in so many of the points


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
        """Return the range of the line at x, a number or an array."""
        return self.offset + self.slope * x


def noise_level(z: Array, configured: float) -> float:
    """
    Return the range noise of consecutive valid points, bounded near the configured one.

    With a third of gross outliers a third of the second differences is still free of them.
    """
    if len(z) < 8:
        return configured
    first = z[1:] - z[:-1]
    second = first[1:] - first[:-1]
    np.abs(second, out=second)
    rank = len(second) // 5
    second.partition(rank)
    level = float(second[rank]) / 0.2533 / 6 ** 0.5
    return min(max(level, configured / 3), MOST_NOISE * configured)


def without_clutter(rows: NDArray[np.intp], points: Array, noise: float) -> NDArray[np.intp]:
    """
    Return the rows (k,) whose points are on a surface; all rows if few points are clutter.

    A sensor may return random ranges where nothing reflects. A point of a surface has neighbours
    at a similar range. noise: configured, 1 sigma (m).
    """
    z, slack = points[:, 1].take(rows), MOST_NOISE * noise
    if np.count_nonzero(np.abs(z[1:] - z[:-1]) > slack) <= MOST_JUMPS * len(rows):
        return rows
    x = points[:, 0].take(rows)
    neighbours = np.zeros(len(rows), dtype=np.intp)
    for k in range(1, NEIGHBOURS + 1):
        near = np.abs(z[k:] - z[:-k]) < slack + STEEPEST * np.abs(x[k:] - x[:-k])
        neighbours[k:] += near
        neighbours[:-k] += near
    return rows[neighbours >= FEWEST_NEIGHBOURS]


def straight_segments(points: Array, noise: float, min_points: int) -> list[Segment]:
    """
    Return the straight pieces of a profile, in the order of its rows.

    points: (n, 2); noise: configured range noise (1 sigma); min_points: fewest of a piece.
    """
    return segments_among(returned(points), points, noise, min_points)


def segments_among(rows: NDArray[np.intp], points: Array, noise: float, min_points: int
                   ) -> list[Segment]:
    """Return the same as straight_segments from the rows (k,) with returns."""
    if len(rows) < min_points:
        return []
    rows = without_clutter(rows, points, noise)
    if len(rows) < min_points:
        return []
    x, z = points.take(rows, axis=0).T.copy()
    tolerance = INLIER_SIGMAS * max(noise_level(z, noise), noise)
    segments, free, terms = [], np.arange(len(rows)), line_terms(x, z)
    for _ in range(MAX_LINES):
        inliers = dominant_line(terms, tolerance, min_points)
        if inliers is None:
            break
        for piece in _pieces(free[inliers]):
            if len(piece) < min_points:
                continue
            segment = _segment(rows.take(piece), x.take(piece), z.take(piece), noise / 3)
            along = points[:, 0].take(segment.straight)
            margin = len(along) // 10  # single points at the ends do not make a line
            if _is_wide(along[margin:len(along) - margin]):
                segments.append(segment)
        left = (~inliers).nonzero()[0]
        if len(left) < min_points:
            break
        free, terms = free.take(left), terms.take(left, axis=1)
    return sorted(segments, key=lambda s: s.first)


def _is_wide(x: Array) -> bool:
    """Return whether points cover a sufficient length of the laser line."""
    # mostly the ends alone suffice
    return bool(abs(x[-1] - x[0]) > NARROWEST or x.max() - x.min() > NARROWEST)


def returned(points: Array) -> NDArray[np.intp]:
    """Return the rows of points (n, 2) that are finite."""
    finite = np.isfinite(points)
    return (finite[:, 0] & finite[:, 1]).nonzero()[0]


def _pieces(members: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Split the points of a line where points of another surface are between them."""
    steps = members[1:] - members[:-1]
    cuts = (steps > FOREIGN_POINTS).nonzero()[0] + 1
    for first, last in pairwise([0, *cuts.tolist(), len(members)]):
        while last - first > 2 and steps[first] > STRAY_GAP:
            first += 1
        while last - first > 2 and steps[last - 2] > STRAY_GAP:
            last -= 1
        yield members[first:last]


def _segment(rows: NDArray[np.intp], x: Array, z: Array, least_noise: float) -> Segment:
    """
    Return the segment fitted to the points x, z of rows.

    least_noise: lower bound of the noise (m), as a sensor that rounds may show none.
    """
    # the last points at an end are the worst: the line is fitted without them
    margin = min(max(2, len(rows) // 50), (len(rows) - 3) // 2)
    inner = slice(margin, len(rows) - margin)
    offset, slope, residual, noise = _fit_with_noise(x, z, inner)
    noise = max(noise, least_noise)
    first, last = _rounded_end(residual, noise), _rounded_end(residual[::-1], noise)
    if max(first, last) > margin:
        inner = slice(max(margin, first), len(rows) - max(margin, last))
        offset, slope, _, noise = _fit_with_noise(x, z, inner)
    return Segment(int(rows[0]), int(rows[-1]), rows, offset, slope, max(noise, least_noise),
                   rows[first:len(rows) - last])


def _fit_with_noise(x: Array, z: Array, inner: slice) -> tuple[float, float, Array, float]:
    """Return offset and slope from the inner points, residuals of all, and their std."""
    count = inner.stop - inner.start
    mean_x = float(np.add.reduce(x[inner])) / count
    mean_z = float(np.add.reduce(z[inner])) / count
    dx, dz = x - mean_x, z - mean_z
    inner_x = dx[inner]
    spread = float(inner_x @ inner_x)
    slope = float(inner_x @ dz[inner]) / spread if spread > 0 else 0.0
    dx *= slope
    dz -= dx
    own = dz[inner]
    return mean_z - slope * mean_x, slope, dz, math.sqrt(own @ own / max(count - 2, 1))


def _rounded_end(residual: Array, noise: float) -> int:
    """Return the number of leading residuals (n,) that indicate a rounded end."""
    most, least = len(residual) // LARGEST_END // END_POINTS, ROUNDED_SIGMAS * noise
    if abs(sum(residual[:END_POINTS].tolist())) / END_POINTS <= least / END_POINTS ** 0.5:
        return 0  # the usual case
    sums = np.add.reduce(residual[:most * END_POINTS].reshape(most, END_POINTS), axis=1)
    off = np.abs(sums / END_POINTS) > least / END_POINTS ** 0.5
    return END_POINTS * (int(off.argmin()) if not off.all() else most)
