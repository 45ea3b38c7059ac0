"""
What blocks of whitened residuals say: each of them, and the others without it.

A block is what stands or falls together: a station, a point, a pair of poses.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.linalg import inverse
from handeye_ros.estimation.quantiles import chi2_median, chi2_sf
import numpy as np
from numpy.typing import NDArray

BATCH = 50  # one of so many blocks is dropped at a time
FALSE_ALARM = 1e-3  # of good data losing one block
REGULAR = 1e-9  # keeps what a block fixes alone from being divided by zero


def groups(block: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return arrays (blocks, count) of rows, one for each count of rows per block."""
    _, first, count = np.unique(block, return_index=True, return_counts=True)
    return tuple(first[count == c, None] + np.arange(c) for c in np.unique(count))


def leave_one_out(white: Array, jacobian: Array, covariance: Array, block: NDArray[np.intp]
                  ) -> Array:
    """
    Return residuals (m,), each against the answer without its block, to first order.

    white: (m,) against that of all blocks; jacobian: (m, u), covariance: (u, u).
    """
    left_out = np.empty_like(white)
    for rows in groups(block):
        J = jacobian[rows]
        left_out[rows] = leave_own_out(J @ covariance @ np.swapaxes(J, 1, 2), white[rows])
    return left_out


def leave_own_out(predicted_covariance: Array, white: Array) -> Array:
    """
    Return leave-one-out residuals (s, c) of blocks, to first order, (12).

    white: (s, c) against that of all; seen: (s, c, c) the covariance of what that explains.
    """
    regular = (1 + REGULAR) * np.eye(predicted_covariance.shape[1]) - predicted_covariance
    return np.asarray(np.linalg.solve(regular, white[..., None])[..., 0])


def step_without(white: Array, jacobian: Array, covariance: Array) -> Array:
    """
    Return by how much the unknowns (u,) differ without some rows, to first order.

    white: (m,) of these rows, jacobian: (m, u); covariance: (u, u) from all.
    """
    to_rows = jacobian @ covariance
    inside = (1 + REGULAR) * np.eye(len(white)) - to_rows @ jacobian.T
    return np.asarray(to_rows.T @ np.linalg.solve(inside, white))


def step_without_many(information: Array, lost: Array, gradient: Array) -> Array:
    """
    Return the same for many rows, of which only the sums are needed.

    information: (u, u) of all; lost: (u, u) that of these rows; gradient: (u,) of them.
    """
    return inverse(information - lost) @ gradient


def outliers(mean_squares: Array, freedom: NDArray[np.intp] | int, total: int, spare: int
             ) -> NDArray[np.intp]:
    """
    Return the blocks, worst first, that are to be dropped now: the others do not explain them.

    mean_squares: (n,) squared deleted residuals per degree of freedom; total: how many blocks
    there were at first; spare: how many there are beyond what is needed.
    """
    probability = chi2_sf(mean_squares * freedom, freedom)
    most = max(1, min(len(mean_squares) // BATCH, spare)) if spare > 0 else 0
    worst = np.argsort(probability, kind='stable')[:most]
    return np.asarray(worst[probability[worst] < FALSE_ALARM / total])


def shared_scale(mean_squares: Array, freedom: NDArray[np.intp] | int) -> float:
    """Return the variance factor that most blocks share, 1 where they fit as they should."""
    typical = chi2_median(freedom) / freedom
    return max(1.0, float(np.median(mean_squares / typical)))
