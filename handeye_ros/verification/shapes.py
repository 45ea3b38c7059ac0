"""The shapes that routines fit, each by the distances of points from it."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.verification.routine import BAGS, Nominal, Shape
import numpy as np
from numpy.typing import NDArray

Kinds = NDArray[np.intp]


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
