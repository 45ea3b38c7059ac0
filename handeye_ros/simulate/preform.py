"""
A curved preform with a seam, as a cloud, and the true seam.

The sheet is z = f(x, y), the seam y = g(x) in plan. In a lap seam the upper sheet lies on the
lower one where y > g(x); in a butt seam two sheets end on either side of a gap.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Preform:
    """
    What is scanned; metres. noise: 1 sigma of each axis.

    kind: lap or butt; thickness: height of the lap's step; gap: width of the butt's gap; bend,
    arch: radii along and across the seam; sway: how far the seam leaves a straight line.
    missing: share of its length (from, to) that was not scanned. seams: how many, side by side.
    """

    kind: str = 'lap'
    thickness: float = 5e-3
    gap: float = 3e-3
    length: float = 0.2
    width: float = 0.06
    spacing: float = 4e-4
    noise: float = 1e-4
    bend: float = 0.25
    arch: float = 0.15
    sway: float = 8e-3
    missing: tuple[float, float] = (0.0, 0.0)
    seams: int = 1


@dataclass(frozen=True, eq=False)
class PreformCloud:
    """Points (n, 3) in the base; centre (m, 3) of the seam and normals (m, 3) of the sheet."""

    points: Array
    centre: Array
    normals: Array


def preform_cloud(preform: Preform, rng: np.random.Generator) -> PreformCloud:
    """Return a cloud of a preform that lies somewhere before a robot, and its true seam."""
    counts = np.ceil([preform.length / preform.spacing, preform.width / preform.spacing])
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts.astype(int)), indexing='ij'), -1)
    place = (cells.reshape(-1, 2) + rng.random((cells.shape[0] * cells.shape[1], 2)))
    x, y = (place * preform.spacing - [preform.length / 2, preform.width / 2]).T
    missing = (np.array(preform.missing) - 0.5) * preform.length
    kept = ~((x > missing[0]) & (x < missing[1]))
    side = np.zeros(len(x))
    for offset in (np.arange(preform.seams) - (preform.seams - 1) / 2) * preform.width / 2:
        across = (y - offset - _seam(preform, x)) / np.hypot(1, _slope(preform, x))
        side += across > 0
        if preform.kind == 'butt':
            kept &= np.abs(across) > preform.gap / 2
    sheet = _sheet(preform, x, y)
    if preform.kind == 'lap':
        sheet = sheet + preform.thickness * side[:, None] * _normals(preform, x, y)
    T = se3.transform(
        Rotation.from_euler('xyz', rng.uniform([-0.5, -0.5, -3], [0.5, 0.5, 3])).as_matrix(),
        rng.uniform([0.5, -0.3, 0.1], [0.9, 0.3, 0.4]))
    points = sheet[kept] + preform.noise * rng.normal(size=(int(kept.sum()), 3))
    along = np.linspace(-0.5, 0.5, 2001) * preform.length
    line, normals = (make(preform, along, _seam(preform, along)) for make in (_sheet, _normals))
    if preform.kind == 'lap':
        line = line + 0.5 * preform.thickness * normals
    return PreformCloud(se3.apply(T, points), se3.apply(T, line), normals @ T[:3, :3].T)


def _seam(preform: Preform, x: Array) -> Array:
    u = 2 * x / preform.length
    return np.asarray(preform.sway * (u ** 2 - 0.6 * u ** 3 - 0.4))


def _slope(preform: Preform, x: Array) -> Array:
    u = 2 * x / preform.length
    return np.asarray(preform.sway * (2 * u - 1.8 * u ** 2) * 2 / preform.length)


def _sheet(preform: Preform, x: Array, y: Array) -> Array:
    return np.stack([x, y, -x ** 2 / (2 * preform.bend) - y ** 2 / (2 * preform.arch)], axis=-1)


def _normals(preform: Preform, x: Array, y: Array) -> Array:
    normals = np.stack([x / preform.bend, y / preform.arch, np.ones_like(x)], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
