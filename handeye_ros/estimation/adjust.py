"""
Robust least squares over blocks of residuals, for what is no profile on a flange.

From a start, blocks that do not fit lose their say; then those that the others do not explain
are left out, worst first.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from handeye_ros.data import Array
from handeye_ros.estimation.influence import leave_one_out, outliers, shared_scale
from handeye_ros.estimation.linalg import covariance_of
from handeye_ros.estimation.solver import (
    ANNEALING_STEPS,
    believed,
    graduated,
    least_squares,
    NEAR,
    System,
)
import numpy as np
from numpy.typing import NDArray

S = TypeVar('S')

LOST = 64.0  # squared residual, over that of the believed, of a block that is not asked again


@dataclass(frozen=True, eq=False)
class Adjusted(Generic[S]):
    """
    The outcome, of n blocks of k residuals.

    used: indices of the blocks used, ascending; residuals (n, k): whitened, of all blocks;
    left_out (used, k): those of the used, each against the answer without it, to first order;
    covariance: (u, u), times the variance factor where that exceeds 1.
    """

    state: S
    used: NDArray[np.intp]
    residuals: Array
    left_out: Array
    covariance: Array
    variance_factor: float


def adjust(system: System[S], start: S, minimum: int) -> Adjusted[S]:
    """
    Return the adjusted state from a start in reach of it.

    minimum: of the blocks that are left; all have equally many rows.
    """
    n = int(system.block[-1]) + 1

    def squares(state: S) -> Array:
        rows = system.rows(state)
        return np.asarray((rows.white()(rows.residuals) ** 2).reshape(n, -1).mean(axis=1))

    def refit(state: S, weights: Array) -> S:
        return least_squares(system, state, weights, ANNEALING_STEPS, NEAR)
    state = graduated(start, squares, refit)
    now = squares(state)
    return _without_outliers(system, state, now <= LOST * max(1.0, believed(now)), minimum)


def _whitened(system: System[S], state: S) -> tuple[Array, Array]:
    """Return the residuals (m,) and their derivatives (m, u)."""
    rows = system.rows(state)
    white = rows.white()
    return white(rows.residuals), white(rows.jacobian())


def _without_outliers(system: System[S], state: S, good: NDArray[np.bool_], minimum: int
                      ) -> Adjusted[S]:
    """Return the adjusted state after leaving out the blocks that do not fit."""
    while True:
        state = least_squares(system, state, good.astype(float))
        r, J = _whitened(system, state)
        used, rows = np.flatnonzero(good), good[system.block]
        k = len(r) // len(good)
        covariance = covariance_of(J[rows])
        left_out = leave_one_out(r[rows], J[rows], covariance, system.block[rows])
        statistic = (r[rows] * left_out).reshape(-1, k).mean(axis=1)
        worst = outliers(statistic / shared_scale(statistic, k), k, len(good),
                         len(used) - minimum)
        if not len(worst):
            variance = float(r[rows] @ r[rows] / max(rows.sum() - J.shape[1], 1))
            return Adjusted(state, used, r.reshape(-1, k), left_out.reshape(-1, k),
                            covariance * max(1.0, variance), variance)
        good = good.copy()
        good[used[worst]] = False
