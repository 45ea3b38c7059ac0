"""Where faces end: what observations of edge points know beside the points themselves."""
from __future__ import annotations

from dataclasses import dataclass, field

from handeye_ros.data import Array
from handeye_ros.estimation.linearise import Linear
from handeye_ros.estimation.model import Observations
import numpy as np
from numpy.typing import NDArray

ENDS = ('step', 'shadow', 'roof', 'gap', 'open')  # how a face ends; numbered from 1


@dataclass(frozen=True, eq=False)
class EdgeObservations(Observations):
    """
    Observations, some of which are edge points; these are of the second variance component.

    end: (m,) how the face ends where an edge point is, 0 of any other point; outward: (m, 2) unit
    vector out of the face there; shape: (m,) 1 sigma of how far outwards its edge is off since
    the edge's shape is not known exactly, alike at all.
    """

    end: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    outward: Array = field(default_factory=lambda: np.empty((0, 2)))
    shape: Array = field(default_factory=lambda: np.empty(0))


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

    def outwards(self, linear: Linear) -> Array:
        """Return derivatives (m,) by the points out of their faces, of unit length by feature."""
        along = out_of_face(linear)
        length = np.sqrt(np.bincount(self.feature, along ** 2))[self.feature]
        return np.divide(along, length, out=np.zeros(len(along)), where=length > 0)


def out_of_face(linear: Linear) -> Array:
    """Return derivatives (m,) of residuals by moves of edge points out of their faces."""
    outward = edges_of(linear.problem.observations).outward
    return np.asarray((linear.by_point * outward).sum(axis=1))


def edges_of(obs: Observations) -> EdgeObservations:
    """Return observations as such of edge points, of which there may be none."""
    if isinstance(obs, EdgeObservations):
        return obs
    none = np.zeros(len(obs))
    return EdgeObservations(obs.station, obs.points, obs.kind, obs.noise, obs.source,
                            obs.component, none.astype(np.intp), np.zeros((len(obs), 2)), none)


def ends_of(obs: EdgeObservations) -> Ends:
    """Return the ends of faces among observations."""
    source = obs.station * (int(obs.source.max(initial=0)) + 1) + obs.source
    _, feature, count = np.unique(source, return_inverse=True, return_counts=True)
    kind = np.where(count[feature] > 1, 0, obs.kind)  # conditions of one point share its edge
    found = sorted({(int(k), int(e)) for k, e in zip(kind, obs.end, strict=True) if e})
    slope = np.divide(obs.outward[:, 1], np.abs(obs.outward[:, 0]), out=np.zeros(len(obs)),
                      where=obs.outward[:, 0] != 0)
    return Ends(feature, {(k, e): (kind == k) & (obs.end == e) for k, e in found}, slope)
