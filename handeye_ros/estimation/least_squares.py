"""
The one least squares of this package: Levenberg-Marquardt over blocks of residuals.

A block is what stands or falls together, and has one weight: a station, a point, a pair of poses.
Far from the truth blocks are weighted down by a graduated non-convexity (Yang et al. 2020,
RA-L 5:1127).
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

S = TypeVar('S')

MAX_ITERATIONS = 50
FIRST_DAMPING, DAMPING_FACTOR, MAX_DAMPINGS = 1e-4, 30.0, 8
SMALLEST_DAMPING = 1e-15
CONVERGED = 1e-8  # step length in sigmas
ROUNDING = 1e-9  # of the sum of squares; residuals are differences of large numbers
STANDSTILL = 1e-14  # of the same: what is left is the rounding of the derivatives
BELIEVED_SHARE = 0.65  # of the blocks that a good answer must explain
SMALLEST_SCALE = 9.0  # squared residual, in variances, at which a block begins to be doubted
SCALE = 3.0  # the same, in squared residuals that the believed share stays below
MAX_ANNEALINGS, ANNEALING_STEPS = 40, 4
NEAR = 1e-3  # step length in sigmas that ends a round of annealing

States: TypeAlias = tuple[Array, ...]
White: TypeAlias = Callable[[Array], Array]
"""A linear map of (m, ...) values to such of unit covariance."""


def as_they_are(values: Array) -> Array:
    """Return values that are white."""
    return values


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Residuals (m,) of a state, and what is made of it when it is asked for.

    jacobian(): their derivatives (m, u) by a step; white(): the map that whitens both, kept while
    a step is looked for; without it both are white.
    """

    residuals: Array
    jacobian: Callable[[], Array]
    white: Callable[[], White] = lambda: as_they_are


@dataclass(frozen=True, eq=False)
class System(Generic[S]):
    """
    What is to be made small: rows(state), moved by retract(state, step (u,)).

    block: (m,) the number of each row's block.
    """

    rows: Callable[[S], Rows]
    retract: Callable[[S, Array], S]
    block: NDArray[np.intp]


def least_squares(system: System[S], start: S, weights: Array | None = None,
                  iterations: int = MAX_ITERATIONS, converged: float = CONVERGED) -> S:
    """
    Return the state with the least squared whitened residuals.

    weights: (n,) of the blocks' squared residuals; converged: a step that changes the residuals
    by less ends it.
    """
    root = np.ones(len(system.block)) if weights is None else np.sqrt(weights)[system.block]
    damping, state, rows = FIRST_DAMPING, start, system.rows(start)
    for _ in range(iterations):
        white = rows.white()
        r, J = white(rows.residuals) * root, white(rows.jacobian()) * root[:, None]
        cost = float(r @ r)
        for _attempt in range(MAX_DAMPINGS):
            step = _damped_steps(J, r, np.array(damping))
            moved = system.retract(state, step)
            moved_rows = system.rows(moved)
            after = float(((white(moved_rows.residuals) * root) ** 2).sum())
            if after <= cost * (1 + ROUNDING):
                break
            damping *= DAMPING_FACTOR
        else:
            return state
        state, rows = moved, moved_rows
        damping = max(damping / DAMPING_FACTOR ** 2, SMALLEST_DAMPING)
        if (np.linalg.norm(J @ step) < converged * (1.0 + cost ** 0.5)
                or after >= cost * (1 - STANDSTILL)):
            break
    return state


def _damped_steps(J: Array, r: Array, damping: Array) -> Array:
    """
    Return the steps (..., u) of Levenberg and Marquardt, their damping relative to each column.

    J: (..., m, u), r: (..., m), damping: (...).
    """
    scale = np.maximum(np.sqrt(np.einsum('...mi,...mi->...i', J, J)), 1e-300)
    scaled = J / scale[..., None, :]
    transposed = np.swapaxes(scaled, -1, -2)
    A, every = transposed @ scaled, np.arange(J.shape[-1])
    A[..., every, every] += damping[..., None]
    step = np.linalg.solve(A, transposed @ r[..., None])[..., 0]
    return np.asarray(-step / scale)


def many_least_squares(linear: Callable[[States], tuple[Array, Array]],
                       retract: Callable[[States, Array], States], starts: States,
                       iterations: int, converged: float) -> tuple[States, Array]:
    """
    Return where k starts lead, each by itself, and their sums of squares (k,).

    starts: arrays (k, ...); linear(states): residuals (k, m) and their derivatives (k, m, u);
    retract(states, steps (k, u)): the moved states; converged: see least_squares.
    """
    count, now = len(starts[0]), [part.copy() for part in (*starts, *linear(starts))]
    damping, taken = np.full(count, FIRST_DAMPING), np.zeros(count, dtype=int)
    refused, going = np.zeros(count, dtype=int), np.arange(count)
    while len(going):
        *states, r, J = (values[going] for values in now)
        step = _damped_steps(J, r, damping[going])
        moved = retract(tuple(states), step)
        new = [*moved, *linear(moved)]
        before, after = (np.einsum('km,km->k', e, e) for e in (r, new[-2]))
        better = after <= before * (1 + ROUNDING)
        for values, part in zip(now, new, strict=True):
            values[going[better]] = part[better]
        damping[going] *= np.where(better, DAMPING_FACTOR ** -2, DAMPING_FACTOR)
        damping = np.maximum(damping, SMALLEST_DAMPING)
        taken[going] += better
        refused[going] = np.where(better, 0, refused[going] + 1)
        length = np.linalg.norm(np.einsum('kmu,ku->km', J, step), axis=1)
        done = better & ((length < converged * (1 + before ** 0.5))
                         | (after >= before * (1 - STANDSTILL)))
        going = going[~done & (taken[going] < iterations) & (refused[going] < MAX_DAMPINGS)]
    *states, r, _ = now
    return tuple(states), np.einsum('km,km->k', r, r)


def graduated(start: S, squares: Callable[[S], Array], refit: Callable[[S, Array], S]) -> S:
    """
    Return the state that a start leads to while blocks that do not fit lose their say.

    squares(state): (n,) mean squared whitened residuals of the blocks; refit(state, weights
    (n,)): the state some steps nearer to the least weighted squares.
    """
    state, now = start, squares(start)
    control, before = float(now.max()), np.inf
    for _ in range(MAX_ANNEALINGS):
        spread = believed(now)
        scale = max(SMALLEST_SCALE, SCALE * spread)
        if control <= scale and spread > 0.99 * before:
            break
        width = max(control, scale)
        state = refit(state, (width / (width + now)) ** 2)
        now, before, control = squares(state), spread, control / 2
    return state


def believed(squares: Array) -> float:
    """Return the squared residual that the believed share of blocks stays below."""
    return float(np.quantile(squares, BELIEVED_SHARE))
