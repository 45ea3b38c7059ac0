"""What the stops of a verification saw, and the shapes that are fitted to it."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array
from handeye_ros.estimation.model import Observations
from handeye_ros.estimation.solver import Rows, System, White
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


def by_point(shape: Shape, p: Array, kind: Kinds, q: Array) -> Array:
    """Return the derivatives (m, 3) of the distances by the points p (m, 3)."""
    return np.stack([(shape.distance(p + d, kind, q) - shape.distance(p - d, kind, q))
                     / (2 * STEP) for d in STEP * np.eye(3)], axis=1)


def system_of(shape: Shape, p: Array, kind: Kinds,
              white: Callable[[Array], White] | None = None) -> System[Array]:
    """Return what the solver makes small: the distances of points p (m, 3) from a shape."""
    def rows(q: Array) -> Rows:
        own = Rows(shape.distance(p, kind, q),
                   lambda: derivatives(lambda at: shape.distance(p, kind, at), q))
        return replace(own, white=lambda: white(q)) if white else own

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
    """Start and distance of a Shape; normals (b, 3) and heights along them (b,) of unknowns."""

    start: Array
    distance: Callable[[Array, Kinds, Array], Array]
    normals: Callable[[Array], Array]
    heights: Callable[[Array], Array]


def planes(p: Array, kind: Kinds, of: Kinds) -> Planes:
    """
    Return a plane for each bag.

    p: (m, 3); of: (b,) of which set of parallel planes each bag is. The unknowns are two tilts of
    each set, and one height of each plane over the middle of its points.
    """
    bag, sets = kind // BAGS, int(of.max()) + 1
    middles = np.array([p[bag == k].mean(axis=0) for k in range(len(of))])
    centred = p - middles[bag]
    frames = np.array([np.linalg.svd(centred[of[bag] == k], full_matrices=False)[2].T
                       for k in range(sets)])
    for k in range(sets):  # upwards from the first of a set to the last
        reach = (middles[of == k] - middles[of == k][0]) @ frames[k][:, 2]
        frames[k][:, 2] *= np.sign(reach[np.argmax(np.abs(reach))] or 1.0)

    def normals(q: Array) -> Array:
        tilt = q[:2 * sets].reshape(sets, 2)
        n = frames[:, :, 2] + np.einsum('kij,kj->ki', frames[:, :, :2], tilt)
        return np.asarray((n / np.linalg.norm(n, axis=1)[:, None])[of])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        k = kind // BAGS
        return np.asarray(((p - middles[k]) * normals(q)[k]).sum(axis=1) - q[2 * sets + k])

    def heights(q: Array) -> Array:
        return np.asarray((middles * normals(q)).sum(axis=1) + q[2 * sets:])

    return Planes(np.zeros(2 * sets + len(of)), distance, normals, heights)


def parallel_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return blocks of parallel planes: heights over the first of each block."""
    bags = int((kind // BAGS).max()) + 1
    of = np.arange(bags) // (bags // (bags - len(nominal.lengths)))
    made = planes(p, kind, of)
    first = np.searchsorted(of, of)

    def values(q: Array) -> Array:
        height = made.heights(q)
        return np.asarray((height - height[first])[first < np.arange(bags)])

    return Shape(made.start, made.distance, values, tuple(nominal.lengths))


def free_planes(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return planes that do not depend on each other: of two, the angle between them."""
    of = np.arange(int((kind // BAGS).max()) + 1)
    made = planes(p, kind, of)

    def values(q: Array) -> Array:
        n = made.normals(q)
        return np.array([np.arctan2(np.linalg.norm(np.cross(n[0], n[1])), np.abs(n[0] @ n[1]))]
                        if len(of) == 2 else [])

    return Shape(made.start, made.distance, values, (np.pi / 2,) * (len(of) == 2))


def point(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
    """Return one point; kinds 0 to 2 are its distances along x, y and z."""
    middle = p.mean(axis=0)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(np.take_along_axis(p - middle - q, (kind % BAGS)[:, None], 1)[:, 0])

    known = tuple(nominal.reference) or (None, None, None)
    return Shape(np.zeros(3), distance, lambda q: np.asarray(middle + q), known)


def spheres(p: Array, kind: Kinds, nominal: VerifyConfig) -> Shape:
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
