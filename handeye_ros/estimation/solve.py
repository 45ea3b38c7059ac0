# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The whitened least squares (4) with all blocks, its solution, and the estimate of scales and noise.

With whitened residuals r + J xi + K n = e, parameters n of variance tau^2 and noise e of unit
variance, the least squares of [J K; 0 1/tau] give the best linear unbiased xi (Henderson 1975,
Biometrics 31:423). The variances of the noise are estimated by restricted maximum likelihood in
multiplicative fixed-point steps (Patterson and Thompson 1971, Biometrika 58:545), held to the
configured ones by a weak prior; the scales of the parameters from prior and likelihood (see
noise).

The estimate and its reported covariance have different prior scales: an error without evidence in
the data must not move the estimate, but it may exist.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array, rms
from handeye_ros.estimation.basis import farthest_points, pose_features
from handeye_ros.estimation.blocks import (
    best_fit_motions,
    blocks_at,
    ParameterBlock,
    with_columns,
)
from handeye_ros.estimation.least_squares import (
    bounded_inverse,
    covariance_of,
    FREE_DIRECTION,
    leave_one_out,
    left_out_residuals,
)
from handeye_ros.estimation.noise import (
    BLOCKS_AS_NOISE,
    covariance_parts,
    FACTOR_FREEDOM,
    LOCAL_DISTORTION,
    Noise,
    prior_variances,
    total_covariance,
    Whitening,
    whitening,
)
from handeye_ros.estimation.problem import Estimate, Linear, linearise, Problem
import numpy as np
from numpy.typing import NDArray

# The iteration of the unknowns ends at a step of CONVERGED_SIGMAS; one more follows with the final
# scales. After MOST_STEPS, one of NEAR_SIGMAS is small enough.
CONVERGED_SIGMAS, NEAR_SIGMAS, MOST_STEPS = 0.25, 1.0, 10
FULL_STEPS = 5  # in which the scales change in full, later by half
LAST_STEPS = 3  # of variance factors and scales, after the last of the unknowns
LEFT_BY_OTHERS = 1e-6  # share of a variance; a station that leaves less to the others is needed
# prior variance factors for the estimate: no distortion that differs, unless the data show some
MAP_PRIOR_FACTORS = np.where(np.arange(5) == LOCAL_DISTORTION, 1e-4, 1.0)


@dataclass(frozen=True, eq=False)
class Solution:
    """
    The least squares at an estimate, (4), solved with one noise and one scale of each block.

    It is made in three stages: robust (refined_robustly: all stations, blocks as noise), agreed
    (without_outliers: the stations that agree), and MAP (with_systematic_errors: with blocks, and
    a conservative one for the report).

    Of the stations used:

    linear: their observations with the labels that these have, linearised before the last step;
        estimate and postfit_residuals are after it
    blocks: their q nuisance parameters are in units of the configured sigmas
    prefit_residuals: (m,) whitened residuals with all parameters of blocks at 0
    jacobian: (m, u + q) whitened derivatives A by u unknowns (first six: X) and q parameters
    normal_matrix: (u + q, u + q) A' A

    How these were chosen:

    full_problem: the problem with all stations and observations
    used: (n,) indices of those used
    dropped_squares: squared residual of the others
    probability_wrong: that one of few used stations is wrong
    surely_wrong: the place in `used` of the station that almost surely is, () without one

    What is reported, (8), is the estimate of one solution with the covariance of another:

    conservative: the latter, of a solution for the estimate: its own estimate moves too far
    added_covariances: (6, 6) by cause, added to the reported covariance of the transform, as by
        (10)
    """

    linear: Linear
    noise: Noise
    blocks: tuple[ParameterBlock, ...]
    whitening: Whitening
    prefit_residuals: Array
    jacobian: Array
    normal_matrix: Array
    full_problem: Problem
    used: NDArray[np.intp]
    dropped_squares: Mapping[int, float] = field(default_factory=dict)
    probability_wrong: float = 0.0
    added_covariances: Mapping[str, Array] = field(default_factory=dict)
    surely_wrong: tuple[int, ...] = ()
    conservative: Solution | None = None

    @classmethod
    def of_linear(cls, linear: Linear, noise: Noise, blocks: tuple[ParameterBlock, ...]
                  ) -> Solution:
        """Return the solution of a linearised problem with the parameters of blocks."""
        residuals = linear.residuals
        for block in blocks:
            if block.value is not None:  # its parameter is in the estimate, or in the poses
                residuals = residuals - block.columns @ (block.value / block.std)
        whiten, problem = whitening(linear, noise), linear.problem
        whitened = whiten(np.column_stack([linear.jacobian[:, problem.free_columns],
                                           *(block.columns for block in blocks), residuals]))
        A = whitened[:, :-1]
        return cls(linear, noise, blocks, whiten, whitened[:, -1], A, A.T @ A, problem,
                   np.arange(len(problem.poses)))

    @property
    def problem(self) -> Problem:
        """Return the problem of the used stations, with the observations used."""
        return self.linear.problem

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without the nuisance parameters."""
        return len(self.problem.free_columns)

    def prior_scale(self, block: ParameterBlock) -> float:
        """Return tau of a block: its sigma over the configured one."""
        return float(self.noise.block_variances.get(block.name, 1.0) ** 0.5)

    @property
    def variances(self) -> Array:
        """Return tau^2 of each block (d,)."""
        variances = self.noise.block_variances
        return np.array([variances.get(block.name, 1.0) for block in self.blocks])

    @cached_property
    def prior_information(self) -> Array:
        """Return the diagonal (u + q,) of P in (5): no information about the unknowns."""
        counts = [block.count for block in self.blocks]
        return np.append(np.zeros(self.unknowns), np.repeat(1 / self.variances, counts))

    @cached_property
    def information(self) -> Array:
        """Return the (u + q, u + q) information of residuals and priors."""
        return np.asarray(self.normal_matrix + np.diag(self.prior_information))

    @cached_property
    def covariance(self) -> Array:
        """Return C (u + q, u + q) of (5)."""
        if self.noise.blocks_as_noise:
            return covariance_of(self.jacobian)
        return bounded_inverse(self.information)

    @cached_property
    def _step_to_minimum(self) -> Array:
        """Return the change (u + q,) of unknowns and nuisance parameters to the minimum, (5)."""
        if self.noise.blocks_as_noise:  # the search ends where no step is left
            return np.zeros(self.unknowns)
        return np.asarray(-self.covariance @ (self.jacobian.T @ self.prefit_residuals))

    @property
    def nuisance(self) -> Array:
        """Return the estimates (q,) of the nuisance parameters."""
        return self._step_to_minimum[self.unknowns:]

    @cached_property
    def postfit_residuals(self) -> Array:
        """Return the whitened residuals (m,) at the solution, without the part of the blocks."""
        return np.asarray(self.prefit_residuals + self.jacobian @ self._step_to_minimum)

    @cached_property
    def estimate(self) -> Estimate:
        """Return the estimate after the last step, the stated measures of the target too."""
        moved = self.problem.retracted(
            self.linear.estimate, self._step_to_minimum[:self.unknowns])
        delta = np.zeros(len(self.problem.target.parameter_names))
        for block, columns in with_columns(self.blocks):
            if block.parameter is not None and block.value is not None:
                after = self.nuisance[columns] * block.std
                delta[block.parameter] = (after - block.value)[0]
        return Estimate(moved.X, self.problem.target.retract(moved.state, delta))

    def relinearise(self) -> Linear:
        """Return the problem linearised after the step, with the poses at their values then."""
        problem, values = self.problem, self.problem.pose_values.copy()
        for block, columns in with_columns(self.blocks):
            if block.pose_value is not None:
                values[block.pose_value] = self.nuisance[columns][0] * block.std
        return linearise(problem.with_pose_values(values), self.estimate)

    def predicted_covariance(self, rows: NDArray[np.intp]) -> Array:
        """Return the covariance (s, c, c) of whitened predictions in the rows (s, c)."""
        J = self.jacobian[rows]
        gain = (J.reshape(-1, J.shape[2]) @ self.covariance).reshape(J.shape)
        return np.asarray(gain @ np.swapaxes(J, 1, 2))

    def estimated_factors(self, prior: Array | float = 1.0) -> Array:
        """Return the variance factors (5,) from residuals and their prior phi_0, (7)."""
        # e' V~ e, and the trace of V~ (I - A C A'), of each factor
        before, groups = self.noise.variance_factors, self.problem.observations.station_groups
        sums = np.zeros((len(before), 2))
        for group, root in zip(groups, self.whitening.roots, strict=True):
            parts = covariance_parts(self.linear, group)
            whitened_parts = (root @ parts @ np.swapaxes(root, 1, 2)).reshape(len(parts), -1)
            e = self.postfit_residuals[group.rows]
            products = e[:, :, None] * e[:, None]
            expected = np.eye(e.shape[1]) - self.predicted_covariance(group.rows)
            sums[:len(parts)] += whitened_parts @ np.column_stack(
                [products.ravel(), expected.ravel()])
        squares, trace = before * sums.T
        after = before * (squares + FACTOR_FREEDOM * prior / before) / (
            np.maximum(trace, 0.0) + FACTOR_FREEDOM)
        return np.asarray(np.clip(after, 1e-4, 1e8))

    def estimated_block_variances(self) -> tuple[Array, Array]:
        """Return the variances (d,) of blocks for the estimate and for the report, (6)."""
        u, least = self.unknowns, [block.least_variance for block in self.blocks]
        for_estimate, for_report = prior_variances(
            self.covariance[u:, u:], self.nuisance, [block.count for block in self.blocks],
            self.variances, np.array([block.largest_variance for block in self.blocks]))
        return np.maximum(for_estimate, least), np.maximum(for_report, least)

    def with_variances(self, variances: Array) -> Solution:
        """Return the solution with variances (d,) of blocks, relative to the configured ones."""
        named = dict(zip([block.name for block in self.blocks], variances.tolist(), strict=True))
        return replace(self, noise=replace(self.noise, block_variances=named))

    def with_estimated_factors(self, prior: Array | float = 1.0) -> Solution:
        """Return the solution with variance factors from (7), linearised where this one is."""
        noise = replace(self.noise, variance_factors=self.estimated_factors(prior))
        return Solution.of_linear(self.linear, noise, self.blocks)

    def with_scales_for_report(self, steps: int) -> Solution:
        """
        Return the solution at the estimated prior scales for the report, itself if it is there.

        Ends early if a step hardly changes the variances.
        """
        current = self
        for _ in range(steps if self.blocks else 0):
            _, variances = current.estimated_block_variances()
            if np.abs(np.log(variances / current.variances)).max() < 0.03:
                break
            current = current.with_variances(variances)
        return current

    @property
    def for_report(self) -> Solution:
        """Return the solution for the report, itself without one."""
        return self.conservative or self

    @cached_property
    def reported_covariance(self) -> Array:
        """
        Return the reported covariance (u, u) of the unknowns, (8).

        It covers the errors of both the mount's transform and the best-fit transform.
        """
        reported = self.for_report.covariance[:self.unknowns, :self.unknowns].copy()
        if self.conservative is None:
            return reported
        shift = self.shift_for_report
        reported[:6, :6] = cover(reported[:6, :6] + np.outer(shift, shift), self._best_fit)
        reported[:6, :6] += sum(self.added_covariances.values())
        return reported

    @property
    def transform_covariance(self) -> Array:
        """Return the reported covariance (6, 6) of the transform."""
        return self.reported_covariance[:6, :6]

    @property
    def shift_for_report(self) -> Array:
        """Return d (6,): how far the scales for the report would move the estimate, (8)."""
        return se3.difference(self.for_report.estimate.X, self.estimate.X)

    @property
    def _best_fit(self) -> Array:
        """Return the mean square (6, 6) of the best-fit transform about the estimate, (9)."""
        reported = self.for_report
        G = best_fit_motions(reported.linear, reported.blocks)
        L = np.hstack([np.eye(6, reported.unknowns), G])
        d_fit = self.shift_for_report + G @ reported.nuisance
        return np.asarray(L @ reported.covariance @ L.T + np.outer(d_fit, d_fit))

    @cached_property
    def ranks(self) -> NDArray[np.intp]:
        """
        Return the rank (n,) of each station's derivatives by the unknowns.

        Many points of one line have rank two: the offset and the direction of the line.
        """
        station = self.problem.observations.station
        ranks = np.zeros(len(self.problem.poses), dtype=np.intp)
        J = self.jacobian[:, :self.unknowns]
        J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        for group in self.problem.observations.station_groups:
            s = np.linalg.svd(J[group.rows], compute_uv=False)
            # smaller singular values are repeated information with other noise
            ranks[station[group.rows[:, 0]]] = (s > 1e-3 * s[:, :1]).sum(axis=1)
        return ranks

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of squares of residuals and nuisance parameters."""
        r, step = self.postfit_residuals, self._step_to_minimum
        return float(r @ r + step ** 2 @ self.prior_information)

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual per degree of freedom."""
        return self.sum_of_squares / max(self.degrees_of_freedom, 1)

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of conditions less the number of unknowns."""
        return len(self.prefit_residuals) - self.unknowns

    @property
    def target_std(self) -> Array:
        """Return 1 sigma (k,) of the target's parameters, 0 for known ones."""
        std, reported = np.zeros(len(self.problem.target.parameter_names)), self.for_report
        variances = np.diag(reported.covariance)
        std[self.problem.free_columns[6:] - 6] = np.sqrt(variances[6:self.unknowns])
        for block, columns in with_columns(reported.blocks, self.unknowns):
            if block.parameter is not None:
                std[block.parameter] = block.std * variances[columns][0] ** 0.5
        return std

    @property
    def redundancy(self) -> int:
        """
        Return the number of independent conditions in excess of the unknowns.

        A repeated pose adds no information; of very many poses only some are counted.
        """
        distinct = farthest_points(pose_features(self.problem.poses), self.problem.enough)
        return int(self.ranks[distinct].sum()) - self.unknowns

    @property
    def residual_rms(self) -> float:
        """Return the RMS (m) of the residuals before whitening."""
        return rms(self.linear.residuals)

    @property
    def expected_rms(self) -> float:
        """Return the expected RMS (m) of residuals for configured noise and nuisances."""
        covariances = (total_covariance(self.linear, group, BLOCKS_AS_NOISE)
                       for group in self.problem.observations.station_groups)
        total = sum(float(np.einsum('nii->', covariance)) for covariance in covariances)
        return float((total / len(self.linear.residuals)) ** 0.5)

    @property
    def deviance(self) -> float:
        """Return -2 log of the marginal likelihood, the prior of the noise factors included."""
        log_det_V = -2 * sum(float(np.log(np.einsum('nii->ni', root)).sum())
                             for root in self.whitening.roots)
        factors, priors = self.noise.variance_factors, self.prior_information[self.unknowns:]
        prior_of_factors = FACTOR_FREEDOM * float((np.log(factors) + 1 / factors - 1).sum())
        return float(log_det_V + np.linalg.slogdet(self.information)[1] - np.log(priors).sum()
                     + self.sum_of_squares + prior_of_factors)

    @property
    def stations_without_edges(self) -> NDArray[np.intp]:
        """Return the used stations that show essential observations, but of which none is used."""
        shown = self.full_problem.subset(self.used).shows_essential
        return self.used[shown & ~self.problem.shows_essential]

    @property
    def fully_used(self) -> int:
        """Return the number of used stations with their essential observations used."""
        return len(self.used) - len(self.stations_without_edges)

    def corrected_poses(self, nuisance: Array | None = None) -> Array:
        """
        Return the poses (n, 4, 4) without the estimated errors of the robot.

        nuisance: (n, q) parameters of the blocks at each pose, None: as estimated.
        """
        problem, T = self.problem, self.problem.robot_poses
        values = np.zeros((len(T), 1)) + (self.nuisance if nuisance is None else nuisance)
        twists = np.zeros((len(T), 6))
        for block, columns in with_columns(self.blocks):
            if block.twists is not None:
                # the poses already include the parameters that they depend on, as estimated
                included = self.nuisance[columns] * (block.value is not None)
                twists += block.std * np.einsum(
                    'nxk,nk->nx', block.twists, values[:, columns] - included)
        corrected = se3.transform(se3.exp_rotation(twists[:, 3:]) @ T[:, :3, :3],
                                  T[:, :3, 3] + twists[:, :3])
        return corrected if problem.config.in_hand else se3.inverse(corrected)

    def left_out_squares(self) -> tuple[Array, NDArray[np.intp]]:
        """
        Return per station the mean squared leave-one-out residual and its degrees of freedom.

        Whitened, and to first order from the fit without the station, (12): times its degrees of
        freedom it is chi-squared distributed when the station is good. All points of a station
        share one pose, which has 6 degrees of freedom.
        """
        station, e = self.problem.observations.station, self.postfit_residuals
        products = e * leave_one_out(e, self.jacobian, self.covariance, station)
        sums, count = (np.bincount(station, weights, len(self.problem.poses))
                       for weights in (products, None))
        return sums / np.maximum(count, 1), np.clip(count, 1, 6)

    @property
    def is_determined(self) -> bool:
        """Return whether no direction of the unknowns is free: 1 sigma of 1 m or 1 rad."""
        return bool(np.linalg.eigvalsh(self.covariance)[-1] <= 1.0)

    @property
    def indispensable_stations(self) -> NDArray[np.intp]:
        """Return the used stations that determine something that no other one shows."""
        station, needed = self.problem.observations.station, np.zeros(len(self.used), dtype=bool)
        for group in self.problem.observations.station_groups:
            # 1 where all that is known of a direction comes from the station itself
            largest_share = np.linalg.eigvalsh(self.predicted_covariance(group.rows))[:, -1]
            needed[station[group.rows[:, 0]]] = largest_share > 1 - LEFT_BY_OTHERS
        return self.used[needed]

    def predictions(self, fold: NDArray[np.intp]) -> tuple[list[Estimate], Array]:
        """
        Return the estimate without each fold of stations, to first order.

        fold: (n,) fold of each station, from 0. Also returns the poses (n, 4, 4), corrected by the
        robot's smooth error as estimated from the other folds.
        """
        fold_of_row, u = fold[self.problem.observations.station], self.unknowns
        steps = np.empty((fold.max() + 1, len(self.prior_information)))
        for k in range(len(steps)):
            A, e = self.jacobian[fold_of_row == k], self.postfit_residuals[fold_of_row == k]
            left_out = left_out_residuals((A @ self.covariance @ A.T)[None], e[None])[0]
            steps[k] = self.covariance @ (A.T @ left_out)
        return ([self.problem.retracted(self.estimate, step) for step in steps[:, :u]],
                self.corrected_poses(self.nuisance + steps[fold, u:]))


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
class Minimum:
    """Where the least squares (4) converged, and noise and scales for the estimate and report."""

    linear: Linear
    noise_of_estimate: Noise
    noise_of_report: Noise


def map_solution(problem: Problem, start: Estimate) -> Solution:
    """Return the MAP solution near a start, with prior scales and noise estimated."""
    return solution_at_minimum(problem, minimum_near(problem, start))


def solution_at_minimum(problem: Problem, minimum: Minimum, before: Solution | None = None
                        ) -> Solution:
    """
    Return the MAP solution of a problem at the minimum of its stations, or of a part of them.

    It is for the estimate, and holds another one for the report: at wider scales, with long errors
    of the robot only. before: the same of a few stations more, whose scales are hardly different.
    """
    at = minimum.linear
    problem = problem.with_pose_values(at.problem.pose_values)
    solution = solution_at(problem, at.estimate, minimum.noise_of_estimate)
    if len(problem.poses) > len(at.problem.poses):  # one step from the scales of the part
        at_report_scales = replace(solution, noise=replace(
            minimum.noise_of_estimate, block_variances=minimum.noise_of_report.block_variances))
        for_estimate, _ = at_report_scales.estimated_block_variances()
        solution = solution.with_variances(for_estimate)
    noise, steps = (before.for_report.noise, 1) if before else (
        minimum.noise_of_report, LAST_STEPS)
    report = solution_at(replace(problem, long_errors=True), at.estimate, noise)
    return replace(solution, conservative=report.with_scales_for_report(steps))


def minimum_near(problem: Problem, start: Estimate) -> Minimum:
    """
    Return the minimum near a start, with noise and scales estimated there.

    Of a large problem it is that of evenly chosen stations.
    """
    n = len(problem.poses)
    if problem.is_large:
        problem = problem.subset(np.arange(0, n, round(n / problem.enough)))
    reached, converged = _iterated(solution_at(problem, start, Noise()))
    if not converged:  # the nearest is the answer, as uncertain as any
        return Minimum(reached.linear, reached.noise, reached.noise)
    # both scales follow from the posterior at those for the report
    for_estimate = for_report = reached
    if reached.blocks:
        posterior = reached.with_scales_for_report(LAST_STEPS - 1)
        for_estimate, for_report = map(reached.with_variances,
                                       posterior.estimated_block_variances())
    # the noise of the estimate, at its own scales; that of the report stays as it converged
    for _ in range(LAST_STEPS):
        for_estimate = for_estimate.with_estimated_factors(MAP_PRIOR_FACTORS)
    return Minimum(for_estimate.relinearise(), for_estimate.noise, for_report.noise)


def _iterated(start: Solution) -> tuple[Solution, bool]:
    """
    Return the solution that repeated steps (5) reach and True, or, if none, the nearest and False.

    The nearest has the shortest step in sigmas. After each step the variance factors are estimated
    from the residuals before it, (7), and then the scales for the report from those after it, (6).
    (Both from the same residuals may swing from too much of one to too much of the other for ever.
    Where these do all the same, half of the later changes, in logarithms, ends it.)
    """
    current = nearest = start
    shortest = np.inf
    for number in range(MOST_STEPS):
        step = current._step_to_minimum[:current.unknowns]
        sigmas = np.sqrt(np.diag(current.covariance)[:current.unknowns])
        length = float(np.abs(step / sigmas).max())
        if length < shortest:
            nearest, shortest = current, length
        factors = current.estimated_factors()
        steady = np.abs(np.log(factors / current.noise.variance_factors)).max() < 0.1
        noise = replace(current.noise, variance_factors=factors)
        linear = current.relinearise()
        following = Solution.of_linear(linear, noise, blocks_at(linear)).with_scales_for_report(1)
        if number >= FULL_STEPS and len(current.blocks) == len(following.blocks):
            following = following.with_variances(np.sqrt(following.variances * current.variances))
        current = following
        if length < CONVERGED_SIGMAS and steady:
            break
    # a variance factor of a few points may settle slowly, and hardly moves the solution
    return (current, True) if length < NEAR_SIGMAS else (nearest, False)


def solution_at(problem: Problem, estimate: Estimate, noise: Noise) -> Solution:
    """Return the solution at an estimate; all blocks are its parameters if they are no noise."""
    linear = linearise(problem, estimate)
    return Solution.of_linear(linear, noise, () if noise.blocks_as_noise else blocks_at(linear))


def with_noise_reestimated(solution: Solution, further: tuple[ParameterBlock, ...] = ()
                           ) -> Solution:
    """Return a solution with noise and prior scales estimated again, and further blocks."""
    linear = linearise(solution.problem, solution.estimate)
    estimated = Solution.of_linear(linear, solution.noise, (*further, *blocks_at(linear)))
    for _ in range(LAST_STEPS):
        estimated = estimated.with_estimated_factors().with_scales_for_report(2)
    return estimated
