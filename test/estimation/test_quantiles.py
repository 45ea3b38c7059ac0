"""Quantiles and tails are those of scipy.stats."""
from __future__ import annotations

from handeye_ros.estimation.outliers import chi2_isf, chi2_sf, f_isf
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy import stats

CHANCES = st.floats(1e-12, 1 - 1e-6)
FREEDOM = st.integers(1, 2000)


@given(CHANCES, FREEDOM)
def test_chi_squared(chance: float, freedom: int) -> None:
    value = chi2_isf(chance, freedom)
    assert value == pytest.approx(stats.chi2.isf(chance, freedom), rel=1e-9)
    assert chi2_sf(value, freedom) == pytest.approx(
        stats.chi2.sf(value, freedom), rel=1e-9)
    assert chi2_isf(0.5, freedom) == pytest.approx(stats.chi2.median(freedom), rel=1e-9)


@given(CHANCES, FREEDOM, FREEDOM)
def test_ratios_of_variances(chance: float, above: int, below: int) -> None:
    value = f_isf(chance, above, below)
    assert stats.f.sf(value, above, below) == pytest.approx(chance, rel=1e-6)


def test_several_at_once_and_none_without_a_degree_of_freedom() -> None:
    chances = chi2_sf(np.array([0.0, 1.0, 2.0, 2.0]), np.array([0, 0, 1, 3]))
    assert np.isnan(chances).tolist() == [True, True, False, False]
    np.testing.assert_allclose(chances[2:], stats.chi2.sf(2.0, [1, 3]))
