# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Straight pieces in a laser profile, robust to gross outliers.

Profiles are (n, 2): along the laser line, range; NaN where there was no return. Lines are
z = offset + slope * x, because a profiler's noise is in its range.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import Any

from handeye_ros.data import Array, has_return, Indices
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.ransac import dominant_line_inliers, MIN_LINE_WIDTH
import numpy as np

MAX_LINES = 5
LONGEST_STEP = 5  # from one point of a line to its next, counted in points: a longer one splits it
MAX_OFF_LINE = 5  # points between the ends of a line: more may be the middle of a bent face
STRAY_GAP = 2  # an end point further than this from its neighbour is on the line by chance
INLIER_SIGMAS = 4.0
MAX_NOISE = 30.0  # times the configured noise: more is no surface
STEEPEST_SURFACE = 4.0  # slope of a surface from which light still comes back
CLUTTER_JUMPS = 0.1  # largest share of jumps from point to point in a profile without clutter
# compared on either side; fewest of all at a similar range
NEIGHBOURS_EACH_SIDE, MIN_NEIGHBOURS = 5, 4
END_POINTS = 5  # points of a group whose mean shows a bent end
ROUNDED_SIGMAS = 3.0
SIGMAS_OF_FIFTH = 0.2533  # a fifth of normal deviates are smaller
BENT_SHARE = 6  # a bent end has at most one part in so many of the points


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A straight piece of a profile: z = offset + slope * x.

    first, last: its first and last point, as columns of the profile
    columns: (k,) all its points
    noise: the standard deviation of its points in range
    straight_columns: columns without the ends that are bent
    """

    first: int
    last: int
    columns: Indices
    offset: float
    slope: float
    noise: float
    straight_columns: Indices

    def height(self, x: Any) -> Any:
        """Return the range of the line at x, a number or an array."""
        return self.offset + self.slope * x

    def crossing(self, other: Segment) -> float:
        """Return x where the line crosses that of another segment, of another slope."""
        return (other.offset - self.offset) / (self.slope - other.slope)

    def reversed(self, size: int) -> Segment:
        """Return the segment in the reversed profile of so many columns."""
        end = size - 1
        return Segment(end - self.last, end - self.first, end - self.columns[::-1], self.offset,
                       self.slope, self.noise, end - self.straight_columns[::-1])


def legendre_2(spreads: Any) -> Any:
    """
    Return the second Legendre polynomial, scaled: over evenly spread points its RMS is 1.

    spreads: distance from the middle of the points, over their standard deviation. Such points
    have no correlation with it in offset and slope, so its factor is the bow of a face (RMS).
    """
    return 5 ** 0.5 / 2 * (spreads * spreads - 1)


def noise_level(z: Array, configured: float) -> float:
    """
    Return the range noise (m, 1 sigma) of ranges z (n,) of consecutive valid points.

    It is a third to MAX_NOISE times the configured one; of fewer than 8 points it is the
    configured one. With a third of gross outliers a third of the second differences is still free
    of them.
    """
    if len(z) < 8:
        return configured
    second = np.abs(z[2:] - 2 * z[1:-1] + z[:-2])
    rank = len(second) // 5
    level = float(np.partition(second, rank)[rank]) / SIGMAS_OF_FIFTH / 6 ** 0.5
    return min(max(level, configured / 3), MAX_NOISE * configured)


def surface_columns(points: Array, noise: float) -> Indices:
    """
    Return the columns (k,) of points (n, 2) that are on a surface: with a return, no clutter.

    A sensor may return random ranges where nothing reflects. A point of a surface has neighbours
    at a similar range. If few points are clutter, none is left out.

    noise: configured, 1 sigma (m).
    """
    columns = np.flatnonzero(has_return(points))
    (x, z), slack = points.take(columns, axis=0).T, MAX_NOISE * noise
    if np.count_nonzero(np.abs(z[1:] - z[:-1]) > slack) <= CLUTTER_JUMPS * len(columns):
        return columns
    neighbours = np.zeros(len(columns), dtype=np.intp)
    for k in range(1, NEIGHBOURS_EACH_SIDE + 1):
        near = np.abs(z[k:] - z[:-k]) < slack + STEEPEST_SURFACE * np.abs(x[k:] - x[:-k])
        neighbours[k:] += near
        neighbours[:-k] += near
    return columns[neighbours >= MIN_NEIGHBOURS]


def straight_segments(points: Array, noise: float, min_points: int) -> list[Segment]:
    """
    Return the straight pieces of a profile, in the order of its columns.

    points: (n, 2); noise: configured range noise (1 sigma); min_points: fewest of a piece. Raises
    FeatureError without any.
    """
    columns = surface_columns(points, noise)
    x, z = points.take(columns, axis=0).T.copy()
    tolerance = INLIER_SIGMAS * max(noise_level(z, noise), noise)
    segments, unassigned = list[Segment](), np.arange(len(columns))

    def segments_of(members: Indices) -> list[Segment]:
        fitted = [_segment(columns.take(piece), x.take(piece), z.take(piece), noise / 3)
                  for piece in _pieces(members) if len(piece) >= min_points]
        return [segment for segment in fitted if segment and segment.noise <= MAX_NOISE * noise]

    for _ in range(MAX_LINES):
        left_x, left_z = x.take(unassigned), z.take(unassigned)
        is_near = dominant_line_inliers(left_x, left_z, tolerance, min_points)
        if is_near is None:
            break
        new = segments_of(unassigned[is_near])
        if len(new) > 1:
            # a line that slants through two surfaces may have more points than either has
            largest = max(new, key=lambda s: len(s.columns))
            is_near = np.abs(left_z - largest.height(left_x)) < tolerance
            new = segments_of(unassigned[is_near])
        if len(new) == 1:
            # a bent laser line shows a plane as a parabola, of which parts are off every line
            within = (columns[unassigned] >= new[0].first) & (columns[unassigned] <= new[0].last)
            if np.count_nonzero(within & ~is_near) > MAX_OFF_LINE:
                on_line = is_near & within
                parabola = np.polyfit(left_x[on_line], left_z[on_line], 2)
                is_near |= within & (np.abs(left_z - np.polyval(parabola, left_x)) < tolerance)
                new = segments_of(unassigned[is_near])
        segments += new
        unassigned = unassigned[~is_near]
    if not segments:
        raise FeatureError(f'no straight piece of {min_points} points or more in the profile, so '
                           'no face')
    return sorted(segments, key=lambda s: s.first)


def _pieces(members: Indices) -> Iterator[Indices]:
    """Split the points of a line where points of another surface are between them."""
    cuts = np.flatnonzero(np.diff(members) > LONGEST_STEP) + 1
    for piece in np.split(members, cuts):
        while len(piece) > 2 and piece[1] - piece[0] > STRAY_GAP:
            piece = piece[1:]
        while len(piece) > 2 and piece[-1] - piece[-2] > STRAY_GAP:
            piece = piece[:-1]
        yield piece


def _segment(columns: Indices, x: Array, z: Array, least_noise: float) -> Segment | None:
    """
    Return the segment fitted to the points x, z of columns, None if all have the same x.

    least_noise: lower bound of the noise (m), as a sensor that rounds may show none.
    """
    # the last points at an end are the worst: the line is fitted without them, and then without
    # the ends that are seen to bend away from it
    n = len(columns)
    unused = min(max(2, n // 50), (n - 3) // 2)
    line = line_through(x, z, slice(unused, n - unused), least_noise)
    if line is None:
        return None
    _, _, noise, residual = line
    bent = _bent_point_count(residual, noise), _bent_point_count(residual[::-1], noise)
    if max(bent) > unused:
        inner = slice(max(unused, bent[0]), n - max(unused, bent[1]))
        line = line_through(x, z, inner, least_noise)
        if line is None:
            return None
    offset, slope, noise, _ = line
    return Segment(columns.item(0), columns.item(-1), columns, offset, slope, noise,
                   straight_columns=columns[bent[0]:n - bent[1]])


def line_through(x: Array, z: Array, part: slice = slice(None), least_noise: float = 0.0
                 ) -> tuple[float, float, float, Array] | None:
    """
    Return offset, slope and noise of the line through a part, and the residuals (n,) of all.

    None if the points of the part have the same x.
    """
    n = len(x[part])
    middle_x, middle_z = float(x[part].sum()) / n, float(z[part].sum()) / n
    dx, dz = x - middle_x, z - middle_z
    square = float(dx[part] @ dx[part])
    if square < n * MIN_LINE_WIDTH ** 2:
        return None
    slope = float(dx[part] @ dz[part]) / square
    residual = dz - slope * dx
    noise = math.sqrt(residual[part] @ residual[part] / max(n - 2, 1))
    return middle_z - slope * middle_x, slope, max(noise, least_noise), residual


def _bent_point_count(residual: Array, noise: float) -> int:
    """Return the number of leading residuals (n,) that indicate a bent end."""
    bent, most = 0, len(residual) // BENT_SHARE // END_POINTS * END_POINTS
    least = ROUNDED_SIGMAS * noise * END_POINTS ** 0.5
    while bent < most and abs(sum(residual[bent:bent + END_POINTS].tolist())) > least:
        bent += END_POINTS
    return bent
