# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The one least squares: what it finds, what blocks say of it, and that nobody has another."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    adjust,
    covariance_of,
    leave_one_out,
    many_least_squares,
    outliers,
    Rows,
    System,
)
import numpy as np
from numpy.typing import NDArray
import pytest

SEEDS = pytest.mark.parametrize('seed', range(5))


def linear(seed: int, noise: float = 1.0) -> tuple[System[Array], Array, Array, NDArray[np.intp]]:
    """Return a system r = A x - b of blocks of 2 rows, correlated, with A, b and the blocks."""
    rng = np.random.default_rng(seed)
    A, truth = rng.normal(size=(40, 4)), rng.normal(size=4)
    b, block = A @ truth + noise * rng.normal(size=40), np.repeat(np.arange(20), 2)
    root = np.kron(np.eye(20), np.array([[1.0, 0.0], [0.7, 2.0]]))
    system = System(lambda x: Rows(A @ x - b, lambda: A, lambda: lambda v: root @ v),
                    np.add, block)
    return system, root @ A, root @ b, block


@SEEDS
def test_a_linear_system_is_solved_as_by_its_normal_equations(seed: int) -> None:
    system, A, b, block = linear(seed)
    weights = np.random.default_rng(seed).uniform(0.1, 2.0, 20)
    root = np.sqrt(weights)[block]
    expected = np.linalg.lstsq(A * root[:, None], b * root, rcond=None)[0]
    assert np.abs(system.least_squares(np.zeros(4), weights) - expected).max() < 1e-9


def test_an_unknown_that_nothing_depends_on_stays_where_it_is() -> None:
    _, A, b, _ = linear(0)
    J = np.column_stack([A, np.zeros(len(A))])
    (found,), squares = many_least_squares(
        lambda states: (states[0] @ J.T - b, np.broadcast_to(J, (len(states[0]), *J.shape))),
        lambda states, steps: (states[0] + steps,), (np.ones((3, 5)),), 20)
    expected, least, _, _ = np.linalg.lstsq(A, b, rcond=None)
    assert np.abs(found - [*expected, 1.0]).max() < 1e-9
    assert np.abs(squares - least).max() < 1e-9


@SEEDS
def test_what_blocks_say_without_each_other_is_what_refits_say(seed: int) -> None:
    _, A, b, block = linear(seed)
    x, C = np.linalg.lstsq(A, b, rcond=None)[0], covariance_of(A)
    r = A @ x - b
    left_out = leave_one_out(r, A, C, block)
    out = block == 3
    refit = np.linalg.lstsq(A[~out], b[~out], rcond=None)[0]
    assert np.abs(left_out[out] - (A @ refit - b)[out]).max() < 1e-6


@SEEDS
def test_wrong_blocks_are_left_out_and_change_nothing(seed: int) -> None:
    system, A, b, block = linear(seed, noise=0.01)
    good, wrong = np.arange(3, 20), np.isin(block, (0, 1, 2))
    b = b + 100.0 * wrong
    spoilt = System(lambda x: Rows(A @ x - b, lambda: A), np.add, block)
    found = adjust(spoilt, np.zeros(4), minimum=4)
    assert set(found.used.tolist()) <= set(good.tolist())
    kept = np.isin(block, found.used)
    assert np.abs(found.state - np.linalg.lstsq(A[kept], b[kept], rcond=None)[0]).max() < 1e-9
    assert len(found.used) >= len(good) - 1


def test_no_more_blocks_are_dropped_than_can_be_spared() -> None:
    squares = np.full(200, 100.0)
    for spare, dropped in ((0, 0), (1, 1), (3, 3), (100, 4)):
        assert len(outliers(squares, 2, 200, spare)) == dropped
    assert not len(outliers(np.full(200, 1.0), 2, 200, 100))
