# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye transform and errors of an arm from the same stops: one least squares with priors.

Estimate and reported covariance follow docs/estimator.md: the data determine the scale of each
kind of error, its most likely value for the estimate and a conservative one for the covariance.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.arm import Arm
from handeye_ros.data import Array, rms
from handeye_ros.estimation.basis import smooth_basis
from handeye_ros.estimation.least_squares import (
    covariance_of,
    drop_outliers,
    leave_one_out,
    Rows,
    System,
)
from handeye_ros.estimation.noise import prior_variances
from handeye_ros.robot.residuals import ArmState, ArmStops
import numpy as np
from numpy.typing import NDArray

MINIMUM = 12  # stops
# iterations of prior scales and noise; relative change that ends them
MOST_ROUNDS, CONVERGED_CHANGE = 6, 0.02
POOLED_FREEDOM = 4.0  # degrees of freedom by which the noise of all axes counts for each axis
LEAST_NOISE = 1e-6  # rounding of the values (m)
LARGEST_SCALE = 1e3  # largest prior scale


@dataclass(frozen=True, eq=False)
class ArmFit:
    """
    An estimate with the weights of stops (n,), and which of these are used.

    noise: (axes,) sigma of each axis of the residuals; variances: (g,) of each kind of error of
    the robot, relative to its prior.
    """

    stops: ArmStops
    state: ArmState
    noise: Array
    variances: Array
    used: NDArray[np.bool_]

    @property
    def stds(self) -> Array:
        """Return the prior sigmas (p,) of the errors of arm and robot, as estimated."""
        return self.state.stds * np.sqrt(self.variances[self.state.kind_numbers])

    @property
    def rows(self) -> NDArray[np.intp]:
        """Return the numbers (m,) of the residuals of used stops, among all."""
        return np.flatnonzero(self.used[self.stops.station])

    @cached_property
    def linear(self) -> tuple[Array, Array]:
        """Return the residuals (m,) of used stops in sigmas, and their derivatives (m, u)."""
        r, J = (values[self.rows] for values in self.stops.linearised(self.state))
        sigma = self.noise[self.rows % self.stops.axes]
        return r / sigma, J / sigma[:, None]

    @property
    def by_priors(self) -> Array:
        """Return the derivatives (p, u) of the errors in sigmas."""
        return np.hstack([np.zeros((len(self.stds), self.stops.unknowns)), np.diag(1 / self.stds)])

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance (u, u) of all unknowns."""
        return covariance_of(np.vstack([self.linear[1], self.by_priors]))

    @property
    def residual_rms(self) -> float:
        """Return the RMS residual of the used stops (m)."""
        return rms(self.stops.distances(self.state)[self.used])

    @property
    def smooth_rms(self) -> float:
        """Return the RMS of the smooth remaining error of the robot, per axis (m)."""
        shift = self.stops.root @ self.state.smooth.reshape(-1, 3)
        return rms(shift[self.used])

    def solved(self) -> ArmFit:
        """Return the least-squares estimate with these weights, near this one."""
        stds, by_priors = self.stds, self.by_priors

        def rows(state: ArmState) -> Rows:
            r, J = replace(self, state=state).linear
            return Rows(np.append(r, state.errors / stds), lambda: np.vstack([J, by_priors]))
        item = np.append(self.stops.station[self.rows], np.full(len(stds), len(self.stops)))
        return replace(self, state=System(rows, self.stops.moved, item).least_squares(
            self.state, iterations=20, converged=1e-4))


def estimated_weights(fit: ArmFit, conservative: bool = False) -> tuple[Array, Array]:
    """Return noise and variances as a fit shows them; conservative: those for the report."""
    variances, u = fit.variances, fit.stops.unknowns
    if len(variances):
        order = np.argsort(fit.state.kind_numbers, kind='stable')
        sigma, covariance = fit.stds[order], fit.covariance[u:, u:][np.ix_(order, order)]
        first = np.searchsorted(fit.state.kind_numbers[order], np.arange(len(variances)))
        variances = prior_variances(
            covariance / np.outer(sigma, sigma), fit.state.errors[order] / sigma, first,
            variances, np.full(len(variances), LARGEST_SCALE))[int(conservative)]
    (r, J), axis = fit.linear, fit.rows % fit.stops.axes
    free, squares = (np.bincount(axis, values) for values in (
        1 - np.einsum('mi,mi->m', J @ fit.covariance, J), (r * fit.noise[axis]) ** 2))
    pooled = squares.sum() / max(free.sum(), 1.0)
    noise = np.sqrt((squares + POOLED_FREEDOM * pooled) / (np.maximum(free, 0.0) + POOLED_FREEDOM))
    return np.maximum(noise, LEAST_NOISE), variances


def estimate_weights(fit: ArmFit, conservative: bool = False, rounds: int = MOST_ROUNDS) -> ArmFit:
    """Return a fit with estimated weights; see estimated_weights."""
    for _ in range(rounds):
        before = np.append(fit.noise, fit.variances)
        noise, variances = estimated_weights(fit, conservative)
        fit = replace(fit, noise=noise, variances=variances).solved()
        if np.abs(np.log(np.append(noise, variances) / before)).max() < CONVERGED_CHANGE:
            break
    return fit


def without_outliers(fit: ArmFit) -> ArmFit:
    """Return a fit without the stops that the others do not predict."""
    every = np.arange(len(fit.stops))

    def fitted_to(before: ArmFit | None, used: NDArray[np.intp]) -> ArmFit:
        return estimate_weights(replace(before or fit, used=np.isin(every, used)))

    def judged(found: ArmFit) -> tuple[Array, NDArray[np.intp]]:
        _, item = np.unique(found.stops.station[found.rows], return_inverse=True)
        (r, J), freedom = found.linear, np.bincount(item)
        left_out = leave_one_out(r, J, found.covariance, item)
        return np.bincount(item, r * left_out) / freedom, freedom
    return drop_outliers(every[fit.used], len(every), MINIMUM, fitted_to, judged)[0]


def first_fit(stops: ArmStops, state: ArmState, used: NDArray[np.bool_], noise: float = 1.0
              ) -> ArmFit:
    """Return a fit of the hand-eye transform alone, near a state, with estimated weights."""
    fit = ArmFit(stops, state, np.full(stops.axes, noise), np.zeros(0), used)
    return estimate_weights(fit.solved())


def with_arm(fit: ArmFit, arm: Arm) -> ArmFit:
    """Return the fit with the errors of an arm, at their configured sigmas."""
    state = replace(fit.state, arm=arm)
    return replace(fit, state=state, variances=np.ones(len(set(state.kind_numbers)))).solved()


def reported_covariance(fit: ArmFit, chosen: ArmState) -> tuple[ArmFit, Array]:
    """
    Return a fit with conservative prior scales, and the covariance of a chosen estimate.

    (u, u), of X, the targets and the errors of the arm. It includes how far the wider priors move
    X and these errors, and a smooth remaining error of the robot, which neighbouring stops have
    in common.
    """
    wide = estimate_weights(fit, conservative=True)
    of_arm, noise = wide.variances, wide.noise
    stops = replace(wide.stops, root=smooth_basis(wide.state.arm.forward(wide.stops.q)))
    wide = replace(wide, stops=stops, state=replace(
        wide.state, smooth=np.zeros(3 * stops.root.shape[1])), variances=np.append(of_arm, 1.0))
    for _ in range(2):  # iterations of the noise beside a smooth error
        wide = replace(wide, noise=noise).solved()
        noise, variances = estimated_weights(wide, conservative=True)
    wide = replace(wide, variances=np.append(of_arm, variances[-1]))
    free = chosen.arm.free[wide.state.arm.free]
    kept = np.append(np.arange(stops.unknowns), stops.unknowns + np.flatnonzero(free))
    difference = np.zeros(len(kept))
    difference[:6] = se3.difference(wide.state.X, chosen.X)
    difference[stops.unknowns:] = wide.state.arm.values[free] - chosen.arm.values
    return wide, wide.covariance[np.ix_(kept, kept)] + np.outer(difference, difference)
