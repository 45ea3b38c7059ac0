"""
What blocks of whitened residuals say: each of them, and the others without it.

A block is what stands or falls together: a station, a point, a pair of poses.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.algebra import inverse
from handeye_ros.estimation.chances import chance_of_chi2, chi2_median
import numpy as np
from numpy.typing import NDArray

BATCH = 50  # one of so many blocks is dropped at a time
FALSE_ALARM = 1e-3  # of good data losing one block
REGULAR = 1e-9  # keeps what a block fixes alone from being divided by zero


def groups(block: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return arrays (blocks, count) of rows, one for each count of rows per block."""
    _, first, count = np.unique(block, return_index=True, return_counts=True)
    return tuple(first[count == c, None] + np.arange(c) for c in np.unique(count))


def deleted(white: Array, jacobian: Array, covariance: Array, block: NDArray[np.intp]) -> Array:
    """
    Return residuals (m,), each against the answer without its block, to first order.

    white: (m,) against that of all blocks; jacobian: (m, u), covariance: (u, u).
    """
    left_out = np.empty_like(white)
    for rows in groups(block):
        J = jacobian[rows]
        H = J @ covariance @ np.swapaxes(J, 1, 2)
        regular = (1 + REGULAR) * np.eye(H.shape[1]) - H
        left_out[rows] = np.linalg.solve(regular, white[rows][..., None])[..., 0]
    return left_out


def step_without(white: Array, jacobian: Array, covariance: Array, information: Array,
                 out: NDArray[np.bool_]) -> Array:
    """
    Return by how much the unknowns (u,) differ without some rows, to first order.

    out: (m,) which; information: (u, u), the inverse of covariance.
    """
    J_out, r_out = jacobian[out], white[out]
    if len(r_out) < jacobian.shape[1]:
        to_out = J_out @ covariance
        inside = (1 + REGULAR) * np.eye(len(r_out)) - to_out @ J_out.T
        return np.asarray(to_out.T @ np.linalg.solve(inside, r_out))
    return inverse(information - J_out.T @ J_out) @ (J_out.T @ r_out)


def unexplained(mean_squares: Array, freedom: NDArray[np.intp] | int, total: int, spare: int
                ) -> NDArray[np.intp]:
    """
    Return the blocks, worst first, that are to be dropped now: the others do not explain them.

    mean_squares: (n,) squared deleted residuals per degree of freedom; total: how many blocks
    there were at first; spare: how many there are beyond what is needed.
    """
    probability = chance_of_chi2(mean_squares * freedom, freedom)
    most = max(1, min(len(mean_squares) // BATCH, spare)) if spare > 0 else 0
    worst = np.argsort(probability, kind='stable')[:most]
    return np.asarray(worst[probability[worst] < FALSE_ALARM / total])


def shared_scale(mean_squares: Array, freedom: NDArray[np.intp] | int) -> float:
    """Return the variance factor that most blocks share, 1 where they fit as they should."""
    typical = chi2_median(freedom) / freedom
    return max(1.0, float(np.median(mean_squares / typical)))
