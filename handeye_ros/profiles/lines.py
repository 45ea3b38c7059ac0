# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The line of a face with its mean points, of one profile or of all of a stop.

Mean points are those of equal bins of points. Speckle is correlated over some columns and
constant while the robot stands, so the scatter of single points over the root of their number is
too small an uncertainty. The scatter of the means is used instead: second differences remove the
smooth shape.
"""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros.data import Array, EdgePoint, FaceLine, Indices
from handeye_ros.profiles.segment import legendre_2, Segment
import numpy as np

LINE_POINTS, SWEPT_LINE_POINTS = 6, 4  # of a line; where hundreds of profiles show each part of it
BIN_COUNT = 24  # bins whose scatter gives the variance of the mean points
MIN_POINTS = 4  # of a bin
MIN_BINS = 6
SURELY_MORE = 1.7  # ratio to the variance of white noise that chance seldom exceeds


def face_line(segment: Segment, points: Array, moving: bool) -> FaceLine:
    """
    Return the face line of a segment of a profile (n, 2), with its mean points.

    moving: whether the profile is one of a sweep.
    """
    most = SWEPT_LINE_POINTS if moving else LINE_POINTS
    measured = points.take(segment.straight_columns, axis=0)
    n, length = len(measured), math.hypot(1.0, segment.slope)
    middle, spread_x = float(measured[:, 0].mean()), float(measured[:, 0].std())
    bin_count = BIN_COUNT if n >= BIN_COUNT * MIN_POINTS else min(most, n)
    bins, _ = bin_means(measured, bin_count)
    centre = np.array([middle, segment.height(middle)])
    white_var = (segment.noise / length) ** 2 * bin_count / n
    return line_of_bins(centre, segment.slope, spread_x * length, bins, white_var, most)


def with_line_errors(edge: EdgePoint, line: FaceLine, excess: float = 1.0) -> EdgePoint:
    """
    Return an edge with its uncertainty across the line of its face.

    excess: std of the line over that of white noise alone; an edge that is the crossing of two
    lines is as much more uncertain.
    """
    spreads = float((edge.point - line.centre) @ line.direction) / line.spread
    std = edge.std * (max(excess, 1.0) if edge.ending == 'roof' else 1.0)
    return replace(edge, std=float(std), std_across=float(line.std * (1 + spreads ** 2) ** 0.5))


def line_of_bins(centre: Array, slope: float, spread: float, bins: Array, white_var: float,
                 most: int = LINE_POINTS) -> FaceLine:
    """
    Return the face line with the mean points that follow from its bins, means of fewer points.

    centre (2,), slope, spread: of the line; bins: (m, 2); white_var: the variance (m^2) of each
    bin for independent noise; most: of the mean points.
    """
    direction = np.array([1.0, slope]) / math.hypot(1.0, slope)
    normal = np.array([-direction[1], direction[0]])
    across, along = (bins - centre) @ normal, bins @ direction
    variance = variance_of_bins(across, white_var)
    points, size = bin_means(bins, min(most, len(bins)))
    if len(bins) >= MIN_BINS:  # of a bowed face the mean of a part lies beside the surface
        bow = (across * legendre_2((along - along.mean()) / along.std())).mean()
        points -= bow * (legendre_2(1 / len(size)) - legendre_2(0.0)) * normal
    return FaceLine(centre, direction, spread, math.sqrt(variance / len(bins)),
                    points, np.sqrt(variance / size), bins)


def bin_means(values: Array, bin_count: int) -> tuple[Array, Indices]:
    """Return the means (k, ...) of k equal bins of values (n, ...), and the sizes of the bins."""
    first = np.arange(bin_count) * len(values) // bin_count
    count = np.append(first[1:], len(values)) - first
    total = np.add.reduceat(values, first)
    return total / (count if values.ndim == 1 else count[:, None]), count


def variance_of_bins(bins: Array, white_var: float) -> float:
    """
    Return the variance (m^2) of the means (k,) of neighbouring bins of residuals (m).

    white_var: the variance for white noise (m^2); it is returned unless the bins scatter
    significantly more.
    """
    if len(bins) < MIN_BINS:
        return white_var
    variance = _variance_about_smooth(bins)
    if variance <= SURELY_MORE * white_var:
        return white_var
    # speckle that is wider than a bin makes two neighbours alike
    pairs = bins[:len(bins) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return (variance if len(pairs) < MIN_BINS else
            max(variance, 2 * _variance_about_smooth(pairs)))


def _variance_about_smooth(bins: Array) -> float:
    """Return the variance (m^2) of white noise with the second differences of bins (k,)."""
    second = bins[:-2] - 2 * bins[1:-1] + bins[2:]
    return float(second @ second) / (6 * len(second))
