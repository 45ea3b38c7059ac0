"""What an estimated target looks like: lines and balls for pictures, whatever the target."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np

EDGE = 0.1  # m of an edge that is drawn when its length is unknown
TURN = np.linspace(0, 2 * np.pi, 49)


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A target, in the frame that it rests in (metres).

    edges: polylines (n, 3), each a straight edge; outline: polylines (n, 3) of the rest; ball:
    the centre (3,) and radius of a sphere, where there is one.
    """

    edges: tuple[Array, ...] = ()
    outline: tuple[Array, ...] = ()
    ball: tuple[Array, float] | None = None


def shape(target: Mapping[str, Any], size: tuple[float, ...], near: Array) -> Shape:
    """
    Return the shape of a target as calibration.yaml describes it.

    size: of a plate (metres), empty if unknown; near: points (k, 3) that were seen of it, around
    which what has no end is drawn.
    """
    if 'centre' in target:
        centre = _xyz(target['centre'])
        return Shape(outline=_rings(centre, target['radius']), ball=(centre, target['radius']))
    if 'pose' in target:
        return _plate(target, size, near)
    if 'direction' in target and 'point' in target:
        return Shape(edges=(_along(_xyz(target['point']), np.array(target['direction']), near),))
    if 'normal' in target:
        return Shape(outline=(_square(np.array(target['normal']), target['distance'], near),))
    return Shape()


def _xyz(values: Mapping[str, float]) -> Array:
    return np.array([values[axis] for axis in 'xyz'], dtype=float)


def _plate(target: Mapping[str, Any], size: tuple[float, ...], near: Array) -> Shape:
    pose = target['pose']
    T = se3.from_quaternion(_xyz(pose['translation']),
                            np.array([pose['rotation'][axis] for axis in 'xyzw'], dtype=float))
    angle = target.get('edge_angle', np.pi / 2)
    local = se3.apply(se3.inverse(T), near) if len(near) else np.empty((0, 3))
    length, width = size or (_reach(local[:, 0]), _reach(local[:, 1]))
    p = np.array([length, 0.0, 0.0])
    q = width * np.array([np.cos(angle), np.sin(angle), 0.0])
    ends = se3.apply(T, np.array([np.zeros(3), p, q, p + q]))
    return Shape(edges=(ends[[0, 1]], ends[[0, 2]]), outline=(ends[[1, 3, 2]],))


def _reach(values: Array) -> float:
    return max(EDGE / 2, float(values.max())) if len(values) else EDGE


def _along(point: Array, direction: Array, near: Array) -> Array:
    """Return the ends (2, 3) of a line where it was seen."""
    along = (near - point) @ direction if len(near) else np.array([-EDGE / 2, EDGE / 2])
    return point + np.outer([along.min(), along.max()], direction)


def _square(normal: Array, distance: float, near: Array) -> Array:
    """Return the outline (5, 3) of the part of a plane that was seen."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.array([first, np.cross(normal, first)]) / np.linalg.norm(first)
    flat = near @ axes.T if len(near) else np.array([[-EDGE, -EDGE], [EDGE, EDGE]]) / 2
    (x0, y0), (x1, y1) = flat.min(axis=0), flat.max(axis=0)
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])
    return np.asarray(corners @ axes + normal * distance)


def _rings(centre: Array, radius: float) -> tuple[Array, ...]:
    """Return three great circles (49, 3) of a ball."""
    return tuple(centre + ring for ring in rings(np.eye(3) * radius))


def rings(axes: Array) -> tuple[Array, ...]:
    """Return the three ellipses (49, 3) of an ellipsoid with half axes in columns (3, 3)."""
    return tuple(np.outer(np.cos(TURN), axes[:, i]) + np.outer(np.sin(TURN), axes[:, j])
                 for i, j in ((0, 1), (1, 2), (2, 0)))


def half_axes(covariance: Array) -> Array:
    """Return the half axes of the 1 sigma ellipsoid of a covariance (3, 3), in columns."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def enlargement(largest: float, wanted: float) -> float:
    """Return by how much a length is enlarged to look about as long as wanted: 1, 2, 5, 10, ..."""
    if largest <= 0:
        return 1.0
    ratio = wanted / largest
    power = 10.0 ** np.floor(np.log10(ratio))
    return float(max(1.0, power * max(step for step in (1, 2, 5) if step * power <= ratio)))
