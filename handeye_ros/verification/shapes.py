"""What the stops of a verification saw, and the shapes that are fitted to it."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

from handeye_ros.data import Array
from handeye_ros.estimation.model import Observations
from handeye_ros.estimation.solver import as_they_are, Rows, System, White
import numpy as np
from numpy.typing import NDArray

BAGS = 10  # the kind of a condition is BAGS * the number of its bag + what it is of

STEP = 1e-7  # of numeric derivatives (m, rad)

Kinds = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Seen:
    """
    What the stations of one bag saw.

    poses: (n, 4, 4) of what carries the sensor in what carries the target; observations: points
    of the sensor plane with their noise, kind: what they are of. groups: (n,) which poses share
    their error, ascending; each has its own where there are none. stamps, bags: (n,) of the
    poses; surface: what was taken of several in sight, in words.
    """

    poses: Array
    observations: Observations
    groups: NDArray[np.intp] | None = None
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    bags: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    surface: str = ''

    def __post_init__(self) -> None:
        """Take poses without stamps or bags for those of one bag."""
        for name in ('stamps', 'bags'):
            if len(getattr(self, name)) < len(self.poses):
                object.__setattr__(self, name, np.zeros(len(self.poses), dtype=np.int64))

    def without(self, groups: Collection[int]) -> Seen:
        """Return what the other groups of poses saw."""
        obs = self.observations
        left = np.isin(groups_of(self)[obs.station], list(groups), invert=True)
        return replace(self, observations=obs.select(left)) if len(groups) else self


@dataclass(frozen=True)
class Nominal:
    """
    What is known of the artefact; metres.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; radius: of
    the spheres (0: unknown); reference: the touched point; aim: 1 sigma of how exactly the laser
    was put to the point; flank: horizontal way of a tooth's flank (0: unknown); std: 1 sigma of
    all these values, as the artefact's certificate states it.
    """

    lengths: tuple[float, ...] = ()
    radius: float = 0.0
    reference: tuple[float, ...] = ()
    aim: float = 0.0
    flank: float = 0.0
    std: float = 0.0


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A shape with k unknowns, fitted to points of the base.

    start: (k,); distance(points (m, 3), kind (m,), q (k,)): signed distances (m,) from it;
    values(q): what is read off it; nominals: the same as it should be, None where unknown.
    """

    start: Array
    distance: Callable[[Array, NDArray[np.intp], Array], Array]
    values: Callable[[Array], Array]
    nominals: tuple[float | None, ...]


def derivatives(function: Callable[[Array], Array], q: Array) -> Array:
    """Return central differences (m, k): the derivatives of a function at q (k,)."""
    return np.stack([(function(q + d) - function(q - d)) / (2 * STEP)
                     for d in STEP * np.eye(len(q))], axis=1)


def system_of(shape: Shape, p: Array, kind: Kinds,
              white: Callable[[Array], White] = lambda q: as_they_are) -> System[Array]:
    """Return what the solver makes small: the distances of points p (m, 3) from a shape."""
    def rows(q: Array) -> Rows:
        return Rows(shape.distance(p, kind, q),
                    lambda: derivatives(lambda at: shape.distance(p, kind, at), q),
                    lambda: white(q))

    return System(rows, np.add, np.zeros(len(p), dtype=np.intp))


def groups_of(seen: Seen) -> NDArray[np.intp]:
    """Return for each pose (n,) the group that shares its error."""
    return np.arange(len(seen.poses)) if seen.groups is None else seen.groups


def stacked(seen: Sequence[Seen]) -> Seen:
    """Return several bags as one, the number of the bag in the kind."""
    first = np.cumsum([0, *(len(s.poses) for s in seen)])
    groups = np.cumsum([0, *(1 + groups_of(s).max(initial=-1) for s in seen)])
    obs = [s.observations for s in seen]
    return Seen(np.concatenate([s.poses for s in seen]), Observations(
        np.concatenate([o.station + n for o, n in zip(obs, first[:-1], strict=True)]),
        np.concatenate([o.points for o in obs]),
        np.concatenate([o.kind + BAGS * k for k, o in enumerate(obs)]),
        np.concatenate([o.noise for o in obs]), np.concatenate([o.source for o in obs])),
        np.concatenate([groups_of(s) + n for s, n in zip(seen, groups[:-1], strict=True)]),
        np.concatenate([s.stamps for s in seen]),
        np.repeat(np.arange(len(seen)), [len(s.poses) for s in seen]),
        '; '.join(f'recording {k}: {s.surface}' for k, s in enumerate(seen, 1) if s.surface))


def line(p: Array, kind: Kinds, nominal: Nominal) -> Shape:
    """Return a straight line; kinds 0 and 1 are its two distances."""
    middle = p.mean(axis=0)
    frame = np.linalg.svd(p - middle)[2].T

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        local = (p - middle) @ frame
        away = local[:, 1:] - q[:2] - local[:, :1] * q[2:]
        return np.asarray(np.where(kind % BAGS == 0, away[:, 0], away[:, 1]))

    return Shape(np.zeros(4), distance, lambda q: np.empty(0), ())


def planes(p: Array, kind: Kinds, nominal: Nominal, parallel: bool) -> Shape:
    """
    Return one plane of each bag: parallel, with steps between them, or each its own.

    The values are the heights over the first plane, or the angle between two.
    """
    bag = kind // BAGS
    count = int(bag.max()) + 1
    middles = np.array([p[bag == k].mean(axis=0) for k in range(count)])
    centred = p - middles[bag]
    parts = [centred] * count if parallel else [centred[bag == k] for k in range(count)]
    frames = np.array([np.linalg.svd(part, full_matrices=False)[2].T for part in parts])
    if parallel:
        reach = (middles - middles[0]) @ frames[0][:, 2]
        frames[:, :, 2] *= np.sign(reach[np.argmax(np.abs(reach))] or 1.0)

    def normals(q: Array) -> Array:
        tilt = q[:2 * count].reshape(count, 2)
        tilt = np.repeat(tilt[:1], count, axis=0) if parallel else tilt
        n = frames[:, :, 2] + np.einsum('kij,kj->ki', frames[:, :, :2], tilt)
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])

    size = 2 if parallel else 2 * count

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        k = kind // BAGS
        n = normals(np.concatenate([q[:2], np.zeros(2 * count - 2)]) if parallel else q)
        return np.asarray(((p - middles[k]) * n[k]).sum(axis=1) - q[size + k])

    def values(q: Array) -> Array:
        if parallel:
            n = normals(np.concatenate([q[:2], np.zeros(2 * count - 2)]))[0]
            height = middles @ n + q[2:]
            return np.asarray(height[1:] - height[0])
        n = normals(q)
        return np.array([np.arctan2(np.linalg.norm(np.cross(n[0], n[1])), np.abs(n[0] @ n[1]))]
                        if count == 2 else [])

    told = nominal.lengths if parallel else (np.pi / 2,) * (count == 2)
    return Shape(np.zeros(size + count), distance, values, tuple(told))


def parallel_planes(p: Array, kind: Kinds, nominal: Nominal) -> Shape:
    """Return parallel planes."""
    return planes(p, kind, nominal, parallel=True)


def free_planes(p: Array, kind: Kinds, nominal: Nominal) -> Shape:
    """Return planes that do not depend on each other."""
    return planes(p, kind, nominal, parallel=False)


def point(p: Array, kind: Kinds, nominal: Nominal) -> Shape:
    """Return one point; kinds 0 to 2 are its distances along x, y and z."""
    middle = p.mean(axis=0)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(np.take_along_axis(p - middle - q, (kind % BAGS)[:, None], 1)[:, 0])

    known = tuple(nominal.reference) or (None, None, None)
    return Shape(np.zeros(3), distance, lambda q: np.asarray(middle + q), known)


def spheres(p: Array, kind: Kinds, nominal: Nominal) -> Shape:
    """Return one sphere of each bag; values: the radii, and the distance of two centres."""
    bag = kind // BAGS
    count = int(bag.max()) + 1
    start = np.concatenate([sphere_through(p[bag == k]) for k in range(count)])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        of = q.reshape(count, 4)[kind // BAGS]
        return np.asarray(np.linalg.norm(p - of[:, :3], axis=1) - of[:, 3])

    def values(q: Array) -> Array:
        of = q.reshape(count, 4)
        apart = np.linalg.norm(of[1:, :3] - of[:-1, :3], axis=1)
        return np.concatenate([of[:, 3], apart])

    known = (nominal.radius or None,) * count + tuple(nominal.lengths)
    return Shape(start, distance, values, known)


def sphere_through(p: Array) -> Array:
    """Return centre and radius (4,) with the least squared (|p - c|^2 - r^2) of points (n, 3)."""
    middle = p.mean(axis=0)
    centred = p - middle
    A = np.column_stack([2 * centred, np.ones(len(p))])
    x = np.linalg.lstsq(A, (centred ** 2).sum(axis=1), rcond=None)[0]
    return np.append(x[:3] + middle, np.sqrt(max(x[3] + x[:3] @ x[:3], 1e-12)))
