"""The routines that verify a calibration, by name."""
from __future__ import annotations

from collections.abc import Callable, Sequence

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Sample
from handeye_ros.errors import UnknownNameError
from handeye_ros.estimation.model import Observations
from handeye_ros.targets.common import add_face, edge_noise, ObservationRows
from handeye_ros.verification import shapes, tooth_gauge
from handeye_ros.verification.routine import Nominal, Routine, Seen, Shape, TEETH
import numpy as np

TRIALS = 300  # pairs of edge points that an edge is looked for with


def faces(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return two points of each face line."""
    rows = ObservationRows()
    for station, sample in enumerate(samples):
        lines = [f for f in sample.features if isinstance(f, FaceLine)]
        for line in lines[:1]:
            add_face(rows, station, line, 0)
    return rows.observations()


def arcs(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return the normal points of each arc."""
    rows = ObservationRows()
    for station, sample in enumerate(samples):
        for arc in (f for f in sample.features if isinstance(f, Arc)):
            outward = arc.points - arc.centre
            outward = outward / np.linalg.norm(outward, axis=1)[:, None]
            for i, (point, std) in enumerate(zip(arc.points, arc.std, strict=True)):
                noise = np.column_stack([outward[i] * std, np.zeros(2)])
                rows.add(station, point, 0, noise, i)
    return rows.observations()


def edge(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return two distances of one edge point of each station: the one on the common line."""
    return _edge_points(samples, poses, X, line=True)


def corner(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return three distances of one edge point of each station: the one at the common point."""
    return _edge_points(samples, poses, X, line=False)


def _edge_points(samples: Sequence[Sample], poses: Array, X: Array, line: bool) -> Observations:
    found = [(station, f) for station, sample in enumerate(samples)
             for f in sample.features if isinstance(f, EdgePoint)]
    rows = ObservationRows()
    if found:
        station = np.array([s for s, _ in found])
        inside = np.array([f.point for _, f in found])
        in_mount = inside @ X[:3, [0, 2]].T + X[:3, 3]
        p = np.array([se3.apply(poses[s], m[None])[0]
                      for s, m in zip(station, in_mount, strict=True)])
        for k in _common(p, station, line):
            for what in range(2 if line else 3):
                rows.add(int(station[k]), inside[k], what, edge_noise(found[k][1]), 0)
    return rows.observations()


def _common(p: Array, station: Array, line: bool) -> list[int]:
    """Return for each station which point (k, 3) lies nearest to the best common line or point."""
    rng = np.random.default_rng(0)
    best, chosen = np.inf, np.empty(0, dtype=int)
    for _ in range(TRIALS):
        a, b = rng.integers(len(p), size=2)
        away = p - p[a]
        if line:
            way = p[b] - p[a]
            size = float(np.linalg.norm(way))
            if size < 1e-9:
                continue
            away = away - (away @ way)[:, None] * way / size ** 2
        distance = np.linalg.norm(away, axis=1)
        order = np.lexsort([distance, station])
        first = order[np.unique(station[order], return_index=True)[1]]
        cost = float(np.median(distance[first]) + 0.1 * distance[first].mean())
        if cost < best:
            best, chosen = cost, first
    return [int(k) for k in chosen]


def whole(shape: Callable[[Array, shapes.Kinds, Nominal], Shape]
          ) -> Callable[[Seen, Array, Nominal], tuple[Seen, Shape]]:
    """Return how a shape is fitted in which all observations take part."""
    def fitted(seen: Seen, p: Array, nominal: Nominal) -> tuple[Seen, Shape]:
        return seen, shape(p, seen.observations.kind, nominal)

    return fitted


def no_samples(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return nothing: what is seen while the robot moves is no sample."""
    return ObservationRows().observations()


def _nothing(count: int) -> tuple[tuple[str, str], ...]:
    return ()


def _heights(count: int) -> tuple[tuple[str, str], ...]:
    return tuple((f'height of face {k + 1} over face 0', 'm') for k in range(count))


def _balls(count: int) -> tuple[tuple[str, str], ...]:
    if count == 1:
        return (('radius', 'm'),)
    balls = (count + 1) // 2
    return (*((f'radius of ball {k + 1}', 'm') for k in range(balls)),
            *((f'distance of balls {k + 1} and {k + 2}', 'm') for k in range(balls - 1)))


ROUTINES: dict[str, Routine] = {routine.name: routine for routine in (
    Routine('line', 'distances of edge points from a straight edge', 'line', (1, 1), edge,
            whole(shapes.line), _nothing),
    Routine('plane', 'distances of points from a flat face', 'plane', (1, 1), faces,
            whole(shapes.free_planes), _nothing),
    Routine('point', 'one point seen from everywhere: scatter, and bias of a touched one', 'line',
            (1, 1), corner, whole(shapes.point),
            lambda count: (('x', 'm'), ('y', 'm'), ('z', 'm'))),
    Routine('sphere', 'radius of a ball', 'sphere', (1, 1), arcs, whole(shapes.spheres), _balls),
    Routine('ball_bar', 'distance of two balls', 'sphere', (2, 2), arcs, whole(shapes.spheres),
            _balls, lambda bags: bags - 1),
    Routine('step', 'heights of parallel faces over the first', 'plane', (2, 9), faces,
            whole(shapes.parallel_planes), _heights, lambda bags: bags - 1),
    Routine('square', 'angle between two faces, and their flatness', 'plane', (2, 2), faces,
            whole(shapes.free_planes), lambda count: (('angle between the faces', 'rad'),)),
    Routine('tooth', 'pitch and height of a tooth gauge, scanned in passes', TEETH, (2, 20),
            no_samples, tooth_gauge.fitted, lambda count: (('pitch', 'm'), ('height', 'm')),
            lambda bags: 2),
)}
"""What `handeye verify` knows."""


def routine_of(name: str) -> Routine:
    """Return the routine of a name; raises UnknownNameError."""
    if name not in ROUTINES:
        raise UnknownNameError('routine', name, list(ROUTINES))
    return ROUTINES[name]
