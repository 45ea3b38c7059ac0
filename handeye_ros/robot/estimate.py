# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye transform and joints from the same points: one least squares with priors.

Estimate and reported covariance follow docs/estimator.md: the data determine the scale of each
kind of error, its most likely value for the estimate and a conservative one for the covariance.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

from handeye_ros import se3
from handeye_ros.arm import Arm
from handeye_ros.data import Array
from handeye_ros.estimation.basis import process_root
from handeye_ros.estimation.least_squares import leave_one_out, outliers, Rows, System
from handeye_ros.estimation.linalg import covariance_of
from handeye_ros.estimation.noise import prior_scales
import numpy as np
from numpy.typing import NDArray

MINIMUM = 12  # configurations
SMOOTH = 2e-4  # prior 1 sigma of the remaining error of the robot, each axis (m)
ROUNDS, CONVERGED = 6, 0.02  # iterations of prior scales and noise; relative change that ends them
POOLED = 4.0  # degrees of freedom by which the noise of all axes counts for each axis
LEAST_NOISE = 1e-6  # rounding of the values (m)
SMOOTH_ROUNDS = 2  # iterations of the size of the smooth error and the noise
LARGEST = 1e3  # largest prior scale


@dataclass(frozen=True, eq=False)
class State:
    """
    An estimate: sensor in its mount X (4, 4), positions of the targets, the arm.

    targets: (t, 3) of points, or the parameters of the targets of profiles. smooth: (r, 3)
    remaining error of the robot, coefficients of smooth functions.
    """

    X: Array
    targets: Array
    arm: Arm
    smooth: Array

    def with_arm_step(self, step: Array) -> State:
        """Return the state after a step of the arm and of its smooth remaining error."""
        parameters, smooth = np.split(step, [len(self.arm.values)])
        return replace(self, arm=replace(self.arm, values=self.arm.values + parameters),
                       smooth=self.smooth + smooth.reshape(self.smooth.shape))


class Data(Protocol):
    """Measurements at n configurations: m residuals of an estimate with u unknowns."""

    @property
    def q(self) -> Array: ...
    @property
    def unknowns(self) -> int: ...
    @property
    def block(self) -> NDArray[np.intp]: ...
    @property
    def component(self) -> NDArray[np.intp]: ...
    def __len__(self) -> int: ...
    def retracted(self, state: State, step: Array) -> State: ...
    def distances(self, state: State) -> Array: ...
    def linearised(self, state: State, root: Array) -> tuple[Array, Array]: ...


@dataclass(frozen=True, eq=False)
class Weights:
    """Sigma (c,) of each component of the residuals; variances (g,) of each kind."""

    noise: Array
    variances: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """
    An estimate with its weights and used configurations (n,); root: the smooth functions.

    residuals: (m,) whitened, of all configurations, without the smooth error; jacobian: (m, u).
    """

    data: Data
    state: State
    weights: Weights
    used: NDArray[np.bool_]
    root: Array
    residuals: Array
    jacobian: Array

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of unknowns with a prior, in their order."""
        kinds = dict.fromkeys(p.kind for p in self.state.arm.parameters)
        return (*kinds, 'smooth') if self.root.shape[1] else tuple(kinds)

    @cached_property
    def group(self) -> NDArray[np.intp]:
        """Return the kind of each unknown with a prior, an index into kinds."""
        kinds = self.kinds
        groups = [kinds.index(p.kind) for p in self.state.arm.parameters]
        return np.array(groups + [len(kinds) - 1] * (3 * self.root.shape[1]), dtype=np.intp)

    @property
    def stds(self) -> Array:
        """Return the prior sigmas, shape (q,), times the estimated scales."""
        configured = np.append(self.state.arm.stds, np.full(3 * self.root.shape[1], SMOOTH))
        return configured * np.sqrt(self.weights.variances[self.group])

    @property
    def values(self) -> Array:
        """Return the values, shape (q,), of the unknowns with a prior."""
        return np.append(self.state.arm.values, self.state.smooth.ravel())

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance of all unknowns, (u, u)."""
        prior = np.zeros((len(self.stds), self.jacobian.shape[1]))
        prior[:, self.data.unknowns:] = np.diag(1 / self.stds)
        return covariance_of(np.vstack([self.jacobian[self.rows], prior]))

    @property
    def rows(self) -> NDArray[np.bool_]:
        """Return which residuals (m,) belong to used configurations."""
        return self.used[self.data.block]

    @property
    def noise_rms(self) -> float:
        """Return the RMS residual of the used configurations (m)."""
        return float(np.sqrt((self.data.distances(self.state)[self.used] ** 2).mean()))

    @property
    def smooth_rms(self) -> float:
        """Return the RMS of the smooth remaining error of the robot, per axis (m)."""
        return float(np.sqrt(((self.root @ self.state.smooth)[self.used] ** 2).mean()))


def fitted(data: Data, state: State, weights: Weights, used: NDArray[np.bool_], root: Array
           ) -> Fit:
    """Return the least-squares estimate with priors near a state."""
    unfitted = Fit(data, state, weights, used, root, np.zeros(0), np.zeros((0, 0)))
    prior, n, u = 1 / unfitted.stds, len(data), data.unknowns
    whiten = 1 / weights.noise[data.component]

    def rows(state_now: State) -> Rows:
        r, J = data.linearised(state_now, root)
        values = np.append(state_now.arm.values, state_now.smooth.ravel())
        by_prior = np.zeros((len(prior), J.shape[1]))
        by_prior[:, u:] = np.diag(prior)
        return Rows(np.append(r * whiten, values * prior),
                    lambda: np.vstack([J * whiten[:, None], by_prior]))
    block = np.append(data.block, np.full(len(prior), n))
    system = System(rows, data.retracted, block)
    state = system.least_squares(state, np.append(used.astype(float), 1.0), 20, 1e-4)
    r, J = data.linearised(state, root)
    return replace(unfitted, state=state, residuals=r * whiten, jacobian=J * whiten[:, None])


def estimated_weights(fit: Fit, conservative: bool = False) -> Weights:
    """Return the weights estimated from a fit; conservative: with the scales for the report."""
    variances = fit.weights.variances
    if fit.kinds:
        q, s = fit.data.unknowns, fit.stds
        first = np.searchsorted(fit.group, np.arange(len(fit.kinds)))
        of_map, of_report = prior_scales(
            fit.covariance[q:, q:] / np.outer(s, s), fit.values / s, first, variances,
            np.full(len(first), LARGEST))
        variances = of_report if conservative else of_map
    rows, component = fit.rows, fit.data.component
    J, residuals = fit.jacobian[rows], (fit.residuals * fit.weights.noise[component])[rows]
    free, squares = (np.bincount(component[rows], values, len(fit.weights.noise)) for values in (
        1 - np.einsum('mi,mi->m', J @ fit.covariance, J), residuals ** 2))
    pooled = squares.sum() / max(free.sum(), 1.0)
    noise = np.sqrt((squares + POOLED * pooled) / (np.maximum(free, 0.0) + POOLED))
    return Weights(np.maximum(noise, LEAST_NOISE), variances)


def adjusted(fit: Fit, conservative: bool = False, rounds: int = ROUNDS) -> Fit:
    """Return a fit with estimated weights; see estimated_weights."""
    for _ in range(rounds):
        weights = estimated_weights(fit, conservative)
        change = max(np.abs(np.log(weights.noise / fit.weights.noise)).max(),
                     np.abs(np.log(weights.variances / fit.weights.variances)).max(initial=0.0))
        fit = fitted(fit.data, fit.state, weights, fit.used, fit.root)
        if change < CONVERGED:
            break
    return fit


def without_outliers(fit: Fit) -> Fit:
    """Return a fit without the configurations that the others do not predict."""
    while True:
        fit = adjusted(fit)
        rows, used = fit.rows, np.flatnonzero(fit.used)
        r, block = fit.residuals[rows], np.searchsorted(used, fit.data.block[rows])
        left_out = leave_one_out(r, fit.jacobian[rows], fit.covariance, block)
        freedom = np.bincount(block)
        squares = np.bincount(block, r * left_out) / freedom
        worst = outliers(squares, freedom, len(fit.data), len(used) - MINIMUM)
        if not len(worst):
            return fit
        keep = fit.used.copy()
        keep[used[worst]] = False
        fit = replace(fit, used=keep)


def fit_of(data: Data, state: State) -> Fit:
    """Return a fit of the hand-eye transform alone, near a state, with estimated weights."""
    noise = np.ones(int(data.component.max()) + 1)
    used, no_smooth = np.ones(len(data), dtype=bool), np.zeros((len(data), 0))
    return adjusted(fitted(data, state, Weights(noise, np.zeros(0)), used, no_smooth))


def with_arm(fit: Fit, arm: Arm) -> Fit:
    """Return the fit with the parameters of an arm, at their configured sigmas."""
    state = replace(fit.state, arm=arm)
    variances = np.ones(len({p.kind for p in arm.parameters}))
    return fitted(fit.data, state, Weights(fit.weights.noise, variances), fit.used, fit.root)


def reported_covariance(fit: Fit, chosen: State) -> tuple[Fit, Array]:
    """
    Return a fit with conservative prior scales, and the covariance of a chosen estimate.

    (u, u), of X, the targets and the parameters of the chosen estimate. It includes the change of
    X and the parameters by the wider priors, and a smooth remaining error of the robot, which
    neighbouring configurations have in common.
    """
    wide = _with_smooth(adjusted(fit, conservative=True))
    count, u = len(chosen.arm.values), fit.data.unknowns
    difference = np.zeros(u + count)
    difference[:6] = se3.difference(wide.state.X, chosen.X)
    difference[u:] = wide.state.arm.values[:count] - chosen.arm.values
    u += count
    return wide, wide.covariance[:u, :u] + np.outer(difference, difference)


def _with_smooth(fit: Fit) -> Fit:
    """Return a fit with the smooth remaining error of the robot, of a conservative size."""
    root = process_root(fit.state.arm.forward(fit.data.q))
    state = replace(fit.state, smooth=np.zeros((root.shape[1], 3)))
    for _ in range(SMOOTH_ROUNDS):
        weights = Weights(fit.weights.noise, np.append(
            fit.weights.variances[:len(fit.kinds) - bool(fit.root.shape[1])], 1.0))
        fit = fitted(fit.data, state, weights, fit.used, root)
        estimated = estimated_weights(fit, conservative=True)
        fit = replace(fit, weights=Weights(estimated.noise, np.append(
            weights.variances[:-1], estimated.variances[-1])))
    return fit
