# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Solids for ray casting: boxes, balls, rods, and plates with their defects."""
from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TypeAlias

from handeye_ros.data import Array
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Box:
    """A box along the axes, from low to high (metres)."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class Ball:
    """A ball around the origin."""

    radius: float


@dataclass(frozen=True, eq=False)
class Convex:
    """All points p with normals (k, 3) @ p <= offsets (k,); normals of unit length."""

    normals: Array
    offsets: Array


@dataclass(frozen=True)
class Rod:
    """A cylinder along axis 0 (x) or 1 (y) from start to end; centre: its other coordinates."""

    axis: int
    centre: tuple[float, float]
    radius: float
    start: float
    end: float


Solid: TypeAlias = Box | Ball | Convex | Rod


def table(depth: float | None) -> tuple[Solid, ...]:
    """Return a table whose top is at z = -depth, or nothing."""
    return () if depth is None else (Box((-1.0, -1.0, -depth - 0.05), (1.0, 1.0, -depth)),)


def crossings(solid: Solid, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
    """
    Return the parameters where rays enter and leave a solid, and the cosine of incidence, (m, n).

    origin, direction: (3, m, n), broadcast. The parameters are inf and -inf for missed solids.
    """
    if isinstance(solid, Box):
        return _box_crossings(solid, origin, direction)
    if isinstance(solid, Convex):
        return _convex_crossings(solid, origin, direction)
    if isinstance(solid, Rod):
        return _rod_crossings(solid, origin, direction)
    return _ball_crossings(solid, origin, direction)


def _box_crossings(box: Box, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
    shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
    enter, leave = np.full(shape, -np.inf), np.full(shape, np.inf)
    cosine = np.zeros(shape)
    length = np.sqrt((direction**2).sum(axis=0))
    for o, d, low, high in zip(origin, direction, box.low, box.high, strict=True):
        with np.errstate(divide='ignore', invalid='ignore'):
            a, b = (low - o) / d, (high - o) / d
        first = np.minimum(a, b)
        cosine = np.where(first > enter, np.abs(d) / length, cosine)
        enter, leave = np.fmax(enter, first), np.fmin(leave, np.maximum(a, b))
    missed = enter > leave
    return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave), cosine


def _ball_crossings(ball: Ball, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
    square = (direction**2).sum(axis=0)
    middle = -(origin * direction).sum(axis=0) / square
    room = middle**2 - ((origin**2).sum(axis=0) - ball.radius**2) / square
    half = np.sqrt(np.maximum(room, 0.0))
    cosine = half * np.sqrt(square) / ball.radius
    hit = room > 0
    return (np.where(hit, middle - half, np.inf), np.where(hit, middle + half, -np.inf), cosine)


def _convex_crossings(solid: Convex, origin: Array, direction: Array
                      ) -> tuple[Array, Array, Array]:
    shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
    enter, leave = np.full(shape, -np.inf), np.full(shape, np.inf)
    cosine = np.zeros(shape)
    length = np.sqrt((direction**2).sum(axis=0))
    for normal, offset in zip(solid.normals, solid.offsets, strict=True):
        rate = np.einsum('i,imn->mn', normal, direction)
        room = offset - np.einsum('i,imn->mn', normal, origin)
        with np.errstate(divide='ignore', invalid='ignore'):
            parameter = room / rate
        inwards = (rate < 0) & (parameter > enter)
        enter = np.where(inwards, parameter, enter)
        cosine = np.where(inwards, -rate / length, cosine)
        leave = np.where((rate > 0) & (parameter < leave), parameter, leave)
        leave = np.where((rate == 0) & (room < 0), -np.inf, leave)
    missed = enter > leave
    return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave), cosine


def _rod_crossings(rod: Rod, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
    axes = [axis for axis in range(3) if axis != rod.axis]
    d = direction[axes]
    o = origin[axes] - np.reshape(rod.centre, (2, 1, 1))
    square = np.maximum((d**2).sum(axis=0), 1e-300)
    middle = -(o * d).sum(axis=0) / square
    room = middle**2 - ((o**2).sum(axis=0) - rod.radius**2) / square
    half = np.sqrt(np.maximum(room, 0.0))
    with np.errstate(divide='ignore', invalid='ignore'):
        a, b = ((end - origin[rod.axis]) / direction[rod.axis] for end in (rod.start, rod.end))
    enter = np.fmax(middle - half, np.minimum(a, b))
    leave = np.fmin(middle + half, np.maximum(a, b))
    cosine = half * square / rod.radius / np.sqrt((direction**2).sum(axis=0))
    hit = (room > 0) & (enter < leave)
    return np.where(hit, enter, np.inf), np.where(hit, leave, -np.inf), cosine


def cast(solids: tuple[Solid, ...], origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the parameter of the first point on any solid (inf: none), and its incidence."""
    shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
    nearest, squareness = np.full(shape, np.inf), np.zeros(shape)
    for solid in solids:
        enter, _, cosine = crossings(solid, origin, direction)
        nearer = (enter > 0) & (enter < nearest)
        nearest = np.where(nearer, enter, nearest)
        squareness = np.where(nearer, cosine, squareness)
    return nearest, squareness


def hidden(solids: tuple[Solid, ...], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Return (m, n), true where a solid is between points and eye, both (3, m, n)."""
    covered = np.zeros(np.broadcast_shapes(points.shape, eye.shape)[1:], dtype=bool)
    for solid in solids:
        enter, leave, _ = crossings(solid, points, eye - points)
        covered |= (leave > 1e-6) & (enter < 1)
    return covered


WAVES = 12  # of a wavy face
WAVELENGTH = (0.015, 0.060)  # m


def slab(target: PlateTarget) -> tuple[Solid, ...]:
    """Return the solids of a flat plate, with the given shape of its edges."""
    (length, width), bottom = target.size, -target.thickness
    if target.rounding:
        return _rounded(target)
    if target.bevel:
        return (_bevelled(target),)
    return (Box((0, 0, bottom), (length, width, 0)),)


def _rounded(target: PlateTarget) -> tuple[Solid, ...]:
    (length, width), r, bottom = target.size, target.rounding, -target.thickness
    return (Box((r, r, bottom), (length - r, width - r, 0)),
            Box((0, 0, bottom), (length, width, -r)),
            Rod(0, (r, -r), r, 0.0, length), Rod(0, (width - r, -r), r, 0.0, length),
            Rod(1, (r, -r), r, 0.0, width), Rod(1, (length - r, -r), r, 0.0, width))


def _bevelled(target: PlateTarget) -> Convex:
    (length, width), half = target.size, math.sqrt(0.5)
    normals, offsets = [], []
    for axis, end in ((0, length), (1, width)):
        for sign, offset in ((-1.0, 0.0), (1.0, end)):
            normal = np.zeros(3)
            normal[axis] = sign
            normals += [normal, half * (normal + [0.0, 0.0, 1.0])]
            offsets += [offset, half * (offset - target.bevel)]
    normals += [np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])]
    return Convex(np.array(normals), np.array([*offsets, 0.0, target.thickness]))


@dataclass(frozen=True, eq=False)
class Relief:
    """
    The height of a face over its nominal plane: a bow, and waves.

    vectors (k, 2): of the waves (rad/m); phases: (k,); amplitude: of each wave (m).
    """

    target: PlateTarget
    vectors: Array
    phases: Array
    amplitude: float

    def heights(self, x: Array, y: Array) -> Array:
        """Return the height at positions on the face, at its border for those outside."""
        length, width = self.target.size
        x, y = np.clip(x, 0.0, length), np.clip(y, 0.0, width)
        u, v = 2 * x / length - 1, 2 * y / width - 1
        height = self.target.bow * (1 - (u * u + v * v) / 2)
        for (a, b), phase in zip(self.vectors, self.phases, strict=True):
            height = height + self.amplitude * np.sin(a * x + b * y + phase)
        return np.asarray(height)


def relief(target: object, rng: np.random.Generator) -> Relief | None:
    """Return the relief of a plate, None for a flat one and for other targets."""
    if not isinstance(target, PlateTarget) or not (target.bow or target.waves):
        return None
    count = WAVES if target.waves else 0
    shortest, longest = np.log(WAVELENGTH)
    length = np.exp(rng.uniform(shortest, longest, count))
    turn = rng.uniform(0, np.pi, count)
    vectors = 2 * np.pi / length[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    amplitude = target.waves * math.sqrt(2 / count) if count else 0.0
    return Relief(target, vectors, rng.uniform(0, 2 * np.pi, count), amplitude)
