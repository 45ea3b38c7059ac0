# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What many stages compute: RMS, robust spread, an even choice, the circle nearest to points."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from handeye_ros.data import Array, Indices
import numpy as np

T = TypeVar('T')
SIGMA_OF_MEDIAN = 1.4826  # 1 sigma of a normal distribution over its median absolute deviation


def rms(values: Array) -> float:
    """Return the root mean square of values of any shape, in their unit."""
    return float(np.sqrt((values ** 2).mean()))


def robust_std(deviations: Array) -> float:
    """Return 1 sigma of normal deviations (n,), by their median size: outliers do not widen it."""
    return float(SIGMA_OF_MEDIAN * np.median(np.abs(deviations)))


def even_indices(n: int, most: int) -> Indices:
    """Return at most `most` indices of n items, evenly spaced from the first to the last."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(np.intp)


def evenly_spaced(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` of some items, evenly spaced from the first to the last."""
    return [items[i] for i in even_indices(len(items), most)]


def fit_round(points: Array) -> Array:
    """
    Return the centre and radius (d + 1,) of the circle or sphere nearest to points (n, d).

    Least squares of the squared distances (Kasa 1976, IEEE Trans. Instrum. Meas. 25:8).
    """
    design = np.column_stack([2.0 * points, np.ones(len(points))])
    fit = np.linalg.lstsq(design, np.sum(points ** 2, axis=1), rcond=None)[0]
    fit[-1] = np.sqrt(max(fit[-1] + fit[:-1] @ fit[:-1], 1e-12))
    return np.asarray(fit)
