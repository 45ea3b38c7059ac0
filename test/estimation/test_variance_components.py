# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Variance components: each cause of noise is identified; quantiles are those of scipy.stats."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    chi2_isf,
    chi2_sf,
    first_variances,
    variance_components,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy import stats

SCALES = (1e-3, 2e-3)  # 1 sigma of the two causes


def blocks(n: int, prior_scales: tuple[float, float], rng: np.random.Generator
           ) -> tuple[Array, Array, Array]:
    """Return residuals (n, 3) of an adjustment, its Jacobian, and parts: white, and common."""
    parts = np.array([np.broadcast_to(np.eye(3), (n, 3, 3)), np.ones((n, 3, 3))])
    noise = prior_scales[0] * rng.normal(size=(n, 3)) + prior_scales[1] * rng.normal(size=(n, 1))
    J = rng.normal(size=(n, 3, 4))
    flat = J.reshape(-1, 4)
    state = np.linalg.lstsq(flat, noise.ravel(), rcond=None)[0]
    return noise - J @ state, J, parts


def test_the_causes_are_distinguished() -> None:
    r, J, parts = blocks(4000, SCALES, np.random.default_rng(0))
    found = variance_components(r, J, parts, np.array([1e-6, 1e-6]))
    np.testing.assert_allclose(np.sqrt(found), SCALES, rtol=0.05)


@pytest.mark.parametrize('absent', [0, 1])
def test_an_absent_cause_is_small(absent: int) -> None:
    prior_scales = (0.0, SCALES[1]) if absent == 0 else (SCALES[0], 0.0)
    r, J, parts = blocks(400, prior_scales, np.random.default_rng(1))
    found = np.sqrt(variance_components(r, J, parts, np.array([1e-6, 1e-6])))
    assert found[absent] < 0.3 * found[1 - absent]
    assert found[1 - absent] == pytest.approx(prior_scales[1 - absent], rel=0.15)


def test_few_residuals_do_not_make_it_too_small_on_average() -> None:
    """Restricted: four unknowns of eighteen residuals would make it 12 % too small."""
    rng, start = np.random.default_rng(2), np.square(SCALES)
    found = [variance_components(*blocks(6, SCALES, rng), start) for _ in range(400)]
    np.testing.assert_allclose(np.mean(found, axis=0) / start, 1.0, atol=0.1)


def test_the_first_guess_ignores_wrong_blocks() -> None:
    rng = np.random.default_rng(3)
    r = np.concatenate([rng.normal(size=(300, 3)), 5 * rng.normal(size=(300, 3))], axis=1)
    r[:30] += 1e3
    own = np.broadcast_to(np.eye(6), (300, 6, 6))
    both = own + 8.0 * own * ([1] * 3 + [0] * 3)
    found = first_variances(r, np.array([own * ([0] * 3 + [1] * 3), both]))
    assert found == pytest.approx([25 / 2, 1 / 9 / 2], rel=0.3)


def test_without_any_noise_they_stay_positive() -> None:
    r, J, parts = blocks(10, (0.0, 0.0), np.random.default_rng(4))
    first = first_variances(r, parts)
    found = variance_components(r, J, parts, first)
    assert (found > 0).all() and (found < 1e-20).all()


PROBABILITIES = st.floats(1e-12, 1 - 1e-6)
FREEDOM = st.integers(1, 2000)


@given(PROBABILITIES, FREEDOM)
def test_chi_squared(probability: float, freedom: int) -> None:
    value = chi2_isf(probability, freedom)
    assert value == pytest.approx(stats.chi2.isf(probability, freedom), rel=1e-9)
    assert chi2_sf(value, freedom) == pytest.approx(
        stats.chi2.sf(value, freedom), rel=1e-9)
    assert chi2_isf(0.5, freedom) == pytest.approx(stats.chi2.median(freedom), rel=1e-9)


def test_several_at_once_and_none_without_a_degree_of_freedom() -> None:
    probabilities = chi2_sf(np.array([0.0, 1.0, 2.0, 2.0]), np.array([0, 0, 1, 3]))
    assert np.isnan(probabilities).tolist() == [True, True, False, False]
    np.testing.assert_allclose(probabilities[2:], stats.chi2.sf(2.0, [1, 3]))
