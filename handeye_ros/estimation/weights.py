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
from handeye_ros.estimation.blocks import groups
from handeye_ros.estimation.problem import Linear, Problem
import numpy as np
from numpy.typing import NDArray

SMALLEST_STD = 1e-9  # of a feature without any noise, which would weigh infinitely (m)
DISTORTION_LENGTH = 0.01  # over which the error of a sensor's field is alike (m)
TURN_LENGTH = 0.3  # over which an error of the robot's joints turns as much as it shifts (m)
LOCAL = 0.6  # of the distortion, which differs from station to station: speckle, and waves
ROUNDING = 1e-12  # keeps a covariance invertible that one pose error rules


@dataclass(frozen=True)
class Noise:
    """
    Scale factors on the configured variances.

    sensor: on the features' own, edge: on those of edge points; robot: on the pose noise;
    doubts: on the unknowns of each, by name; lumped: whether doubts count as errors of each
    station here.
    """

    sensor: float = 1.0
    edge: float = 1.0
    robot: float = 1.0
    doubts: Mapping[str, float] = field(default_factory=dict)
    lumped: bool = True

    @property
    def factors(self) -> Array:
        """Return the factors on the parts of covariances."""
        return np.array([self.sensor, self.edge, self.robot])


@dataclass(frozen=True, eq=False)
class Whitening:
    """Per group of stations with equally many observations: their rows and inverse factors."""

    rows: tuple[NDArray[np.intp], ...]
    factors: tuple[Array, ...]

    def __call__(self, values: Array) -> Array:
        """Return (m, ...) values with unit covariance."""
        white = values.copy()
        for rows, factor in zip(self.rows, self.factors, strict=True):
            flat = values[rows].reshape(*rows.shape, -1)
            white[rows] = (factor @ flat).reshape(values[rows].shape)
        return white


def covariances(problem: Problem, linear: Linear, rows: NDArray[np.intp]) -> Array:
    """Return covariances, (3, stations, c, c), of the residuals: of features, edges, poses."""
    obs, noise = problem.observations, problem.config.noise
    H = linear.by_feature[rows]
    # no covariance between edges and the rest, so that any factors keep the sum positive
    edge, rest = (row[:, :, None] & row[:, None, :] for row in (
        obs.end[rows] > 0, obs.end[rows] == 0))
    feature = (H @ np.swapaxes(H, 1, 2)) * _shared(obs.source[rows]) + (
        SMALLEST_STD ** 2 * np.eye(rows.shape[1]))
    feature = feature + _distortion(obs.points[rows], linear.by_point[rows],
                                    LOCAL * noise.distortion)
    G = linear.by_pose[rows] * np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    return np.array([feature * rest, feature * edge, G @ np.swapaxes(G, 1, 2)])


def lumped(problem: Problem, linear: Linear, rows: NDArray[np.intp]) -> Array:
    """
    Return covariances (stations, c, c) of the residuals from what all stations share.

    The distortion of a sensor is smooth: points near each other in its plane share it.
    """
    obs, config = problem.observations, problem.config
    by_point = linear.by_point[rows]
    along = (by_point * obs.outward[rows]).sum(axis=2) * config.target.setback_std
    robot = config.noise.robot_smooth * np.repeat([1.0, 1 / TURN_LENGTH], 3)
    G = linear.by_pose[rows] * robot
    return np.asarray(_distortion(obs.points[rows], by_point, config.noise.distortion)
                      + along[:, :, None] * along[:, None, :] * _shared(obs.source[rows])
                      + G @ np.swapaxes(G, 1, 2))


def _shared(source: NDArray[np.intp]) -> NDArray[np.bool_]:
    return np.asarray(source[:, :, None] == source[:, None, :])


def _distortion(points: Array, by_point: Array, sigma: float) -> Array:
    """Return the covariances (n, c, c) of a smooth field at points (n, c, 2)."""
    if not sigma:
        return np.zeros((*points.shape[:2], points.shape[1]))
    apart = points[:, :, None] - points[:, None, :]
    near = np.exp(-0.5 * (apart ** 2).sum(axis=3) / DISTORTION_LENGTH ** 2)
    return np.asarray(sigma ** 2 * near * (by_point @ np.swapaxes(by_point, 1, 2)))


def whitening(problem: Problem, linear: Linear, noise: Noise) -> Whitening:
    """Return the map to residuals of unit covariance."""
    rows = groups(problem.observations.station)
    factors = []
    for group in rows:
        total = np.tensordot(noise.factors, covariances(problem, linear, group), 1)
        if noise.lumped:
            total = total + lumped(problem, linear, group)
        factors.append(inverse_roots(total))
    return Whitening(rows, tuple(factors))


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    size = np.einsum('nii->n', covariance)[:, None, None]
    regular = covariance + ROUNDING * size * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(regular)))
