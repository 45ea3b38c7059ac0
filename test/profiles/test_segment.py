# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Straight pieces of a profile, exact and under all that a sensor does to them."""
from __future__ import annotations

import warnings

from handeye_ros.data import Array
from handeye_ros.profiles.segment import noise_level, straight_segments
from hypothesis import given
import numpy as np
from profiles import any_points, COLUMNS, drawn, face, NOISE, X
import pytest


def segments(points: Array, min_points: int = 20) -> list:
    return straight_segments(points, NOISE, min_points)


@pytest.mark.parametrize('tilt', [-1.0, -0.4, 0.0, 0.02, 0.7])
def test_an_exact_line_is_recovered_exactly(tilt: float) -> None:
    found, = segments(drawn(lambda x: face(x, tilt), noise=0.0))
    assert (found.first, found.last) == (0, COLUMNS - 1)
    assert found.slope == pytest.approx(np.tan(tilt), abs=1e-12)
    assert found.offset == pytest.approx(0.17, abs=1e-14)
    assert found.noise == NOISE / 3 and np.array_equal(found.rows, np.arange(COLUMNS))
    assert found.height(0.01) == pytest.approx(0.17 + 0.01 * np.tan(tilt))


def test_a_noisy_line_is_as_good_as_least_squares() -> None:
    errors = []
    for seed in range(40):
        found, = segments(drawn(face, seed))
        errors.append([found.height(0.0) - face(0.0), found.slope - np.tan(0.1)])
        assert found.noise == pytest.approx(NOISE, rel=0.15)
    best = np.array([1.0, 1 / X.std()]) * NOISE / COLUMNS ** 0.5
    assert (np.array(errors).std(axis=0) < 1.4 * best).all()


def test_a_repeated_point_is_no_straight_piece_whatever_is_beside_it() -> None:
    repeated = np.tile([0.0, 0.17], (100, 1))
    assert not segments(np.concatenate([[[-0.01, 0.17]], repeated, [[0.01, 0.17]]]))


@pytest.mark.parametrize('share', [0.1, 0.3])
def test_gross_outliers_do_not_move_a_line(share: float) -> None:
    rng = np.random.default_rng(5)
    for seed in range(10):
        points = drawn(face, seed)
        wrong = rng.random(COLUMNS) < share
        points[wrong, 1] += rng.uniform(-5e-3, 5e-3, wrong.sum())
        # outliers in a row part a line, as something that stands in front of it does
        pieces = segments(points)
        assert sum(len(s.rows) for s in pieces) > 0.9 * (~wrong).sum()
        for found in pieces:
            ends = X[[found.first, found.last]]
            assert np.abs(found.offset + found.slope * ends - face(ends)).max() < 5e-5


@pytest.mark.parametrize('lost', [np.nan, np.inf, -np.inf])
def test_every_value_that_is_not_finite_is_no_return(lost: float) -> None:
    points = drawn(face)
    points[300:310, 1], points[400:405, 0] = lost, lost
    found, = segments(points)
    assert not np.isin(found.rows, [*range(300, 310), *range(400, 405)]).any()


def test_what_stands_in_front_of_a_face_parts_it() -> None:
    def height(x: Array) -> Array:
        return np.where(np.abs(x) < 0.002, face(x) - 0.004, face(x))
    left, middle, right = segments(drawn(height))
    assert left.last < middle.first < middle.last < right.first
    assert left.slope == pytest.approx(right.slope, abs=3e-3)


def test_few_points_are_no_line() -> None:
    assert segments(drawn(face)[:19]) == []
    assert len(segments(drawn(face)[:20])) == 1
    assert segments(np.full((100, 2), np.nan)) == [] == segments(np.empty((0, 2)))


def test_noise_is_distinguished_from_shape() -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(0, 1, 3000)
    for sigma in (1e-5, 1e-4):
        z = rng.normal(0, sigma, 3000) + 0.01 * x + 0.02 * (x > 0.5) + 0.001 * x ** 2
        assert noise_level(z, 3e-5) == pytest.approx(max(sigma, 1e-5), rel=0.1)
    assert noise_level(np.full(100, 0.17), 3e-5) == 1e-5
    assert noise_level(np.zeros(3), 3e-5) == 3e-5


@given(any_points())
def test_any_array_gives_finite_pieces_and_stays_as_it_is(points: Array) -> None:
    before = points.copy()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = segments(points, 5)
    assert np.array_equal(points, before, equal_nan=True)
    for s in found:
        assert np.isfinite([s.offset, s.slope, s.noise]).all() and s.noise >= 0
        assert s.rows[0] == s.first and s.rows[-1] == s.last and len(s.rows) >= 5
        assert (np.diff(s.rows) > 0).all() and np.isfinite(points[s.rows]).all()
    owned = np.concatenate([s.rows for s in found]) if found else np.array([])
    assert len(owned) == len(np.unique(owned)), 'a point belongs to one piece'
