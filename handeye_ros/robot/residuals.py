# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What a sensor measures of fixed targets at stops of an arm: residuals and their derivatives.

A target gives profiles, with the residuals of the hand-eye estimate (docs/estimator.md), or
points: r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in
the axes of the sensor; s is the measured point, c the position of the target. Several targets, or
one at several positions, have sensor and arm in common; the errors of the arm act through the
twists of the flange.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, TypeAlias

from handeye_ros import se3
from handeye_ros.arm import Arm, ERROR_KINDS
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import identity
from handeye_ros.estimation.noise import LUMPED, whitening
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.frames import mount_poses
import numpy as np
from numpy.typing import NDArray

SMOOTH_ERROR_STD = 2e-4  # prior 1 sigma of the remaining error of the robot, each axis (m)


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
                         linear.wrt_pose, whitening(linear, LUMPED))

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
        at = se3.apply(T, (lever + X[:3, 3])[:, None])[:, 0]  # where the target is fixed
        to_mount = np.broadcast_to(X[:3, :3].T, (n, 3, 3))
        to_fixed = to_mount @ np.swapaxes(T[:, :3, :3], 1, 2)
        values = to_fixed @ (at - target)[:, :, None]
        wrt_own = np.concatenate([to_mount, -to_mount @ se3.skew(lever), -to_fixed], axis=2)
        wrt_shift, from_flange = (to_fixed, at - T[:, :3, 3]) if self.in_hand else (
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
        return max(one.axes for one in self.measured)

    @cached_property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return int(self.by_target[-1][2].stop)

    @cached_property
    def by_target(self) -> list[tuple[Measurement, slice, slice]]:
        """Return for each target its measurements, its stops, and the columns of its unknowns."""
        stops = np.cumsum([0, *map(len, self.measured)])
        columns = np.cumsum([6, *(one.unknowns for one in self.measured)])
        return [(one, slice(*own), slice(*free)) for one, own, free in zip(
            self.measured, pairwise(stops), pairwise(columns), strict=True)]

    @cached_property
    def station(self) -> NDArray[np.intp]:
        """Return the stop (m,) of each residual."""
        return np.concatenate([one.station + stops.start for one, stops, _ in self.by_target])

    def residuals(self, state: ArmState) -> list[Residuals]:
        """Return the residuals of each target, without the smooth error."""
        T = state.arm.forward(self.q)
        return [one.residuals(T[stops], state.X, target) for (one, stops, _), target in zip(
            self.by_target, state.targets, strict=True)]

    def distances(self, state: ArmState) -> Array:
        """Return the length (n,) of the residual of each stop, RMS of several (m)."""
        values = np.concatenate([residual.values for residual in self.residuals(state)])
        return lengths(values, self.station, self.axes)

    def linearised(self, state: ArmState) -> tuple[Array, Array]:
        """
        Return whitened residuals (m,), and their derivatives (m, u).

        By X, the targets, the errors of the arm and the smooth error.
        """
        twists, rows = state.arm.twists(self.q)[:, :, state.arm.free], []
        for residual, (one, stops, columns) in zip(self.residuals(state), self.by_target,
                                                   strict=True):
            station = one.station + stops.start
            wrt_own = np.zeros((len(residual.values), self.unknowns))
            wrt_own[:, :6], wrt_own[:, columns] = residual.wrt_own[:, :6], residual.wrt_own[:, 6:]
            wrt_arm = (residual.wrt_pose[:, None] @ twists[station])[:, 0]
            wrt_smooth = (self.root[station][:, :, None] * residual.wrt_pose[:, None, :3]
                          ).reshape(len(wrt_own), -1)
            values = residual.values + wrt_smooth @ state.smooth
            rows.append(residual.whiten(np.column_stack([wrt_own, wrt_arm, wrt_smooth, values])))
        whitened = np.concatenate(rows)
        return whitened[:, -1], whitened[:, :-1]

    def moved(self, state: ArmState, step: Array) -> ArmState:
        """Return a state after a step (u,)."""
        targets = tuple(one.moved(target, step[columns]) for (one, _, columns), target in zip(
            self.by_target, state.targets, strict=True))
        of_arm, smooth = np.split(step[self.unknowns:], [len(state.arm.values)])
        return ArmState(se3.perturb(state.X, step[:6]), targets,
                        replace(state.arm, values=state.arm.values + of_arm),
                        state.smooth + smooth)
