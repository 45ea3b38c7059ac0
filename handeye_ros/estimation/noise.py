# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of the residuals, (3), whitening, and the scales of priors, (6).

Blocks are unknowns of the solution, common to all stations (see solve.py). During the search they
count as independent errors of each station. The scale of a block is the standard deviation of its
parameters over the configured one; it has a half-t prior (Gelman 2006, Bayesian Analysis 1:515).
Its most likely value is 0 if few parameters happen to be small, so it is averaged over.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import eigen, inverse_roots
from handeye_ros.estimation.problem import Linear, StationGroup
import numpy as np
from numpy.typing import NDArray

TURN_LENGTH = 0.3  # m: a joint error that turns the flange by 1 rad shifts it by this
PRIOR_FREEDOM = 4.0  # degrees of freedom of the prior of variance factors, about 1

TRIED_SCALES = np.geomspace(0.001, 1e4, 43)  # of blocks; quantities are summed over these
TRIED_VARIANCES = np.square(TRIED_SCALES)


def _log_half_t(freedom: float, scale: float) -> Array:
    """Return the log of the half-t prior of TRIED_SCALES, equally spaced in their log."""
    return np.asarray(np.log(TRIED_SCALES) - (freedom + 1) / 2 * np.log1p(
        TRIED_VARIANCES / (freedom * scale ** 2)))


# For the report: as configured in the mean square, and with some chance several times as much.
CONSERVATIVE_PRIOR = _log_half_t(3.0, 0.8)
# The same for a block of one parameter, which says little about a scale. Not a Cauchy prior: a
# sigma would grow by half or more as samples are added that fit (see estimator.md).
SINGLE_PRIOR = _log_half_t(2.0, 0.8)
# For the estimate: zero, unless the data show something.
MAP_PRIOR = _log_half_t(1.0, 0.01)

EDGES = 1  # place of the edge points among the variance factors


@dataclass(frozen=True, eq=False)
class Noise:
    """
    Factors on the configured variances in (3), and the scales of blocks.

    variance_factors: (5,) of the own errors of faces and arcs; of those of edges (EDGES); of the
        distortion that differs between stations; of the pose noise; of the white errors of the
        pose values, such as time
    block_variances: tau^2 of each block by name
    blocks_as_noise: whether blocks count as errors of each station
    """

    variance_factors: Array = field(default_factory=lambda: np.ones(5))
    block_variances: Mapping[str, float] = field(default_factory=dict)
    blocks_as_noise: bool = False


BLOCKS_AS_NOISE = Noise(blocks_as_noise=True)  # and all else as configured: of the search


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


def covariance_parts(linear: Linear, group: StationGroup) -> Array:
    """
    Return the parts of the covariance, (3), as (p, stations, c, c), for variance factors of 1.

    The p parts: two components of the features' errors, the distortion that differs between
    stations, the poses, and the pose values if they have white errors.
    """
    noise = linear.problem.config.noise
    local = (0.6 * noise.distortion) ** 2  # the share that differs, as speckle does
    pose = np.repeat([noise.robot_translation ** 2, noise.robot_rotation ** 2], 3)
    # no covariance between the components, so that any factors keep the sum positive
    features = _outer(linear.wrt_feature[group.rows]) * group.shared
    features += 1e-9 ** 2 * np.eye(group.rows.shape[1])  # m; without noise its weight is infinite
    parts = [*features * group.components,
             group.correlation * _outer(linear.wrt_point[group.rows], local),
             _outer(linear.wrt_pose[group.rows], pose)]
    if linear.wrt_jitter is not None:
        parts.append(_outer(linear.wrt_jitter[group.rows]))
    return np.array(parts)


def total_covariance(linear: Linear, group: StationGroup, noise: Noise) -> Array:
    """Return the covariance (stations, c, c), (3), with the blocks if they count as noise."""
    problem, config = linear.problem, linear.problem.config.noise
    parts = covariance_parts(linear, group)
    total = np.asarray(np.tensordot(noise.variance_factors[:len(parts)], parts, 1))
    if noise.blocks_as_noise:  # distortion, the robot's smooth error, and the target's own
        axes = np.repeat([1.0, TURN_LENGTH ** -2], 3)
        total += group.correlation * _outer(linear.wrt_point[group.rows], config.distortion ** 2)
        total += _outer(linear.wrt_pose[group.rows], config.robot_smooth ** 2 * axes)
        feature_errors = problem.target.feature_errors(linear)
        total += _outer(feature_errors[group.rows]) * group.shared
    return total


def _outer(factor: Array, variances: Array | float = 1.0) -> Array:
    """Return factor @ diag(variances) @ factor.T of factors (stations, c, k)."""
    scaled = factor * np.sqrt(variances)
    return np.asarray(scaled @ np.swapaxes(scaled, 1, 2))


def whitening(linear: Linear, noise: Noise) -> Whitening:
    """Return the map that whitens residuals to unit covariance."""
    groups = linear.problem.station_groups
    return Whitening(tuple(group.rows for group in groups), tuple(
        inverse_roots(total_covariance(linear, group, noise)) for group in groups))


def prior_variances(covariance: Array, value: Array, counts: Sequence[int], before: Array,
                    largest: Array) -> tuple[Array, Array]:
    """
    Return the scales of blocks, (6), for the estimate and for the report, as variances (d,).

    value (q,), covariance (q, q): of the parameters, in configured sigmas, when the variance of
    each block is before (d,) times the configured one; counts: (d,) number of parameters of each
    block; largest: (d,) bound of the variance.
    """
    first = np.cumsum([0, *counts])[:-1]
    # along the axes in which a block's parameters are independent
    posterior, along = np.empty((2, len(value)))
    for start, count in zip(first.tolist(), counts, strict=True):
        block = slice(start, start + count)
        posterior[block], axes = eigen(covariance[block, block])
        along[block] = axes.T @ value[block]
    # without a prior: the information of the data about each parameter, and its gradient
    present = np.repeat(before, counts)
    posterior = np.clip(posterior, 1e-12 * present, (1 - 1e-9) * present)
    information, gradient = 1 / posterior - 1 / present, along / posterior
    # with each variance that is tried, of each parameter: its posterior variance (s, q), and the
    # first term of (6), its squared estimate over that variance
    tried = TRIED_VARIANCES[:, None]
    growth = 1 + tried * information
    variance = tried / growth
    explained = variance * gradient ** 2
    # of each block (s, d): the log likelihood, and the moments to match, for estimate and report
    evidence = 0.5 * np.add.reduceat(explained - np.log(growth), first, axis=1)
    evidence[tried > largest] = -np.inf
    of_estimate = np.add.reduceat(explained, first, axis=1)
    of_report = np.add.reduceat(variance * (1 + explained), first, axis=1)
    prior = np.where(np.equal(counts, 1), SINGLE_PRIOR[:, None], CONSERVATIVE_PRIOR[:, None])
    return (_moment_matched(MAP_PRIOR[:, None] + evidence, of_estimate),
            _moment_matched(prior + evidence, of_report))


def _moment_matched(posterior: Array, moment: Array) -> Array:
    """Return the variances (d,) where moment (s, d) equals its posterior mean over the scales."""
    weights = np.exp(posterior - posterior.max(axis=0))
    means = (weights * moment).sum(axis=0) / weights.sum(axis=0)
    return np.exp([np.interp(mean, of_block, np.log(TRIED_VARIANCES))
                   for mean, of_block in zip(means, moment.T, strict=True)])
