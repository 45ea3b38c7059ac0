"""The routines that verify a calibration, by name."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
import math

from handeye_ros import se3
from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array, EdgePoint, Sample
from handeye_ros.errors import UnknownNameError
from handeye_ros.estimation.model import Observations
from handeye_ros.profiles.circles import fit_circle
from handeye_ros.targets import METHODS
from handeye_ros.targets.common import edge_noise, ObservationRows
from handeye_ros.verification import shapes, tooth_gauge
from handeye_ros.verification.fixed_fit import FixedFit, points_in_base
from handeye_ros.verification.shapes import BAGS, Kinds, Seen, Shape
from handeye_ros.verification.verification import Quantity
import numpy as np

TEETH = 'teeth'  # the target of a routine that takes points while the robot moves
TRIALS = 300  # pairs of edge points that an edge is looked for with


@dataclass(frozen=True)
class Routine:
    """
    A way to verify a calibration.

    says: what it measures. target: the target.type whose features the stations give, or TEETH
    where points are taken while the robot moves. bags: how many, least and most; lengths: how
    many of verify.lengths there may be for so many bags. observe(samples, poses (n, 4, 4), X): the
    conditions of one bag, where the robot stops; shape(seen, points (m, 3), nominal): what is
    fitted, and what takes part. names(bags, values): name, unit and characteristic (see Quantity)
    of each value; spread(seen, X, fit): what single stations show beside the fit.
    """

    name: str
    says: str
    target: str
    bags: tuple[int, int]
    observe: Callable[[Sequence[Sample], Array, Array], Observations]
    shape: Callable[[Seen, Array, VerifyConfig], tuple[Seen, Shape]]
    names: Callable[[int, int], Iterator[tuple[str, str, str]]]
    lengths: Callable[[int], tuple[int, ...]] = lambda bags: (0,)
    spread: Callable[[Seen, Array, FixedFit], tuple[Quantity, ...]] = lambda seen, X, found: ()


def faces(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return the normal points of each face line."""
    return METHODS['plane'].features.observe(samples)


def arcs(samples: Sequence[Sample], poses: Array, X: Array) -> Observations:
    """Return the normal points of each arc."""
    return METHODS['sphere'].features.observe(samples)


def edge_points(samples: Sequence[Sample], poses: Array, X: Array, line: bool) -> Observations:
    """
    Return the distances of one edge point of each station: the one at the common line or point.

    line: two distances from a line, else three from a point.
    """
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


def whole(shape: Callable[[Array, Kinds, VerifyConfig], Shape]
          ) -> Callable[[Seen, Array, VerifyConfig], tuple[Seen, Shape]]:
    """Return how a shape is fitted in which all observations take part."""
    def fitted(seen: Seen, p: Array, nominal: VerifyConfig) -> tuple[Seen, Shape]:
        return seen, shape(p, seen.observations.kind, nominal)

    return fitted


def _points_spread(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """Return 3 sigma of the points of the stations along x, y and z of the base."""
    p, kind = points_in_base(seen, X), seen.observations.kind % BAGS
    return tuple(_spread(f'3 sigma of the points along {axis}', 3 * float(
        p[kind == k, k].std(ddof=1)), int((kind == k).sum()) - 1) for k, axis in enumerate('xyz'))


def _centres_spread(seen: Seen, X: Array) -> tuple[Quantity, ...]:
    """
    Return 1 sigma, each axis, of the centres of the arcs about that of their ball.

    An arc tells its centre in the light plane: two conditions of the centre of the ball.
    """
    obs, poses = seen.observations, seen.poses
    bag = obs.kind // BAGS
    sentences = []
    for k in range(int(bag.max()) + 1):
        rows, values = [], []
        for station in np.unique(obs.station[bag == k]):
            sensor = poses[station] @ X
            axes = sensor[:3, [0, 2]].T
            rows.append(axes)
            centre = fit_circle(obs.points[obs.station == station])[:2]
            values.append(centre + axes @ sensor[:3, 3])
        A, b = np.concatenate(rows), np.concatenate(values)
        off = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
        freedom = max(len(b) - 3, 1)
        sentences.append(_spread(f'scatter of the centre of ball {k + 1}, 1 sigma',
                                 float(np.sqrt(off @ off / freedom)), freedom))
    return tuple(sentences)


def _form(name: str, symbol: str, seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """Return the form error of each face or ball: its highest point less its lowest."""
    bag = seen.observations.kind // BAGS
    parts = [found.distances[bag == k] for k in range(int(bag.max()) + 1)]
    return tuple(_spread(f'{name} {k}, noise included', float(np.ptp(away)), len(away) - 1, symbol)
                 for k, away in enumerate(parts, 1))


def _balls_spread(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """Return form error of each ball, and how its centre scatters from stop to stop."""
    return (*_form('form error of ball', 'PF', seen, X, found), *_centres_spread(seen, X))


def _spread(name: str, value: float, freedom: int, symbol: str = '') -> Quantity:
    """Return a spread with its own 1 sigma, as that of a normal scatter of so many freedoms."""
    return Quantity(name, value, value / math.sqrt(2 * max(freedom, 1)), 0.0,
                    characteristic=symbol)


def _named(*names: tuple[str, str, str]) -> Callable[[int, int], Iterator[tuple[str, str, str]]]:
    """Return the same name, unit and characteristic for each value, whatever was measured."""
    return lambda bags, values: iter(names)


def _heights(bags: int, values: int) -> Iterator[tuple[str, str, str]]:
    """Yield the names of the heights of blocks that have equally many faces each."""
    blocks = bags - values
    for k in range(values):
        block, face = divmod(k, values // blocks)
        of = f' of block {block + 1}' if blocks > 1 else ''
        yield f'height of face {face + 1} over face 0{of}', 'm', 'E'


def _blocks(bags: int) -> tuple[int, ...]:
    """Return how many heights so many faces may have: of one block, two or three."""
    return tuple(bags - n for n in (1, 2, 3) if bags % n == 0 and bags > n)


def _balls(bags: int, values: int) -> Iterator[tuple[str, str, str]]:
    for k in range(1, bags + 1):
        yield ('radius' if bags == 1 else f'radius of ball {k}'), 'm', 'PS'
    for k in range(1, bags):
        yield f'distance of balls {k} and {k + 1}', 'm', 'SD'


ROUTINES: dict[str, Routine] = {routine.name: routine for routine in (
    Routine('line', 'distances of edge points from a straight edge', 'line', (1, 1),
            partial(edge_points, line=True), whole(shapes.line), _named()),
    Routine('plane', 'distances of points from a flat face', 'plane', (1, 1), faces,
            whole(shapes.free_planes), _named(), spread=partial(_form, 'flatness of face', 'F')),
    Routine('point', 'one point seen from everywhere: scatter, and bias of a touched one', 'line',
            (1, 1), partial(edge_points, line=False), whole(shapes.point),
            _named(('x', 'm', ''), ('y', 'm', ''), ('z', 'm', '')), spread=_points_spread),
    Routine('sphere', 'radius of a ball', 'sphere', (1, 1), arcs, whole(shapes.spheres), _balls,
            spread=_balls_spread),
    Routine('ball_bar', 'distance of two balls', 'sphere', (2, 2), arcs, whole(shapes.spheres),
            _balls, lambda bags: (bags - 1,), _balls_spread),
    Routine('step', 'heights of parallel faces over the first, of one block to three', 'plane',
            (2, 12), faces, whole(shapes.parallel_planes), _heights, _blocks),
    Routine('square', 'angle between two faces, and their flatness', 'plane', (2, 2), faces,
            whole(shapes.free_planes), _named(('angle between the faces', 'rad', '')),
            spread=partial(_form, 'flatness of face', 'F')),
    Routine('tooth', 'pitch and height of a tooth gauge, scanned in passes', TEETH, (2, 20),
            faces, tooth_gauge.fitted, _named(('pitch', 'm', 'E'), ('height', 'm', 'E')),
            lambda bags: (2,)),
)}
"""What `handeye verify` knows."""


def routine_of(name: str) -> Routine:
    """Return the routine of a name; raises UnknownNameError."""
    if name not in ROUTINES:
        raise UnknownNameError('routine', name, list(ROUTINES))
    return ROUTINES[name]
