"""
Leave-one-out residuals of blocks, (12) of estimator.md, and which blocks are outliers.

A block is a group of residuals that is used or dropped as a whole: a station, a point, a pair of
poses. `adjust` is the robust least squares for data other than profiles: blocks that do not fit
lose weight, then those that the others do not predict are dropped, worst first.

Variance components by restricted maximum likelihood (Patterson and Thompson 1971, Biometrika
58:545), in multiplicative fixed-point steps. A weak prior prevents zero variances from few
residuals.

Quantiles of chi-squared: scipy.stats has them too, but it takes longer to import than the rest of
a command to start.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import believed, graduated, ROUNDING, System
from handeye_ros.estimation.linalg import covariance_of, inverse_roots
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri

S = TypeVar('S')

GROSS = 64.0  # squared residual over the believed quantile (8 sigma): dropped at once
FALSE_ALARM = 1e-3  # probability that good data lose one block


def groups(block: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return arrays (blocks, count) of rows, one for each count of rows per block."""
    _, first, count = np.unique(block, return_index=True, return_counts=True)
    return tuple(first[count == c, None] + np.arange(c) for c in np.unique(count))


def leave_one_out(white: Array, jacobian: Array, covariance: Array, block: NDArray[np.intp]
                  ) -> Array:
    """
    Return leave-one-out residuals (m,), to first order: each from the fit without its block.

    white: (m,) of the fit to all blocks; jacobian: (m, u), covariance: (u, u) of this fit.
    """
    left_out = np.empty_like(white)
    for rows in groups(block):
        J = jacobian[rows]
        left_out[rows] = leave_own_out(J @ covariance @ np.swapaxes(J, 1, 2), white[rows])
    return left_out


def leave_own_out(predicted_covariance: Array, white: Array) -> Array:
    """
    Return leave-one-out residuals (s, c) of blocks, to first order, (12).

    predicted_covariance: (s, c, c) H_i; white: (s, c) the residuals e_i of the fit to all.
    """
    # avoids division by zero for what a block determines alone
    regular = (1 + ROUNDING) * np.eye(predicted_covariance.shape[1]) - predicted_covariance
    return np.asarray(np.linalg.solve(regular, white[..., None])[..., 0])


def outliers(mean_squares: Array, freedom: NDArray[np.intp] | int, total: int, spare: int
             ) -> NDArray[np.intp]:
    """
    Return the blocks to drop in this round, worst first, at most one in 50.

    mean_squares: (n,) squared leave-one-out residuals per degree of freedom; total: initial number
    of blocks; spare: number of blocks beyond those needed.
    """
    probability = chi2_sf(mean_squares * freedom, freedom)
    most = max(1, min(len(mean_squares) // 50, spare)) if spare > 0 else 0
    worst = np.argsort(probability, kind='stable')[:most]
    return np.asarray(worst[probability[worst] < FALSE_ALARM / total])


def shared_scale(mean_squares: Array, freedom: NDArray[np.intp] | int) -> float:
    """Return the variance factor common to most blocks, at least 1."""
    typical = chi2_isf(0.5, freedom) / freedom
    return max(1.0, float(np.median(mean_squares / typical)))


@dataclass(frozen=True, eq=False)
class Adjusted(Generic[S]):
    """
    Result of robust least squares over n blocks of k residuals.

    used: ascending indices of the used blocks; residuals (n, k): whitened, of all blocks; left_out
    (used, k): leave-one-out residuals of the used blocks, to first order; covariance: (u, u),
    multiplied by the variance factor if that exceeds 1.
    """

    state: S
    used: NDArray[np.intp]
    residuals: Array
    left_out: Array
    covariance: Array
    variance_factor: float


def adjust(system: System[S], start: S, minimum: int) -> Adjusted[S]:
    """
    Return the least-squares state without outliers, from a start near it.

    minimum: smallest number of blocks that remain; all have equally many rows.
    """
    n = int(system.block[-1]) + 1

    def squares(state: S) -> Array:
        rows = system.rows(state)
        return np.asarray((rows.white()(rows.residuals) ** 2).reshape(n, -1).mean(axis=1))

    state = graduated(start, squares, system.reweighted)
    current = squares(state)
    good = current <= GROSS * max(1.0, believed(current))
    return _without_outliers(system, state, good, minimum)


def _whitened(system: System[S], state: S) -> tuple[Array, Array]:
    """Return the residuals (m,) and their derivatives (m, u)."""
    rows = system.rows(state)
    white = rows.white()
    return white(rows.residuals), white(rows.jacobian())


def _without_outliers(system: System[S], state: S, good: NDArray[np.bool_], minimum: int
                      ) -> Adjusted[S]:
    """Return the least-squares state after dropping outliers."""
    while True:
        state = system.least_squares(state, good.astype(float))
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


def chi2_isf(probability: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the value that chi-squared exceeds with a probability."""
    return np.asarray(chdtri(freedom, probability))


def chi2_sf(value: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the probability of chi-squared above a value; nan without degrees of freedom."""
    return np.where(np.asarray(freedom) > 0, chdtrc(freedom, value), np.nan)


def variance_components(residuals: Array, jacobian: Array, parts: Array, start: Array) -> Array:
    """
    Return the variances (c,) of c causes of error.

    residuals: (n, k) of n independent blocks, at an adjusted state; jacobian: (n, k, u) their
    derivatives; parts: (c, n, k, k) covariances of the residuals for unit variance of each cause,
    whose sum is regular; start: (c,) initial variances, all positive.
    """
    variances = start
    for _ in range(30):
        whitener = inverse_roots(np.tensordot(variances, parts, 1))
        J, whitened = whitener @ jacobian, (whitener @ residuals[..., None])[..., 0]
        flat = J.reshape(-1, J.shape[2])
        unknowns = np.linalg.pinv(flat.T @ flat)
        r = whitened - J @ (unknowns @ (flat.T @ whitened.ravel()))
        W = (whitener @ parts @ np.swapaxes(whitener, 1, 2)) * variances[:, None, None, None]
        form = np.einsum('ni,cnij,nj->c', r, W, r, optimize=True)
        taken = np.einsum('nia,cnij,njb,ab->c', J, W, J, unknowns, optimize=True)
        expected = np.maximum(np.einsum('cnii->c', W) - taken, 0.0)
        # the prior counts for half a degree of freedom, about the start
        factors = (form + 0.5 * start / variances) / (expected + 0.5)
        variances = variances * factors
        if np.abs(np.log(factors)).max() < 1e-2:
            break
    return np.asarray(variances)


def first_variances(residuals: Array, parts: Array) -> Array:
    """
    Return start values (c,): half of the variance that each cause alone would need.

    residuals: (n, k), in threes of vectors (such as translation, rotation); some may be wrong.
    parts: as for variance_components.
    """
    n = len(residuals)
    lengths = np.linalg.norm(residuals.reshape(n, -1, 3), axis=2)
    predicted_covariance = np.median(lengths, axis=0) ** 2 / chi2_isf(0.5, 3)
    made = np.einsum('cnii->cni', parts).reshape(len(parts), n, -1, 3).mean(axis=(1, 3))
    alone = np.divide(predicted_covariance, made, out=np.full(made.shape, np.inf), where=made > 0)
    return np.asarray(np.maximum(alone.min(axis=1) / 2, 1e-24))
