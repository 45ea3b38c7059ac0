"""
The least squares of this package: Levenberg-Marquardt over blocks of residuals.

A block has one weight: a station, a point, a pair of poses. Blocks that do not fit are weighted
down by graduated non-convexity (Yang et al. 2020, RA-L 5:1127).
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any, Generic, NamedTuple, ParamSpec, TypeAlias, TypeVar

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

S = TypeVar('S')
T = TypeVar('T')
P = ParamSpec('P')

ROUNDING = 1e-9  # of the sum of squares; residuals are differences of large numbers
BELIEVED_SHARE = 0.65  # of the blocks that a good answer must explain

States: TypeAlias = tuple[NDArray[Any], ...]
White: TypeAlias = Callable[[Array], Array]
"""A linear map of values (m, ...) to values of unit covariance."""
Attempt: TypeAlias = tuple[States, Array, Callable[[], tuple[Array, Array]]]
"""Moved states, their sums of squares (k,), a function for residuals and derivatives there."""


def as_they_are(values: Array) -> Array:
    """Return values unchanged: they are white."""
    return values


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Residuals (m,) of a state; the rest is computed on demand.

    jacobian(): derivatives (m, u) by a step of the state; white(): the map that whitens both, kept
    while steps are tried; by default both are white already.
    """

    residuals: Array
    jacobian: Callable[[], Array]
    white: Callable[[], White] = lambda: as_they_are


@dataclass(frozen=True, eq=False)
class System(Generic[S]):
    """
    A least-squares problem: rows(state), and retract(state, step (u,)), the state after a step.

    block: (m,) the number of each row's block.
    """

    rows: Callable[[S], Rows]
    retract: Callable[[S, Array], S]
    block: NDArray[np.intp]

    def least_squares(self, start: S, weights: Array | None = None, iterations: int = 50,
                      converged: float = 1e-8) -> S:
        """
        Return the state with the least squared whitened residuals.

        weights: (n,) on the squared residuals of the blocks; converged: the iteration ends when a
        step changes the residuals by less than this (sigmas).
        """
        root = np.ones(len(self.block)) if weights is None else np.sqrt(weights)[self.block]
        white: White = as_they_are

        def linear(rows: Rows) -> tuple[Array, Array]:
            nonlocal white
            white = rows.white()
            r, J = white(rows.residuals) * root, white(rows.jacobian()) * root[:, None]
            return r[None], J[None]

        def attempt(states: States, steps: Array) -> Attempt:
            moved = np.empty(1, dtype=object)
            moved[0] = self.retract(states[0][0], steps[0])
            rows = self.rows(moved[0])
            after = ((white(rows.residuals) * root) ** 2).sum()
            return (moved,), np.array([after]), lambda: linear(rows)

        first = np.empty(1, dtype=object)
        first[0] = start
        (ends,), _ = _descent((first,), linear(self.rows(start)), attempt, iterations, converged)
        end: S = ends[0]
        return end

    def reweighted(self, state: S, weights: Array) -> S:
        """Return the state after a few steps towards the least squares with block weights (n,)."""
        return self.least_squares(state, weights, iterations=4, converged=1e-3)


def many_least_squares(linear: Callable[[States], tuple[Array, Array]],
                       retract: Callable[[States, Array], States], starts: States,
                       iterations: int, converged: float) -> tuple[States, Array]:
    """
    Return the least-squares states from k independent starts, and their sums of squares (k,).

    starts: arrays (k, ...); linear(states): residuals (k, m) and their derivatives (k, m, u);
    retract(states, steps (k, u)): the moved states; converged: see System.
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
    Return the states after damped steps from k independent starts, and their squares (k,).

    first: residuals (k, m) and their derivatives (k, m, u) there.
    """
    going, current = np.arange(len(starts[0])), [*starts, *first]
    ends, squares = [part.copy() for part in starts], np.empty(len(going))
    damping = np.full(len(going), 1e-4)
    taken, refused = np.zeros((2, len(going)), dtype=int)
    while len(going):
        *states, r, J = current
        step = _damped_steps(J, r, damping)
        moved, after, linear = attempt(tuple(states), step)
        length = np.linalg.norm((J @ step[..., None])[..., 0], axis=1)
        before = np.einsum('km,km->k', r, r)
        tried = _judged(before, after, length, converged)
        damping = np.maximum(damping * tried.damping, 1e-14)
        taken, refused = taken + tried.better, np.where(tried.better, 0, refused + 1)
        left = ~tried.done & (taken < iterations) & (refused < 8)
        if tried.better.any():
            at = linear() if left.any() else (r, J)
            current = _better_of(current, [*moved, *at], tried.better)
        if left.all():
            continue
        reached = [*current[:-2], np.where(tried.better, after, before)]
        for end, values in zip([*ends, squares], reached, strict=True):
            end[going[~left]] = values[~left]
        current = [values[left] for values in current]
        going, damping, taken, refused = (v[left] for v in (going, damping, taken, refused))
    return tuple(ends), squares


class _Judged(NamedTuple):
    """Outcome of k steps: accepted or not, last or not, and the factor of the damping."""

    better: NDArray[np.bool_]
    done: NDArray[np.bool_]
    damping: Array


def _judged(before: Array, after: Array, length: Array, converged: float) -> _Judged:
    """
    Return which steps are accepted, by the sums of squares (k,) before and after.

    length: (k,) of the change of the residuals that the linearisation predicts.
    """
    better = np.less_equal(after, np.multiply(before, 1 + ROUNDING))
    done = better & ((length < converged * (1 + np.sqrt(before)))
                     # what is left is the rounding of the derivatives
                     | np.greater_equal(after, np.multiply(before, 1 - 1e-14)))
    return _Judged(better, done, np.where(better, 30.0 ** -2, 30.0))


def _damped_steps(J: Array, r: Array, damping: Array) -> Array:
    """
    Return Levenberg-Marquardt steps (..., u), the damping relative to each column.

    J: (..., m, u), r: (..., m), damping: (...).
    """
    transposed, every = np.swapaxes(J, -1, -2), np.arange(J.shape[-1])
    A = transposed @ J
    scale = np.maximum(np.sqrt(A[..., every, every]), 1e-150)  # its square is a number, too
    A /= scale[..., None, :] * scale[..., None]
    A[..., every, every] += damping[..., None]
    step = np.linalg.solve(A, (transposed @ r[..., None]) / scale[..., None])[..., 0]
    return np.asarray(-step / scale)


def _better_of(old: list[NDArray[Any]], new: list[NDArray[Any]], better: NDArray[np.bool_]
               ) -> list[NDArray[Any]]:
    """Return old states (k, ...), replaced by the new ones where better (k,)."""
    if better.all():
        return new
    return [np.where(better.reshape(-1, *[1] * (values.ndim - 1)), part, values)
            for values, part in zip(old, new, strict=True)]


def graduated(start: S, squares: Callable[[S], Array], refit: Callable[[S, Array], S]) -> S:
    """
    Return the state that graduated non-convexity reaches from a start, (11).

    squares(state): (n,) mean squared whitened residuals of the blocks; refit(state, weights (n,)):
    the state after some steps of the weighted least squares.
    """
    state, current = start, squares(start)
    # where a start explains most blocks, the few others have little weight from the first step on
    control, before = min(float(current.max()), 100.0 * believed(current)), np.inf
    for _ in range(50):
        spread = believed(current)
        last = max(9.0, 3.0 * spread)  # of mu, a squared whitened residual: 3 sigma
        if control <= last and spread > 0.99 * before:
            break
        mu = max(control, last)
        state = refit(state, (mu / (mu + current)) ** 2)
        current, before, control = squares(state), spread, control / 2
    return state


def believed(squares: Array) -> float:
    """Return the BELIEVED_SHARE quantile of squared residuals."""
    return float(np.quantile(squares, BELIEVED_SHARE))


@cache
def _controller() -> Any:
    """Return the controller of the thread pools, None without threadpoolctl."""
    try:
        from threadpoolctl import ThreadpoolController
    except ModuleNotFoundError:
        return None
    return ThreadpoolController()


def single_threaded(function: Callable[P, T]) -> Callable[P, T]:
    """
    Return the function, run with one BLAS thread.

    A pool of threads makes products of small matrices several times slower. What the caller set
    is in force again afterwards.
    """
    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        controller = _controller()
        if controller is None:
            return function(*args, **kwargs)
        with controller.limit(limits=1):
            return function(*args, **kwargs)
    return limited
