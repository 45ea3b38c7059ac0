# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Joints as a laser profiler sees them: a cross-section swept along y, shadows and noise included.

The laser source stands above the seam and leans about it; each ray meets the first surface on its
way. Not the simulator of the package: what finds seams is not tried on what it was made with.
"""
from __future__ import annotations

from dataclasses import dataclass, field

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np
from scipy.spatial.transform import Rotation

FAR = 60.0  # mm: where surfaces end that the sensor sees no end of


@dataclass(frozen=True)
class Joint:
    """
    A cross-section and how it is scanned; millimetres and degrees.

    segments: lines (u, h, u, h) of the section; line: (u, h) of the true seam; toward: the angle
    of the true approach from straight down. bend: radius of the seam in plan, 0: straight.
    ends: what lies below the part beyond its ends, nan: nothing.
    """

    segments: tuple[tuple[float, float, float, float], ...]
    line: tuple[float, float]
    toward: float = 0.0
    lean: float = 0.0
    length: float = 120.0
    bend: float = 0.0
    spatter: int = 0
    pitch: float = 0.4
    noise: float = 0.03
    robot: float = 0.02
    width: float = 60.0
    below: float = float('nan')
    expected: tuple[str, ...] = field(default=())


def butt(gap: float, depth: float, half: float = FAR, **more) -> Joint:
    """Return two plates on a backing, seen down to it."""
    e, h = gap / 2, half
    sides = [(-h, 0, -e, 0), (e, 0, h, 0)]
    sides += [(s * w, 0, s * w, -depth) for s in (-1, 1) for w in ({e, h} - {FAR})]
    return Joint((*sides, (-80, -depth, 80, -depth)), (0.0, 0.0), **more)


def lap(height: float, **more) -> Joint:
    """Return a sheet that lies on another."""
    return Joint(((-FAR, height, 0, height), (0, height, 0, 0), (0, 0, FAR, 0)),
                 (0.0, height / 2), **more)


def vee(thick: float, gap: float, angle: float = 30.0, land: float = 1.0, **more) -> Joint:
    """Return a V with a root gap on a backing; the line is that of the root."""
    e = gap / 2
    top = e + (thick - land) * np.tan(np.radians(angle))
    half = ((top, 0, FAR, 0), (e, land - thick, top, 0), (e, -thick, e, land - thick))
    mirrored = tuple((-a, b, -c, d) for a, b, c, d in half)
    return Joint((*half, *mirrored, (-80, -thick, 80, -thick)), (0.0, land - thick), **more)


def tee(height: float, web: float = 8.0, toward: float = 45.0, **more) -> Joint:
    """Return a web that stands on a plate, its right side seen; the line is that of the root."""
    return Joint(((-web, height, 0, height), (0, height, 0, 0), (-FAR, 0, FAR, 0),
                  (-web, 0, -web, height)), (0.0, 0.0), toward=toward, **more)


def corner(angle: float, **more) -> Joint:
    """Return two plates that meet at an angle, open upwards; the line is that of the root."""
    u, h = FAR * np.sin(np.radians(angle / 2)), FAR * np.cos(np.radians(angle / 2))
    return Joint(((-u, h, 0, 0), (0, 0, u, h)), (0.0, 0.0), **more)


@dataclass(frozen=True, eq=False)
class Scanned:
    """Points (n, 3) in the base (m); centre (m, 3) and normals (m, 3) of the true seam."""

    points: Array
    centre: Array
    normals: Array


def scanned(joint: Joint, rng: np.random.Generator) -> Scanned:
    """Return what a scan of a joint shows."""
    rows, y = [], np.arange(-joint.length / 2 - 10, joint.length / 2 + 10, joint.pitch)
    balls = np.column_stack([rng.uniform(-3, 3, joint.spatter),
                             rng.uniform(-0.48, 0.48, joint.spatter) * joint.length,
                             rng.uniform(0.5, 1.5, joint.spatter)])
    for at in y:
        shift = at ** 2 / (2 * joint.bend) if joint.bend else 0.0
        inside = abs(at) <= joint.length / 2
        segments = joint.segments if inside else (
            ((-80, joint.below, 80, joint.below),) if np.isfinite(joint.below) else ())
        if not segments:
            continue
        u, h = _rays(joint, np.array(segments, dtype=float), balls[inside * np.abs(
            balls[:, 1] - at) < balls[:, 2]] if inside else balls[:0], at, rng)
        off = rng.normal(size=3) * joint.robot
        rows.append(np.column_stack([u + shift + off[0], np.full(len(u), at) + off[1],
                                     h + off[2]]))
    T = se3.transform(Rotation.from_euler('xyz', rng.uniform([-0.2, -0.2, -3], [0.2, 0.2, 3])
                                          ).as_matrix(), np.array([0.8, 0.1, 0.2]))
    along = np.linspace(-0.5, 0.5, 2001) * joint.length
    line = np.column_stack([joint.line[0] + (along ** 2 / (2 * joint.bend) if joint.bend else 0
                                             * along), along, np.full(2001, joint.line[1])])
    a = np.radians(joint.toward)
    normals = np.tile([np.sin(a), 0.0, np.cos(a)], (2001, 1))
    return Scanned(se3.apply(T, np.concatenate(rows) * 1e-3), se3.apply(T, line * 1e-3),
                   normals @ T[:3, :3].T)


def _rays(joint: Joint, segments: Array, balls: Array, at: float, rng: np.random.Generator
          ) -> tuple[Array, Array]:
    """Return where the rays of one profile end (n,), (n,)."""
    a, far = np.radians(joint.lean), 200.0
    source = far * np.array([np.sin(a), np.cos(a)])
    slope = np.linspace(-0.5, 0.5, 640) * joint.width / far
    way = np.column_stack([slope * np.cos(a) - np.sin(a), -slope * np.sin(a) - np.cos(a)])
    first, step = segments[:, :2], segments[:, 2:] - segments[:, :2]
    cross = way[:, None, 0] * step[:, 1] - way[:, None, 1] * step[:, 0]
    offset = first - source
    with np.errstate(divide='ignore', invalid='ignore'):
        t = (offset[:, 0] * step[:, 1] - offset[:, 1] * step[:, 0]) / cross
        s = (offset[:, 0] * way[:, None, 1] - offset[:, 1] * way[:, None, 0]) / cross
    steep = np.abs(cross) < np.cos(np.radians(80)) * np.linalg.norm(step, axis=1) * np.linalg.norm(
        way, axis=1)[:, None]
    t = np.where((s >= 0) & (s <= 1) & (t > 0), t, np.inf)
    best = np.argmin(t, axis=1)
    t = np.where(steep[np.arange(len(t)), best], np.inf, t[np.arange(len(t)), best])
    for u, y, r in balls:
        centre = np.array([u, 0.0]) - source
        squared = (way ** 2).sum(axis=1)
        b = way @ centre
        root = b ** 2 - squared * (centre @ centre - (r ** 2 - (y - at) ** 2))
        hit = root > 0
        t[hit] = np.minimum(t[hit], (b[hit] - np.sqrt(root[hit])) / squared[hit])
    seen = np.isfinite(t)
    ends = source + t[seen, None] * way[seen]
    unit = way[seen] / np.linalg.norm(way[seen], axis=1)[:, None]
    ends = ends + joint.noise * rng.normal(size=(len(ends), 1)) * unit
    return ends[:, 0], ends[:, 1]


JOINTS = {
    **{f'butt 3, backing {d}': butt(3, d) for d in (1, 2, 5, 10)},
    'butt 3, no backing': butt(3, float('nan')),
    'butt 3 on a table, seen all round': butt(3, 5, half=20, below=-5),
    'butt 2, lean 15, bent': butt(2, 5, lean=15, bend=400),
    **{f'lap 5, lean {a}': lap(5, lean=a) for a in (-20, 0, 20)},
    'lap 3': lap(3),
    'vee 6, root 2': vee(6, 2),
    'vee 8, root 1.5, 45 degrees': vee(8, 1.5, angle=45),
    **{f'corner of {a} degrees': corner(a) for a in (90, 120, 135)},
    'tee 12': tee(12),
    'tee 12, lean 30': tee(12, lean=30),
    'tee 30, lean 45': tee(30, lean=45),
    'butt 3, backing 5, spatter': butt(3, 5, spatter=20),
    'lap 5, spatter': lap(5, spatter=20),
}
