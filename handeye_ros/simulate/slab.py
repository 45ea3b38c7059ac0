"""The plate as it really is: its edges rounded or bevelled, its face bowed or wavy."""
from __future__ import annotations

from dataclasses import dataclass
import math

from handeye_ros.data import Array
from handeye_ros.simulate.scenario import PlateTarget
from handeye_ros.simulate.solids import Box, Convex, Rod, Solid
import numpy as np

WAVES = 12  # that a wavy face is made of
WAVELENGTH = (0.015, 0.060)  # m


def slab(target: PlateTarget) -> tuple[Solid, ...]:
    """Return the solids that make up a flat plate, the edges of its face as they are."""
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
        """Return the height at places of the face, the nearest of it for others."""
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
