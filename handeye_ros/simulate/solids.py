# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Solids for ray casting: polyhedra, balls, rods, and plates with their defects."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import TypeAlias

from handeye_ros.data import Array
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Crossings: TypeAlias = tuple[Array, Array, Array]
"""Where rays enter and leave (inf, -inf: missed), and the cosine of incidence; (m, n) each."""


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """All points p with low (k,) <= normals (k, 3) @ p <= high (k,); normals of unit length."""

    normals: Array
    low: Array
    high: Array

    def crossings(self, origin: Array, direction: Array) -> Crossings:
        """Return the crossings of rays from origins along directions, both (3, m, n)."""
        length = np.sqrt((direction**2).sum(axis=0))
        shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
        enter, leave, cosine = np.full(shape, -np.inf), np.full(shape, np.inf), np.zeros(shape)
        for normal, low, high in zip(self.normals, self.low, self.high, strict=True):
            o, d = (np.einsum('i,imn->mn', normal, rays) for rays in (origin, direction))
            with np.errstate(divide='ignore', invalid='ignore'):
                a, b = (low - o) / d, (high - o) / d
            first = np.minimum(a, b)
            cosine = np.where(first > enter, np.abs(d) / length, cosine)
            enter, leave = np.fmax(enter, first), np.fmin(leave, np.maximum(a, b))
        return *_unless_missed(enter <= leave, enter, leave), cosine


def box(low: Sequence[float], high: Sequence[float]) -> Polyhedron:
    """Return a box along the axes, from low to high (3,) in metres."""
    return Polyhedron(np.eye(3), np.array(low), np.array(high))


@dataclass(frozen=True)
class Ball:
    """A ball around the origin."""

    radius: float

    def crossings(self, origin: Array, direction: Array) -> Crossings:
        """Return the crossings of rays from origins along directions, both (3, m, n)."""
        middle, half, square = _through_circle(origin, direction, self.radius)
        cosine = half * np.sqrt(square) / self.radius
        return *_unless_missed(half > 0, middle - half, middle + half), cosine


@dataclass(frozen=True)
class Rod:
    """A cylinder along axis 0 (x) or 1 (y) from start to end; centre: its other coordinates."""

    axis: int
    centre: tuple[float, float]
    radius: float
    start: float
    end: float

    def crossings(self, origin: Array, direction: Array) -> Crossings:
        """Return the crossings of rays from origins along directions, both (3, m, n)."""
        across = [axis for axis in range(3) if axis != self.axis]
        middle, half, square = _through_circle(
            origin[across] - np.reshape(self.centre, (2, 1, 1)), direction[across], self.radius)
        with np.errstate(divide='ignore', invalid='ignore'):
            a, b = ((end - origin[self.axis]) / direction[self.axis]
                    for end in (self.start, self.end))
        enter = np.fmax(middle - half, np.minimum(a, b))
        leave = np.fmin(middle + half, np.maximum(a, b))
        cosine = half * square / self.radius / np.sqrt((direction**2).sum(axis=0))
        return *_unless_missed((half > 0) & (enter < leave), enter, leave), cosine


Solid: TypeAlias = Polyhedron | Ball | Rod


def _through_circle(origin: Array, direction: Array, radius: float) -> tuple[Array, ...]:
    """
    Return the middle of the way of rays inside a circle or ball around the origin, and half of it.

    Both as parameters of the ray (m, n), half 0 for a miss; third the squared lengths of the
    directions. origin, direction: (2 or 3, m, n).
    """
    square = np.maximum((direction**2).sum(axis=0), 1e-300)
    middle = -(origin * direction).sum(axis=0) / square
    half_squared = middle**2 - ((origin**2).sum(axis=0) - radius**2) / square
    return middle, np.sqrt(np.maximum(half_squared, 0.0)), square


def _unless_missed(hit: NDArray[np.bool_], enter: Array, leave: Array) -> tuple[Array, Array]:
    """Return where rays enter and leave, (inf, -inf) for those that do not hit."""
    return np.where(hit, enter, np.inf), np.where(hit, leave, -np.inf)


def cast(solids: Sequence[Solid], origin: Array, direction: Array) -> tuple[Array, Array]:
    """
    Return the parameters (m, n) of the first points of rays on a solid, the cosines of incidence.

    origin, direction: (3, m, n). The parameter of a ray that meets none is inf, its cosine 0.
    """
    shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
    nearest, cosines = np.full(shape, np.inf), np.zeros(shape)
    for solid in solids:
        enter, _, cosine = solid.crossings(origin, direction)
        nearer = (enter > 0) & (enter < nearest)
        nearest = np.where(nearer, enter, nearest)
        cosines = np.where(nearer, cosine, cosines)
    return nearest, cosines


def hidden(solids: Sequence[Solid], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Return (m, n), true where a solid is between points and eye, both (3, m, n)."""
    covered = np.zeros(np.broadcast_shapes(points.shape, eye.shape)[1:], dtype=bool)
    for solid in solids:
        enter, leave, _ = solid.crossings(points, eye - points)
        covered |= (leave > 1e-6) & (enter < 1)
    return covered


def table_top(depth: float | None) -> tuple[Solid, ...]:
    """Return a table whose top is at z = -depth, or nothing."""
    return () if depth is None else (box((-1.0, -1.0, -depth - 0.05), (1.0, 1.0, -depth)),)


def slab(target: PlateTarget) -> tuple[Solid, ...]:
    """Return the solids of a flat plate; its edges are rounded, or else bevelled, as given."""
    (length, width), r, bottom = target.size, target.rounding, -target.thickness
    if r:
        return (box((r, r, bottom), (length - r, width - r, 0)),
                box((0, 0, bottom), (length, width, -r)),
                Rod(0, (r, -r), r, 0.0, length), Rod(0, (width - r, -r), r, 0.0, length),
                Rod(1, (r, -r), r, 0.0, width), Rod(1, (length - r, -r), r, 0.0, width))
    plain = box((0, 0, bottom), (length, width, 0))
    if not target.bevel:
        return (plain,)
    half = math.sqrt(0.5)
    chamfers = half * np.array([[-1, 0, 1], [1, 0, 1], [0, -1, 1], [0, 1, 1]])
    ends = half * (np.array([0, length, 0, width]) - target.bevel)
    return (Polyhedron(np.vstack([plain.normals, chamfers]),
                       np.append(plain.low, np.full(4, -np.inf)), np.append(plain.high, ends)),)


WAVE_COUNT = 12  # of a wavy face
WAVELENGTH = (0.015, 0.060)  # m


Relief: TypeAlias = Callable[[Array, Array], Array]
"""The height of a face over its nominal plane at positions; at its border for those outside."""


def relief(target: object, rng: Generator) -> Relief | None:
    """Return the bow and the waves of a plate, None for a flat one and for other targets."""
    if not isinstance(target, PlateTarget) or not (target.bow or target.waves):
        return None
    count = WAVE_COUNT if target.waves else 0
    shortest, longest = np.log(WAVELENGTH)
    wavelength = np.exp(rng.uniform(shortest, longest, count))
    turn = rng.uniform(0, np.pi, count)
    vectors = 2 * np.pi / wavelength[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    phases = rng.uniform(0, 2 * np.pi, count)
    amplitude = target.waves * math.sqrt(2 / max(count, 1))

    def height(x: Array, y: Array) -> Array:
        length, width = target.size
        x, y = np.clip(x, 0.0, length), np.clip(y, 0.0, width)
        u, v = 2 * x / length - 1, 2 * y / width - 1
        result = target.bow * (1 - (u * u + v * v) / 2)
        for (a, b), phase in zip(vectors, phases, strict=True):
            result = result + amplitude * np.sin(a * x + b * y + phase)
        return np.asarray(result)
    return height
