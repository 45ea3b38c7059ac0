# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The line and the circles with the most points, by themselves: any of them, among clutter."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.profiles.arcs import distances_from_circle
from handeye_ros.profiles.ransac import circles_among, dominant_line_inliers, MAX_CIRCLES
from hypothesis import given
from hypothesis import strategies as st
import numpy as np

TOLERANCE = 2e-4  # m
seeds, counts, shares = st.integers(0, 10_000), st.integers(60, 900), st.floats(0.0, 0.35)


def in_clutter(z: Array, share: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return z (n,) with errors within a third of TOLERANCE, a share of clutter, and which is."""
    is_clutter = rng.random(len(z)) < share
    error = np.where(is_clutter, rng.uniform(-0.03, 0.03, len(z)),
                     rng.uniform(-TOLERANCE / 3, TOLERANCE / 3, len(z)))
    return z + error, is_clutter


@given(seeds, counts, shares, st.floats(-2.0, 2.0))
def test_the_line_of_most_points_is_found(
        seed: int, count: int, share: float, slope: float) -> None:
    x = np.linspace(-0.02, 0.02, count)
    z, is_clutter = in_clutter(0.2 + slope * x, share, np.random.default_rng(seed))
    near = dominant_line_inliers(x, z, TOLERANCE, 20)
    assert near is not None and near[~is_clutter].all()
    assert np.abs(z - 0.2 - slope * x)[near].max() < 1.7 * TOLERANCE


@given(seeds, st.integers(0, 60), st.integers(1, 60))
def test_fewer_points_than_wanted_are_no_line(seed: int, count: int, fewest: int) -> None:
    x, z = np.random.default_rng(seed).uniform(-0.1, 0.1, (2, count))
    near = dominant_line_inliers(x, z, TOLERANCE, fewest)
    assert near is None or near.shape == (count,)
    assert near is None or count >= fewest


@given(seeds, counts, shares, st.floats(0.008, 0.04))
def test_the_circle_of_most_points_comes_first(
        seed: int, count: int, share: float, radius: float) -> None:
    x = radius * np.sin(np.linspace(-1.0, 1.0, count))
    z, is_clutter = in_clutter(0.2 - np.sqrt(radius ** 2 - x ** 2), share,
                               np.random.default_rng(seed))
    points = np.column_stack([x, z])
    circles = list(circles_among(points, 0.005, 0.06, TOLERANCE))
    assert 0 < len(circles) <= MAX_CIRCLES
    assert all(0.005 < r < 0.06 for _, _, r in circles)
    distances = np.abs(distances_from_circle(points[~is_clutter], circles[0]))
    assert np.median(distances) < TOLERANCE and distances.max() < 20 * TOLERANCE


@given(counts, st.floats(-2.0, 2.0))
def test_points_of_one_line_are_no_circle(count: int, slope: float) -> None:
    x = np.linspace(-0.02, 0.02, count)
    points = np.column_stack([x, 0.2 + slope * x])
    assert not list(circles_among(points, 0.005, 0.06, TOLERANCE))
