"""
Quantiles and tails of the chi-squared and the F distribution.

scipy.stats has them too, but it takes longer to import than the rest of a command to start, and
a hundred times as long for each value.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri, fdtri

Values = NDArray[np.float64]


def chi2_isf(chance: ArrayLike, freedom: ArrayLike) -> Values:
    """Return what chi-squared of so many degrees of freedom exceeds with that chance."""
    return np.asarray(chdtri(freedom, chance))


def chi2_sf(value: ArrayLike, freedom: ArrayLike) -> Values:
    """Return the chance that chi-squared exceeds a value; nan without a degree of freedom."""
    return np.where(np.asarray(freedom) > 0, chdtrc(freedom, value), np.nan)


def chi2_median(freedom: ArrayLike) -> Values:
    return chi2_isf(0.5, freedom)


def f_isf(chance: float, freedom: int, freedom_below: int) -> float:
    """Return what a ratio of variances of so many degrees of freedom exceeds with that chance."""
    # P(F(a, b) > x) = P(F(b, a) < 1 / x), which keeps the digits of a small chance
    return 1 / float(fdtri(freedom_below, freedom, chance))
