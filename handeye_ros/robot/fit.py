# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye transform and errors of an arm from the same stops: one least squares with priors.

A target gives profiles, with the residuals of the hand-eye estimate (docs/estimator.md), or
points: r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in
the axes of the sensor; s is the measured point, c the position of the target. Several targets, or
one at several positions, have sensor and arm in common; the errors of the arm act through the
twists of the flange.

As of the blocks in sections 3 and 4 of docs/estimator.md, the data determine tau^2 of each kind of
error: its most likely value for the estimate, a conservative one for the covariance.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.arm import Arm, KIND_OF_ERROR
from handeye_ros.data import Array, Indices
from handeye_ros.estimation.basis import smooth_basis
from handeye_ros.estimation.least_squares import (
    covariance_from_jacobian,
    Evaluation,
    LeastSquares,
    rms_by,
)
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, tau_squares_of_block, whitening
from handeye_ros.estimation.outliers import drop_outliers, leave_one_out_residuals
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.frames import mount_poses
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

SMOOTH_ERROR_STD = 2e-4  # prior 1 sigma of the remaining error of the robot, each axis (m)
MIN_STOPS = 12  # that the cross-validation has four regions of three stops
# iterations of taus and noise; relative change below which they end
MAX_ROUNDS, CONVERGED_CHANGE = 6, 0.02
POOLED_FREEDOM = 4.0  # degrees of freedom by which the noise of all axes counts for each axis
MIN_NOISE = 1e-6  # rounding of the values (m)
LARGEST_TAU_SQUARED = 1e3  # of a kind of error


@dataclass(frozen=True, eq=False)
class Residuals:
    """
    The independent residuals of one target, and their derivatives; ArmFit.noise are their sigmas.

    values: (m,) of profiles in sigmas as configured, of points in metres
    station: (m,) the stop of each residual
    wrt_X_and_target: (m, 6 + k) derivatives by X and the k parameters of the target
    wrt_pose: (m, 6) derivatives by a shift of the flange and a turn about it, in the base
    distances: (n,) of the points of each stop from the target, RMS (m)
    """

    values: Array
    station: Indices
    wrt_X_and_target: Array
    wrt_pose: Array
    distances: Array


@dataclass(frozen=True, eq=False)
class ArmProfiles:
    """Profiles of a target at reported joint values q (n, joints): a problem, posed by the arm."""

    q: Array
    problem: Problem

    def residuals(self, arm: Arm, X: Array, target: Array) -> Residuals:
        """Return the residuals with the sensor in its mount X (4, 4) and a state of the target."""
        poses = mount_poses(arm.forward(self.q), self.problem.config)
        problem = replace(self.problem, poses=poses)
        linear, station = linearise(problem, Estimate(X, target)), problem.observations.station
        whiten = whitening(linear, BLOCKS_AS_NOISE)
        return Residuals(whiten(linear.residuals), station,
                         whiten(linear.jacobian[:, problem.free_columns]), whiten(linear.wrt_pose),
                         rms_by(station, linear.residuals, len(poses)))

    def retracted(self, target: Array, step: Array) -> Array:
        """Return the state of the target after a step (k,)."""
        step = np.append(np.zeros(6), step)
        return self.problem.retracted(Estimate(np.eye(4), target), step).state


@dataclass(frozen=True, eq=False)
class ArmPoints:
    """
    The point (n, 3) that a target is, in the sensor frame, at reported joint values q (n, joints).

    in_hand: whether the sensor is on the flange.
    """

    q: Array
    points: Array
    in_hand: bool

    def mount_poses(self, arm: Arm) -> Array:
        """Return the poses (n, 4, 4) of the mount of the sensor where the target is fixed."""
        T_base_flange = arm.forward(self.q)
        return T_base_flange if self.in_hand else se3.inverse(T_base_flange)

    def residuals(self, arm: Arm, X: Array, target: Array) -> Residuals:
        """Return the residuals with the sensor in its mount X (4, 4) and the target (3,)."""
        T = self.mount_poses(arm)
        lever, n = self.points @ X[:3, :3].T, len(self.q)
        in_fixed = se3.apply(T, (lever + X[:3, 3])[:, None])[:, 0]  # where the target is fixed
        to_mount = np.broadcast_to(X[:3, :3].T, (n, 3, 3))
        to_fixed = to_mount @ np.swapaxes(T[:, :3, :3], 1, 2)
        values = to_fixed @ (in_fixed - target)[:, :, None]
        wrt_X_and_target = np.concatenate(
            [to_mount @ se3.perturbation_jacobian(lever), -to_fixed], axis=2)
        wrt_shift, from_flange = (to_fixed, in_fixed - T[:, :3, 3]) if self.in_hand else (
            -to_mount, target @ T[:, :3, :3])
        wrt_pose = wrt_shift @ se3.perturbation_jacobian(from_flange)
        return Residuals(values.ravel(), np.repeat(np.arange(n), 3),
                         wrt_X_and_target.reshape(3 * n, -1), wrt_pose.reshape(3 * n, 6),
                         np.linalg.norm(values[:, :, 0], axis=1))

    def retracted(self, target: Array, step: Array) -> Array:
        """Return the position of the target after a step (3,)."""
        return target + step


Measurement: TypeAlias = ArmProfiles | ArmPoints


@dataclass(frozen=True, eq=False)
class ArmFit:
    """
    An estimate from n stops, target by target, and their weights; the state of a least squares.

    Its unknowns (u of them): sensor in its mount X (4, 4), errors of the arm, smooth error of the
    robot, state of each target.

    measured, targets: what the sensor measured of each target, and the state of the target
    smooth: (3 b,) coefficients of smooth functions, the remaining error of the robot
    noise: (axes,) 1 sigma of the residuals: of points one for each axis, else one
    used: (n,) which stops count
    tau_squares: (g,) tau^2 of each kind of error of the robot: its variance over the prior one
    smooth_error_basis: (n, b) the smooth functions at the stops
    """

    measured: tuple[Measurement, ...]
    X: Array
    arm: Arm
    smooth: Array
    targets: tuple[Array, ...]
    noise: Array
    used: NDArray[np.bool_]
    tau_squares: Array
    smooth_error_basis: Array

    @classmethod
    def of_arm(cls, arm: Arm, measured: Sequence[Measurement], X: Array,
               targets: Iterable[Array], noise: Array) -> ArmFit:
        """Return a start with all stops, without errors of the robot."""
        n, empty = sum(len(data.q) for data in measured), np.zeros(0)
        return cls(tuple(measured), X, arm, empty, tuple(targets), noise, np.ones(n, dtype=bool),
                   empty, np.zeros((n, 0)))

    @cached_property
    def q(self) -> Array:
        """Return the reported joint values (n, joints)."""
        return np.concatenate([data.q for data in self.measured])

    @cached_property
    def station(self) -> Indices:
        """Return the stop (r,) of each residual, of unused stops too."""
        first = np.cumsum([0, *(len(data.q) for data in self.measured)])[:-1]
        return np.concatenate([start + residual.station
                               for start, residual in zip(first, self.residuals, strict=True)])

    @property
    def used_rows(self) -> Indices:
        """
        Return the numbers (m,) of the residuals of used stops, among all r.

        Points have x, y and z in turn, so the remainder by the axes of `noise` is the axis.
        """
        return np.flatnonzero(self.used[self.station])

    @property
    def robot_errors(self) -> Array:
        """Return the errors (p,) of the robot: those of the arm, and the smooth ones."""
        return np.append(self.arm.error_values, self.smooth)

    @property
    def kind_numbers(self) -> Indices:
        """Return the kind (p,) of each error as a number from 0; the smooth ones are the last."""
        _, kind = np.unique(KIND_OF_ERROR[self.arm.is_estimated.nonzero()[1]], return_inverse=True)
        return np.append(kind, np.full(len(self.smooth), kind.max(initial=-1) + 1))

    @property
    def prior_stds(self) -> Array:
        """Return the prior sigmas (p,) of the errors, at the estimated tau of each kind."""
        stated = np.append(self.arm.prior_stds[self.arm.is_estimated],
                           np.full(len(self.smooth), SMOOTH_ERROR_STD))
        return stated * np.sqrt(self.tau_squares[self.kind_numbers])

    @cached_property
    def residuals(self) -> list[Residuals]:
        """Return the residuals of each target, without the smooth error."""
        return [data.residuals(self.arm, self.X, target)
                for data, target in zip(self.measured, self.targets, strict=True)]

    @property
    def distances(self) -> Array:
        """Return the distances (n,) of the points of each stop from the target, RMS (m)."""
        return np.concatenate([residual.distances for residual in self.residuals])

    @property
    def residual_rms(self) -> float:
        """Return the RMS distance of the points of the used stops from their target (m)."""
        return rms(self.distances[self.used])

    @cached_property
    def whitened_rows(self) -> tuple[Array, Array]:
        """Return the residuals (m,) of used stops in sigmas, and their derivatives (m, u)."""
        shifts = np.einsum('nb,tx->ntbx', self.smooth_error_basis, np.eye(6, 3)).reshape(
            len(self.q), 6, -1)
        by_errors = self.arm.error_jacobian(self.q)[..., self.arm.is_estimated]
        twists = np.append(by_errors, shifts, axis=2)
        values, wrt_X, wrt_pose = (np.concatenate(parts) for parts in zip(*(
            (residual.values, residual.wrt_X_and_target[:, :6], residual.wrt_pose)
            for residual in self.residuals), strict=True))
        wrt_errors = (wrt_pose[:, None] @ twists[self.station])[:, 0]
        values = values + wrt_errors[:, len(self.arm.error_values):] @ self.smooth
        wrt_targets = block_diag(*(residual.wrt_X_and_target[:, 6:]
                                   for residual in self.residuals))
        rows = np.column_stack([values, wrt_X, wrt_errors, wrt_targets])[self.used_rows]
        rows /= self.noise[self.used_rows % len(self.noise), None]
        return rows[:, 0], rows[:, 1:]

    @cached_property
    def rows_with_priors(self) -> tuple[Array, Array]:
        """Return whitened_rows with the errors of the robot in sigmas as further residuals."""
        (r, J), stds = self.whitened_rows, self.prior_stds
        by_priors = np.eye(len(stds), J.shape[1], 6) / stds[:, None]
        return np.append(r, self.robot_errors / stds), np.vstack([J, by_priors])

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance (u, u) of all unknowns."""
        return covariance_from_jacobian(self.rows_with_priors[1])

    @property
    def system(self) -> LeastSquares[ArmFit]:
        """Return the least squares with these weights; all errors of the robot are one item."""
        stations = self.station[self.used_rows]
        item = np.append(stations, np.full(len(self.robot_errors), len(self.q)))
        return LeastSquares(lambda fit: Evaluation(
            fit.rows_with_priors[0], lambda: fit.rows_with_priors[1]), ArmFit.retracted, item)

    def retracted(self, step: Array) -> ArmFit:
        """Return the estimate after a step (u,)."""
        sizes = [6, len(self.arm.error_values), len(self.smooth),
                 *(residual.wrt_X_and_target.shape[1] - 6 for residual in self.residuals)]
        X_step, arm_step, smooth_step, *target_steps = np.split(step, np.cumsum(sizes)[:-1])
        targets = tuple(data.retracted(target, target_step) for data, target, target_step in zip(
            self.measured, self.targets, target_steps, strict=True))
        return replace(self, X=se3.perturb(self.X, X_step), targets=targets,
                       arm=replace(self.arm, error_values=self.arm.error_values + arm_step),
                       smooth=self.smooth + smooth_step)

    def solved(self) -> ArmFit:
        """Return the least-squares estimate with these weights, near this one."""
        return self.system.minimised(self, iterations=20, tolerance=1e-4)


def noise_and_tau_squares(fit: ArmFit, conservative: bool = False) -> tuple[Array, Array]:
    """
    Return noise (axes,) and tau^2 (g,) of ArmFit as the residuals of a fit show them.

    The tau^2 of all kinds of errors are the most likely ones; conservative: larger ones, for a
    reported covariance. The noise of each axis is pooled with that of all axes.
    """
    tau_squares = fit.tau_squares.copy()
    for kind, present in enumerate(fit.tau_squares):
        of_kind = np.flatnonzero(fit.kind_numbers == kind)
        stated = fit.prior_stds[of_kind] / np.sqrt(present)
        covariance = fit.covariance[np.ix_(6 + of_kind, 6 + of_kind)] / np.outer(stated, stated)
        likeliest, for_report = tau_squares_of_block(
            covariance, fit.robot_errors[of_kind] / stated, present, LARGEST_TAU_SQUARED)
        tau_squares[kind] = for_report if conservative else likeliest
    (r, J), axis = fit.whitened_rows, fit.used_rows % len(fit.noise)
    redundancy = 1 - np.einsum('mi,mi->m', J @ fit.covariance, J)
    freedom, squares = np.bincount(axis, redundancy), np.bincount(axis, (r * fit.noise[axis]) ** 2)
    pooled = squares.sum() / max(freedom.sum(), 1.0)
    noise = np.sqrt((squares + POOLED_FREEDOM * pooled)
                    / (np.maximum(freedom, 0.0) + POOLED_FREEDOM))
    return np.maximum(noise, MIN_NOISE), tau_squares


def with_estimated_weights(fit: ArmFit, conservative: bool = False, rounds: int = MAX_ROUNDS
                           ) -> ArmFit:
    """Return a fit with noise and taus as it shows them; see noise_and_tau_squares."""
    for _ in range(rounds):
        before = np.append(fit.noise, fit.tau_squares)
        noise, tau_squares = noise_and_tau_squares(fit, conservative)
        fit = replace(fit, noise=noise, tau_squares=tau_squares).solved()
        if np.abs(np.log(np.append(noise, tau_squares) / before)).max() < CONVERGED_CHANGE:
            break
    return fit


def without_bad_stops(fit: ArmFit) -> ArmFit:
    """Return a fit without the stops that the others do not predict."""
    stops = np.arange(len(fit.q))

    def fitted_to(previous: ArmFit | None, used: Indices, _: object) -> ArmFit:
        return with_estimated_weights(replace(previous or fit, used=np.isin(stops, used)))

    def left_out_squares(fit: ArmFit) -> tuple[Array, Indices]:
        _, item = np.unique(fit.station[fit.used_rows], return_inverse=True)
        (r, J), freedom = fit.whitened_rows, np.bincount(item)
        left_out = leave_one_out_residuals(r, J, J @ fit.covariance, item)
        return np.bincount(item, r * left_out) / freedom, freedom
    return drop_outliers(stops[fit.used], len(stops), MIN_STOPS, fitted_to, left_out_squares)


def solved_with_arm(fit: ArmFit, arm: Arm) -> ArmFit:
    """Return the fit with the errors of an arm, at the sigmas of PRIOR_STDS."""
    fit = replace(fit, arm=arm)
    return replace(fit, tau_squares=np.ones(len(set(fit.kind_numbers)))).solved()


def arm_covariance(fit: ArmFit, chosen_fit: ArmFit) -> tuple[Array, float]:
    """
    Return the covariance of a chosen fit to report, and the RMS of the robot's smooth error.

    The covariance (6 + k, 6 + k) is that of X and the errors of the arm, the RMS (m, per axis)
    that of what is left, which neighbouring stops have in common. Both come from fit, which has
    all kinds of errors of the arm, with conservative taus and the smooth error; the
    covariance includes how far X and the errors of the arm are from those of the chosen fit there.
    """
    wide = with_estimated_weights(fit, conservative=True)
    arm_tau_squares, noise = wide.tau_squares, wide.noise
    basis = smooth_basis(wide.arm.forward(wide.q))
    wide = replace(wide, smooth_error_basis=basis, smooth=np.zeros(3 * basis.shape[1]),
                   tau_squares=np.append(arm_tau_squares, 1.0))
    for _ in range(2):  # iterations of the noise beside a smooth error
        wide = replace(wide, noise=noise).solved()
        noise, tau_squares = noise_and_tau_squares(wide, conservative=True)
    wide = replace(wide, tau_squares=np.append(arm_tau_squares, tau_squares[-1]))
    in_chosen = chosen_fit.arm.is_estimated[wide.arm.is_estimated]
    rows = np.append(np.arange(6), 6 + np.flatnonzero(in_chosen))
    difference = np.append(se3.difference(wide.X, chosen_fit.X),
                           wide.arm.error_values[in_chosen] - chosen_fit.arm.error_values)
    covariance = wide.covariance[np.ix_(rows, rows)] + np.outer(difference, difference)
    return covariance, rms((basis @ wide.smooth.reshape(-1, 3))[wide.used])
