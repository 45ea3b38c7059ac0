# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Which items of data are outliers; an item is what is right or wrong as a whole (least_squares.py).

`graduated_fit` reaches a fit from a rough start in spite of outliers, (11) (graduated
non-convexity, Yang et al. 2020, RA-L 5:1127). `are_near` tells which items are not far from it.
`drop_outliers` then drops those that the others do not predict, by leave-one-out residuals, (12).
`robust_least_squares` does all three for a table.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    chi2_isf,
    chi2_sf,
    covariance_from_jacobian,
    LeastSquares,
    ROUNDING_SHARE,
    rows_by_count,
)
import numpy as np
from numpy.typing import NDArray

F = TypeVar('F')
S = TypeVar('S')

TYPICAL_SHARE = 0.65  # of the items that a good answer must explain
GROSS_SQUARE = 64.0  # squared residual over the typical one (8 sigma): dropped at once
FALSE_ALARM = 1e-3  # probability that good data lose one item


def graduated_fit(start: S, squares: Callable[[S], Array], refit: Callable[[S, Array], S]) -> S:
    """
    Return the state that graduated non-convexity reaches from a start, (11).

    In each round item i has the weight (mu / (mu + q_i))^2, and mu is halved.

    squares(state): (n,) q, the mean squared whitened residuals of the items; refit(state, weights
    (n,)): the state after some steps of the weighted least squares.
    """
    state, q = start, squares(start)
    typical, typical_before = typical_square(q), np.inf
    # where a start explains most items, the few others have little weight from the first round on
    unbounded_mu = min(float(q.max()), 10.0 * typical)
    for _ in range(50):
        least = max(9.0, 3.0 * typical)  # of mu, a squared whitened residual: 3 sigma
        if unbounded_mu <= least and typical > 0.99 * typical_before:
            break
        mu = max(unbounded_mu, least)
        state = refit(state, (mu / (mu + q)) ** 2)
        q, unbounded_mu = squares(state), unbounded_mu / 2
        typical, typical_before = typical_square(q), typical
    return state


def typical_square(squares: Array) -> float:
    """Return the TYPICAL_SHARE quantile of squared residuals."""
    return float(np.quantile(squares, TYPICAL_SHARE))


def are_near(squares: Array, limit: float = GROSS_SQUARE, fewest: int = 0) -> NDArray[np.bool_]:
    """
    Return which items (n,) are not far from a fit.

    squares: (n,) mean squared whitened residuals; limit: over the typical square; fewest: number
    of the nearest that always are.
    """
    near = squares <= limit * max(1.0, typical_square(squares))
    near[np.argsort(squares, kind='stable')[:fewest]] = True
    return near


def leave_one_out_residuals(whitened: Array, jacobian: Array, cross_covariance: Array,
                            item: NDArray[np.intp]) -> Array:
    """
    Return leave-one-out residuals (m,), to first order: each from the fit without its item, (12).

    whitened: (m,) residuals e of the fit to all items; jacobian: A (m, u) of this fit;
    cross_covariance: A C (m, u); item: (m,) the number of each row's item, ascending.
    """
    left_out = np.empty_like(whitened)
    for rows in rows_by_count(item):
        predicted = cross_covariance[rows] @ np.swapaxes(jacobian[rows], 1, 2)
        # avoids division by zero for what an item determines alone
        regular = (1 + ROUNDING_SHARE) * np.eye(rows.shape[1]) - predicted
        left_out[rows] = np.linalg.solve(regular, whitened[rows][..., None])[..., 0]
    return left_out


def worst_outliers(squares: Array, freedom: NDArray[np.intp] | int, total: int, spare: int
                   ) -> NDArray[np.intp]:
    """
    Return the items to drop in this round, worst first: at most one, or one in 50 of 100 or more.

    squares: (n,) left-out squares: mean products of residuals and leave-one-out residuals, (12);
    freedom: their degrees of freedom;
    total: initial number of items; spare: number of items beyond those needed.
    """
    probability = chi2_sf(squares * freedom, freedom)
    most = max(1, min(len(squares) // 50, spare)) if spare > 0 else 0
    # by the squares where probabilities are too small to differ
    worst = np.lexsort((-squares, probability))[:most]
    return np.asarray(worst[probability[worst] < FALSE_ALARM / total])


def over_shared_factor(squares: Array, freedom: NDArray[np.intp] | int
                       ) -> tuple[Array, NDArray[np.intp] | int]:
    """
    Return left-out squares over the variance factor common to most items, and their freedom.

    The factor is at least 1; see worst_outliers.
    """
    expected = chi2_isf(0.5, freedom) / freedom  # their median if the factor is 1
    return squares / max(1.0, float(np.median(squares / expected))), freedom


def drop_outliers(used: NDArray[np.intp], total: int, fewest: int,
                  fitted: Callable[[F | None, NDArray[np.intp], dict[int, float]], F],
                  left_out_squares: Callable[[F], tuple[Array, NDArray[np.intp] | int]],
                  surely_wrong_indices: Callable[[F], Sequence[int]] = lambda fit: ()) -> F:
    """
    Return the fit of the items that agree.

    Each round fits the items used, and drops those that the others do not predict, (12).

    used: numbers of the items to begin with, of `total`; fewest: number that at least remain
    fitted(the fit of the previous round or None, used, dropped): the fit of the items used;
        dropped: the squares of those dropped so far, by item
    left_out_squares(fit): (len(used),) left-out squares of the items used, and their degrees of
        freedom
    surely_wrong_indices(fit): in `used`, of items that are wrong though no square is too large
    """
    fit, dropped = fitted(None, used, {}), dict[int, float]()
    while True:
        squares, freedom = left_out_squares(fit)
        spare = max(len(used) - fewest, 0)
        wrong = [*worst_outliers(squares, freedom, total, spare)] or [
            *surely_wrong_indices(fit)][:spare]
        if not wrong:
            return fit
        dropped = {**dropped, **{int(used[index]): float(squares[index]) for index in wrong}}
        used = np.delete(used, wrong)
        fit = fitted(fit, used, dropped)


@dataclass(frozen=True, eq=False)
class RobustFit(Generic[S]):
    """
    Result of robust least squares over n items of k residuals.

    used: ascending indices of the used items
    residuals (n, k): whitened, of all items
    left_out (used, k): leave-one-out residuals of the used items, to first order
    covariance: (u, u), multiplied by the variance factor if that exceeds 1
    """

    state: S
    used: NDArray[np.intp]
    residuals: Array
    left_out: Array
    covariance: Array
    variance_factor: float


def robust_least_squares(system: LeastSquares[S], start: S, fewest: int) -> RobustFit[S]:
    """
    Return the least-squares state without outliers, from a start near it.

    fewest: smallest number of items that remain; all have equally many rows.
    """
    n = int(system.item[-1]) + 1

    def mean_squares(state: S) -> Array:
        evaluated = system.evaluate(state)
        whitened = evaluated.whitener()(evaluated.residuals).reshape(n, -1)
        return np.asarray((whitened ** 2).mean(axis=1))

    def fitted(previous: RobustFit[S] | None, used: NDArray[np.intp], _: object) -> RobustFit[S]:
        is_used = np.isin(np.arange(n), used)
        state = system.minimised(previous.state if previous else robust, is_used.astype(float))
        evaluated, is_used_row = system.evaluate(state), is_used[system.item]
        whiten = evaluated.whitener()
        whitened = whiten(evaluated.residuals)
        r, J = whitened[is_used_row], whiten(evaluated.jacobian())[is_used_row]
        covariance = covariance_from_jacobian(J)
        left_out = leave_one_out_residuals(r, J, J @ covariance, system.item[is_used_row])
        variance_factor = float(r @ r / max(len(r) - J.shape[1], 1))
        return RobustFit(state, used, whitened.reshape(n, -1), left_out.reshape(len(used), -1),
                         covariance * max(1.0, variance_factor), variance_factor)

    def left_out_squares(fit: RobustFit[S]) -> tuple[Array, NDArray[np.intp] | int]:
        squares = (fit.residuals[fit.used] * fit.left_out).mean(axis=1)
        return over_shared_factor(squares, fit.residuals.shape[1])

    robust = graduated_fit(start, mean_squares, system.few_weighted_steps)
    near = are_near(mean_squares(robust), fewest=fewest)
    return drop_outliers(np.flatnonzero(near), n, fewest, fitted, left_out_squares)
