# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Observations at the stops of a verification, and the shapes fitted to them."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import Rows, System, White
from handeye_ros.estimation.problem import Observations
import numpy as np
from numpy.typing import NDArray

BAGS = 10  # the kind of a condition is BAGS * the number of its bag + its kind in the bag

STEP = 1e-7  # of numeric derivatives (m, rad)

Kinds = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class StationSet:
    """
    Observations of the stations of one bag.

    poses: (n, 4, 4) of the mount of the sensor in that of the target; observations: points of the
    sensor plane with their noise and kind. groups: (n,) ascending; poses of one group share their
    error, None: each pose has its own. stamps, bags: (n,) of the poses; surface: the choice
    between several surfaces in sight, in words.
    """

    poses: Array
    observations: Observations
    groups: NDArray[np.intp] | None = None
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    bags: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    surface: str = ''

    def __post_init__(self) -> None:
        """Complete poses without stamps or bags as those of one bag."""
        for name in ('stamps', 'bags'):
            if len(getattr(self, name)) < len(self.poses):
                object.__setattr__(self, name, np.zeros(len(self.poses), dtype=np.int64))

    def without(self, groups: Collection[int]) -> StationSet:
        """Return the observations of the other groups of poses."""
        obs = self.observations
        others = np.isin(groups_of(self)[obs.station], list(groups), invert=True)
        return replace(self, observations=obs.select(others)) if len(groups) else self


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A shape with k unknowns, fitted to points in the base.

    start: (k,); distance(points (m, 3), kind (m,), q (k,)): signed distances (m,) from it;
    values(q): the measured quantities; nominals: their nominal values, None where unknown.
    """

    start: Array
    distance: Callable[[Array, NDArray[np.intp], Array], Array]
    values: Callable[[Array], Array]
    nominals: tuple[float | None, ...]


def derivatives(function: Callable[[Array], Array], q: Array) -> Array:
    """Return the central differences (m, k) of a function at q (k,)."""
    return np.stack([(function(q + d) - function(q - d)) / (2 * STEP)
                     for d in STEP * np.eye(len(q))], axis=1)


def by_point(shape: Shape, p: Array, kind: Kinds, q: Array) -> Array:
    """Return the derivatives (m, 3) of the distances by the points p (m, 3)."""
    return np.stack([(shape.distance(p + d, kind, q) - shape.distance(p - d, kind, q))
                     / (2 * STEP) for d in STEP * np.eye(3)], axis=1)


def system_of(shape: Shape, p: Array, kind: Kinds,
              white: Callable[[Array], White] | None = None) -> System[Array]:
    """Return the least-squares system of the distances of points p (m, 3) from a shape."""
    def rows(q: Array) -> Rows:
        residual_rows = Rows(shape.distance(p, kind, q),
                             lambda: derivatives(lambda point: shape.distance(p, kind, point), q))
        return replace(residual_rows, white=lambda: white(q)) if white else residual_rows

    return System(rows, np.add, np.zeros(len(p), dtype=np.intp))


def groups_of(stations: StationSet) -> NDArray[np.intp]:
    """Return for each pose (n,) the group with a common error."""
    return np.arange(len(stations.poses)) if stations.groups is None else stations.groups


def stacked(bags: Sequence[StationSet]) -> StationSet:
    """Return several bags as one; the kind contains the number of the bag."""
    first = np.cumsum([0, *(len(s.poses) for s in bags)])
    groups = np.cumsum([0, *(1 + groups_of(s).max(initial=-1) for s in bags)])
    obs = [s.observations for s in bags]
    return StationSet(np.concatenate([s.poses for s in bags]), Observations(
        np.concatenate([o.station + n for o, n in zip(obs, first[:-1], strict=True)]),
        np.concatenate([o.points for o in obs]),
        np.concatenate([o.kind + BAGS * k for k, o in enumerate(obs)]),
        np.concatenate([o.noise for o in obs]), np.concatenate([o.source for o in obs])),
        np.concatenate([groups_of(s) + n for s, n in zip(bags, groups[:-1], strict=True)]),
        np.concatenate([s.stamps for s in bags]),
        np.repeat(np.arange(len(bags)), [len(s.poses) for s in bags]),
        '; '.join(f'recording {k}: {s.surface}' for k, s in enumerate(bags, 1) if s.surface))


def line(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return a straight line; kinds 0 and 1 are its two distances."""
    middle = p.mean(axis=0)
    frame = np.linalg.svd(p - middle)[2].T

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        local = (p - middle) @ frame
        away = local[:, 1:] - q[:2] - local[:, :1] * q[2:]
        return np.asarray(np.where(kind % BAGS == 0, away[:, 0], away[:, 1]))

    return Shape(np.zeros(4), distance, lambda q: np.empty(0), ())


class Planes(NamedTuple):
    """Start and distances of a Shape; normals (b, 3) and heights along them (b,) from unknowns."""

    start: Array
    distance: Callable[[Array, Kinds, Array], Array]
    normals: Callable[[Array], Array]
    heights: Callable[[Array], Array]


def planes(p: Array, kind: Kinds, plane_set: Kinds) -> Planes:
    """
    Return a plane for each bag.

    p: (m, 3); plane_set: (b,) the set of parallel planes of each bag. The unknowns are two tilts
    of each set, and one height of each plane over the middle of its points.
    """
    bag, sets = kind // BAGS, int(plane_set.max()) + 1
    middles = np.array([p[bag == k].mean(axis=0) for k in range(len(plane_set))])
    centred = p - middles[bag]
    frames = np.array([np.linalg.svd(centred[plane_set[bag] == k], full_matrices=False)[2].T
                       for k in range(sets)])
    for k in range(sets):  # upwards from the first of a set to the last
        reach = (middles[plane_set == k] - middles[plane_set == k][0]) @ frames[k][:, 2]
        frames[k][:, 2] *= np.sign(reach[np.argmax(np.abs(reach))] or 1.0)

    def normals(q: Array) -> Array:
        tilt = q[:2 * sets].reshape(sets, 2)
        n = frames[:, :, 2] + np.einsum('kij,kj->ki', frames[:, :, :2], tilt)
        return np.asarray((n / np.linalg.norm(n, axis=1)[:, None])[plane_set])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        k = kind // BAGS
        return np.asarray(((p - middles[k]) * normals(q)[k]).sum(axis=1) - q[2 * sets + k])

    def heights(q: Array) -> Array:
        return np.asarray((middles * normals(q)).sum(axis=1) + q[2 * sets:])

    return Planes(np.zeros(2 * sets + len(plane_set)), distance, normals, heights)


def parallel_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return blocks of parallel planes: heights over the first of each block."""
    bags = int((kind // BAGS).max()) + 1
    block = np.arange(bags) // (bags // (bags - len(nominal.lengths)))
    fitted_planes = planes(p, kind, block)
    first = np.searchsorted(block, block)

    def values(q: Array) -> Array:
        height = fitted_planes.heights(q)
        return np.asarray((height - height[first])[first < np.arange(bags)])

    return Shape(fitted_planes.start, fitted_planes.distance, values, tuple(nominal.lengths))


def free_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return independent planes; of two, the angle between them is measured."""
    plane_set = np.arange(int((kind // BAGS).max()) + 1)
    fitted_planes = planes(p, kind, plane_set)

    def values(q: Array) -> Array:
        n = fitted_planes.normals(q)
        return np.array([np.arctan2(np.linalg.norm(np.cross(n[0], n[1])), np.abs(n[0] @ n[1]))]
                        if len(plane_set) == 2 else [])

    return Shape(fitted_planes.start, fitted_planes.distance, values,
                 (np.pi / 2,) * (len(plane_set) == 2))


def point(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return one point; kinds 0 to 2 are its distances along x, y and z."""
    middle = p.mean(axis=0)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(np.take_along_axis(p - middle - q, (kind % BAGS)[:, None], 1)[:, 0])

    nominals = tuple(nominal.reference) or (None, None, None)
    return Shape(np.zeros(3), distance, lambda q: np.asarray(middle + q), nominals)


def spheres(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return one sphere of each bag; values: the radii, and the distance of two centres."""
    bag = kind // BAGS
    count = int(bag.max()) + 1
    start = np.concatenate([sphere_through(p[bag == k]) for k in range(count)])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        balls = q.reshape(count, 4)[kind // BAGS]
        return np.asarray(np.linalg.norm(p - balls[:, :3], axis=1) - balls[:, 3])

    def values(q: Array) -> Array:
        balls = q.reshape(count, 4)
        spacings = np.linalg.norm(balls[1:, :3] - balls[:-1, :3], axis=1)
        return np.concatenate([balls[:, 3], spacings])

    nominals = (nominal.radius or None,) * count + tuple(nominal.lengths)
    return Shape(start, distance, values, nominals)


def sphere_through(p: Array) -> Array:
    """Return centre and radius (4,) of the algebraic sphere fit to points (n, 3)."""
    middle = p.mean(axis=0)
    centred = p - middle
    A = np.column_stack([2 * centred, np.ones(len(p))])
    x = np.linalg.lstsq(A, (centred ** 2).sum(axis=1), rcond=None)[0]
    return np.append(x[:3] + middle, np.sqrt(max(x[3] + x[:3] @ x[:3], 1e-12)))
