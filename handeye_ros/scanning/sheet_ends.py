"""
Where a sheet ends in a section, and how well the points show it.

For points spread evenly with density q up to an end e, each off by a Gaussian error of s, the
likelihood is largest where sum h((e - b) / s) / s = q, h = phi / Phi. Its bias to first order in
1 / q (Cox and Snell 1968), (1/2) int h' phi dx / (int h phi dx)^2 / q = -0.365 / q, is taken off.
Where the columns of neighbouring profiles lie at the same places across the seam, an end between
two of them is not seen any better in many profiles.
"""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import log_ndtr

FEWEST = 12  # points of a side of a section
SHORT = 0.365  # of 1 / q: what the likeliest end falls short by on average, of few points
INNER = 15.0  # spacings beside the seam up to which the distance of columns is measured
FREQUENCIES = np.linspace(0.5, 5.0, 226)  # of columns, in one spacing
IRREGULAR, REGULAR = 0.15, 0.35  # share of a period in random points at most; in columns at least


def sheet_through(b: Array, height: Array, margin: float, degree: int
                  ) -> tuple[Array, float] | None:
    """Return the polynomial through the sheet at b > margin, and the scatter about it."""
    kept: NDArray[np.bool_] = np.asarray(b > margin)
    if kept.sum() < FEWEST or np.ptp(b[kept]) < margin:
        return None
    sheet, noise = np.zeros(3), np.inf
    for cut in (np.inf, 3.0, 3.0):
        apart = np.abs(height - np.polyval(sheet, b))
        used = kept & (apart <= cut * noise)
        if used.sum() < FEWEST:
            return None
        sheet = np.polyfit(b[used], height[used], degree)
        noise = 1.4826 * float(np.median(np.abs(height[used] - np.polyval(sheet, b[used]))))
        noise = max(noise, 1e-6)
    return sheet, noise


def end_of(b: Array, noise: float, density: float) -> float:
    """Return the likeliest end of points b (n,) spread evenly below it; see the module."""
    def excess(end: float) -> float:
        scaled = (end - b) / noise
        ratio = np.exp(-0.5 * scaled ** 2 - log_ndtr(scaled)) / np.sqrt(2 * np.pi)
        return float(ratio.sum() / noise - density)

    last = float(b.max())
    low, high = last - 5 * noise, last + 5 * noise + 10 / max(density, 1.0)
    if excess(low) < 0 or excess(high) > 0:
        return last
    return float(brentq(excess, low, high, xtol=1e-8)) + SHORT / density


def column_resolution(b: Array, spacing: float, margin: float) -> float:
    """
    Return 1 sigma (m) of an end that lies anywhere between two columns.

    b: (n,) across the seam from its edge, of the points of many profiles (m); those within margin
    spacings are left out. If the columns follow the seam, their distance is a period of b; else an
    end lies at another place between columns in each profile.
    """
    inner = b[(b > margin * spacing) & (b < INNER * spacing)] / spacing
    if len(inner) < FEWEST:
        return 0.0
    periodic = np.abs(np.exp(2j * np.pi * np.outer(FREQUENCIES, inner)).mean(axis=1))
    first = int(np.argmax(periodic > 0.8 * periodic.max()))
    while first + 1 < len(periodic) and periodic[first + 1] > periodic[first]:
        first += 1
    share = np.clip((periodic[first] - IRREGULAR) / (REGULAR - IRREGULAR), 0.0, 1.0)
    return float(share * spacing / FREQUENCIES[first] / np.sqrt(12))
