# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye transform and errors of an arm from the same stops: one least squares with priors.

A target gives profiles, with the residuals of the hand-eye estimate (docs/estimator.md), or
points: r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in
the axes of the sensor; s is the measured point, c the position of the target. Several targets, or
one at several positions, have sensor and arm in common; the errors of the arm act through the
twists of the flange.

Estimate and reported covariance follow docs/estimator.md: the data determine the scale of each
kind of error, its most likely value for the estimate and a conservative one for the covariance.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, TypeAlias

from handeye_ros import se3
from handeye_ros.arm import Arm, ERROR_KINDS
from handeye_ros.data import Array, rms
from handeye_ros.estimation.basis import smooth_basis
from handeye_ros.estimation.least_squares import (
    covariance_of,
    drop_outliers,
    identity,
    leave_one_out,
    Rows,
    System,
)
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, prior_variances, whitening
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.frames import mount_poses
import numpy as np
from numpy.typing import NDArray

SMOOTH_ERROR_STD = 2e-4  # prior 1 sigma of the remaining error of the robot, each axis (m)
MINIMUM = 12  # stops
# iterations of prior scales and noise; relative change that ends them
MOST_ROUNDS, CONVERGED_CHANGE = 6, 0.02
POOLED_FREEDOM = 4.0  # degrees of freedom by which the noise of all axes counts for each axis
LEAST_NOISE = 1e-6  # rounding of the values (m)
LARGEST_SCALE = 1e3  # largest prior scale


@dataclass(frozen=True, eq=False)
class Residuals:
    """
    Residuals (m,) of one target in metres, and their derivatives.

    wrt_own: (m, 6 + k) by X and the target
    wrt_pose: (m, 6) by a shift of the flange and a turn about it, in the base
    whiten: what whitens values (m, ...)
    """

    values: Array
    wrt_own: Array
    wrt_pose: Array
    whiten: Callable[[Array], Array] = identity


@dataclass(frozen=True, eq=False)
class ArmProfiles:
    """
    Profiles of a target: a problem, whose poses are replaced by those of the arm.

    axes: residuals in one vector, each with a noise of its own.
    """

    problem: Problem
    axes: ClassVar[int] = 1

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.problem.poses)

    @property
    def unknowns(self) -> int:
        """Return the number of unknown parameters of the target."""
        return len(self.problem.free_columns) - 6

    @property
    def station(self) -> NDArray[np.intp]:
        """Return the stop (m,) of each residual."""
        return self.problem.observations.station

    def residuals(self, T_base_flange: Array, X: Array, target: Array) -> Residuals:
        """Return the residuals with the sensor in its mount X (4, 4) and a state of the target."""
        problem = replace(self.problem, poses=mount_poses(T_base_flange, self.problem.config))
        linear = linearise(problem, Estimate(X, target))
        return Residuals(linear.residuals, linear.jacobian[:, problem.free_columns],
                         linear.wrt_pose, whitening(linear, BLOCKS_AS_NOISE))

    def moved(self, target: Array, step: Array) -> Array:
        """Return the state of the target after a step (k,)."""
        step = np.append(np.zeros(6), step)
        return self.problem.retracted(Estimate(np.eye(4), target), step).state


@dataclass(frozen=True, eq=False)
class ArmPoints:
    """The point (n, 3) that a target is, in the sensor frame; in_hand: of one on the flange."""

    points: Array
    in_hand: bool
    axes: ClassVar[int] = 3
    unknowns: ClassVar[int] = 3

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.points)

    @property
    def station(self) -> NDArray[np.intp]:
        """Return the stop (m,) of each residual."""
        return np.repeat(np.arange(len(self)), self.axes)

    def residuals(self, T_base_flange: Array, X: Array, target: Array) -> Residuals:
        """Return the residuals with the sensor in its mount X (4, 4) and the target (3,)."""
        T = T_base_flange if self.in_hand else se3.inverse(T_base_flange)
        lever, n = self.points @ X[:3, :3].T, len(self)
        in_fixed = se3.apply(T, (lever + X[:3, 3])[:, None])[:, 0]  # where the target is fixed
        to_mount = np.broadcast_to(X[:3, :3].T, (n, 3, 3))
        to_fixed = to_mount @ np.swapaxes(T[:, :3, :3], 1, 2)
        values = to_fixed @ (in_fixed - target)[:, :, None]
        wrt_own = np.concatenate([to_mount, -to_mount @ se3.skew(lever), -to_fixed], axis=2)
        wrt_shift, from_flange = (to_fixed, in_fixed - T[:, :3, 3]) if self.in_hand else (
            -to_mount, target @ T[:, :3, :3])
        wrt_pose = np.concatenate([wrt_shift, -wrt_shift @ se3.skew(from_flange)], axis=2)
        return Residuals(values.ravel(), wrt_own.reshape(3 * n, -1), wrt_pose.reshape(3 * n, 6))

    def moved(self, target: Array, step: Array) -> Array:
        """Return the position of the target after a step (3,)."""
        return target + step


Measurement: TypeAlias = ArmProfiles | ArmPoints


def lengths(residuals: Array, station: NDArray[np.intp], axes: int = 1) -> Array:
    """Return the length (n,) of the residual of each stop, RMS of several; axes: of a vector."""
    vectors = np.bincount(station) / axes
    return np.asarray(np.sqrt(np.bincount(station, residuals ** 2) / vectors))


@dataclass(frozen=True, eq=False)
class ArmState:
    """
    An estimate: sensor in its mount X (4, 4), state of each target, and the arm.

    smooth: (3 r,) coefficients of smooth functions, the remaining error of the robot.
    """

    X: Array
    targets: tuple[Array, ...]
    arm: Arm
    smooth: Array

    @property
    def errors(self) -> Array:
        """Return the errors (p,) of the arm, and the smooth ones."""
        return np.append(self.arm.values, self.smooth)

    @property
    def stds(self) -> Array:
        """Return their prior sigmas (p,) as stated."""
        return np.append(self.arm.priors[self.arm.free],
                         np.full(len(self.smooth), SMOOTH_ERROR_STD))

    @property
    def kind_numbers(self) -> NDArray[np.intp]:
        """Return the number of the kind of each (p,), from 0; the smooth ones are the last."""
        _, own = np.unique(ERROR_KINDS[np.nonzero(self.arm.free)[1]], return_inverse=True)
        return np.append(own, np.full(len(self.smooth), own.max(initial=-1) + 1))


@dataclass(frozen=True, eq=False)
class ArmStops:
    """
    The measurements of all targets: q (n, joints) reported joint values, target by target.

    root: (n, r) smooth functions of which the remaining error of the robot consists.
    """

    q: Array
    measured: tuple[Measurement, ...]
    root: Array

    @classmethod
    def of(cls, q: Array, measured: tuple[Measurement, ...]) -> ArmStops:
        """Return the measurements of a robot without a smooth error."""
        return cls(q, measured, np.zeros((len(q), 0)))

    def __len__(self) -> int:
        """Return the number of stops."""
        return len(self.q)

    @property
    def axes(self) -> int:
        """Return the number of residuals in one vector: they differ in their noise."""
        return max(data.axes for data in self.measured)

    @cached_property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return int(self.parts[-1][2].stop)

    @cached_property
    def parts(self) -> list[tuple[Measurement, slice, slice]]:
        """Return for each target its measurements, its stops, and the columns of its unknowns."""
        stops = np.cumsum([0, *map(len, self.measured)])
        columns = np.cumsum([6, *(data.unknowns for data in self.measured)])
        return [(data, slice(*own), slice(*free)) for data, own, free in zip(
            self.measured, pairwise(stops), pairwise(columns), strict=True)]

    @cached_property
    def station(self) -> NDArray[np.intp]:
        """Return the stop (m,) of each residual."""
        return np.concatenate([data.station + stops.start for data, stops, _ in self.parts])

    def residuals(self, state: ArmState) -> list[Residuals]:
        """Return the residuals of each target, without the smooth error."""
        T = state.arm.forward(self.q)
        return [data.residuals(T[stops], state.X, target) for (data, stops, _), target in zip(
            self.parts, state.targets, strict=True)]

    def distances(self, state: ArmState) -> Array:
        """Return the length (n,) of the residual of each stop, RMS of several (m)."""
        values = np.concatenate([residual.values for residual in self.residuals(state)])
        return lengths(values, self.station, self.axes)

    def linearised(self, state: ArmState) -> tuple[Array, Array]:
        """
        Return whitened residuals (m,), and their derivatives (m, u).

        By X, the targets, the errors of the arm and the smooth error.
        """
        shifts = np.einsum('nr,tx->ntrx', self.root, np.eye(6, 3)).reshape(len(self), 6, -1)
        of_arm, rows = state.arm.twists(self.q)[:, :, state.arm.free], list[Array]()
        twists = np.append(of_arm, shifts, axis=2)
        for residual, (data, stops, columns) in zip(self.residuals(state), self.parts,
                                                    strict=True):
            station = data.station + stops.start
            wrt_own = np.zeros((len(residual.values), self.unknowns))
            wrt_own[:, :6], wrt_own[:, columns] = residual.wrt_own[:, :6], residual.wrt_own[:, 6:]
            wrt_errors = (residual.wrt_pose[:, None] @ twists[station])[:, 0]
            values = residual.values + wrt_errors[:, len(state.arm.values):] @ state.smooth
            rows.append(residual.whiten(np.column_stack([wrt_own, wrt_errors, values])))
        whitened = np.concatenate(rows)
        return whitened[:, -1], whitened[:, :-1]

    def moved(self, state: ArmState, step: Array) -> ArmState:
        """Return a state after a step (u,)."""
        targets = tuple(data.moved(target, step[columns]) for (data, _, columns), target in zip(
            self.parts, state.targets, strict=True))
        of_arm, smooth = np.split(step[self.unknowns:], [len(state.arm.values)])
        return ArmState(se3.perturb(state.X, step[:6]), targets,
                        replace(state.arm, values=state.arm.values + of_arm),
                        state.smooth + smooth)


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


def noise_and_scales(fit: ArmFit, conservative: bool = False) -> tuple[Array, Array]:
    """
    Return noise (axes,) and variances (g,) of ArmFit as the residuals of a fit show them.

    conservative: the wider variances, for a reported covariance.
    """
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


def with_estimated_weights(fit: ArmFit, conservative: bool = False, rounds: int = MOST_ROUNDS
                           ) -> ArmFit:
    """Return a fit with noise and scales of the priors as it shows them; see noise_and_scales."""
    for _ in range(rounds):
        before = np.append(fit.noise, fit.variances)
        noise, variances = noise_and_scales(fit, conservative)
        fit = replace(fit, noise=noise, variances=variances).solved()
        if np.abs(np.log(np.append(noise, variances) / before)).max() < CONVERGED_CHANGE:
            break
    return fit


def without_outliers(fit: ArmFit) -> ArmFit:
    """Return a fit without the stops that the others do not predict."""
    every = np.arange(len(fit.stops))

    def fitted_to(before: ArmFit | None, used: NDArray[np.intp]) -> ArmFit:
        return with_estimated_weights(replace(before or fit, used=np.isin(every, used)))

    def left_out_squares(found: ArmFit) -> tuple[Array, NDArray[np.intp]]:
        _, item = np.unique(found.stops.station[found.rows], return_inverse=True)
        (r, J), freedom = found.linear, np.bincount(item)
        left_out = leave_one_out(r, J, found.covariance, item)
        return np.bincount(item, r * left_out) / freedom, freedom
    return drop_outliers(every[fit.used], len(every), MINIMUM, fitted_to, left_out_squares)[0]


def first_fit(stops: ArmStops, state: ArmState, used: NDArray[np.bool_], noise: float = 1.0
              ) -> ArmFit:
    """Return a fit of the hand-eye transform alone, near a state, with estimated weights."""
    fit = ArmFit(stops, state, np.full(stops.axes, noise), np.zeros(0), used)
    return with_estimated_weights(fit.solved())


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
    wide = with_estimated_weights(fit, conservative=True)
    of_arm, noise = wide.variances, wide.noise
    stops = replace(wide.stops, root=smooth_basis(wide.state.arm.forward(wide.stops.q)))
    wide = replace(wide, stops=stops, state=replace(
        wide.state, smooth=np.zeros(3 * stops.root.shape[1])), variances=np.append(of_arm, 1.0))
    for _ in range(2):  # iterations of the noise beside a smooth error
        wide = replace(wide, noise=noise).solved()
        noise, variances = noise_and_scales(wide, conservative=True)
    wide = replace(wide, variances=np.append(of_arm, variances[-1]))
    free = chosen.arm.free[wide.state.arm.free]
    kept = np.append(np.arange(stops.unknowns), stops.unknowns + np.flatnonzero(free))
    difference = np.zeros(len(kept))
    difference[:6] = se3.difference(wide.state.X, chosen.X)
    difference[stops.unknowns:] = wide.state.arm.values[free] - chosen.arm.values
    return wide, wide.covariance[np.ix_(kept, kept)] + np.outer(difference, difference)
