"""
Profiles of targets, from many robot configurations: the same unknowns as for points.

The residuals are those of the hand-eye estimate (see estimation), whitened with what is configured
of the sensor; the arm moves the poses, and its parameters act through the twists of the flange.
Several targets, or one at several places, share the sensor and the arm.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.linearise import Linear, linearise, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.frames import in_mount
from handeye_ros.kinematics.errors import TargetsApartError
from handeye_ros.kinematics.estimate import State
from handeye_ros.kinematics.model import Arm
import numpy as np
from numpy.typing import NDArray

INACCURATE = 5e-4  # what the robot may err by before it is corrected (m)
APART = 0.05  # m and rad; the sensor is not elsewhere by more, as several targets see it
SEED = 0


@dataclass(frozen=True, eq=False)
class Profiles:
    """
    What was seen: q (n, joints) reported joint values of all stops, one target after the other.

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

    def with_postures(self, rows: NDArray[np.intp], q: Array) -> Profiles:
        """Return what stops (k,) ascending would show with other postures q (k, joints)."""
        own = [rows[(rows >= at.start) & (rows < at.stop)] - at.start for at in self.stops]
        problems = tuple(map(_repeated, self.problems, own))
        return replace(self, q=q, problems=problems, number=self.number[rows])

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return 6 + sum(len(problem.columns) - 6 for problem in self.problems)

    @cached_property
    def block(self) -> NDArray[np.intp]:
        """Return the configuration (m,) that each residual is of."""
        return np.concatenate([problem.observations.station + at.start
                               for problem, at in zip(self.problems, self.stops, strict=True)])

    @property
    def component(self) -> NDArray[np.intp]:
        """Return which noise (m,) each residual has: all one, over the configured one."""
        return np.zeros(len(self.block), dtype=np.intp)

    def moved(self, state: State, step: Array) -> State:
        """Return a state moved by a step: X, targets, parameters of the arm, smooth."""
        after = [problem.retracted(own, np.append(step[:6], step[at]))
                 for problem, own, at in zip(self.problems, self._estimates(state), self._columns,
                                             strict=True)]
        targets = np.concatenate([own.target for own in after])
        return replace(state, X=after[0].X, targets=targets).with_arm_moved(step[self.unknowns:])

    def distances(self, state: State) -> Array:
        """Return by how far (n,) the configurations miss, RMS of their residuals (m)."""
        g = np.concatenate([linear.residuals for linear in self._linear(
            state, state.arm.forward(self.q))])
        count = np.bincount(self.block, minlength=len(self))
        return np.asarray(np.sqrt(np.bincount(self.block, g ** 2) / count))

    def linearised(self, state: State, root: Array) -> tuple[Array, Array]:
        """Return whitened residuals (m,) and derivatives (m, u); root: see Points."""
        T, twists = state.arm.with_twists(self.q)
        residuals, rows = [], []
        for linear, at, columns in zip(self._linear(state, T), self.stops, self._columns,
                                       strict=True):
            problem, by_pose = linear.problem, linear.by_pose
            station = problem.observations.station + at.start
            by_arm = np.einsum('mi,mik->mk', by_pose, twists[station])
            by_smooth = (root[station][:, :, None] * by_pose[:, None, :3]).reshape(
                len(station), -1)
            r = linear.residuals + by_smooth @ state.smooth.ravel()
            own = linear.jacobian[:, problem.columns]
            J = np.zeros((len(r), self.unknowns))
            J[:, :6], J[:, columns] = own[:, :6], own[:, 6:]
            white = whitening(linear, Noise())(np.column_stack([J, by_arm, by_smooth, r]))
            residuals.append(white[:, -1])
            rows.append(white[:, :-1])
        return np.concatenate(residuals), np.concatenate(rows)

    @cached_property
    def _columns(self) -> tuple[slice, ...]:
        return _slices([len(problem.columns) - 6 for problem in self.problems], 6)

    def _estimates(self, state: State) -> list[Estimate]:
        return [Estimate(state.X, state.targets[at]) for at in _slices(self.sizes)]

    def _linear(self, state: State, T_base_flange: Array) -> Iterator[Linear]:
        """Yield each problem linearised, with the poses (n, 4, 4) of the arm."""
        for problem, at, own in zip(self.problems, self.stops, self._estimates(state),
                                    strict=True):
            poses = in_mount(T_base_flange[at], problem.config)
            yield linearise(replace(problem, poses=poses), own)


def _slices(counts: Sequence[int], first: int = 0) -> tuple[slice, ...]:
    ends = first + np.cumsum([0, *counts])
    return tuple(slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True))


def _repeated(problem: Problem, rows: NDArray[np.intp]) -> Problem:
    """Return a problem with some of its stations (k,), which may be repeated."""
    obs = problem.observations
    picked = [np.flatnonzero(obs.station == row) for row in rows]
    index = np.concatenate([np.zeros(0, dtype=np.intp), *picked])
    station = np.repeat(np.arange(len(rows)), [len(part) for part in picked])
    others = obs.select(index)
    others = replace(others, station=station,
                     source=others.source + station * (obs.source.max(initial=0) + 1))
    return replace(problem, poses=problem.poses[rows], observations=others)


def profiles_of(problems: Sequence[Problem], q: Sequence[Array], arm: Arm
                ) -> tuple[Profiles, State]:
    """
    Return what samples show that agree, and the estimate with the arm as it is.

    problems: of all samples of each target, the poses those of the arm; q: (n, joints) of each.
    Raises TargetsApartError where the targets do not see the sensor at one place.
    """
    agreed = [_agreed(problem) for problem in problems]
    X = agreed[0][1].X
    for _, estimate, _ in agreed[1:]:
        away = se3.difference(estimate.X, X)
        if np.linalg.norm(away[:3]) > APART or np.linalg.norm(away[3:]) > APART:
            raise TargetsApartError(float(np.linalg.norm(away[:3])))
    targets = [estimate.target for _, estimate, _ in agreed]
    state = State(X, np.concatenate(targets), arm, np.zeros((0, 3)))
    used = [own for _, _, own in agreed]
    data = Profiles(np.concatenate([own[rows] for own, rows in zip(q, used, strict=True)]),
                    tuple(problem for problem, _, _ in agreed), tuple(map(len, targets)),
                    np.concatenate(used))
    return data, state


def _agreed(problem: Problem) -> tuple[Problem, Estimate, NDArray[np.intp]]:
    """Return the problem of the stations that agree, its estimate, and which they are."""
    noise = replace(problem.config.noise, robot_smooth=INACCURATE)
    rough = replace(problem, config=replace(problem.config, noise=noise))
    agreed = Consensus.of(rough, np.random.default_rng(SEED), subsets=True)
    exact = replace(problem.config, noise=replace(noise, robot_smooth=0.0))
    solution = agreed.solution
    return replace(solution.problem, config=exact), solution.estimate, agreed.used


def misfit(problem: Problem) -> float:
    """Return by how much (m) half of the stations miss at least, as far as any estimate goes."""
    agreed = Consensus.of(problem, np.random.default_rng(SEED))
    g = linearise(agreed.whole, agreed.solution.estimate).residuals
    station = problem.observations.station
    squares = np.bincount(station, g ** 2) / np.maximum(np.bincount(station), 1)
    return float(np.sqrt(np.median(squares)))
