# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the targets' starts share: few stations, one candidate of each profile, a grid of directions.

A candidate is a part of a profile that may be the target: a surface, a pair of faces, an end of a
face. At most one candidate of a profile is.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import means_by
from handeye_ros.estimation.problem import Estimate, Observations, Problem, UNUSED
from handeye_ros.estimation.search import distinct
import numpy as np
from numpy.typing import NDArray

START_STATIONS = 40  # more only take longer
SAME_SURFACE = 3e-4  # m: largest distance between candidates of one surface
FITTING_SHARE = 0.7  # of the stations that a start should fit
SIMILAR_RATIO = 2.0  # to the best start's distance: up to it the given order decides
TRIED_DIRECTIONS = 400  # for a line or the normal of a plane
TINY = 1e-30  # m^2
DEFECT_LENGTH = 1e-3  # m RMS: residuals that are as bad as r1 of length 0


def with_few_stations(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return the problem with at most START_STATIONS stations, to search for a start."""
    return problem.subset(random_indices(len(problem.poses), START_STATIONS, rng))


def random_indices(count: int, most: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return at most `most` of the indices below count, ascending."""
    return np.sort(rng.permutation(count)[:most])


def best_fitting_first(problem: Problem, rounds: Iterable[Sequence[Estimate]]
                       ) -> Iterator[Estimate]:
    """
    Yield the starts of each round, those that most stations of the problem fit before the others.

    Starts that repeat one of the round are left out.
    """
    for starts in rounds:
        distance = {k: _typical_distance(problem, starts[k])
                    for k in distinct(np.array([start.X for start in starts]))}
        limit = SIMILAR_RATIO * min(distance.values(), default=0.0)
        yield from (starts[k] for k in sorted(distance, key=lambda k: distance[k] > limit))


def _typical_distance(problem: Problem, estimate: Estimate) -> float:
    """Return the RMS distance (m) from the target within which most stations have a candidate."""
    p, target = problem.points_in_base(estimate.X), problem.target
    kind = target.reassign(problem.observations, p, estimate.state, problem.config).kind
    used, n = kind != UNUSED, len(problem.poses)
    squares = target.conditions(p[used], kind[used], estimate.state, problem.config).g ** 2
    station = problem.observations.station[used]
    return float(np.quantile(means_by(station, squares, n), FITTING_SHARE) ** 0.5)


def with_one_candidate(problem: Problem, candidate: NDArray[np.intp], choices: Iterable[Array]
                       ) -> list[Problem]:
    """
    Return problems with one candidate per station, one problem for each choice that differs.

    candidate: (m,) that each observation belongs to; choices: ranks (n, k) of the candidates at
    each station, of which the least is chosen, NaN where it may not be. Stations without one are
    dropped, and problems with too few stations while others have more.
    """
    obs = problem.observations
    selections = dict[bytes, NDArray[np.intp]]()  # the candidate of each station, -1: none
    for ranks in choices:
        best = np.where(np.isnan(ranks), np.inf, ranks).argmin(axis=1)
        selection = np.where(np.isnan(ranks).all(axis=1), -1, best)
        selections[selection.tobytes()] = selection
    counts = [int((selection >= 0).sum()) for selection in selections.values()]
    enough = min(problem.target.min_samples, max(counts, default=0))
    return [replace(problem, observations=obs.select(
                selection[obs.station] == candidate)).subset(np.flatnonzero(selection >= 0))
            for selection, count in zip(selections.values(), counts, strict=True)
            if count >= enough]


def is_of_nearest_candidate(observations: Observations, candidate: NDArray[np.intp],
                            squares: Array) -> NDArray[np.bool_]:
    """
    Return which observations (m,) belong to the nearest candidate of their station.

    Of candidates about as near, it is the first. candidate: (m,) that each observation belongs to;
    squares: (m,) its squared distance (m^2).
    """
    count, total = (sums_by_part(observations, candidate, values)
                    for values in (np.ones(len(candidate)), squares))
    distance = np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.inf))
    near = distance <= distance.min(axis=1, keepdims=True) + SAME_SURFACE
    return np.asarray(near.argmax(axis=1)[observations.station] == candidate)


def sums_by_part(observations: Observations, part: NDArray[np.intp], values: Array) -> Array:
    """Return the sums (stations, parts) of values (m,) over the parts (m,) of each station."""
    shape = int(observations.station.max()) + 1, int(part.max()) + 1
    group = observations.station * shape[1] + part
    return np.asarray(np.bincount(group, values, shape[0] * shape[1]).reshape(shape), float)


def lines_of_parts(observations: Observations, part: NDArray[np.intp]
                   ) -> tuple[Array, Array, Array]:
    """Return middle x, middle z and slope of the line of each part (stations, parts), or NaN."""
    x, z = observations.points.T
    n, x, z, xx, xz = (sums_by_part(observations, part, values)
                       for values in (np.ones(len(x)), x, z, x * x, x * z))
    n[n == 0] = np.nan
    return x / n, z / n, (xz - x * z / n) / np.maximum(xx - x * x / n, TINY)


def frames_over_directions(count: int) -> Array:
    """Return rotations (count, 3, 3), their x axes evenly over half a sphere (Fibonacci)."""
    i = np.arange(count) + 0.5
    height, turn = i / count, i * np.pi * (3 - 5 ** 0.5)
    r = np.sqrt(1 - height * height)
    x = np.column_stack([r * np.cos(turn), r * np.sin(turn), height])
    helper = np.where(np.abs(x[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    z = np.cross(x, helper)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def linear_solutions(problem: Problem, axes: list[int], across: slice, count: int
                     ) -> list[Estimate]:
    """
    Return the count best linear solutions for a line or a plane, over all its directions.

    axes: the order of the axes of the target's frame, of which the first becomes the direction;
    across: the axes W of the frame along which all points of the target have the same
    coordinates c. With the columns r1, r3 and t of X, a point (x, z) seen from a pose (R, a) gives
    W' (R (x r1 + z r3 + t) + a) = c, which is linear in r1, r3, t and c. The best solutions have
    small residuals, and r1 and r3 that are nearly orthonormal.
    """
    frames = frames_over_directions(TRIED_DIRECTIONS)[:, :, axes]
    T, W = problem.poses[problem.observations.station], frames[:, :, across]
    R, a, middle = T[:, :3, :3], T[:, :3, 3], problem.poses[:, :3, 3].mean(axis=0)
    x, z = problem.observations.points.T[:, :, None, None]

    # for each frame the rows A (r1, r3, t, c) = b, with a relative to the middle of the poses
    wrt_X_and_b = np.concatenate([x * R, z * R, R, (middle - a)[:, :, None]], axis=2)
    m, (k, _, q) = len(wrt_X_and_b), W.shape
    along_W = (np.swapaxes(W, 1, 2)[:, None] @ wrt_X_and_b).reshape(k, m * q, 10)
    A = np.concatenate([along_W[..., :9], np.tile(-np.eye(q), (k, m, 1))], axis=2)
    b = along_W[..., 9:]

    # least squares of each; what the points do not show, such as r3 of one height, is 0
    transposed = np.swapaxes(A, 1, 2)
    covariance = np.linalg.pinv(transposed @ A, rcond=1e-12, hermitian=True)
    solved = covariance @ (transposed @ b)
    rms = np.sqrt(((A @ solved - b) ** 2).mean(axis=(1, 2)))
    r1, r3, t, c = np.split(solved[..., 0], [3, 6, 9], axis=1)
    defect = (np.abs((r1 ** 2).sum(1) - 1) + np.abs((r3 ** 2).sum(1) - 1)
              + np.abs((r1 * r3).sum(1)))
    best = np.argsort(rms / DEFECT_LENGTH + defect)[:count]

    # the nearest rotation of each, and the frame with its origin on the target
    U, _, Vt = np.linalg.svd(np.stack([r1, r3], axis=1)[best], full_matrices=False)
    r1, r3 = np.moveaxis(U @ Vt, 1, 0)
    X = se3.transform(np.stack([r1, np.cross(r3, r1), r3], axis=-1), t[best])
    origin = middle + (W[best] @ c[best, :, None])[..., 0]
    states = se3.transform(frames[best], origin).reshape(-1, 16)
    return [Estimate(*each) for each in zip(X, states, strict=True)]
