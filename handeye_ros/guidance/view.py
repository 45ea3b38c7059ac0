# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The visible field of view, and the uncertainty of points that the transform maps from it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array, Sample
from handeye_ros.results.scene import lines_and_spots
from handeye_ros.results.truth_file import field_points
import numpy as np

USED_VIEW_SHARE = 0.88  # share of the view for features: the rest is a margin for the operator

_ANGLES = np.arange(32) * 2 * np.pi / 32
BORDER_NORMALS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # outwards from the borders


@dataclass(frozen=True, eq=False)
class View:
    """A convex part of the sensor plane: points p (m) with BORDER_NORMALS @ p <= offsets (32,)."""

    offsets: Array

    @property
    def low(self) -> Array:
        """Return the smallest x and range, (2,)."""
        return np.asarray(-self.offsets[[16, 24]])

    @property
    def high(self) -> Array:
        """Return the largest x and range, (2,)."""
        return np.asarray(self.offsets[[0, 8]])

    @property
    def middle(self) -> Array:
        """Return the middle of the box around it, (2,)."""
        return (self.low + self.high) / 2

    @property
    def size(self) -> Array:
        """Return width and depth, (2,)."""
        return self.high - self.low

    def inner(self, border: float = 0.0) -> View:
        """Return the view with a margin for the operator, and without a border (m)."""
        from_middle = self.offsets - BORDER_NORMALS @ self.middle
        border = min(border, float(self.size.min()) / 4)
        return View(self.offsets - (1 - USED_VIEW_SHARE) * from_middle - border)

    def room(self, points: Array) -> Array:
        """Return the distances of points (..., 2) from the border, negative outside."""
        return np.asarray((self.offsets - points @ BORDER_NORMALS.T).min(axis=-1))


def extremes(points: Array) -> Array:
    """Return the extreme ones of points (n, 2), which determine a view; NaN rows are ignored."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[np.unique((finite @ BORDER_NORMALS.T).argmax(axis=0))] if len(finite) else finite


def learn_view(samples: Sequence[Sample], seen: Array | None = None) -> View:
    """
    Return the view that contains the features of samples and visible points (n, 2).

    There must be one sample, or one point, at least.
    """
    lines, spots = lines_and_spots(feature for sample in samples for feature in sample.features)
    points = [*lines, *spots, *([] if seen is None else [seen])]
    return View((extremes(np.concatenate(points)) @ BORDER_NORMALS.T).max(axis=0))


@dataclass(frozen=True, eq=False)
class MappedPoints:
    """
    k points of the field of view, mapped by the transform.

    wrt_transform: (k, 3, 6) their derivatives by a perturbation of the transform.
    """

    wrt_transform: Array

    def variance(self, covariance: Array) -> Array:
        """Return the mean squared errors (...) (m^2) of the points for covariances (..., 6, 6)."""
        G = self.wrt_transform.reshape(-1, 6)
        mean = G.T @ G / len(self.wrt_transform)
        return np.asarray(np.einsum('...ij,ij->...', covariance, mean))

    def std(self, covariance: Array) -> float:
        """Return the RMS error (m) of the points for a covariance (6, 6)."""
        return float(np.sqrt(self.variance(covariance)))

    def worst(self, covariance: Array) -> tuple[float, Array]:
        """Return the largest 1 sigma of any of the points (m), and its direction (3,)."""
        G = self.wrt_transform
        values, vectors = np.linalg.eigh(G @ covariance @ np.swapaxes(G, 1, 2))
        at = int(np.argmax(values[:, 2]))
        return float(np.sqrt(max(values[at, 2], 0.0))), vectors[at, :, 2]


def mapped_points(X: Array, view: View) -> MappedPoints:
    """Return a grid over the field of view, mapped by X (4, 4)."""
    points = field_points(*zip(view.low, view.high, strict=True))
    return MappedPoints(se3.wrt_perturbation(points @ X[:3, :3].T))
