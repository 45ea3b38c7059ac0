"""
Robust least squares over blocks of residuals, for what is no profile on a flange.

A block is what stands or falls together: a point, a pose. Far from the truth blocks are weighted
down by a graduated non-convexity (Yang et al. 2020, RA-L 5:1127); then those that the others do
not explain are left out, worst first.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from handeye_ros.data import Array
from handeye_ros.estimation.algebra import covariance_of
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

S = TypeVar('S')

MAX_ITERATIONS = 60
MAX_DAMPINGS = 12
CONVERGED = 1e-8  # step length in sigmas
ROUNDING = 1e-12  # of the sum of squares
BELIEVED_SHARE = 0.7  # of the blocks that a good answer must explain
FALSE_ALARM = 1e-3  # of good data losing one block
BATCH = 50  # one of so many blocks is left out at a time


@dataclass(frozen=True)
class Model(Generic[S]):
    """
    What is adjusted.

    blocks(state): whitened residuals (n, k) and their derivatives (n, k, u) by a step;
    retract(state, step (u,)): the moved state. minimum: fewest blocks.
    """

    blocks: Callable[[S], tuple[Array, Array]]
    retract: Callable[[S, Array], S]
    minimum: int


@dataclass(frozen=True, eq=False)
class Adjusted(Generic[S]):
    """
    The outcome.

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


def adjust(model: Model[S], start: S) -> Adjusted[S]:
    """Return the adjusted state from a start in reach of it."""
    state, squares = start, _squares(model, start)
    control = max(float(squares.max()), 1.0)
    while True:
        scale = 9.0 * max(1.0, float(np.quantile(squares, BELIEVED_SHARE)))
        width = max(control, scale)
        state = _least_squares(model, state, (width / (width + squares)) ** 2, 6)
        squares = _squares(model, state)
        if control <= scale:
            return _without_outliers(model, state, squares <= 7 * scale)
        control /= 4.0


def _squares(model: Model[S], state: S) -> Array:
    return np.asarray((model.blocks(state)[0] ** 2).mean(axis=1))


def _without_outliers(model: Model[S], state: S, good: NDArray[np.bool_]) -> Adjusted[S]:
    """Return the adjusted state after leaving out the blocks that do not fit."""
    n = len(good)
    while True:
        state = _least_squares(model, state, good.astype(float), MAX_ITERATIONS)
        r, J = model.blocks(state)
        used = np.flatnonzero(good)
        covariance, left_out = _statistics(r[used], J[used])
        statistic = np.einsum('ni,ni->n', r[used], left_out)
        factor = max(1.0, float(np.median(statistic) / chi2.median(r.shape[1])))
        probability = chi2.sf(statistic / factor, r.shape[1])
        worst = np.argsort(probability)[:max(1, n // BATCH)]
        worst = worst[probability[worst] < FALSE_ALARM / n]
        if not len(worst) or len(used) - len(worst) < model.minimum:
            freedom = max(r[used].size - J.shape[2], 1)
            variance = float((r[used] ** 2).sum() / freedom)
            return Adjusted(state, used, r, left_out, covariance * max(1.0, variance), variance)
        good = good.copy()
        good[used[worst]] = False


def _statistics(r: Array, J: Array) -> tuple[Array, Array]:
    """Return the covariance (u, u) and the residuals (n, k) of blocks left out one by one."""
    covariance = covariance_of(J.reshape(-1, J.shape[2]))
    H = J @ covariance @ np.swapaxes(J, 1, 2)
    left_out = np.linalg.solve((1 + 1e-9) * np.eye(r.shape[1]) - H, r[..., None])[..., 0]
    return covariance, np.asarray(left_out)


def _least_squares(model: Model[S], state: S, weights: Array, iterations: int) -> S:
    """Return the state with the least weighted squares (Levenberg-Marquardt)."""
    root = np.sqrt(weights)[:, None]
    damping = 1e-6
    r, J = model.blocks(state)
    for _ in range(iterations):
        flat, A = (r * root).ravel(), (J * root[..., None]).reshape(r.size, -1)
        cost, scale = float(flat @ flat), np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        N, g = (A / scale).T @ (A / scale), (A / scale).T @ flat
        for _attempt in range(MAX_DAMPINGS):
            step = -np.linalg.solve(N + damping * np.eye(len(N)), g) / scale
            moved = model.retract(state, step)
            r_moved, J_moved = model.blocks(moved)
            cost_moved = float(((r_moved * root) ** 2).sum())
            if cost_moved <= cost * (1 + ROUNDING):
                break
            damping *= 10
        else:
            return state
        state, r, J, damping = moved, r_moved, J_moved, max(damping / 10, 1e-15)
        # what is left is the rounding of the derivatives: more steps would lead nowhere
        if np.linalg.norm(A @ step) < CONVERGED * (1 + cost ** 0.5) or (
                cost_moved >= cost * (1 - ROUNDING)):
            break
    return state
