"""
The rounded or bevelled end of a plate: how it bends away from the face, and where its edge is.

The edge is where the planes of face and wall meet. A rounding of radius r that was seen down to a
depth d ends r - sqrt(2 r d - d^2) before it; a bevel of 45 degrees and legs r, which is seen
whole (d = r) or not at all (d = 0), ends as far before it as a rounding of that radius.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
import numpy as np

SMALLEST, LARGEST = 1e-5, 4e-3  # radius of a rounding (m)
SMALLEST_SLOPE = 0.3  # of a bevel
FEWEST = 2  # points behind where a bend begins
TINY = 1e-30  # of points that lie on each other


def reach(radius: float, depth: float) -> float:
    """Return how far outwards a rounding leads that is seen down to a depth."""
    depth = min(max(depth, 0.0), radius)
    return float(np.sqrt(depth * (2 * radius - depth)))


@dataclass(frozen=True)
class Bend:
    """
    The bend at the end of a face, as one profile shows it.

    depth: of its end (m); radius: of it, were it a rounding; roundness: logarithm of how much
    more likely it is one than a bevel.
    """

    depth: float
    radius: float
    roundness: float


def bend_of(u: Array, v: Array, end: float, noise: float) -> Bend:
    """
    Return the bend at an end of a face.

    u (n,): outwards along the face; v (n,): below it; noise: 1 sigma of these. Circles that leave
    the face line, and straight lines that do, from every point of it, as they are likely.
    """
    begin = np.concatenate([u[:-FEWEST], (u[:-FEWEST] + u[1:1 - FEWEST]) / 2])[:, None]
    a = np.maximum(u - begin, 0.0)
    q = np.where(a > 0, a * a + v * v, 0.0)
    curvature = np.maximum((q @ v) / np.maximum((q * q).sum(axis=1), TINY), 1 / (2 * LARGEST))
    slope = np.maximum((a @ v) / np.maximum((a * a).sum(axis=1), TINY), SMALLEST_SLOPE)
    out = np.maximum(end - begin[:, 0], 0.0)
    radius, bevel = 0.5 / curvature, np.maximum(slope * out, SMALLEST)
    depth = radius - np.sqrt(np.maximum(radius ** 2 - out ** 2, 0.0))
    misfit = np.array([_squares(v, curvature, q), _squares(v, slope, a)]) / noise ** 2
    # few points fit large radii as well as small ones
    weights = np.exp((misfit.min(axis=1, keepdims=True) - misfit) / 2) / [radius, bevel]
    total = weights.sum(axis=1)
    roundness = float(np.log(total[0] / total[1]) + (misfit[1].min() - misfit[0].min()) / 2)
    depths = (weights * [depth, bevel]).sum(axis=1) / total
    share = 1 / (1 + np.exp(-np.clip(roundness, -50.0, 50.0)))
    return Bend(float(depths @ [share, 1 - share]),
                float(np.exp(weights[0] @ np.log(radius) / total[0])), roundness)


def _squares(v: Array, factor: Array, shape: Array) -> Array:
    """Return the squared residuals (k,) of v (n,) against factors (k,) of shapes (k, n)."""
    return np.asarray(((v - factor[:, None] * shape) ** 2).sum(axis=1))
