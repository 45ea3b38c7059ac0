"""How far what single stations saw is spread, beside the values of the fit to all of them."""
from __future__ import annotations

import math

from handeye_ros.data import Array
from handeye_ros.profiles.circles import fit_circle
from handeye_ros.verification.fixed_fit import FixedFit, points_in_base
from handeye_ros.verification.routine import BAGS, Seen
from handeye_ros.verification.verification import Quantity
import numpy as np


def of_points(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """Return 3 sigma of the points of the stations along x, y and z of the base."""
    p, kind = points_in_base(seen, X), seen.observations.kind % BAGS
    return tuple(_spread(f'3 sigma of the points along {axis}', 3 * float(
        p[kind == k, k].std(ddof=1)), int((kind == k).sum()) - 1) for k, axis in enumerate('xyz'))


def of_centres(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """
    Return 1 sigma, each axis, of the centres of the arcs about that of their ball.

    An arc tells its centre in the light plane: two conditions of the centre of the ball.
    """
    obs, poses = seen.observations, seen.poses
    bag = obs.kind // BAGS
    told = []
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
        told.append(_spread(f'scatter of the centre of ball {k + 1}, 1 sigma',
                            float(np.sqrt(off @ off / freedom)), freedom))
    return tuple(told)


def of_faces(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    """Return the flatness of each face: its highest point less its lowest, noise included."""
    bag = seen.observations.kind // BAGS
    told = []
    for k in range(int(bag.max()) + 1):
        away = found.distances[bag == k]
        told.append(_spread(f'flatness of face {k + 1}, noise included',
                            float(away.max() - away.min()), len(away) - 1))
    return tuple(told)


def _spread(name: str, value: float, freedom: int) -> Quantity:
    """Return a spread with its own 1 sigma, as that of a normal scatter of so many freedoms."""
    return Quantity(name, value, value / math.sqrt(2 * max(freedom, 1)), 0.0)
