# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The visible field of view, and the uncertainty of points mapped from it.

Its size, its causes, and what further samples would change.

With the nuisance parameters n and unknowns u of the conservative posterior, the part of a block b
in the covariance of u is C_ub C_bb^-1 C_bu: what would go if b were known.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
import math

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Sample
from handeye_ros.estimation.problem import Observations, Problem
from handeye_ros.estimation.solve import evaluated, Solution
import numpy as np

DIRECTIONS = 32  # of the tangents that bound the view
ROOM = 0.88  # share of the view for features: the rest is a margin for the operator
STEPS = 13  # points of the field of view along each side: fewer would be mostly its corners
# Beginnings of the names of blocks: what they are, and the setting of their prior.
CAUSES = (
    ('robot_', "the robot's accuracy as configured", 'noise.robot_smooth'),
    ('scale', "the scale of the robot's lengths as configured", 'noise.robot_scale'),
    ('distortion', "the sensor's linearity as configured", 'noise.distortion'),
    ('line_bend', 'how straight the laser line is as configured', 'noise.line_bend'),
    ('flatness', "the flatness of the target's faces as configured", 'noise.flatness'),
    ('setback', 'how far faces end before their edges', 'target.setback_std'),
    ('incidence', 'how far faces end before their edges', 'target.setback_std'),
    ('shape', 'the rounding of the edges', 'target.setback_std'),
)
SMALLEST = 0.5  # share of the variance: a smaller cause is not named


@dataclass(frozen=True, eq=False)
class View:
    """
    A convex part of the sensor plane: p with normals @ p <= offsets.

    normals: (d, 2) unit vectors; offsets: (d,); low, high: (2,) corners of the box around it.
    """

    normals: Array
    offsets: Array
    low: Array
    high: Array

    @property
    def size(self) -> Array:
        """Return width and depth, (2,)."""
        return np.asarray(self.high - self.low)

    def shrunk(self, border: float) -> View:
        """Return the view without a border (m), at least half of its width and depth."""
        border = min(border, float(self.size.min()) / 4)
        return View(self.normals, self.offsets - border, self.low + border, self.high - border)

    def inner(self) -> View:
        """Return the view with a margin for the operator."""
        middle = (self.low + self.high) / 2
        offsets = self.normals @ middle + ROOM * (self.offsets - self.normals @ middle)
        half = ROOM * self.size / 2
        return View(self.normals, offsets, middle - half, middle + half)

    def room(self, points: Array) -> Array:
        """Return the distance of points (..., 2) from the border, negative outside: (...)."""
        return np.asarray((self.offsets - points @ self.normals.T).min(axis=-1))


def seen_points(sample: Sample) -> Array:
    """Return points (n, 2) that span the features of a sample."""
    points: list[Array] = []
    for f in sample.features:
        if isinstance(f, FaceLine):
            reach = 3 ** 0.5 * f.spread * f.direction  # half its length, were it sampled evenly
            points += [f.centre - reach, f.centre + reach]
        elif isinstance(f, EdgePoint):
            points.append(f.point)
        elif isinstance(f, Arc):
            points += [*f.raw[[0, -1]], *f.points]
    return np.array(points).reshape(-1, 2)


def tangents() -> Array:
    """Return the outward normals (d, 2) of the borders of a view."""
    turn = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    return np.column_stack([np.cos(turn), np.sin(turn)])


def extremes(points: Array) -> Array:
    """Return the extreme ones of points (n, 2), which determine a view; NaN rows are ignored."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[np.unique((finite @ tangents().T).argmax(axis=0))] if len(finite) else finite


def learn_view(samples: Sequence[Sample], seen: Array | None = None) -> View:
    """
    Return the view that contains the features of samples and visible points (n, 2).

    There must be one sample, or one point, at least.
    """
    found = [seen_points(sample) for sample in samples]
    points = np.concatenate([*found, *([] if seen is None else [extremes(seen)])])
    normals = tangents()
    return View(normals, (points @ normals.T).max(axis=0), points.min(axis=0),
                points.max(axis=0))


@dataclass(frozen=True, eq=False)
class Mapping:
    """
    k points of the field of view, mapped by the transform.

    by_transform: (k, 3, 6) derivatives of the mapped points by a perturbation of the transform.
    """

    by_transform: Array

    def variance(self, covariance: Array) -> Array:
        """Return the mean squared error (...) (m^2) of the points for covariances (..., 6, 6)."""
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
    """Return the points of the field of view mapped by X (4, 4)."""
    share = np.linspace(0.0, 1.0, STEPS)
    x, z = np.meshgrid(*(view.low + share[:, None] * view.size).T)
    lever = np.column_stack([x.ravel(), z.ravel()]) @ X[:3, [0, 2]].T
    shift = np.tile(np.eye(3), (len(lever), 1, 1))
    return Mapping(np.concatenate([shift, -se3.skew(lever)], axis=2))


def with_rows(solution: Solution, rows: Array) -> Array:
    """
    Return covariances (n, 6, 6) of the transform, each after adding one of n sets of conditions.

    rows: (n, c, u) whitened derivatives of the c conditions of each set by the unknowns.
    """
    if not len(rows):
        return np.zeros((0, 6, 6))
    covariance = solution.reported
    # (N + A'A)^-1 = C - C A' (1 + A C A')^-1 A C inverts only a (c, c) matrix
    carried = rows @ covariance
    inner = carried @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1])
    X = carried[:, :, :6]
    return np.asarray(covariance[:6, :6] - np.swapaxes(X, 1, 2) @ np.linalg.solve(inner, X))


@dataclass(frozen=True)
class Cause:
    """The largest cause: in words, its key, and its share of the 1 sigma of mapped points (m)."""

    text: str
    key: str
    std: float


def largest_cause(solution: Solution, mapped: Mapping) -> Cause | None:
    """Return the largest nuisance if it causes most of the uncertainty, else None (noise)."""
    source = solution.conservative or solution
    C, first = source.covariance, source.unknowns
    rows: dict[tuple[str, str], list[int]] = {}
    for block in source.blocks:
        for name, text, key in CAUSES:
            if block.name.startswith(name):
                rows.setdefault((text, key), []).extend(range(first, first + block.count))
        first += block.count
    total = float(mapped.variance(C[:6, :6]))
    parts = {cause: float(mapped.variance(_explained(C, np.array(at)))) / total
             for cause, at in rows.items()}
    if not parts or max(parts.values()) < SMALLEST:
        return None
    (text, key), share = max(parts.items(), key=lambda item: item[1])
    return Cause(text, key, share ** 0.5 * mapped.std(solution.reported[:6, :6]))


def _explained(C: Array, at: Array) -> Array:
    across = C[:6][:, at]
    return np.asarray(across @ np.linalg.pinv(C[np.ix_(at, at)], hermitian=True) @ across.T)


def with_sample(solution: Solution, mapped: Mapping, one: Problem) -> float:
    """
    Return the reported 1 sigma of mapped points (m) expected after one more sample.

    one: the problem of the sample alone. All nuisance parameters are shared with the others.
    """
    source = solution.conservative or solution
    problem, noise = source.problem, source.noise
    before, after = (
        float(mapped.variance(evaluated(p, solution.estimate, noise).covariance[:6, :6]))
        for p in (problem, _extended(problem, one)))
    return mapped.std(solution.reported[:6, :6]) * math.sqrt(min(after / before, 1.0))


def _extended(problem: Problem, one: Problem) -> Problem:
    """Return a problem with the stations of another appended."""
    more = replace(one.observations, station=one.observations.station + len(problem.poses))
    both = Observations(*(np.concatenate([getattr(problem.observations, item.name),
                                          getattr(more, item.name)])
                          for item in fields(Observations)))
    return replace(problem, poses=np.concatenate([problem.poses, one.poses]), observations=both)
