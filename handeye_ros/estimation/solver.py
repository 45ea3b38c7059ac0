"""
The one least squares of this package: Levenberg-Marquardt over blocks of residuals.

A block is what stands or falls together, and has one weight: a station, a point, a pair of poses.
Far from the truth blocks are weighted down by a graduated non-convexity (Yang et al. 2020,
RA-L 5:1127).
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

S = TypeVar('S')

MAX_ITERATIONS = 50
FIRST_DAMPING, DAMPING_FACTOR, MAX_DAMPINGS = 1e-4, 30.0, 8
CONVERGED = 1e-8  # step length in sigmas
ROUNDING = 1e-9  # of the sum of squares; residuals are differences of large numbers
STANDSTILL = 1e-14  # of the same: what is left is the rounding of the derivatives; least damping
BELIEVED_SHARE = 0.65  # of the blocks that a good answer must explain
SMALLEST_SCALE = 9.0  # squared residual, in variances, from which on a block loses weight
SCALE = 3.0  # the same, in squared residuals that the believed share stays below
WIDEST = 100.0  # first control, over the squared residual of the believed share
FEW_ITERATIONS, NEAR = 4, 1e-3  # of one round of weights; step length in sigmas that ends it

States: TypeAlias = tuple[NDArray[Any], ...]
White: TypeAlias = Callable[[Array], Array]
"""A linear map of (m, ...) values to such of unit covariance."""
Attempt: TypeAlias = tuple[States, Array, Callable[[], tuple[Array, Array]]]
"""Moved states, their sums of squares (k,), and what gives residuals and derivatives there."""


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
    white: White = as_they_are

    def linear(rows: Rows) -> tuple[Array, Array]:
        nonlocal white
        white = rows.white()
        return (white(rows.residuals) * root)[None], (white(rows.jacobian()) * root[:, None])[None]

    def attempt(states: States, steps: Array) -> Attempt:
        moved = np.empty(1, dtype=object)
        moved[0] = system.retract(states[0][0], steps[0])
        rows = system.rows(moved[0])
        after = ((white(rows.residuals) * root) ** 2).sum()
        return (moved,), np.array([after]), lambda: linear(rows)

    first = np.empty(1, dtype=object)
    first[0] = start
    (ends,), _ = _descent((first,), linear(system.rows(start)), attempt, iterations, converged)
    found: S = ends[0]
    return found


def reweighted(system: System[S], state: S, weights: Array) -> S:
    """Return the state some steps nearer to the least squares with weights (n,) of the blocks."""
    return least_squares(system, state, weights, FEW_ITERATIONS, NEAR)


def many_least_squares(linear: Callable[[States], tuple[Array, Array]],
                       retract: Callable[[States, Array], States], starts: States,
                       iterations: int, converged: float) -> tuple[States, Array]:
    """
    Return where k starts lead, each by itself, and their sums of squares (k,).

    starts: arrays (k, ...); linear(states): residuals (k, m) and their derivatives (k, m, u);
    retract(states, steps (k, u)): the moved states; converged: see least_squares.
    """
    def attempt(states: States, steps: Array) -> Attempt:
        moved = retract(states, steps)
        at = linear(moved)
        return moved, np.einsum('km,km->k', at[0], at[0]), lambda: at
    return _descent(starts, linear(starts), attempt, iterations, converged)


def _descent(starts: States, first: tuple[Array, Array],
             attempt: Callable[[States, Array], Attempt], iterations: int, converged: float
             ) -> tuple[States, Array]:
    """
    Return where damped steps lead from k starts, each by itself, and their sums of squares (k,).

    first: residuals (k, m) and their derivatives (k, m, u) there.
    """
    going, now = np.arange(len(starts[0])), [*starts, *first]
    ends, squares = [part.copy() for part in starts], np.empty(len(going))
    damping = np.full(len(going), FIRST_DAMPING)
    taken, refused = np.zeros((2, len(going)), dtype=int)
    while len(going):
        *states, r, J = now
        step = _damped_steps(J, r, damping)
        moved, after, linear = attempt(tuple(states), step)
        length = np.linalg.norm((J @ step[..., None])[..., 0], axis=1)
        before = np.einsum('km,km->k', r, r)
        tried = _judged(before, after, length, converged)
        damping = np.maximum(damping * tried.damping, STANDSTILL)
        taken, refused = taken + tried.better, np.where(tried.better, 0, refused + 1)
        left = ~tried.done & (taken < iterations) & (refused < MAX_DAMPINGS)
        if tried.better.any():
            at = linear() if left.any() else (r, J)
            now = _better_of(now, [*moved, *at], tried.better)
        if left.all():
            continue
        reached = [*now[:-2], np.where(tried.better, after, before)]
        for end, values in zip([*ends, squares], reached, strict=True):
            end[going[~left]] = values[~left]
        now = [values[left] for values in now]
        going, damping, taken, refused = (v[left] for v in (going, damping, taken, refused))
    return tuple(ends), squares


class _Judged(NamedTuple):
    """What becomes of steps: whether they are taken, and the last; factors of their damping."""

    better: NDArray[np.bool_]
    done: NDArray[np.bool_]
    damping: Array


def _judged(before: Array, after: Array, length: Array, converged: float) -> _Judged:
    """
    Return what becomes of steps, by the sums of squares before and after them.

    length: of the change of the residuals that they promised.
    """
    better = np.less_equal(after, np.multiply(before, 1 + ROUNDING))
    done = better & ((length < converged * (1 + np.sqrt(before)))
                     | np.greater_equal(after, np.multiply(before, 1 - STANDSTILL)))
    return _Judged(better, done, np.where(better, DAMPING_FACTOR ** -2, DAMPING_FACTOR))


def _damped_steps(J: Array, r: Array, damping: Array) -> Array:
    """
    Return the steps (..., u) of Levenberg and Marquardt, their damping relative to each column.

    J: (..., m, u), r: (..., m), damping: (...).
    """
    transposed, every = np.swapaxes(J, -1, -2), np.arange(J.shape[-1])
    A = transposed @ J
    scale = np.maximum(np.sqrt(A[..., every, every]), 1e-150)  # its square is a number, too
    A /= scale[..., None, :] * scale[..., None]
    A[..., every, every] += damping[..., None]
    step = np.linalg.solve(A, (transposed @ r[..., None]) / scale[..., None])[..., 0]
    return np.asarray(-step / scale)


def _better_of(now: list[NDArray[Any]], new: list[NDArray[Any]], better: NDArray[np.bool_]
               ) -> list[NDArray[Any]]:
    """Return arrays (k, ...) of states with the new ones where these are better (k,)."""
    if better.all():
        return new
    return [np.where(better.reshape(-1, *[1] * (values.ndim - 1)), part, values)
            for values, part in zip(now, new, strict=True)]


def graduated(start: S, squares: Callable[[S], Array], refit: Callable[[S, Array], S]) -> S:
    """
    Return the state that a start leads to while blocks that do not fit lose weight, (11).

    squares(state): (n,) mean squared whitened residuals of the blocks; refit(state, weights
    (n,)): the state some steps nearer to the least weighted squares.
    """
    state, now = start, squares(start)
    # of a start that explains most blocks, the few others have little say from the first step on
    control, before = min(float(now.max()), WIDEST * believed(now)), np.inf
    for _ in range(MAX_ITERATIONS):
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
