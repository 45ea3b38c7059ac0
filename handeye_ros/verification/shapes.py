# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Observations at the stops of a verification, and the shapes fitted to them."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, fields, replace

from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array
from handeye_ros.estimation.problem import Observations
import numpy as np
from numpy.typing import NDArray

BAGS = 10  # the kind of a condition is BAGS * the number of its bag + its kind in the bag
STEP = 1e-7  # of numeric derivatives (m, rad)

Kinds = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class StationSet:
    """
    Observations of the stations of one bag, or of several.

    poses: (n, 4, 4) of the mount of the sensor in that of the target; observations: points of the
    sensor plane with their noise and kind. Of the poses (n,): groups, ascending: poses of one
    group share their error, by default each has its own; stamps; bags. surface: the choice
    between several surfaces in sight, in words.
    """

    poses: Array
    observations: Observations
    groups: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    bags: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    surface: str = ''

    def __post_init__(self) -> None:
        """Complete what is not given: each pose a group of its own, all of one bag."""
        n = len(self.poses)
        for name, default in (('groups', np.arange(n)), ('stamps', np.zeros(n, dtype=np.int64)),
                              ('bags', np.zeros(n, dtype=np.intp))):
            if len(getattr(self, name)) < n:
                object.__setattr__(self, name, default)

    @property
    def row_groups(self) -> NDArray[np.intp]:
        """Return the group (m,) of each observation."""
        return self.groups[self.observations.station]

    def points(self, X: Array) -> Array:
        """Return the observed points (m, 3) in the base; X: (4, 4) sensor plane in the mount."""
        return self.observations.in_base(self.poses, X)

    def without(self, groups: Collection[int]) -> StationSet:
        """Return the observations of the other groups of poses."""
        if not groups:
            return self
        others = np.isin(self.row_groups, list(groups), invert=True)
        return replace(self, observations=self.observations.select(others))


def stacked(bags: Sequence[StationSet]) -> StationSet:
    """Return several bags as one; the kind contains the number of the bag."""
    stations = groups = 0
    parts = []
    for k, bag in enumerate(bags):
        obs = bag.observations
        parts.append(replace(
            bag, groups=bag.groups + groups, bags=np.full(len(bag.poses), k),
            observations=replace(obs, station=obs.station + stations, kind=obs.kind + BAGS * k)))
        stations, groups = stations + len(bag.poses), groups + 1 + bag.groups.max(initial=-1)
    poses, group, stamps, bag_numbers = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ('poses', 'groups', 'stamps', 'bags'))
    observations = Observations(*(
        np.concatenate([getattr(part.observations, f.name) for part in parts])
        for f in fields(Observations)))
    return StationSet(poses, observations, group, stamps, bag_numbers, '; '.join(
        f'recording {k}: {bag.surface}' for k, bag in enumerate(bags, 1) if bag.surface))


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A shape with k unknowns, fitted to points in the base.

    start: (k,); distance(points (m, 3), kind (m,), q (k,)): signed distances (m,) from it;
    values(q): the measured quantities; nominals: their nominal values, None where unknown.
    """

    start: Array
    distance: Callable[[Array, Kinds, Array], Array]
    values: Callable[[Array], Array]
    nominals: tuple[float | None, ...]

    def by_unknowns(self, p: Array, kind: Kinds, q: Array) -> Array:
        """Return the derivatives (m, k) of the distances by the unknowns q (k,)."""
        return derivatives(lambda unknowns: self.distance(p, kind, unknowns), q)

    def by_point(self, p: Array, kind: Kinds, q: Array) -> Array:
        """Return the derivatives (m, 3) of the distances by the points p (m, 3)."""
        return derivatives(lambda shift: self.distance(p + shift, kind, q), np.zeros(3))


def derivatives(function: Callable[[Array], Array], q: Array) -> Array:
    """Return the central differences (m, k) of a function at q (k,)."""
    return np.stack([(function(q + d) - function(q - d)) / (2 * STEP)
                     for d in STEP * np.eye(len(q))], axis=1)


def line(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return a straight line; kinds 0 and 1 are its two distances."""
    middle = p.mean(axis=0)
    frame = np.linalg.svd(p - middle)[2].T

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        local = (p - middle) @ frame
        away = local[:, 1:] - q[:2] - local[:, :1] * q[2:]
        return np.asarray(np.where(kind % BAGS == 0, away[:, 0], away[:, 1]))

    return Shape(np.zeros(4), distance, lambda q: np.empty(0), ())


def point(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return one point; kinds 0 to 2 are its distances along x, y and z."""
    middle = p.mean(axis=0)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(np.take_along_axis(p - middle - q, (kind % BAGS)[:, None], 1)[:, 0])

    nominals = tuple(nominal.reference) or (None, None, None)
    return Shape(np.zeros(3), distance, lambda q: np.asarray(middle + q), nominals)


def free_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return independent planes; of two, the angle between them is measured."""
    count = int((kind // BAGS).max()) + 1
    start, distance, placed = _planes(p, kind, np.arange(count))

    def values(q: Array) -> Array:
        n, _ = placed(q)
        return np.array([np.arctan2(np.linalg.norm(np.cross(n[0], n[1])), np.abs(n[0] @ n[1]))]
                        if count == 2 else [])

    return Shape(start, distance, values, (np.pi / 2,) * (count == 2))


def parallel_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return blocks of parallel planes: heights over the first of each block."""
    bags = int((kind // BAGS).max()) + 1
    block = np.arange(bags) // (bags // (bags - len(nominal.lengths)))
    start, distance, placed = _planes(p, kind, block)
    first = np.searchsorted(block, block)

    def values(q: Array) -> Array:
        _, height = placed(q)
        return np.asarray((height - height[first])[first < np.arange(bags)])

    return Shape(start, distance, values, tuple(nominal.lengths))


def _planes(p: Array, kind: Kinds, plane_set: Kinds) -> tuple[
        Array, Callable[[Array, Kinds, Array], Array], Callable[[Array], tuple[Array, Array]]]:
    """
    Return start and distances of a plane for each bag, and its normals (b, 3) and heights (b,).

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

    def placed(q: Array) -> tuple[Array, Array]:
        n = normals(q)
        return n, (middles * n).sum(axis=1) + q[2 * sets:]

    return np.zeros(2 * sets + len(plane_set)), distance, placed


def spheres(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return one sphere of each bag; values: the radii, and the distances of the centres."""
    bag = kind // BAGS
    count = int(bag.max()) + 1
    start = np.concatenate([_sphere_through(p[bag == k]) for k in range(count)])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        balls = q.reshape(count, 4)[kind // BAGS]
        return np.asarray(np.linalg.norm(p - balls[:, :3], axis=1) - balls[:, 3])

    def values(q: Array) -> Array:
        balls = q.reshape(count, 4)
        spacings = np.linalg.norm(balls[1:, :3] - balls[:-1, :3], axis=1)
        return np.concatenate([balls[:, 3], spacings])

    nominals = (nominal.radius or None,) * count + tuple(nominal.lengths)
    return Shape(start, distance, values, nominals)


def _sphere_through(p: Array) -> Array:
    """Return centre and radius (4,) of the algebraic sphere fit to points (n, 3)."""
    middle = p.mean(axis=0)
    centred = p - middle
    A = np.column_stack([2 * centred, np.ones(len(p))])
    x = np.linalg.lstsq(A, (centred ** 2).sum(axis=1), rcond=None)[0]
    return np.append(x[:3] + middle, np.sqrt(max(x[3] + x[:3] @ x[:3], 1e-12)))
