# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Profiles of targets from many robot configurations: the same unknowns as for points.

The residuals are those of the hand-eye estimate (docs/estimator.md), whitened with the configured
noise; the arm gives the poses, and its parameters act through the twists of the flange. Several
targets, or one at several positions, have sensor and arm in common.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.arm import Arm
from handeye_ros.data import Array
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.problem import Estimate, Linear, linearise, Problem
from handeye_ros.estimation.search import robust_solution
from handeye_ros.frames import in_mount
from handeye_ros.robot.estimate import State
import numpy as np
from numpy.typing import NDArray

INACCURATE = 5e-4  # 1 sigma of the robot's error before its correction (m)
APART = 0.05  # m and rad: largest difference of X between targets
SEED = 0


@dataclass(frozen=True, eq=False)
class Profiles:
    """
    The measurements: q (n, joints) reported joint values of all stops, target by target.

    problems: the observations of each target; sizes: numbers in the state of each; number: (n,)
    of each stop among the samples of its target.
    """

    q: Array
    problems: tuple[Problem, ...]
    sizes: tuple[int, ...]
    number: NDArray[np.intp]

    def __len__(self) -> int:
        """Return the number of configurations."""
        return len(self.q)

    @cached_property
    def stops(self) -> tuple[slice, ...]:
        """Return the rows of q that belong to each target."""
        return _slices([len(problem.poses) for problem in self.problems])

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return 6 + sum(len(problem.columns) - 6 for problem in self.problems)

    @cached_property
    def block(self) -> NDArray[np.intp]:
        """Return the configuration (m,) of each residual."""
        return np.concatenate([problem.observations.station + stops.start
                               for problem, stops in zip(self.problems, self.stops, strict=True)])

    @property
    def component(self) -> NDArray[np.intp]:
        """Return the noise component of each residual (m,): there is one."""
        return np.zeros(len(self.block), dtype=np.intp)

    def retracted(self, state: State, step: Array) -> State:
        """Return a state after a step: X, targets, parameters of the arm, smooth."""
        estimates = [problem.retracted(estimate, np.append(step[:6], step[columns]))
                     for problem, estimate, columns in zip(
                         self.problems, self._estimates(state), self._columns, strict=True)]
        targets = np.concatenate([estimate.target for estimate in estimates])
        return replace(state, X=estimates[0].X, targets=targets).with_arm_step(
            step[self.unknowns:])

    def distances(self, state: State) -> Array:
        """Return the RMS residual (n,) of each configuration (m)."""
        g = np.concatenate([linear.residuals for linear in self._linear(
            state, state.arm.forward(self.q))])
        count = np.bincount(self.block, minlength=len(self))
        return np.asarray(np.sqrt(np.bincount(self.block, g ** 2) / count))

    def linearised(self, state: State, root: Array) -> tuple[Array, Array]:
        """Return whitened residuals (m,) and derivatives (m, u); root: see Points."""
        T, twists = state.arm.with_twists(self.q)
        residuals, rows = [], []
        for linear, stops, columns in zip(self._linear(state, T), self.stops, self._columns,
                                          strict=True):
            problem, by_pose = linear.problem, linear.by_pose
            station = problem.observations.station + stops.start
            by_arm = np.einsum('mi,mik->mk', by_pose, twists[station])
            by_smooth = (root[station][:, :, None] * by_pose[:, None, :3]).reshape(
                len(station), -1)
            r = linear.residuals + by_smooth @ state.smooth.ravel()
            jacobian = linear.jacobian[:, problem.columns]
            J = np.zeros((len(r), self.unknowns))
            J[:, :6], J[:, columns] = jacobian[:, :6], jacobian[:, 6:]
            white = whitening(linear, Noise())(np.column_stack([J, by_arm, by_smooth, r]))
            residuals.append(white[:, -1])
            rows.append(white[:, :-1])
        return np.concatenate(residuals), np.concatenate(rows)

    @cached_property
    def _columns(self) -> tuple[slice, ...]:
        return _slices([len(problem.columns) - 6 for problem in self.problems], 6)

    def _estimates(self, state: State) -> list[Estimate]:
        return [Estimate(state.X, state.targets[rows]) for rows in _slices(self.sizes)]

    def _linear(self, state: State, T_base_flange: Array) -> Iterator[Linear]:
        """Yield each problem linearised, with the poses (n, 4, 4) of the arm."""
        for problem, stops, estimate in zip(self.problems, self.stops, self._estimates(state),
                                            strict=True):
            poses = in_mount(T_base_flange[stops], problem.config)
            yield linearise(replace(problem, poses=poses), estimate)


def _slices(counts: Sequence[int], first: int = 0) -> tuple[slice, ...]:
    ends = first + np.cumsum([0, *counts])
    return tuple(slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True))


def profiles_of(problems: Sequence[Problem], q: Sequence[Array], arm: Arm
                ) -> tuple[Profiles, State]:
    """
    Return the consistent samples, and the estimate with the arm as stated.

    problems: of all samples of each target, the poses those of the arm; q: (n, joints) of each.
    Raises DataError where the targets give different poses of the sensor.
    """
    agreed = [_agreed(problem) for problem in problems]
    X = agreed[0][1].X
    for _, estimate, _ in agreed[1:]:
        difference = se3.difference(estimate.X, X)
        if np.linalg.norm(difference[:3]) > APART or np.linalg.norm(difference[3:]) > APART:
            raise DataError(
                f'two recordings place the sensor {mm(float(np.linalg.norm(difference[:3])))} '
                'apart: give only recordings of one sensor in one mount, on one robot')
    targets = [estimate.target for _, estimate, _ in agreed]
    state = State(X, np.concatenate(targets), arm, np.zeros((0, 3)))
    used = [indices for _, _, indices in agreed]
    data = Profiles(np.concatenate([indices[rows] for indices, rows in zip(q, used, strict=True)]),
                    tuple(problem for problem, _, _ in agreed), tuple(map(len, targets)),
                    np.concatenate(used))
    return data, state


def _agreed(problem: Problem) -> tuple[Problem, Estimate, NDArray[np.intp]]:
    """Return the problem of the consistent stations, its estimate, and their indices."""
    noise = replace(problem.config.noise, robot_smooth=INACCURATE)
    rough = replace(problem, config=replace(problem.config, noise=noise))
    agreed = robust_solution(rough, np.random.default_rng(SEED), subsets=True)
    exact = replace(problem.config, noise=replace(noise, robot_smooth=0.0))
    solution = agreed
    return replace(solution.problem, config=exact), solution.estimate, agreed.used


def misfit(problem: Problem) -> float:
    """Return the median residual (m) of the stations at the best estimate."""
    agreed = robust_solution(problem, np.random.default_rng(SEED))
    g = linearise(agreed.whole, agreed.estimate).residuals
    station = problem.observations.station
    squares = np.bincount(station, g ** 2) / np.maximum(np.bincount(station), 1)
    return float(np.sqrt(np.median(squares)))
