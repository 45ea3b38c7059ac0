# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The least squares of the estimators, over items of data.

An item is what is right or wrong as a whole: a station, a row of a table, a pair of poses. It has
one or several residuals (rows of the system) with one weight. Which items are outliers is decided
in outliers.py.

`LeastSquares.minimised` is Levenberg-Marquardt. In an inverse, a direction that the data do not
show keeps a large, finite variance.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from handeye_ros.data import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh, lapack
from scipy.special import chdtrc, chdtri

S = TypeVar('S')

ROUNDING_SHARE = 1e-9  # of the sum of squares; residuals are differences of large numbers
# factor of the damping after a refused step; its square divides it after a good one
DAMPING_FACTOR = 30.0

MAX_STD = 1e3  # of a direction without information (m or rad)
FREE_DIRECTION = 1e-13  # relative information, or variance, that is rounding
MIN_INFORMATION = 1e-280  # smallest information: its inverse is still a number

States: TypeAlias = tuple[NDArray[Any], ...]
Whitener: TypeAlias = Callable[[Array], Array]
"""A linear map of values (m, ...) to values of unit covariance."""


def identity(values: Array) -> Array:
    """Return values unchanged: they are white."""
    return values


@dataclass(frozen=True, eq=False)
class Evaluation:
    """
    Residuals (m,) of a state; the rest is computed on demand.

    jacobian(): derivatives (m, u) by a step of the state; whitener(): the map that whitens both,
    kept while steps are tried; by default both are white already.
    """

    residuals: Array
    jacobian: Callable[[], Array]
    whitener: Callable[[], Whitener] = lambda: identity


@dataclass(frozen=True, eq=False)
class LeastSquares(Generic[S]):
    """
    A least-squares problem: evaluate(state), and retract(state, step (u,)), the state after it.

    item: (m,) the number of each row's item, from 0, ascending.
    """

    evaluate: Callable[[S], Evaluation]
    retract: Callable[[S, Array], S]
    item: NDArray[np.intp]

    def minimised(self, start: S, weights: Array | None = None, iterations: int = 50,
                  tolerance: float = 1e-8) -> S:
        """
        Return the state with the least squared whitened residuals.

        weights: (n,) on the squared residuals of the items; tolerance: the iteration ends when a
        step changes the residuals by less than this (sigmas).
        """
        root_weights = np.ones(len(self.item)) if weights is None else np.sqrt(weights)[self.item]

        def whitened(evaluation: Evaluation) -> tuple[Whitener, Array, Array]:
            whiten = evaluation.whitener()
            return (whiten, whiten(evaluation.residuals) * root_weights,
                    whiten(evaluation.jacobian()) * root_weights[:, None])

        state, damping = start, 1e-4
        whiten, r, J = whitened(self.evaluate(start))
        for _ in range(iterations):
            step = _damped_steps(J, r, np.array(damping))
            moved = self.retract(state, step)
            evaluation = self.evaluate(moved)
            cost = r @ r
            cost_moved = float(((whiten(evaluation.residuals) * root_weights) ** 2).sum())
            if not cost_moved <= cost * (1 + ROUNDING_SHARE):  # larger, or nan
                damping *= DAMPING_FACTOR
                continue
            state = moved
            if (np.linalg.norm(J @ step) < tolerance * (1 + np.sqrt(cost))
                    or cost_moved >= cost * (1 - 1e-14)):  # only rounding of the derivatives left
                break
            damping = max(damping / DAMPING_FACTOR ** 2, 1e-14)
            whiten, r, J = whitened(evaluation)
        return state

    def few_weighted_steps(self, state: S, weights: Array) -> S:
        """Return the state after a few steps to the least squares, with weights (n,) of items."""
        return self.minimised(state, weights, iterations=4, tolerance=1e-3)


def many_least_squares(linear: Callable[[States], tuple[Array, Array]],
                       retract: Callable[[States, Array], States], starts: States,
                       iterations: int) -> tuple[States, Array]:
    """
    Return the states after some steps from k independent starts, and their sums of squares (k,).

    starts: arrays (k, ...) that together are k states; linear(states): residuals (k, m) and their
    derivatives (k, m, u); retract(states, steps (k, u)): the moved states. All step at once:
    one start after the other takes more than twice as long.
    """
    states, damping = starts, np.full(len(starts[0]), 1e-4)
    r, J = linear(states)
    for _ in range(iterations):
        moved = retract(states, _damped_steps(J, r, damping))
        r_moved, J_moved = linear(moved)
        better = (r_moved ** 2).sum(axis=1) <= (r ** 2).sum(axis=1) * (1 + ROUNDING_SHARE)
        damping = np.where(better, np.maximum(damping / DAMPING_FACTOR ** 2, 1e-14),
                           damping * DAMPING_FACTOR)
        *arrays, r, J = (np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                         for new, old in zip((*moved, r_moved, J_moved), (*states, r, J),
                                             strict=True))
        states = tuple(arrays)
    return states, (r ** 2).sum(axis=1)


def _damped_steps(J: Array, r: Array, damping: Array) -> Array:
    """
    Return Levenberg-Marquardt steps (..., u), the damping relative to each column.

    J: (..., m, u), r: (..., m), damping: (...).
    """
    J_T, diagonal = np.swapaxes(J, -1, -2), np.arange(J.shape[-1])
    normal = J_T @ J
    # norms of the columns; the least is so small that its square is still a number
    norms = np.maximum(np.sqrt(normal[..., diagonal, diagonal]), 1e-150)
    normal /= norms[..., None, :] * norms[..., None]
    normal[..., diagonal, diagonal] += damping[..., None]
    step = np.linalg.solve(normal, (J_T @ r[..., None]) / norms[..., None])[..., 0]
    return np.asarray(-step / norms)


def rows_by_count(item: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """
    Return arrays (items, count) of rows, one for each count of rows per item.

    item: (m,) ascending.
    """
    _, first, count = np.unique(item, return_index=True, return_counts=True)
    return tuple(first[count == c, None] + np.arange(c) for c in np.unique(count))


def means_by(item: NDArray[np.intp], values: Array, n: int) -> Array:
    """Return the mean (n,) of the values (m,) of each item, 0 of one without any."""
    count = np.bincount(item, minlength=n)
    return np.asarray(np.bincount(item, values, minlength=n) / np.maximum(count, 1))


def rms_by(item: NDArray[np.intp], values: Array, n: int) -> Array:
    """Return the RMS (n,) of the values (m,) of each item, NaN of one without any."""
    has_any = np.bincount(item, minlength=n) > 0
    return np.sqrt(np.where(has_any, means_by(item, values ** 2, n), np.nan))


def covariance_from_jacobian(J: Array) -> Array:
    """Return the covariance (u, u) of the unknowns of a whitened J (m, u), sigmas bounded."""
    # of fewer rows than unknowns, only the full SVD of J has the free directions
    root = J if len(J) < J.shape[1] else np.linalg.qr(J, mode='r')
    _, values, axes = np.linalg.svd(root)
    values = np.pad(values, (0, len(axes) - len(values)))
    scaled = axes / np.maximum(values, 1 / MAX_STD)[:, None]
    return np.asarray(scaled.T @ scaled)


def covariance_from_information(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix, variances of free directions bounded."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), MIN_INFORMATION))
    scaled = information * scale * scale[:, None] + FREE_DIRECTION * np.eye(len(information))
    root, failed = lapack.dpotrf(scaled.T, lower=1)  # and zeros above it
    if failed:  # not positive but for rounding
        values, vectors = eigen(scaled)
        inverse = (vectors / np.maximum(values, FREE_DIRECTION)) @ vectors.T
    else:
        lower, _ = lapack.dpotri(root, lower=1, overwrite_c=1)
        inverse = lower + np.tril(lower, -1).T
    return np.asarray(inverse * scale * scale[:, None])


def eigen(A: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (n,), ascending, and eigenvectors (n, n) of a symmetric matrix."""
    try:
        values, vectors = np.linalg.eigh(A)
    except np.linalg.LinAlgError:  # divide and conquer (n > 25) with some kernels of OpenBLAS
        values, vectors = eigh(A, driver='ev')
    return values, vectors


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    # those of many points, which share the errors of six numbers, are singular but for this
    small = 1e-12 * np.einsum('nii->n', covariance)[:, None, None] * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + small)))


def chi2_isf(probability: ArrayLike, freedom: ArrayLike) -> Array:
    """
    Return the value that chi-squared exceeds with a probability.

    scipy.stats has it too, but takes longer to import than the rest of a command to start.
    """
    return np.asarray(chdtri(freedom, probability))


def chi2_sf(value: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the probability of chi-squared above a value; nan without degrees of freedom."""
    return np.where(np.asarray(freedom) > 0, chdtrc(freedom, value), np.nan)
