# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Quantiles of chi-squared are those of scipy.stats."""
from __future__ import annotations

from handeye_ros.estimation.least_squares import chi2_isf, chi2_sf
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy import stats

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
