"""Solids in the target frame, and where light meets them."""
from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from handeye_ros.data import Array
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


Solid: TypeAlias = Box | Ball


def table(depth: float | None) -> tuple[Solid, ...]:
    """Return a table whose top is at z = -depth, or nothing."""
    return () if depth is None else (Box((-1.0, -1.0, -depth - 0.05), (1.0, 1.0, -depth)),)


def crossings(solid: Solid, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
    """
    Return where rays enter and leave a solid, and how squarely they enter.

    origin, direction: (3, m, n), broadcast. Returns enter, leave, cosine (m, n): the parameters
    of the ray (inf, -inf: missed) and the cosine of the angle of incidence.
    """
    if isinstance(solid, Box):
        return _box_crossings(solid, origin, direction)
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


def cast(solids: tuple[Solid, ...], origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the parameter of the first point on any solid (inf: none), and its cosine."""
    shape = np.broadcast_shapes(origin.shape, direction.shape)[1:]
    nearest, squareness = np.full(shape, np.inf), np.zeros(shape)
    for solid in solids:
        enter, _, cosine = crossings(solid, origin, direction)
        nearer = (enter > 0) & (enter < nearest)
        nearest = np.where(nearer, enter, nearest)
        squareness = np.where(nearer, cosine, squareness)
    return nearest, squareness


def hidden(solids: tuple[Solid, ...], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Return (m, n), true where a solid stands between points and eye, both (3, m, n)."""
    covered = np.zeros(np.broadcast_shapes(points.shape, eye.shape)[1:], dtype=bool)
    for solid in solids:
        enter, leave, _ = crossings(solid, points, eye - points)
        covered |= (leave > 1e-6) & (enter < 1)
    return covered
