# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verification routines, by name."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
import math

from handeye_ros import se3
from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import Array, EdgePoint, Sample
from handeye_ros.errors import InputError, UnknownNameError
from handeye_ros.estimation.problem import Observations
from handeye_ros.profiles.circles import fit_circle
from handeye_ros.targets import METHODS
from handeye_ros.targets.common import edge_noise, ObservationRows
from handeye_ros.verification import shapes, tooth_gauge
from handeye_ros.verification.decision import Quantity
from handeye_ros.verification.fixed_fit import FixedFit
from handeye_ros.verification.shapes import BAGS, Kinds, Shape, StationSet
import numpy as np

TEETH = 'teeth'  # the target of a routine that takes points while the robot moves
LENGTHS = 'lengths (verify.lengths)'
TRIALS = 300  # random pairs of edge points in the search for a common edge


@dataclass(frozen=True)
class Routine:
    """
    One way to verify a calibration.

    says: what it measures. target: the target.type whose features the stations give, or TEETH
    where points are taken while the robot moves. bags: smallest and largest number; lengths: valid
    numbers of verify.lengths for a number of bags. observe(samples, poses (n, 4, 4), X): the
    conditions of one bag, where the robot stops; shape(stations, points (m, 3), nominal): the
    stations that take part, and the shape to fit. names(bags, values): name, unit and
    characteristic (see Quantity) of each value; spread(stations, X, fit): further quantities, from
    single stations.
    """

    name: str
    says: str
    target: str
    bags: tuple[int, int]
    observe: Callable[[Sequence[Sample], Array, Array], Observations]
    shape: Callable[[StationSet, Array, VerifyConfig], tuple[StationSet, Shape]]
    names: Callable[[int, int], Iterator[tuple[str, str, str]]]
    lengths: Callable[[int], tuple[int, ...]] = lambda bags: (0,)
    spread: Callable[[StationSet, Array, FixedFit], tuple[Quantity, ...]] = lambda *_: ()


def faces(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return the normal points of all face lines."""
    return METHODS['plane'].observe(samples)


def arcs(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return the normal points of all arcs."""
    return METHODS['sphere'].observe(samples)


def edge_points(samples: Sequence[Sample], poses: Array, X: Array, line: bool) -> Observations:
    """
    Return the distances of one edge point per station, the one nearest a common line or point.

    line: two distances from a line, else three from a point.
    """
    edges = [(station, f) for station, sample in enumerate(samples)
             for f in sample.features if isinstance(f, EdgePoint)]
    rows = ObservationRows()
    if edges:
        station = np.array([s for s, _ in edges])
        in_mount = np.array([f.point for _, f in edges]) @ X[:3, [0, 2]].T + X[:3, 3]
        p = np.array([se3.apply(poses[s], m[None])[0]
                      for s, m in zip(station, in_mount, strict=True)])
        for k in _common(p, station, line):
            s, edge = edges[k]
            for direction in range(2 if line else 3):
                rows.add(s, edge.point, direction, edge_noise(edge), 0)
    return rows.observations()


def _common(p: Array, station: Array, line: bool) -> list[int]:
    """Return for each station the point (k, 3) nearest to the best common line or point."""
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


def fit_all(shape: Callable[[Array, Kinds, VerifyConfig], Shape]
            ) -> Callable[[StationSet, Array, VerifyConfig], tuple[StationSet, Shape]]:
    """Return the fit of a shape to all observations."""
    def fitted(stations: StationSet, p: Array, nominal: VerifyConfig) -> tuple[StationSet, Shape]:
        return stations, shape(p, stations.observations.kind, nominal)

    return fitted


def _point_scatter(stations: StationSet, X: Array, fit: FixedFit) -> tuple[Quantity, ...]:
    """Return 3 sigma of the points along x, y and z of the base."""
    p, kind = stations.points(X), stations.observations.kind % BAGS
    return tuple(_spread(f'3 sigma of the points along {axis}', 3 * float(
        p[kind == k, k].std(ddof=1)), int((kind == k).sum()) - 1) for k, axis in enumerate('xyz'))


def _centre_scatter(stations: StationSet, X: Array) -> tuple[Quantity, ...]:
    """
    Return 1 sigma per axis of the centres of arcs about the centre of their ball.

    An arc determines its centre in the light plane: two conditions on the centre of the ball.
    """
    obs, poses = stations.observations, stations.poses
    bag = obs.kind // BAGS
    quantities = []
    for k in range(int(bag.max()) + 1):
        rows, values = [], []
        for station in np.unique(obs.station[bag == k]):
            sensor = poses[station] @ X
            axes = sensor[:3, [0, 2]].T
            rows.append(axes)
            centre = fit_circle(obs.points[obs.station == station])[:2]
            values.append(centre + axes @ sensor[:3, 3])
        A, b = np.concatenate(rows), np.concatenate(values)
        deviation = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
        freedom = max(len(b) - 3, 1)
        quantities.append(_spread(f'scatter of the centre of ball {k + 1}, 1 sigma',
                                  float(np.sqrt(deviation @ deviation / freedom)), freedom))
    return tuple(quantities)


def _form_error(name: str, symbol: str, stations: StationSet, X: Array, fit: FixedFit
                ) -> tuple[Quantity, ...]:
    """Return the form error of each face or ball: highest point less lowest point."""
    bag = stations.observations.kind // BAGS
    distances = [fit.distances[bag == k] for k in range(int(bag.max()) + 1)]
    return tuple(_spread(f'{name} {k}, noise included', float(np.ptp(part)), len(part) - 1, symbol)
                 for k, part in enumerate(distances, 1))


def _ball_scatter(stations: StationSet, X: Array, fit: FixedFit) -> tuple[Quantity, ...]:
    """Return the form error of each ball, and the scatter of its centre between stops."""
    return (*_form_error('form error of ball', 'PF', stations, X, fit),
            *_centre_scatter(stations, X))


def _spread(name: str, value: float, freedom: int, symbol: str = '') -> Quantity:
    """Return a standard deviation with its own 1 sigma, for normal scatter."""
    return Quantity(name, value, value / math.sqrt(2 * max(freedom, 1)), 0.0,
                    characteristic=symbol)


def _named(*names: tuple[str, str, str]) -> Callable[[int, int], Iterator[tuple[str, str, str]]]:
    """Return the same name, unit and characteristic for each value."""
    return lambda bags, values: iter(names)


def _heights(bags: int, values: int) -> Iterator[tuple[str, str, str]]:
    """Yield the names of the heights of blocks with equally many faces each."""
    blocks = bags - values
    for k in range(values):
        block, face = divmod(k, values // blocks)
        suffix = f' of block {block + 1}' if blocks > 1 else ''
        yield f'height of face {face + 1} over face 0{suffix}', 'm', 'E'


def _blocks(bags: int) -> tuple[int, ...]:
    """Return the possible numbers of heights for a number of faces: of one block, two or three."""
    return tuple(bags - n for n in (1, 2, 3) if bags % n == 0 and bags > n)


def _balls(bags: int, values: int) -> Iterator[tuple[str, str, str]]:
    for k in range(1, bags + 1):
        yield ('radius' if bags == 1 else f'radius of ball {k}'), 'm', 'PS'
    for k in range(1, bags):
        yield f'distance of balls {k} and {k + 1}', 'm', 'SD'


ROUTINES: dict[str, Routine] = {routine.name: routine for routine in (
    Routine('line', 'distances of edge points from a straight edge', 'line', (1, 1),
            partial(edge_points, line=True), fit_all(shapes.line), _named()),
    Routine('plane', 'distances of points from a flat face', 'plane', (1, 1), faces,
            fit_all(shapes.free_planes), _named(),
            spread=partial(_form_error, 'flatness of face', 'F')),
    Routine('point', 'one point seen from everywhere: scatter, and bias of a touched one', 'line',
            (1, 1), partial(edge_points, line=False), fit_all(shapes.point),
            _named(('x', 'm', ''), ('y', 'm', ''), ('z', 'm', '')), spread=_point_scatter),
    Routine('sphere', 'radius of a ball', 'sphere', (1, 1), arcs, fit_all(shapes.spheres), _balls,
            spread=_ball_scatter),
    Routine('ball_bar', 'distance of two balls', 'sphere', (2, 2), arcs, fit_all(shapes.spheres),
            _balls, lambda bags: (bags - 1,), spread=_ball_scatter),
    Routine('step', 'heights of parallel faces over the first, of one block to three', 'plane',
            (2, 12), faces, fit_all(shapes.parallel_planes), _heights, _blocks),
    Routine('square', 'angle between two faces, and their flatness', 'plane', (2, 2), faces,
            fit_all(shapes.free_planes), _named(('angle between the faces', 'rad', '')),
            spread=partial(_form_error, 'flatness of face', 'F')),
    Routine('tooth', 'pitch and height of a tooth gauge, scanned in passes', TEETH, (2, 20),
            faces, tooth_gauge.fitted, _named(('pitch', 'm', 'E'), ('height', 'm', 'E')),
            lambda bags: (2,)),
)}
"""The routines of `handeye verify`."""


def routine_of(name: str) -> Routine:
    """Return the routine of a name; raises UnknownNameError."""
    if name not in ROUTINES:
        raise UnknownNameError('routine', name, list(ROUTINES))
    return ROUTINES[name]


def settings_for(routine: Routine, config: Config, bags: int) -> Config:
    """
    Return the settings that extract the features of a routine; raises InputError.

    bags: how many there are.
    """
    fewest, most = routine.bags
    if not fewest <= bags <= most:
        raise _wrong_count(routine, 'bags', bags, range(fewest, most + 1))
    lengths, count = routine.lengths(bags), len(config.verify.lengths)
    if count not in lengths:
        raise _wrong_count(routine, LENGTHS, count, lengths)
    if routine.target == TEETH:
        return config
    return with_values(config, {'target.type': routine.target, 'method': 'auto',
                                'target.radius': config.verify.radius}, routine.name)


def parts_of(routine: Routine, lengths: int) -> tuple[int, int]:
    """Return the least and largest number of bags for the lengths; raises InputError."""
    fewest, most = routine.bags
    fit = [n for n in range(fewest, most + 1) if lengths in routine.lengths(n)]
    if not fit:
        raise _wrong_count(routine, LENGTHS, lengths, routine.lengths(fewest))
    return fit[0], fit[-1]


def _wrong_count(routine: Routine, items: str, count: int, valid: Sequence[int]) -> InputError:
    needed = (f'{valid[0]} to {valid[-1]}' if len(valid) > 3 else
              ' or '.join(map(str, sorted(valid))))
    return InputError(f'{routine.name} needs {needed} {items}, and got {count}')
