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
    shared: (s, c, c) 1 where they share the error of one feature; edge, rest: (s, c, c) 1 where
    both are points of edges, and where neither is. alone: whether none shares its error.
    """

    rows: NDArray[np.intp]
    near: Array
    shared: Array
    edge: Array
    rest: Array
    alone: bool

    def of(self, values: Array) -> Array:
        """Return values (m, k) of all observations by stations, (s, c, k)."""
        if self.rows.size == len(values):  # all of them, in their order
            return values.reshape(*self.rows.shape, -1)
        return values[self.rows]

    def every(self, step: int) -> Stations:
        """Return each so manieth of the stations."""
        return Stations(self.rows[::step], self.near[::step], self.shared[::step],
                        self.edge[::step], self.rest[::step], self.alone)


@dataclass(frozen=True, eq=False)
class Ends:
    """
    The ends of faces, m observations in all.

    feature: (m,) which feature each is of; parts: the kind (0 where an end has several) and the
    way in which a face ends, and which observations (m,) these are; slope: (m,) of the face
    there, against the line of sight.
    """

    feature: NDArray[np.intp]
    parts: dict[tuple[int, int], NDArray[np.bool_]]
    slope: Array

    def outwards(self, along: Array) -> Array:
        """Return derivatives (m,) by the point out of its face, of unit length by feature."""
        length = np.sqrt(np.bincount(self.feature, along ** 2))[self.feature]
        return np.divide(along, length, out=np.zeros(len(along)), where=length > 0)


def ends_of(obs: Observations) -> Ends:
    """Return the ends of faces among observations."""
    source = obs.station * (int(obs.source.max(initial=0)) + 1) + obs.source
    _, feature, count = np.unique(source, return_inverse=True, return_counts=True)
    kind = np.where(count[feature] > 1, 0, obs.kind)  # conditions of one point share its edge
    found = sorted({(int(k), int(e)) for k, e in zip(kind, obs.end, strict=True) if e})
    slope = np.divide(obs.outward[:, 1], np.abs(obs.outward[:, 0]), out=np.zeros(len(obs)),
                      where=obs.outward[:, 0] != 0)
    return Ends(feature, {(k, e): (kind == k) & (obs.end == e) for k, e in found}, slope)


def stations_of(observations: Observations) -> tuple[Stations, ...]:
    """Return the stations of observations, by how many each has."""
    return tuple(_of_rows(observations, rows) for rows in groups(observations.station))


def _of_rows(obs: Observations, rows: NDArray[np.intp]) -> Stations:
    points, source, edge = obs.points[rows], obs.source[rows], obs.end[rows] > 0
    apart = points[:, :, None] - points[:, None, :]
    near = np.exp(-0.5 * np.einsum('nijk,nijk->nij', apart, apart) / DISTORTION_LENGTH ** 2)
    shared = source[:, :, None] == source[:, None, :]
    both, neither = (of[:, :, None] & of[:, None, :] for of in (edge, ~edge))
    return Stations(rows, near, shared.astype(float), both.astype(float), neither.astype(float),
                    alone=int(shared.sum()) == rows.size)
