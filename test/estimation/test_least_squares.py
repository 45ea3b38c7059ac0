# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The one least squares: what it finds, which items it leaves out, and quantiles."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    chi2_isf,
    chi2_sf,
    covariance_from_jacobian,
    Evaluation,
    LeastSquares,
    many_least_squares,
)
from handeye_ros.estimation.outliers import (
    leave_one_out_residuals,
    robust_least_squares,
    worst_outliers,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy import stats

SEEDS = pytest.mark.parametrize('seed', range(5))


def linear(seed: int, noise: float = 1.0
           ) -> tuple[LeastSquares[Array], Array, Array, NDArray[np.intp]]:
    """Return a system r = A x - b of items of 2 rows, correlated, with A, b and the items."""
    rng = np.random.default_rng(seed)
    A, truth = rng.normal(size=(40, 4)), rng.normal(size=4)
    b, item = A @ truth + noise * rng.normal(size=40), np.repeat(np.arange(20), 2)
    root = np.kron(np.eye(20), np.array([[1.0, 0.0], [0.7, 2.0]]))
    system = LeastSquares(lambda x: Evaluation(A @ x - b, lambda: A, lambda: lambda v: root @ v),
                          np.add, item)
    return system, root @ A, root @ b, item


@SEEDS
def test_a_linear_system_is_solved_as_by_its_normal_equations(seed: int) -> None:
    system, A, b, item = linear(seed)
    weights = np.random.default_rng(seed).uniform(0.1, 2.0, 20)
    root = np.sqrt(weights)[item]
    expected = np.linalg.lstsq(A * root[:, None], b * root, rcond=None)[0]
    assert np.abs(system.minimised(np.zeros(4), weights) - expected).max() < 1e-9


def test_an_unknown_that_nothing_depends_on_stays_where_it_is() -> None:
    _, A, b, _ = linear(0)
    J = np.column_stack([A, np.zeros(len(A))])
    (estimates,), squares = many_least_squares(
        lambda states: (states[0] @ J.T - b, np.broadcast_to(J, (len(states[0]), *J.shape))),
        lambda states, steps: (states[0] + steps,), (np.ones((3, 5)),), 20)
    expected, least, _, _ = np.linalg.lstsq(A, b, rcond=None)
    assert np.abs(estimates - [*expected, 1.0]).max() < 1e-9
    assert np.abs(squares - least).max() < 1e-9


@SEEDS
def test_what_items_say_without_each_other_is_what_refits_say(seed: int) -> None:
    _, A, b, item = linear(seed)
    x, C = np.linalg.lstsq(A, b, rcond=None)[0], covariance_from_jacobian(A)
    r = A @ x - b
    left_out = leave_one_out_residuals(r, A, A @ C, item)
    in_item = item == 3
    refit = np.linalg.lstsq(A[~in_item], b[~in_item], rcond=None)[0]
    assert np.abs(left_out[in_item] - (A @ refit - b)[in_item]).max() < 1e-6


@SEEDS
def test_wrong_items_are_left_out_and_change_nothing(seed: int) -> None:
    system, A, b, item = linear(seed, noise=0.01)
    good_items, is_wrong = np.arange(3, 20), np.isin(item, (0, 1, 2))
    b = b + 100.0 * is_wrong
    spoilt = LeastSquares(lambda x: Evaluation(A @ x - b, lambda: A), np.add, item)
    adjusted = robust_least_squares(spoilt, np.zeros(4), fewest=4)
    assert set(adjusted.used.tolist()) <= set(good_items.tolist())
    is_used = np.isin(item, adjusted.used)
    refit = np.linalg.lstsq(A[is_used], b[is_used], rcond=None)[0]
    assert np.abs(adjusted.state - refit).max() < 1e-9
    assert len(adjusted.used) >= len(good_items) - 1


def test_no_more_items_are_dropped_than_can_be_spared() -> None:
    squares = np.full(200, 100.0)
    for spare, dropped in ((0, 0), (1, 1), (3, 3), (100, 4)):
        assert len(worst_outliers(squares, 2, 200, spare)) == dropped
    assert not len(worst_outliers(np.full(200, 1.0), 2, 200, 100))


@given(st.floats(1e-12, 1 - 1e-6), st.integers(1, 2000))
def test_chi_squared_is_that_of_scipy(probability: float, freedom: int) -> None:
    value = chi2_isf(probability, freedom)
    assert value == pytest.approx(stats.chi2.isf(probability, freedom), rel=1e-9)
    assert chi2_sf(value, freedom) == pytest.approx(stats.chi2.sf(value, freedom), rel=1e-9)


def test_chi_squared_takes_arrays_and_is_nan_without_a_degree_of_freedom() -> None:
    probabilities = chi2_sf(np.array([0.0, 1.0, 2.0, 2.0]), np.array([0, 0, 1, 3]))
    assert np.isnan(probabilities).tolist() == [True, True, False, False]
    np.testing.assert_allclose(probabilities[2:], stats.chi2.sf(2.0, [1, 3]))
