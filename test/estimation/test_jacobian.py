"""Derivatives kept as factors do what their products do, and few conditions suffice."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.jacobian import FactoredJacobian, products
from handeye_ros.estimation.linalg import eigen, from_information, from_rows, LARGEST_STD
from handeye_ros.estimation.outliers import groups
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest


def columns(counts: list[int], single: int, axes: int, functions: int, seed: int = 0
            ) -> FactoredJacobian:
    """Return random derivatives of stations with so many rows each."""
    rng = np.random.default_rng(seed)
    station = np.repeat(np.arange(len(counts)), counts)
    shared = rng.normal(size=(len(counts), functions))
    local = rng.normal(size=(len(station), single + axes))
    return FactoredJacobian(local, shared, products(shared), axes, groups(station), station)


def spelt_out(made: FactoredJacobian) -> Array:
    """Return the derivatives, one by one."""
    c, shared = made.single, made.basis[made.station]
    return np.column_stack([made.local[:, :c], *(
        own * functions for own in made.local[:, c:].T for functions in shared.T)])


@settings(max_examples=60, deadline=None)
@given(counts=st.lists(st.integers(1, 5), min_size=1, max_size=12), single=st.integers(1, 6),
       axes=st.integers(0, 6), functions=st.integers(0, 5), seed=st.integers(0, 1000))
def test_factors_do_what_their_products_do(counts: list[int], single: int, axes: int,
                                           functions: int, seed: int) -> None:
    made, rng = columns(counts, single, axes, functions, seed), np.random.default_rng(seed)
    dense = spelt_out(made)
    assert made.dense.shape == dense.shape == (len(made.station), made.count)
    assert np.allclose(made.dense, dense)
    assert np.allclose(made.gram, dense.T @ dense)
    x, r = rng.normal(size=made.count), rng.normal(size=len(dense))
    assert np.allclose(made.times(x), dense @ x)
    assert np.allclose(made.gradient_of(r, made.rows), dense.T @ r)
    root = rng.normal(size=(made.count, made.count))
    C = root @ root.T
    for rows in made.rows:
        J = dense[rows]
        assert np.allclose(made.predicted_covariance(C, rows), J @ C @ np.swapaxes(J, 1, 2))
    some = np.arange(0, len(counts), 2)
    part = dense[np.isin(made.station, some)]
    assert np.allclose(made.gram_of(made.of(some)), part.T @ part)


def test_derivatives_in_other_units_are_those_of_the_products() -> None:
    made = columns([3, 2, 3], 4, 2, 3)
    scales = np.array([1.0, 2.0, 3.0, 4.0, *[5.0] * 3, *[6.0] * 3])
    assert np.allclose(made.scaled(scales).dense, spelt_out(made) * scales)


@pytest.mark.parametrize('large', [1.0, 1e-3, 30.0])
def test_few_conditions_and_priors_say_what_the_dense_inverse_says(large: float) -> None:
    rng = np.random.default_rng(1)
    A, r = rng.normal(size=(12, 20)), rng.normal(size=12)
    units = np.append(np.ones(5), np.full(15, large))
    dense = np.linalg.inv((A * units).T @ (A * units) + np.diag([0.0] * 5 + [1.0] * 15))
    for x, covariance in (from_information(A.T @ A, A.T @ r, units, 15),
                          from_rows(A * units, r, 15)):
        assert np.allclose(covariance, dense, rtol=1e-6, atol=1e-9)
        assert np.allclose(x, -dense @ ((A * units).T @ r), rtol=1e-6, atol=1e-9)


def test_a_direction_that_no_condition_shows_is_reported_as_such() -> None:
    rng = np.random.default_rng(2)
    A, r = rng.normal(size=(8, 12)), rng.normal(size=8)
    A[:, 1] = A[:, 0]
    for _, covariance in (from_information(A.T @ A, A.T @ r, np.ones(12), 9),
                          from_rows(A, r, 9)):
        assert covariance[0, 0] > LARGEST_STD, 'the data do not distinguish the two'
        assert covariance[2, 2] < 100
        assert abs(covariance[0, 0] + covariance[1, 1] + 2 * covariance[0, 1]) < 100


def test_eigenvalues_where_divide_and_conquer_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(A: Array) -> None:
        raise np.linalg.LinAlgError('Eigenvalues did not converge')

    A = np.cov(np.random.default_rng(0).normal(size=(60, 30)).T)
    values, vectors = eigen(A)
    monkeypatch.setattr(np.linalg, 'eigh', fails)
    np.testing.assert_allclose(eigen(A)[0], values, rtol=1e-9)
    np.testing.assert_allclose((vectors * values) @ vectors.T, A, atol=1e-12)
