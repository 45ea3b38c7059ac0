"""
What the noise makes of the residuals: their covariances, and the map that makes them white.

The error of a condition has two parts: the feature's own, and that of the station's pose, which
all observations of the station share. Both are whitened together. Doubts, which all stations
share, are unknowns of the solution (see mixed); while it is searched for they count as errors
of each station by itself.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from handeye_ros.data import Array
from handeye_ros.estimation.problem import Linear, Problem
from handeye_ros.estimation.stations import Stations
import numpy as np
from numpy.typing import NDArray

SMALLEST_STD = 1e-9  # of a feature without any noise, which would weigh infinitely (m)
TURN_LENGTH = 0.3  # over which an error of the robot's joints turns as much as it shifts (m)
LOCAL = 0.6  # of the distortion, which differs from station to station: speckle, and waves
ROUNDING = 1e-12  # keeps a covariance invertible that one pose error rules


@dataclass(frozen=True)
class Noise:
    """
    Scale factors on the configured variances.

    sensor: on the features' own, edge: on those of edge points; local: on the share of the
    distortion that is each station's own; robot: on the pose noise;
    doubts: on the unknowns of each, by name; lumped: whether doubts count as errors of each
    station here.
    """

    sensor: float = 1.0
    edge: float = 1.0
    local: float = 1.0
    robot: float = 1.0
    doubts: Mapping[str, float] = field(default_factory=dict)
    lumped: bool = True

    @property
    def factors(self) -> Array:
        """Return the factors on the parts of covariances."""
        return np.array([self.sensor, self.edge, self.local, self.robot])


@dataclass(frozen=True, eq=False)
class Whitening:
    """Per group of stations with equally many observations: their rows and inverse factors."""

    rows: tuple[NDArray[np.intp], ...]
    factors: tuple[Array, ...]

    def __call__(self, values: Array) -> Array:
        """Return (m, ...) values with unit covariance."""
        if len(self.rows) == 1:  # all rows, in their order
            return _white(self.factors[0], values)
        white = np.empty_like(values)
        for rows, factor in zip(self.rows, self.factors, strict=True):
            white[rows.ravel()] = _white(factor, values[rows.ravel()])
        return white


def _white(factor: Array, values: Array) -> Array:
    """Return (n * c, ...) values of n stations, whitened by factor (n, c, c)."""
    by_station = values.reshape(*factor.shape[:2], -1)
    return np.asarray((factor @ by_station).reshape(values.shape))


def covariances(problem: Problem, linear: Linear, at: Stations) -> Array:
    """
    Return covariances, (4, stations, c, c), of the residuals.

    Of features, edges, the distortion that is each station's own, and poses.
    """
    noise = problem.config.noise
    H = linear.by_feature[at.rows]
    feature = (H @ np.swapaxes(H, 1, 2)) * at.shared
    every = np.arange(at.rows.shape[1])
    feature[:, every, every] += SMALLEST_STD ** 2
    local = _distortion(at, linear.by_point[at.rows], LOCAL * noise.distortion)
    G = linear.by_pose[at.rows] * np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    # no covariance between edges and the rest, so that any factors keep the sum positive
    return np.array([feature * at.rest, feature * at.edge, local,
                     G @ np.swapaxes(G, 1, 2)])


def lumped(problem: Problem, linear: Linear, at: Stations) -> Array:
    """
    Return covariances (stations, c, c) of the residuals from what all stations share.

    The distortion of a sensor is smooth: points near each other in its plane share it.
    """
    config, by_point = problem.config, linear.by_point[at.rows]
    outward = problem.observations.outward[at.rows]
    along = (by_point * outward).sum(axis=2) * config.target.setback_std
    robot = config.noise.robot_smooth * np.repeat([1.0, 1 / TURN_LENGTH], 3)
    G = linear.by_pose[at.rows] * robot
    return np.asarray(_distortion(at, by_point, config.noise.distortion)
                      + along[:, :, None] * along[:, None, :] * at.shared
                      + G @ np.swapaxes(G, 1, 2))


def _distortion(at: Stations, by_point: Array, sigma: float) -> Array:
    """Return the covariances (n, c, c) of a smooth field of the sensor, by_point (n, c, 2)."""
    if not sigma:
        return np.zeros(at.near.shape)
    return np.asarray(sigma ** 2 * at.near * (by_point @ np.swapaxes(by_point, 1, 2)))


def whitening(problem: Problem, linear: Linear, noise: Noise) -> Whitening:
    """Return the map to residuals of unit covariance."""
    factors = []
    for at in problem.stations:
        total = np.tensordot(noise.factors, covariances(problem, linear, at), 1)
        if noise.lumped:
            total = total + lumped(problem, linear, at)
        factors.append(inverse_roots(total))
    return Whitening(tuple(at.rows for at in problem.stations), tuple(factors))


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    size = np.einsum('nii->n', covariance)[:, None, None]
    regular = covariance + ROUNDING * size * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(regular)))
