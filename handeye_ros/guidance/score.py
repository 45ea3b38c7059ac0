"""How well mapped points are known, and what further conditions would add."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.solution import Solution
from handeye_ros.guidance.view import View
import numpy as np

STEPS = 13  # points of the field of view along each side: fewer would be mostly its corners


@dataclass(frozen=True, eq=False)
class Mapping:
    """
    Points of the field of view as the transform carries them.

    by_transform: (k, 3, 6) their derivative by the transform's perturbation.
    """

    by_transform: Array

    def variance(self, covariance: Array) -> Array:
        """Return the mean squared error (...) of the points for covariances (..., 6, 6)."""
        G = self.by_transform
        M = np.einsum('kij,kil->jl', G, G) / len(G)
        return np.asarray(np.einsum('...ij,ij->...', covariance, M))

    def std(self, covariance: Array) -> float:
        """Return the RMS error of the points for a covariance (6, 6)."""
        return float(np.sqrt(self.variance(covariance)))

    def worst(self, covariance: Array) -> tuple[float, Array]:
        """Return the largest 1 sigma of any of the points (m), and its direction (3,)."""
        G = self.by_transform
        values, vectors = np.linalg.eigh(G @ covariance @ np.swapaxes(G, 1, 2))
        at = int(np.argmax(values[:, 2]))
        return float(np.sqrt(max(values[at, 2], 0.0))), vectors[at, :, 2]


def mapping(X: Array, view: View) -> Mapping:
    """Return how X (4, 4) carries the field of view."""
    share = np.linspace(0.0, 1.0, STEPS)
    x, z = np.meshgrid(*(view.low + share[:, None] * view.size).T)
    lever = np.column_stack([x.ravel(), z.ravel()]) @ X[:3, [0, 2]].T
    shift = np.tile(np.eye(3), (len(lever), 1, 1))
    return Mapping(np.concatenate([shift, -se3.skew(lever)], axis=2))


def with_rows(solution: Solution, rows: Array) -> Array:
    """
    Return the covariances (n, 6, 6) of the transform after n alternatives of more conditions.

    rows: (n, c, u) whitened derivatives by the unknowns.
    """
    if not len(rows):
        return np.zeros((0, 6, 6))
    covariance = solution.reported
    # (N + A'A)^-1 = C - C A' (1 + A C A')^-1 A C: of the size of the new conditions only
    carried = rows @ covariance
    inner = carried @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1])
    X = carried[:, :, :6]
    return np.asarray(covariance[:6, :6] - np.swapaxes(X, 1, 2) @ np.linalg.solve(inner, X))
