# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The solution: the stations that agree, the estimate from them, and the reported covariance.

The estimate and its reported covariance have different prior widths tau: an error without evidence
in the data must not move the estimate, but it may exist.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.best_fit import best_fit_motions
from handeye_ros.estimation.blocks import blocks_at, blocks_with_columns, ParameterBlock
from handeye_ros.estimation.least_squares import FREE_DIRECTION
from handeye_ros.estimation.noise import factors_but_local_distortion, NoiseModel
from handeye_ros.estimation.posterior import Posterior, posterior_at
from handeye_ros.estimation.problem import (
    Estimate,
    has_unused_edges,
    Linearisation,
    linearise,
    Problem,
)
import numpy as np
from numpy.typing import NDArray

# The iteration of the unknowns ends at a step of CONVERGED_SIGMAS; one more follows with the final
# taus. After MAX_STEPS, one of NEAR_SIGMAS is small enough.
CONVERGED_SIGMAS, NEAR_SIGMAS, MAX_STEPS = 0.25, 1.0, 10
FULL_STEPS = 5  # in which the taus change in full, later by half
LAST_STEPS = 3  # of variance factors and taus, after the last of the unknowns
LEFT_BY_OTHERS = 1e-6  # share of a variance; a station that leaves less to the others is needed
# prior variance factors for the estimate: no distortion that differs, unless the data show some
MAP_PRIOR_FACTORS = factors_but_local_distortion(1e-4)


@dataclass(frozen=True, eq=False)
class Solution:
    """
    The stations that agree and their posterior; first with blocks as noise, then with blocks.

    posterior: of the stations used, for the estimate
    report_posterior: the one whose covariance is reported, (8), at the conservative taus; an
        estimate at these would follow causes without evidence. With blocks as noise, the same
    full_problem: the problem with all stations and observations
    used_stations: (n,) their indices
    dropped_squares: the square by which each of the others was dropped, over what its noise
        explains: its mean square in the robust fit, or its left-out square, (12), without blocks
        over the shared variance factor, with blocks at the estimated noise
    probability_wrong: that one of few used stations is wrong
    surely_wrong_indices: in used_stations, of the one that almost surely is; () without one
    added_covariances: (6, 6) by cause, added to the reported covariance of the transform, as by
        (10)
    """

    posterior: Posterior
    report_posterior: Posterior
    full_problem: Problem
    used_stations: NDArray[np.intp]
    dropped_squares: Mapping[int, float]
    probability_wrong: float = 0.0
    surely_wrong_indices: tuple[int, ...] = ()
    added_covariances: Mapping[str, Array] = field(default_factory=dict)

    @property
    def problem(self) -> Problem:
        """Return the problem of the used stations, with kinds as assigned."""
        return self.posterior.problem

    @property
    def estimate(self) -> Estimate:
        """Return the estimate, the stated measures of the target too."""
        return self.posterior.estimate

    @cached_property
    def reported_covariance(self) -> Array:
        """
        Return the reported covariance (u, u) of the unknowns, (8).

        It covers the errors of both the mount's transform and the best-fit transform.
        """
        u, C = self.posterior.unknown_count, self.report_posterior.covariance
        covariance = C[:u, :u].copy()
        if self.posterior.noise.blocks_as_noise:
            return covariance
        shift = self.shift_for_report
        covariance[:6, :6] = cover(covariance[:6, :6] + np.outer(shift, shift), self._best_fit)
        covariance[:6, :6] += sum(self.added_covariances.values())
        return covariance

    @property
    def transform_covariance(self) -> Array:
        """Return the reported covariance (6, 6) of the transform."""
        return self.reported_covariance[:6, :6]

    @property
    def shift_for_report(self) -> Array:
        """Return d (6,): how far the taus for the report would move the estimate, (8)."""
        return se3.difference(self.report_posterior.estimate.X, self.estimate.X)

    @property
    def _best_fit(self) -> Array:
        """Return the mean square (6, 6) of the best-fit transform about the estimate, (9)."""
        reported = self.report_posterior
        G = best_fit_motions(reported.linear, reported.blocks)
        L = np.hstack([np.eye(6, reported.unknown_count), G])
        d_fit = self.shift_for_report + G @ reported.nuisance
        return np.asarray(L @ reported.covariance @ L.T + np.outer(d_fit, d_fit))

    @property
    def target_std(self) -> Array:
        """Return 1 sigma (k,) of the target's parameters, 0 for known ones."""
        std, reported = np.zeros(len(self.problem.target.parameter_names)), self.report_posterior
        variances = np.diag(reported.covariance)
        std[self.problem.free_columns[6:] - 6] = np.sqrt(variances[6:reported.unknown_count])
        for block, columns in blocks_with_columns(reported.blocks, reported.unknown_count):
            if (i := block.target_parameter_index) is not None:
                std[i] = block.std * variances[columns][0] ** 0.5
        return std

    @property
    def stations_with_unused_edges(self) -> NDArray[np.intp]:
        """Return the used stations that show an edge, but of which none is used."""
        shown = self.full_problem.subset(self.used_stations)
        return self.used_stations[has_unused_edges(shown, self.problem)]

    @property
    def fully_used_count(self) -> int:
        """Return the number of used stations but those without edges."""
        return len(self.used_stations) - len(self.stations_with_unused_edges)

    @property
    def indispensable_stations(self) -> NDArray[np.intp]:
        """Return the used stations that determine something that no other one shows."""
        needed = np.zeros(len(self.used_stations), dtype=bool)
        for group in self.problem.observations.station_groups:
            # 1 where all that is known of a direction comes from the station itself
            shares = np.linalg.eigvalsh(self.posterior.predicted_covariance(group.rows))
            needed[group.stations] = shares[:, -1] > 1 - LEFT_BY_OTHERS
        return self.used_stations[needed]


def cover(first: Array, second: Array) -> Array:
    """Return the smallest covariance (k, k) not below either of two in any direction, (8)."""
    std = np.sqrt(np.diag(first))
    values, vectors = np.linalg.eigh(first / np.outer(std, std))
    scales = np.sqrt(np.maximum(values, FREE_DIRECTION))
    root, inverse_root = std[:, None] * vectors * scales, (vectors / scales).T / std
    # in the axes in which the first is 1 and the second diagonal, the larger of both variances
    values, vectors = np.linalg.eigh(inverse_root @ second @ inverse_root.T)
    axes = root @ vectors
    return np.asarray((axes * np.maximum(values, 1.0)) @ axes.T)


@dataclass(frozen=True, eq=False)
class ConvergedFit:
    """Where the least squares (4) converged, and noise and taus for the estimate and report."""

    linear: Linearisation
    noise_of_estimate: NoiseModel
    noise_of_report: NoiseModel


def posteriors_of_fit(problem: Problem, fit: ConvergedFit, previous: Posterior | None = None
                      ) -> tuple[Posterior, Posterior]:
    """
    Return the posteriors for the estimate and for the report, with all blocks.

    The latter is at larger taus, with long errors of the robot only. fit: of the stations of the
    problem, or of a part of them; previous: the posterior for the report of a few stations more,
    whose taus are hardly different.
    """
    problem = problem.with_pose_parameters(fit.linear.problem.pose_parameters)
    posterior = posterior_at(problem, fit.linear.estimate, fit.noise_of_estimate)
    if len(problem.poses) > len(fit.linear.problem.poses):  # one step from the taus of the part
        at_report_taus = replace(posterior, noise=replace(
            fit.noise_of_estimate, tau_squares=fit.noise_of_report.tau_squares))
        for_estimate, _ = at_report_taus.estimated_tau_squares()
        posterior = posterior.with_tau_squares(for_estimate)
    noise, steps = (previous.noise, 1) if previous else (fit.noise_of_report, LAST_STEPS)
    for_report = posterior_at(replace(problem, long_errors=True), fit.linear.estimate, noise)
    return posterior, for_report.with_taus_for_report(steps)


def converged_fit(problem: Problem, start: Estimate) -> ConvergedFit:
    """
    Return the fit near a start, with noise and taus estimated there.

    Of a large problem it is that of evenly chosen stations.
    """
    n = len(problem.poses)
    if problem.is_large:
        problem = problem.subset(np.arange(0, n, round(n / problem.enough_stations)))
    reached, converged = _iterated(posterior_at(problem, start, NoiseModel()))
    if not converged:  # the nearest is the answer, as uncertain as any
        return ConvergedFit(reached.linear, reached.noise, reached.noise)
    # the taus of both follow from the posterior at those for the report
    at_report_taus = reached.with_taus_for_report(LAST_STEPS - 1)
    for_estimate, for_report = map(reached.with_tau_squares,
                                   at_report_taus.estimated_tau_squares())
    # the noise of the estimate, at its own taus; that of the report stays as it converged
    for _ in range(LAST_STEPS):
        for_estimate = for_estimate.with_estimated_factors(MAP_PRIOR_FACTORS)
    return ConvergedFit(for_estimate.relinearise(), for_estimate.noise, for_report.noise)


def _iterated(start: Posterior) -> tuple[Posterior, bool]:
    """
    Return the posterior that repeated steps (5) reach and True; if none, the nearest and False.

    The nearest has the shortest step in sigmas. In each round the variance factors follow from the
    posterior as it is linearised before the step (its predicted residuals after the step), (7),
    and the taus for the report from the posterior linearised anew there, (6). (Both from the same
    posterior may swing from too much of one to too much of the other for ever. Where these do all
    the same, half of the later changes, in logarithms, ends it.)
    """
    current = nearest = start
    shortest = np.inf
    for number in range(MAX_STEPS):
        sigmas = np.sqrt(np.diag(current.covariance))
        length = float(np.abs(current.step / sigmas)[:current.unknown_count].max())
        if length < shortest:
            nearest, shortest = current, length
        factors = current.estimated_factors()
        steady = np.abs(np.log(factors / current.noise.variance_factors)).max() < 0.1
        noise = replace(current.noise, variance_factors=factors)
        linear = current.relinearise()
        following = Posterior.of_linear(linear, noise, blocks_at(linear)).with_taus_for_report(1)
        if number >= FULL_STEPS and len(current.blocks) == len(following.blocks):
            following = following.with_tau_squares(
                np.sqrt(following.tau_squares * current.tau_squares))
        current = following
        if length < CONVERGED_SIGMAS and steady:
            break
    # a variance factor of a few points may settle slowly, and hardly moves the solution
    return (current, True) if length < NEAR_SIGMAS else (nearest, False)


def with_noise_reestimated(posterior: Posterior, further: tuple[ParameterBlock, ...] = ()
                           ) -> Posterior:
    """Return a posterior with noise and taus estimated again, and further blocks."""
    linear = linearise(posterior.problem, posterior.estimate)
    estimated = Posterior.of_linear(linear, posterior.noise, (*further, *blocks_at(linear)))
    for _ in range(LAST_STEPS):
        estimated = estimated.with_estimated_factors().with_taus_for_report(2)
    return estimated
