"""What the observations of one station have in common with each other, whatever the estimate."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.influence import groups
from handeye_ros.estimation.model import Observations
import numpy as np
from numpy.typing import NDArray

DISTORTION_LENGTH = 0.01  # over which the error of a sensor's field is alike (m)


@dataclass(frozen=True, eq=False)
class Stations:
    """
    The s stations with equally many observations, c.

    rows: (s, c) of them; near: (s, c, c) how alike a smooth error of the sensor is at each two;
    shared: (s, c, c) 1 where they share the error of one feature; components: (2, s, c, c) 1 where
    both are of the first variance component, or both of the second; mixed: whether some are of
    the second. alone: whether none shares its error.
    """

    rows: NDArray[np.intp]
    near: Array
    shared: Array
    components: Array
    mixed: bool
    alone: bool

    def of(self, values: Array) -> Array:
        """Return values (m, k) of all observations by stations, (s, c, k)."""
        if self.rows.size == len(values):  # all of them, in their order
            return values.reshape(*self.rows.shape, -1)
        return values[self.rows]

    def every(self, step: int) -> Stations:
        """Return every step-th of the stations."""
        return Stations(self.rows[::step], self.near[::step], self.shared[::step],
                        self.components[:, ::step], self.mixed, self.alone)


def stations_of(observations: Observations) -> tuple[Stations, ...]:
    """Return the stations of observations, by how many each has."""
    return tuple(_of_rows(observations, rows) for rows in groups(observations.station))


def _of_rows(obs: Observations, rows: NDArray[np.intp]) -> Stations:
    points, source, second = obs.points[rows], obs.source[rows], obs.component[rows] > 0
    apart = points[:, :, None] - points[:, None, :]
    near = np.exp(-0.5 * np.einsum('nijk,nijk->nij', apart, apart) / DISTORTION_LENGTH ** 2)
    shared = source[:, :, None] == source[:, None, :]
    pairs = np.array([of[:, :, None] & of[:, None, :] for of in (~second, second)], dtype=float)
    return Stations(rows, near, shared.astype(float), pairs, mixed=bool(second.any()),
                    alone=int(shared.sum()) == rows.size)
