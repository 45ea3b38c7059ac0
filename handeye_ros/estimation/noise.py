# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of the residuals, (3), whitening, and the prior widths tau, (6).

Blocks are unknowns of the solution, common to all stations (see posterior.py). During the search
distortion, smooth error and set-back count as independent errors of each station, and the others
are left out. tau of a block is the standard deviation of its
parameters over the configured one; it has a half-t prior (Gelman 2006, Bayesian Analysis 1:515).
Its most likely value is 0 if few parameters happen to be small, so it is averaged over.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

from handeye_ros.data import Array, TURN_LENGTH
from handeye_ros.estimation.least_squares import eigen, inverse_roots
from handeye_ros.estimation.problem import Linearisation, StationGroup
import numpy as np
from numpy.typing import NDArray

FACTOR_FREEDOM = 4.0  # degrees of freedom of the prior of variance factors, about 1
# twist by smooth errors of the robot of 1 m: 3 shifts, and 3 turns of which a joint makes 1 m
SMOOTH_UNITS = np.repeat([1.0, 1 / TURN_LENGTH], 3)
LOCAL_SHARE = 0.6  # of the sensor's distortion that differs between stations, as speckle does

TRIED_TAUS = np.geomspace(0.001, 1e4, 43)  # of blocks; quantities are summed over these
TRIED_TAU_SQUARES = np.square(TRIED_TAUS)


def _log_half_t(freedom: float, width: float) -> Array:
    """Return the log of the half-t prior of TRIED_TAUS, equally spaced in their log."""
    return np.asarray(np.log(TRIED_TAUS) - (freedom + 1) / 2 * np.log1p(
        TRIED_TAU_SQUARES / (freedom * width ** 2)))


# For the report, conservative: 1.3 times as configured (RMS), and with some chance several times.
LOG_REPORT_PRIOR = _log_half_t(3.0, 0.8)
# Of one parameter, which says little about its tau: 1.7 times. Not a Cauchy prior: a sigma would
# grow by half or more as samples are added that fit (see estimator.md).
LOG_SINGLE_REPORT_PRIOR = _log_half_t(2.0, 0.8)
# For the estimate: near 0, unless the data show something.
LOG_MAP_PRIOR = _log_half_t(1.0, 0.01)

# Indices of the variance factors: of the own errors of faces and arcs, and of edges; of distortion
# that differs between stations; of the poses; of the white errors of pose parameters, as time.
FACE_INDEX, EDGE_INDEX, LOCAL_DISTORTION_INDEX, POSE_INDEX, POSE_PARAMETER_INDEX = range(5)


def factors_but_local_distortion(factor: float) -> Array:
    """Return variance factors (5,) of 1, but one for distortion that differs between stations."""
    return np.where(np.arange(5) == LOCAL_DISTORTION_INDEX, factor, 1.0)


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """
    Factors on the configured variances in (3), and tau of blocks.

    variance_factors: (5,), see FACE_INDEX
    tau_squares: tau^2 of blocks by name; 1 of those not named
    blocks_as_noise: whether distortion, the robot's smooth error and the target's point_errors
        count as errors of each station, and all other blocks are left out
    """

    variance_factors: Array = field(default_factory=lambda: np.ones(5))
    tau_squares: Mapping[str, float] = field(default_factory=dict)
    blocks_as_noise: bool = False


BLOCKS_AS_NOISE = NoiseModel(blocks_as_noise=True)  # and all else as configured: of the search


@dataclass(frozen=True, eq=False)
class Whitening:
    """
    The whitening of each group of stations of one size.

    rows: row numbers (s, c); roots: inverse roots W (s, c, c) of the covariance, W V W' = 1.
    """

    rows: tuple[NDArray[np.intp], ...]
    roots: tuple[Array, ...]

    def __call__(self, values: Array) -> Array:
        """Return values (m, ...) whitened to unit covariance."""
        whitened = np.empty_like(values)
        for rows, root in zip(self.rows, self.roots, strict=True):
            stacked = values[rows]
            whitened[rows] = (root @ stacked.reshape(*rows.shape, -1)).reshape(stacked.shape)
        return whitened


def covariance_parts(linear: Linearisation, group: StationGroup) -> Array:
    """
    Return the parts of the covariance, (3), as (p, stations, c, c), for variance factors of 1.

    The p parts are in the order of the variance factors; the last is there if the pose
    parameters have white errors.
    """
    configured = linear.problem.config.noise
    local_distortion = (LOCAL_SHARE * configured.distortion) ** 2
    pose_stds = np.repeat([configured.robot_translation, configured.robot_rotation], 3)
    # no covariance between the components, so that any factors keep the sum positive
    own = _outer(linear.wrt_unit_errors[group.rows]) * group.same_point
    own += 1e-9 ** 2 * np.eye(group.rows.shape[1])  # (1 nm)^2: exact points weigh, too
    parts = [*own * group.factor_masks,
             group.correlation * _outer(linear.wrt_point[group.rows], local_distortion),
             _outer(linear.wrt_pose[group.rows], pose_stds ** 2)]
    if linear.wrt_jitter is not None:
        parts.append(_outer(linear.wrt_jitter[group.rows]))
    return np.array(parts)


def total_covariance(linear: Linearisation, group: StationGroup, noise: NoiseModel) -> Array:
    """Return the covariance (stations, c, c), (3), with the blocks if they count as noise."""
    configured, target = linear.problem.config.noise, linear.problem.target
    parts = covariance_parts(linear, group)
    total = np.asarray(np.tensordot(noise.variance_factors[:len(parts)], parts, 1))
    if noise.blocks_as_noise:  # distortion, the robot's smooth error, and the target's own
        rows = group.rows
        total += group.correlation * _outer(linear.wrt_point[rows], configured.distortion ** 2)
        total += _outer(linear.wrt_pose[rows], (configured.robot_smooth * SMOOTH_UNITS) ** 2)
        total += _outer(target.point_errors(linear)[rows]) * group.same_point
    return total


def _outer(factor: Array, variances: Array | float = 1.0) -> Array:
    """Return factor @ diag(variances) @ factor.T of factors (stations, c, k)."""
    scaled = factor * np.sqrt(variances)
    return np.asarray(scaled @ np.swapaxes(scaled, 1, 2))


@lru_cache(maxsize=4)  # the search asks twice: for the residuals, then for the step from there
def whitening(linear: Linearisation, noise: NoiseModel) -> Whitening:
    """Return the map that whitens residuals to unit covariance."""
    groups = linear.problem.observations.station_groups
    return Whitening(tuple(group.rows for group in groups), tuple(
        inverse_roots(total_covariance(linear, group, noise)) for group in groups))


def tau_squares_of_block(covariance: Array, value: Array, present: float, largest: float
                         ) -> tuple[float, float]:
    """
    Return tau^2 of one block, (6), for the estimate and for the report.

    covariance (k, k), value (k,): of its parameters, in configured sigmas, estimated with tau^2 of
    present; largest: bound of tau^2.
    """
    # the axes l along which the parameters are independent
    posterior, axes = eigen(covariance)
    posterior = np.clip(posterior, 1e-12 * present, (1 - 1e-9) * present)
    # lambda_l and gamma_l: what the data say without the prior
    information, gradient = 1 / posterior - 1 / present, (axes.T @ value) / posterior
    # with each tau^2 tried (s, k): the posterior variance, and the squared estimate over it
    growth = 1 + TRIED_TAU_SQUARES[:, None] * information
    variance = TRIED_TAU_SQUARES[:, None] / growth
    squares = variance * gradient ** 2
    log_likelihood = 0.5 * (squares - np.log(growth)).sum(axis=1)
    log_likelihood[largest < TRIED_TAU_SQUARES] = -np.inf
    prior = LOG_SINGLE_REPORT_PRIOR if len(value) == 1 else LOG_REPORT_PRIOR
    second_moment = (variance * (1 + squares)).sum(axis=1)
    return (_matching_tau_squared(LOG_MAP_PRIOR + log_likelihood, squares.sum(axis=1)),
            _matching_tau_squared(prior + log_likelihood, second_moment))


def _matching_tau_squared(log_posterior: Array, moment: Array) -> float:
    """Return the tau^2 at which a moment (s,) equals its mean over TRIED_TAUS, (6)."""
    weights = np.exp(log_posterior - log_posterior.max())
    mean = (weights * moment).sum() / weights.sum()
    return float(np.exp(np.interp(mean, moment, np.log(TRIED_TAU_SQUARES))))
