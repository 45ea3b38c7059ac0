# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The field of view: a convex part of the sensor plane, as samples and points show it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros.data import Array, has_return, Sample
from handeye_ros.estimation.basis import grid_over
import numpy as np

LEVERS_ALONG = 13  # points along each side of the view whose error is told
USED_VIEW_SHARE = 0.88  # share of the view for features: the rest is a margin for the operator

_ANGLES = np.arange(32) * 2 * np.pi / 32
BORDER_NORMALS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # outwards from the borders


@dataclass(frozen=True, eq=False)
class View:
    """A convex part of the sensor plane: points p (m) with BORDER_NORMALS @ p <= offsets (32,)."""

    offsets: Array

    @property
    def box(self) -> Array:
        """Return the smallest and the largest x and range, (2, 2)."""
        return np.array([-self.offsets[[16, 24]], self.offsets[[0, 8]]])

    @property
    def middle(self) -> Array:
        """Return the middle of the box around it, (2,)."""
        return np.asarray(self.box.mean(axis=0))

    @property
    def size(self) -> Array:
        """Return width and depth, (2,)."""
        return np.asarray(np.ptp(self.box, axis=0))

    def inner(self, border: float = 0.0) -> View:
        """Return the view with a margin for the operator, and without a border (m)."""
        from_middle = self.offsets - BORDER_NORMALS @ self.middle
        border = min(border, float(self.size.min()) / 4)
        return View(self.offsets - (1 - USED_VIEW_SHARE) * from_middle - border)

    def room(self, points: Array) -> Array:
        """Return the distances of points (..., 2) from the border, negative outside."""
        return np.asarray((self.offsets - points @ BORDER_NORMALS.T).min(axis=-1))


def extremes(points: Array) -> Array:
    """
    Return the points (k, 2) of (n, 2) that are farthest along BORDER_NORMALS, in order around.

    NaN rows are ignored.
    """
    finite = points[has_return(points)]
    farthest = (finite @ BORDER_NORMALS.T).argmax(axis=0).tolist() if len(finite) else []
    return finite[[*dict.fromkeys(farthest)]]


def learn_view(samples: Sequence[Sample], seen: Array | None = None) -> View:
    """
    Return the view that contains the features of samples and visible points (n, 2).

    There must be one sample, or one point, at least.
    """
    polylines = [feature.polyline for sample in samples for feature in sample.features]
    points = np.concatenate([*([] if seen is None else [seen]), *polylines])
    return View((extremes(points) @ BORDER_NORMALS.T).max(axis=0))


def view_levers(X: Array, view: View) -> Array:
    """Return the levers (k, 3) of a grid over the field of view, in the axes of the mount of X."""
    points = grid_over(view.box, np.linspace(-1, 1, LEVERS_ALONG))
    return np.asarray(points @ X[:3, [0, 2]].T)
