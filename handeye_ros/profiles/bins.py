"""
Means of equal bins of points in a row, and how much they scatter.

Speckle is alike over some columns, and stays while the robot stands: the scatter of single
points, divided by the root of their number, says too little. So the means themselves are looked
at; their second differences do not see the smooth shape below.
"""
from __future__ import annotations

from functools import lru_cache
import math

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

KEPT = 1000  # numbers of points whose bins are remembered
FEWEST_BLOCKS = 6
SURELY_MORE = 1.7  # times the variance of white noise: what chance seldom makes


def mean_and_std(values: Array) -> tuple[float, float]:
    """Return mean and standard deviation of values (n,), as numpy does with more ado."""
    mean = float(np.add.reduce(values)) / len(values)
    away = values - mean
    return mean, math.sqrt(away @ away / len(values))


def bin_means(values: Array, bins: int) -> tuple[Array, NDArray[np.intp]]:
    """Return means, (k, ...), of equal bins of values (n, ...), and the sizes (k,) of these."""
    first, count = _bins(len(values), bins)
    total = np.add.reduceat(values, first)
    return total / (count if values.ndim == 1 else count[:, None]), count


@lru_cache(KEPT)
def _bins(size: int, bins: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where equal bins of so many values begin, and their sizes; not to be changed."""
    first = np.linspace(0, size, bins, endpoint=False).astype(int)
    count = np.diff(np.append(first, size))
    count.setflags(write=False)
    return first, count


def variance_of_bins(blocks: Array, white: float) -> float:
    """
    Return the variance of the means (k,) of neighbouring blocks of residuals.

    white: what it would be if the residuals were white noise; it holds unless the blocks surely
    scatter more.
    """
    if len(blocks) < FEWEST_BLOCKS:
        return white
    seen = _variance(blocks)
    if seen <= SURELY_MORE * white:
        return white
    # speckle that is wider than a block makes two neighbours alike
    pairs = blocks[:len(blocks) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return max(seen, 2 * _variance(pairs)) if len(pairs) >= FEWEST_BLOCKS else seen


def _variance(blocks: Array) -> float:
    second = blocks[:-2] - 2 * blocks[1:-1] + blocks[2:]
    return float(second @ second) / (6 * len(second))
