# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The whitened least squares (4) with all blocks, and what follows from it: the posterior.

With whitened residuals r + J xi + K n = e, parameters n of variance tau^2 and noise e of unit
variance, the least squares of [J K; 0 1/tau] give the best linear unbiased xi (Henderson 1975,
Biometrics 31:423). The variances of the noise are estimated by restricted maximum likelihood in
multiplicative fixed-point steps (Patterson and Thompson 1971, Biometrika 58:545), held to the
configured ones by a weak prior; tau of the parameters follows from prior and likelihood (see
noise).
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.data import Array
from handeye_ros.estimation.basis import farthest_points, scaled_pose_vectors
from handeye_ros.estimation.blocks import blocks_at, blocks_with_columns, ParameterBlock
from handeye_ros.estimation.least_squares import (
    covariance_from_information,
    covariance_from_jacobian,
    means_by,
)
from handeye_ros.estimation.noise import (
    BLOCKS_AS_NOISE,
    covariance_parts,
    FACTOR_FREEDOM,
    NoiseModel,
    tau_squares_of_block,
    total_covariance,
    Whitening,
    whitening,
)
from handeye_ros.estimation.outliers import leave_one_out_residuals
from handeye_ros.estimation.problem import Estimate, Linearisation, linearise, Problem
from handeye_ros.frames import mount_poses
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Posterior:
    """
    The normal distribution (5) of unknowns and nuisance parameters, for one noise and its taus.

    linear: the stations' observations with their kinds as assigned, linearised before the last
        step; estimate and postfit_residuals are after it
    blocks: their q nuisance parameters are in units of the configured sigmas; none where they
        count as noise
    prefit_residuals: (m,) whitened residuals with all parameters of blocks at 0
    jacobian: (m, u + q) whitened derivatives A by u unknowns (first six: X) and q parameters
    normal_matrix: (u + q, u + q) A' A
    """

    linear: Linearisation
    noise: NoiseModel
    blocks: tuple[ParameterBlock, ...]
    whitening: Whitening
    prefit_residuals: Array
    jacobian: Array
    normal_matrix: Array

    @classmethod
    def of_linear(cls, linear: Linearisation, noise: NoiseModel,
                  blocks: tuple[ParameterBlock, ...]) -> Posterior:
        """Return the posterior of a linearised problem with the parameters of blocks."""
        residuals = linear.residuals
        for block in blocks:
            if block.value is not None:  # its parameter is in the estimate, or in the poses
                residuals = residuals - block.columns @ (block.value / block.std)
        whiten, problem = whitening(linear, noise), linear.problem
        whitened = whiten(np.column_stack([linear.jacobian[:, problem.free_columns],
                                           *(block.columns for block in blocks), residuals]))
        A = whitened[:, :-1]
        return cls(linear, noise, blocks, whiten, whitened[:, -1], A, A.T @ A)

    @property
    def problem(self) -> Problem:
        """Return the problem of the used stations, with kinds as assigned."""
        return self.linear.problem

    @property
    def unknown_count(self) -> int:
        """Return the number of unknowns without the nuisance parameters."""
        return len(self.problem.free_columns)

    def prior_tau(self, block: ParameterBlock) -> float:
        """Return tau of a block: its sigma over the configured one."""
        return float(self.noise.tau_squares.get(block.name, 1.0) ** 0.5)

    @property
    def tau_squares(self) -> Array:
        """Return tau^2 of each block (d,)."""
        return np.array([self.noise.tau_squares.get(block.name, 1.0) for block in self.blocks])

    @cached_property
    def prior_information(self) -> Array:
        """Return the diagonal (u + q,) of P in (5): no information about the unknowns."""
        counts = [block.count for block in self.blocks]
        return np.append(np.zeros(self.unknown_count), np.repeat(1 / self.tau_squares, counts))

    @cached_property
    def information(self) -> Array:
        """Return the (u + q, u + q) information of residuals and priors."""
        return np.asarray(self.normal_matrix + np.diag(self.prior_information))

    @cached_property
    def covariance(self) -> Array:
        """Return C (u + q, u + q) of (5)."""
        if self.noise.blocks_as_noise:
            return covariance_from_jacobian(self.jacobian)
        return covariance_from_information(self.information)

    @cached_property
    def step(self) -> Array:
        """Return the change (u + q,) of unknowns and nuisance parameters to the minimum, (5)."""
        if self.noise.blocks_as_noise:  # the search ends where no step is left
            return np.zeros(self.unknown_count)
        return np.asarray(-self.covariance @ (self.jacobian.T @ self.prefit_residuals))

    @property
    def nuisance(self) -> Array:
        """Return the estimates (q,) of the nuisance parameters."""
        return self.step[self.unknown_count:]

    @cached_property
    def postfit_residuals(self) -> Array:
        """Return the whitened residuals (m,) after the last step, without what blocks explain."""
        return np.asarray(self.prefit_residuals + self.jacobian @ self.step)

    @cached_property
    def estimate(self) -> Estimate:
        """Return the estimate after the last step, the stated measures of the target too."""
        moved = self.problem.retracted(self.linear.estimate, self.step[:self.unknown_count])
        delta = np.zeros(len(self.problem.target.parameter_names))
        for block, columns in blocks_with_columns(self.blocks):
            if (i := block.target_parameter_index) is not None and block.value is not None:
                delta[i] = (self.nuisance[columns] * block.std - block.value)[0]
        return Estimate(moved.X, self.problem.target.retract(moved.state, delta))

    def relinearise(self) -> Linearisation:
        """Return the problem linearised after the step, with the poses at their values then."""
        problem, pose_parameters = self.problem, self.problem.pose_parameters.copy()
        for block, columns in blocks_with_columns(self.blocks):
            if block.pose_parameter_index is not None:
                pose_parameters[block.pose_parameter_index] = self.nuisance[columns][0] * block.std
        return linearise(problem.with_pose_parameters(pose_parameters), self.estimate)

    @cached_property
    def cross_covariance(self) -> Array:
        """Return A C (m, u + q), the covariance of whitened predictions with the parameters."""
        return np.asarray(self.jacobian @ self.covariance)

    def predicted_covariance(self, rows: NDArray[np.intp]) -> Array:
        """Return the covariance (s, c, c) of whitened predictions in the rows (s, c)."""
        return np.asarray(self.cross_covariance[rows] @ np.swapaxes(self.jacobian[rows], 1, 2))

    def estimated_factors(self, prior: Array | float = 1.0) -> Array:
        """Return the variance factors (5,) from residuals and their prior phi_0, (7)."""
        # e' V~ e, and the trace of V~ (I - A C A'), of each factor
        present, groups = self.noise.variance_factors, self.problem.observations.station_groups
        sums = np.zeros((len(present), 2))
        for group, root in zip(groups, self.whitening.roots, strict=True):
            parts = covariance_parts(self.linear, group)
            whitened_parts = (root @ parts @ np.swapaxes(root, 1, 2)).reshape(len(parts), -1)
            e = self.postfit_residuals[group.rows]
            products = e[:, :, None] * e[:, None]
            expected = np.eye(e.shape[1]) - self.predicted_covariance(group.rows)
            sums[:len(parts)] += whitened_parts @ np.column_stack(
                [products.ravel(), expected.ravel()])
        squares, trace = present * sums.T
        after = present * (squares + FACTOR_FREEDOM * prior / present) / (
            np.maximum(trace, 0.0) + FACTOR_FREEDOM)
        return np.asarray(np.clip(after, 1e-4, 1e8))

    def estimated_tau_squares(self) -> tuple[Array, Array]:
        """Return tau^2 (d,) of blocks for the estimate and for the report, (6)."""
        squares = np.empty((2, len(self.blocks)))
        for i, (block, columns) in enumerate(
                blocks_with_columns(self.blocks, self.unknown_count)):
            found = tau_squares_of_block(self.covariance[columns, columns], self.step[columns],
                                         self.tau_squares[i], block.largest_tau_squared)
            squares[:, i] = np.maximum(found, block.least_tau_squared)
        return squares[0], squares[1]

    def with_tau_squares(self, squares: Array) -> Posterior:
        """Return the posterior with tau^2 (d,) of blocks."""
        named = dict(zip([block.name for block in self.blocks], squares.tolist(), strict=True))
        return replace(self, noise=replace(self.noise, tau_squares=named))

    def with_estimated_factors(self, prior: Array | float = 1.0) -> Posterior:
        """Return the posterior with variance factors from (7), linearised where this one is."""
        noise = replace(self.noise, variance_factors=self.estimated_factors(prior))
        return Posterior.of_linear(self.linear, noise, self.blocks)

    def with_taus_for_report(self, steps: int) -> Posterior:
        """
        Return the posterior at the estimated taus for the report, itself if it is there.

        Ends early if a step hardly changes them.
        """
        current = self
        for _ in range(steps if self.blocks else 0):
            _, squares = current.estimated_tau_squares()
            if np.abs(np.log(squares / current.tau_squares)).max() < 0.03:
                break
            current = current.with_tau_squares(squares)
        return current

    @cached_property
    def ranks(self) -> NDArray[np.intp]:
        """
        Return the rank (n,) of each station's derivatives by the unknowns.

        Many points of one line have rank two: the offset and the direction of the line.
        """
        ranks = np.zeros(len(self.problem.poses), dtype=np.intp)
        J = self.jacobian[:, :self.unknown_count]
        J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        for group in self.problem.observations.station_groups:
            s = np.linalg.svd(J[group.rows], compute_uv=False)
            # smaller singular values are repeated information with other noise
            ranks[group.stations] = (s > 1e-3 * s[:, :1]).sum(axis=1)
        return ranks

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of squares of residuals and nuisance parameters."""
        r = self.postfit_residuals
        return float(r @ r + self.step ** 2 @ self.prior_information)

    @property
    def reduced_chi_squared(self) -> float:
        """Return the sum of squared whitened residuals per degree of freedom."""
        return self.sum_of_squares / max(self.degrees_of_freedom, 1)

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of conditions less the number of unknowns."""
        return len(self.prefit_residuals) - self.unknown_count

    @property
    def redundancy(self) -> int:
        """
        Return the number of independent conditions in excess of the unknowns.

        A repeated pose adds no information; of very many poses only some are counted.
        """
        problem = self.problem
        distinct = farthest_points(scaled_pose_vectors(problem.poses), problem.enough_stations)
        return int(self.ranks[distinct].sum()) - self.unknown_count

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
    def minus_2_log_marginal(self) -> float:
        """Return -2 log of the marginal likelihood, the prior of the noise factors included."""
        log_det_V = -2 * sum(float(np.log(np.einsum('nii->ni', root)).sum())
                             for root in self.whitening.roots)
        factors, priors = self.noise.variance_factors, self.prior_information[self.unknown_count:]
        prior_of_factors = FACTOR_FREEDOM * float((np.log(factors) + 1 / factors - 1).sum())
        return float(log_det_V + np.linalg.slogdet(self.information)[1] - np.log(priors).sum()
                     + self.sum_of_squares + prior_of_factors)

    def corrected_poses(self, nuisance: Array | None = None) -> Array:
        """
        Return the poses (n, 4, 4) of the mount without the estimated errors of the robot.

        nuisance: (n, q) parameters of the blocks at each pose, None: as estimated.
        """
        problem, T = self.problem, self.problem.robot_poses
        values = np.zeros((len(T), 1)) + (self.nuisance if nuisance is None else nuisance)
        twists = np.zeros((len(T), 6))
        for block, columns in blocks_with_columns(self.blocks):
            if block.twists is not None:
                # the poses already include the parameters that they depend on, as estimated
                included = self.nuisance[columns] * (block.value is not None)
                twists += block.std * np.einsum(
                    'nxk,nk->nx', block.twists, values[:, columns] - included)
        return mount_poses(se3.perturb(T, twists), problem.config)

    def left_out_squares(self) -> tuple[Array, NDArray[np.intp]]:
        """
        Return the left-out square of each station, (12), and its degrees of freedom, (n,) each.

        It is the mean product of whitened residuals and leave-one-out residuals: times its degrees
        of freedom it is chi-squared distributed when the station is good. All points of a station
        share one pose, which has 6 degrees of freedom.
        """
        station, n = self.problem.observations.station, len(self.problem.poses)
        residuals = self.postfit_residuals
        left_out = leave_one_out_residuals(
            residuals, self.jacobian, self.cross_covariance, station)
        return (means_by(station, residuals * left_out, n),
                np.clip(np.bincount(station, minlength=n), 1, 6))

    @property
    def is_determined(self) -> bool:
        """Return whether no direction of the unknowns is free: 1 sigma of 1 m or 1 rad."""
        u = self.unknown_count
        return bool(np.linalg.eigvalsh(self.covariance[:u, :u])[-1] <= 1.0)

    def estimates_without(self, fold: NDArray[np.intp]) -> tuple[list[Estimate], Array]:
        """
        Return the estimate without each fold of stations, to first order.

        fold: (n,) fold of each station, from 0. Also returns the poses (n, 4, 4), corrected by all
        errors of the robot as estimated from the other folds.
        """
        fold_of_row, u = fold[self.problem.observations.station], self.unknown_count
        rows = np.argsort(fold_of_row, kind='stable')
        left_out = leave_one_out_residuals(self.postfit_residuals[rows], self.jacobian[rows],
                                           self.cross_covariance[rows], fold_of_row[rows])
        steps = np.zeros((fold.max() + 1, len(self.prior_information)))
        np.add.at(steps, fold_of_row[rows], left_out[:, None] * self.cross_covariance[rows])
        return ([self.problem.retracted(self.estimate, step) for step in steps[:, :u]],
                self.corrected_poses(self.nuisance + steps[fold, u:]))


def posterior_at(problem: Problem, estimate: Estimate, noise: NoiseModel) -> Posterior:
    """Return the posterior at an estimate; all blocks are its parameters if they are no noise."""
    linear = linearise(problem, estimate)
    return Posterior.of_linear(linear, noise, () if noise.blocks_as_noise else blocks_at(linear))
