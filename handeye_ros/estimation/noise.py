"""
What the noise makes of the residuals: their covariances, and the map that makes them white.

The error of a condition has two parts: the feature's own, and that of the station's pose, which
all observations of the station share. Both are whitened together. Blocks, which all stations
share, are unknowns of the solution (see posterior); while it is searched for they count as errors
of each station by itself.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from handeye_ros.config import NoiseConfig
from handeye_ros.data import Array
from handeye_ros.estimation.linalg import Stations
from handeye_ros.estimation.linearise import Linear
import numpy as np
from numpy.typing import NDArray

SMALLEST_STD = 1e-9  # of a feature without any noise, which would weigh infinitely (m)
TURN_LENGTH = 0.3  # over which an error of the robot's joints turns as much as it shifts (m)
LOCAL = 0.6  # of the distortion, which differs from station to station: speckle, and waves
PRIOR_FREEDOM = 4.0  # degrees of freedom of the prior of variance factors, about 1
ROUNDING = 1e-12  # keeps a covariance invertible that one pose error rules


@dataclass(frozen=True)
class Noise:
    """
    Factors on the configured variances, those of (3), and the scales of blocks.

    feature, feature_2: of the features' own error, by their component; local: of the distortion
    that differs from station to station; robot: of the pose noise; values: of the white errors of
    what the poses depend on, such as the time; scales: tau^2 of each block, by its name; lumped:
    whether blocks count as errors of each station here.
    """

    feature: float = 1.0
    feature_2: float = 1.0
    local: float = 1.0
    robot: float = 1.0
    values: float = 1.0
    scales: Mapping[str, float] = field(default_factory=dict)
    lumped: bool = True

    @property
    def factors(self) -> Array:
        """Return the factors on the parts of covariances."""
        return np.array([self.feature, self.feature_2, self.local, self.robot, self.values])

    def with_factors(self, factors: Array) -> Noise:
        """Return the noise with other factors."""
        feature, feature_2, local, robot, values = factors.tolist()
        return replace(self, feature=feature, feature_2=feature_2, local=local, robot=robot,
                       values=values)


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


def covariances(linear: Linear, at: Stations) -> Array:
    """
    Return the parts of the covariance, (3), as (p, stations, c, c), for variance factors of 1.

    The p parts: the features' two components, the distortion that differs from station to station,
    poses, and the values that poses depend on, where there are such.
    """
    noise = linear.problem.config.noise
    # no covariance between the components, so that any factors keep the sum positive
    values = () if linear.by_values is None else (_squared(at.of(linear.by_values)),)
    return np.array([*_feature(linear, at) * at.components,
                     at.near * _squared(at.of(linear.by_point), _local(noise)),
                     _squared(at.of(linear.by_pose), _pose(noise)), *values])


def total_covariance(linear: Linear, at: Stations, noise: Noise) -> Array:
    """
    Return the covariance (stations, c, c), (3), and that of the blocks where these are lumped.

    Lumped are the distortion (smooth: points near each other in the sensor plane share it), the
    robot's smooth error, and the errors of the target's own.
    """
    problem, config = linear.problem, linear.problem.config.noise
    total = _feature(linear, at)
    first, second = at.components
    total *= noise.feature * first + noise.feature_2 * second if at.mixed else noise.feature
    distortion, robot = noise.local * _local(config), noise.robot * _pose(config)
    if noise.lumped:
        distortion = distortion + config.distortion ** 2
        robot = robot + config.robot_smooth ** 2 * np.repeat([1.0, TURN_LENGTH ** -2], 3)
    if distortion:
        total += at.near * _squared(at.of(linear.by_point), distortion)
    total += _squared(at.of(linear.by_pose), robot)
    if linear.by_values is not None:
        total += noise.values * _squared(at.of(linear.by_values))
    if noise.lumped and problem.method.nuisances:
        total += _squared(at.of(problem.method.nuisances.feature_errors(linear))) * at.shared
    return total


def _feature(linear: Linear, at: Stations) -> Array:
    """Return the covariances (stations, c, c) of the features' own errors."""
    factor, every = at.of(linear.by_feature), np.arange(at.rows.shape[1])
    if at.alone:
        feature = np.zeros(at.near.shape)
        feature[:, every, every] = np.einsum('sck,sck->sc', factor, factor)
    else:
        feature = _squared(factor) * at.shared
    feature[:, every, every] += SMALLEST_STD ** 2
    return feature


def _local(noise: NoiseConfig) -> float:
    """Return the variance of the distortion that differs from station to station."""
    return (LOCAL * noise.distortion) ** 2


def _pose(noise: NoiseConfig) -> Array:
    """Return the variances (6,) of the white error of a pose."""
    return np.repeat([noise.robot_translation ** 2, noise.robot_rotation ** 2], 3)


def _squared(factor: Array, variances: Array | float = 1.0) -> Array:
    """Return factor @ diag(variances) @ factor.T of factors (stations, c, k)."""
    scaled = factor * np.sqrt(variances)
    return np.asarray(scaled @ np.swapaxes(scaled, 1, 2))


def whitening(linear: Linear, noise: Noise) -> Whitening:
    """Return the map to residuals of unit covariance."""
    stations = linear.problem.stations
    return Whitening(tuple(at.rows for at in stations), tuple(
        inverse_roots(total_covariance(linear, at, noise)) for at in stations))


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    every = np.arange(covariance.shape[1])
    own = covariance[:, every, every]
    regular = covariance.copy()
    regular[:, every, every] += ROUNDING * own.sum(axis=1)[:, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(regular)))
