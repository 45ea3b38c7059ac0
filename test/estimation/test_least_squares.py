# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The one least squares: what it finds, what blocks say of it, quantiles, priors and threads."""
from __future__ import annotations

import json
import os

from command import run_python
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    chi2_isf,
    chi2_sf,
    covariance_from_jacobian,
    LeastSquares,
    leave_one_out_residuals,
    many_least_squares,
    robust_least_squares,
    Rows,
    worst_outliers,
)
from handeye_ros.estimation.noise import prior_variances
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
    system = LeastSquares(lambda x: Rows(A @ x - b, lambda: A, lambda: lambda v: root @ v),
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
    spoilt = LeastSquares(lambda x: Rows(A @ x - b, lambda: A), np.add, item)
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


@pytest.mark.parametrize(('count', 'scale'), [(2, 1.3), (10, 1.3), (1, 1.7)])
def test_without_evidence_a_scale_is_for_the_report_as_documented(count: int, scale: float
                                                                  ) -> None:
    _, for_report = prior_variances(np.eye(count), np.zeros(count), 1.0, 400.0)
    assert np.sqrt(for_report) == pytest.approx(scale, abs=0.05)


@pytest.mark.parametrize(('value', 'std', 'least', 'most'), [
    (9.0, 6.0, 0.0, 2.0),  # of 1.5 sigma: not believed at several times its prior
    (0.0, 2.0, 0.7, 2.0),  # it may be there as configured
    (50.0, 0.5, 20.0, 100.0), (0.0, 0.01, 0.0, 0.3)])  # what the data show is believed
def test_a_scale_is_what_data_show(value: float, std: float, least: float, most: float) -> None:
    """Of a single parameter that the data alone put at value +- std."""
    information = 1 / std ** 2
    covariance = np.array([[1 / (1 + information)]])
    _, for_report = prior_variances(covariance, covariance[0] * value * information, 1.0, 1e8)
    assert least < np.sqrt(for_report) < most


# In a process of its own: other tests load libraries with pools of their own, at any time.
PROGRAM = r"""
from threading import Event, Thread
from handeye_ros.threads import single_threaded
import handeye_ros.pipeline  # loads every library that a solve needs
from threadpoolctl import threadpool_info

def threads():
    return [pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas']

began, both_run, before = Event(), Event(), threads()
first = Thread(target=single_threaded(lambda: [began.set(), both_run.wait()]))
first.start()
began.wait()
inside = threads()
single_threaded(lambda: [both_run.set(), first.join()])()
print(before, inside, threads(), sep='\n')
"""


def test_solves_use_one_blas_thread_and_after_the_last_as_many_as_before() -> None:
    pytest.importorskip('threadpoolctl', reason='needs threadpoolctl')
    run = run_python('-c', PROGRAM, env={**os.environ, 'OPENBLAS_NUM_THREADS': '2'})
    before, inside, after = map(json.loads, run.stdout.splitlines())
    assert set(inside) == {1} and after == before
