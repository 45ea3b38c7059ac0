# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Common to the targets: ends of faces, collecting observations, linear search for a start."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from handeye_ros import se3
from handeye_ros.data import Array, EdgePoint, FaceLine
from handeye_ros.estimation.problem import Estimate, Linear, Observations, Problem
import numpy as np
from numpy.typing import NDArray

ENDS = ('step', 'shadow', 'roof', 'gap', 'open')  # how a face ends; numbered from 1
NOWHERE = np.zeros(2)  # the outward direction at points that are no edges
FACE = 0  # the kind of a condition on a face, in every target that has them
SOURCES = 64  # per feature, at most
GUESS_STATIONS = 40  # more only take longer
SAME_SURFACE = 3e-4  # m: largest distance between pieces of one surface


def out_of_face(linear: Linear) -> Array:
    """Return derivatives (m,) of residuals by moves of edge points outwards from their faces."""
    outward = linear.problem.observations.outward
    return np.asarray((linear.by_point * outward).sum(axis=1))


@dataclass
class ObservationRows:
    """Collects the conditions of a target, feature by feature."""

    points: list[Array] = field(default_factory=list)
    noise: list[Array] = field(default_factory=list)
    numbers: list[tuple[int, int, int, int]] = field(default_factory=list)
    outward: list[Array] = field(default_factory=list)
    shape: list[float] = field(default_factory=list)

    def add(self, station: int, point: Array, kind: int, noise: Array, source: int,
            edge: EdgePoint | None = None) -> None:
        """Append one condition; see Observations. edge: the edge that the point is on, or None."""
        self.add_points(station, point[None], kind, noise[None], source, edge)

    def add_points(self, station: int, points: Array, kind: int, noise: Array, source: int = 0,
                   edge: EdgePoint | None = None) -> None:
        """Append a condition for each of points (k, 2), with factors (k, 2, 2)."""
        self.points.append(points)
        self.noise.append(noise)
        self.numbers.append((station, kind, source, 1 + ENDS.index(edge.kind) if edge else 0))
        self.outward.append(edge.direction if edge else NOWHERE)
        self.shape.append(edge.shape_std if edge else 0.0)

    def observations(self) -> Observations:
        """Return the observations collected; each point of a feature has its own error."""
        count = [len(points) for points in self.points]
        first = np.repeat(np.cumsum(count, dtype=np.intp) - count, count)
        numbers = np.array(self.numbers, dtype=np.intp).reshape(-1, 4).T
        station, kind, source, end = np.repeat(numbers, count, axis=1)
        return Observations(
            station, np.concatenate([np.empty((0, 2)), *self.points]), kind,
            np.concatenate([np.empty((0, 2, 2)), *self.noise]),
            source + np.arange(len(first)) - first, end,
            np.repeat(np.array(self.outward).reshape(-1, 2), count, axis=0),
            np.repeat(np.array(self.shape), count))


def add_face(rows: ObservationRows, station: int, line: FaceLine, source: int,
             kind: int = FACE) -> None:
    """Append the normal points of a face line, or two decorrelated points where it has none."""
    across = np.array([-line.direction[1], line.direction[0]])
    points, std = line.points, line.points_std
    if not len(points):
        points = line.centre + np.outer([-1.0, 1.0], line.spread * line.direction)
        std = np.full(2, line.std * 2 ** 0.5)
    noise = np.zeros((len(points), 2, 2))
    noise[:, :, 0] = std[:, None] * across
    rows.add_points(station, points, kind, noise, source)


def edge_noise(edge: EdgePoint) -> Array:
    """Return the factor (2, 2) of an edge point's covariance."""
    along = edge.direction
    across = np.array([-along[1], along[0]])
    return np.column_stack([along * edge.std, across * edge.std_across])


def some_of(problem: Problem, rng: np.random.Generator) -> Problem:
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
    z = se3.cross(x, helper)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, se3.cross(z, x), z], axis=2)


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
    u, v = obs.points.T[:, :, None, None]
    rows = np.concatenate([u * R, v * R, R, (middle - a)[:, :, None]], axis=2)
    # sums over the observations are formed once, then multiplied by the axes of each frame
    flat, q = rows.reshape(len(rows), -1), W.shape[2]
    squares = (flat.T @ flat).reshape(3, 10, 3, 10).swapaxes(1, 2).reshape(9, 100)
    own = (W @ np.swapaxes(W, 1, 2)).reshape(-1, 9) @ squares
    products = np.empty((len(W), 10 + q, 10 + q))
    unknown = np.append(np.arange(9), 9 + q)  # r1, r3, t, and the right-hand side
    products[:, unknown[:, None], unknown] = own.reshape(-1, 10, 10)
    mixed = -np.swapaxes(W, 1, 2) @ rows.sum(axis=0)
    products[:, 9:9 + q, unknown], products[:, unknown, 9:9 + q] = mixed, np.swapaxes(mixed, 1, 2)
    products[:, 9:9 + q, 9:9 + q] = len(rows) * np.eye(q)
    N, right = products[:, :-1, :-1], products[:, :-1, -1:]
    scale = np.sqrt(np.einsum('kii->ki', N))
    scaled = N / scale[:, None] / scale[..., None] + 1e-12 * np.eye(N.shape[1])
    x = np.linalg.solve(scaled, right / scale[..., None]) / scale[..., None]
    both = np.concatenate([x, np.full((len(x), 1, 1), -1.0)], axis=1)
    residual = (np.swapaxes(both, 1, 2) @ products @ both)[:, 0, 0]
    rms, x = np.sqrt(np.maximum(residual, 0.0) / (len(rows) * q)), x[..., 0]
    r1, r3 = x[:, :3], x[:, 3:6]
    defect = (np.abs((r1 ** 2).sum(1) - 1) + np.abs((r3 ** 2).sum(1) - 1)
              + np.abs((r1 * r3).sum(1)))
    best = np.argsort(rms / 1e-3 + defect)[:count]
    T = se3.transform(frames[best], middle + (W[best] @ x[best, 9:, None])[..., 0])
    return [Estimate(*each) for each in zip(nearest_transform(x[best]), T.reshape(-1, 16),
                                            strict=True)]


def nearest_transform(x: Array) -> Array:
    """Return the transforms (..., 4, 4) nearest to r1, r3, t of linear solutions (..., 9+)."""
    U, _, Vt = np.linalg.svd(x[..., :6].reshape(*x.shape[:-1], 2, 3), full_matrices=False)
    r1, r3 = np.moveaxis(U @ Vt, -2, 0)
    return se3.transform(np.stack([r1, se3.cross(r3, r1), r3], axis=-1), x[..., 6:9])


def xyz(point: Array) -> dict[str, float]:
    """Return a point (3,) as plain values."""
    return dict(zip('xyz', map(float, point), strict=True))
