# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Starts of the targets: some stations, one piece of each profile, and a linear sweep."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.problem import Estimate, Observations, Problem
import numpy as np
from numpy.typing import NDArray

GUESS_STATIONS = 40  # more only take longer
SAME_SURFACE = 3e-4  # m: largest distance between pieces of one surface


def with_few_stations(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return the problem with at most GUESS_STATIONS stations, to search for a start."""
    return problem.subset(some_stations(len(problem.poses), GUESS_STATIONS, rng))


def nearest_piece(observations: Observations, piece: NDArray[np.intp], squares: Array
                  ) -> NDArray[np.bool_]:
    """
    Return which observations (m,) belong to the nearest piece of their station.

    piece: (m,) the piece of each observation; squares: (m,) its squared distance (m^2).
    """
    number, total = (sums_by_piece(observations, piece, values)
                     for values in (np.ones(len(piece)), squares))
    mean = np.divide(total, number, out=np.full(total.shape, np.inf), where=number > 0)
    away = np.sqrt(mean)
    near = away <= away.min(axis=1, keepdims=True) + SAME_SURFACE
    return np.asarray(near.argmax(axis=1)[observations.station] == piece)


def sums_by_piece(observations: Observations, piece: NDArray[np.intp], values: Array) -> Array:
    """Return the sums (stations, pieces) of values (m,) over the pieces of each station."""
    shape = int(observations.station.max()) + 1, int(piece.max()) + 1
    group = observations.station * shape[1] + piece
    return np.asarray(np.bincount(group, values, shape[0] * shape[1]).reshape(shape), float)


def with_one_piece(problem: Problem, piece: NDArray[np.intp],
                   choices: Iterable[tuple[Array, NDArray[np.bool_]]]) -> list[Problem]:
    """
    Return problems with one piece per station, one problem for each choice that differs.

    piece: (m,) the piece of each observation; choices: ranks (n, k) of the pieces at each station,
    of which the least is chosen, and which pieces (n, k) may be. Stations without one are dropped.
    """
    obs = problem.observations
    chosen = [np.where(able.any(axis=1), np.where(able, rank, np.inf).argmin(axis=1), -1)
              for rank, able in choices]
    return [replace(problem, observations=obs.select(each[obs.station] == piece)).subset(
        np.flatnonzero(each >= 0)) for each in {each.tobytes(): each for each in chosen}.values()]


def some_stations(count: int, most: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return at most `most` of count stations, ascending."""
    return np.sort(rng.permutation(count)[:most])


def hemisphere(count: int) -> Array:
    """Return unit vectors (count, 3), evenly distributed over half a sphere (Fibonacci)."""
    i = np.arange(count) + 0.5
    z, turn = i / count, i * np.pi * (3 - 5 ** 0.5)
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def frames_along(x: Array) -> Array:
    """Return rotations (k, 3, 3) with given unit vectors (k, 3) as x axes."""
    helper = np.where(np.abs(x[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    z = np.cross(x, helper)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def linear_candidates(problem: Problem, frames: Array, across: slice, count: int
                      ) -> list[Estimate]:
    """
    Return the best estimates of targets whose points lie at one place across given directions.

    frames: (k, 3, 3) rotations of the target that are tried; across: which of its axes W the
    points have a common coordinate along. Then W' (R (x r1 + z r3 + t) + a - c) = 0 is linear in
    r1, r3, t and c. Solutions with small residuals, and with r1 and r3 near orthonormal, come
    first.
    """
    obs, W = problem.observations, frames[:, :, across]
    R, a = problem.poses[obs.station, :3, :3], problem.poses[obs.station, :3, 3]
    middle = problem.poses[:, :3, 3].mean(axis=0)
    x, z = obs.points.T[:, :, None, None]
    # in the base: derivatives (m, 3, 9) of the points by r1, r3 and t, and what they must add to
    known = np.concatenate([x * R, z * R, R, (middle - a)[:, :, None]], axis=2)
    m, (k, _, q) = len(known), W.shape
    along = (np.swapaxes(W, 1, 2)[:, None] @ known).reshape(k, m * q, 10)
    A = np.concatenate([along[..., :9], np.tile(-np.eye(q), (k, m, 1))], axis=2)
    b = along[..., 9:]
    # least squares of each frame; what the points do not show, such as r3 of one height, is 0
    transposed = np.swapaxes(A, 1, 2)
    N = transposed @ A
    scale = np.sqrt(np.einsum('kii->ki', N))[..., None]
    scaled = N / scale / np.swapaxes(scale, 1, 2) + 1e-12 * np.eye(9 + q)
    solved = np.linalg.solve(scaled, transposed @ b / scale) / scale
    rms = np.sqrt(((A @ solved - b) ** 2).mean(axis=(1, 2)))
    r1, r3, c = solved[:, :3, 0], solved[:, 3:6, 0], solved[:, 9:]
    defect = (np.abs((r1 ** 2).sum(1) - 1) + np.abs((r3 ** 2).sum(1) - 1)
              + np.abs((r1 * r3).sum(1)))
    best = np.argsort(rms / 1e-3 + defect)[:count]
    T = se3.transform(frames[best], middle + (W[best] @ c[best])[..., 0])
    return [Estimate(*each) for each in zip(nearest_transform(solved[best, :, 0]),
                                            T.reshape(-1, 16), strict=True)]


def nearest_transform(x: Array) -> Array:
    """Return the transforms (..., 4, 4) nearest to r1, r3, t of linear solutions (..., 9+)."""
    U, _, Vt = np.linalg.svd(x[..., :6].reshape(*x.shape[:-1], 2, 3), full_matrices=False)
    r1, r3 = np.moveaxis(U @ Vt, -2, 0)
    return se3.transform(np.stack([r1, np.cross(r3, r1), r3], axis=-1), x[..., 6:9])
