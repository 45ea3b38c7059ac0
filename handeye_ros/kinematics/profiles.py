"""
Profiles of any target, from many robot configurations: the same unknowns as for points.

The residuals are those of the hand-eye estimate (see estimation), whitened with what is configured
of the sensor; the arm moves the poses, and its parameters act through the twists of the flange.
"""
from __future__ import annotations

from dataclasses import dataclass, fields, replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.consensus import consensus, SUBSETS
from handeye_ros.estimation.linearise import linearise, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.solution import retracted
from handeye_ros.kinematics.model import Arm
from handeye_ros.kinematics.points import State
from handeye_ros.results.outcome import in_mount
import numpy as np
from numpy.typing import NDArray

INACCURATE = 5e-4  # what the robot may err by before it is corrected (m)
SEED = 0


@dataclass(frozen=True, eq=False)
class Profiles:
    """
    What was seen: q (n, joints) reported joint values; problem: the observations of each.

    number: (n,) of each stop among all samples.
    """

    q: Array
    problem: Problem
    number: NDArray[np.intp]

    def __len__(self) -> int:
        """Return the number of configurations."""
        return len(self.q)

    def again(self, rows: NDArray[np.intp], q: Array) -> Profiles:
        """Return what stops (k,) would show with other postures q (k, joints) at these poses."""
        obs = self.problem.observations
        picked = [np.flatnonzero(obs.station == row) for row in rows]
        count, index = [len(part) for part in picked], np.concatenate(picked)
        sources = np.concatenate([obs.source[part] + k * (obs.source.max() + 1)
                                  for k, part in enumerate(picked)])
        others = replace(obs, **{field.name: getattr(obs, field.name)[index]
                                 for field in fields(obs)})
        others = replace(others, station=np.repeat(np.arange(len(rows)), count), source=sources)
        problem = replace(self.problem, poses=self.problem.poses[rows], observations=others)
        return Profiles(q, problem, self.number[rows])

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the target."""
        return len(self.problem.columns)

    @property
    def block(self) -> NDArray[np.intp]:
        """Return the configuration (m,) that each residual is of."""
        return self.problem.observations.station

    @property
    def component(self) -> NDArray[np.intp]:
        """Return which noise (m,) each residual has: all one, over the configured one."""
        return np.zeros(len(self.problem.observations), dtype=np.intp)

    def moved(self, state: State, step: Array) -> State:
        """Return a state moved by a step: X, target, parameters of the arm, smooth."""
        own, rest = np.split(step, [self.unknowns])
        after = retracted(self.problem, Estimate(state.X, state.targets), own)
        return replace(state, X=after.X, targets=after.target).with_arm_moved(rest)

    def difference(self, state: State, other: State) -> Array:
        """Return by how much X (and 0 for the target) (unknowns,) is off another state."""
        found = np.zeros(self.unknowns)
        found[:6] = se3.difference(state.X, other.X)
        return found

    def distances(self, state: State) -> Array:
        """Return by how far (n,) the configurations miss, RMS of their residuals (m)."""
        problem = self._at(state.arm.forward(self.q))
        g = linearise(problem, Estimate(state.X, state.targets)).residuals
        count = np.bincount(self.block, minlength=len(self))
        return np.asarray(np.sqrt(np.bincount(self.block, g ** 2) / count))

    def linearised(self, state: State, root: Array) -> tuple[Array, Array]:
        """Return whitened residuals (m,) and derivatives (m, u); root: see Points."""
        T, twists = state.arm.with_twists(self.q)
        problem = self._at(T)
        linear = linearise(problem, Estimate(state.X, state.targets))
        by_pose, station = linear.by_pose, self.block
        by_arm = np.einsum('mi,mik->mk', by_pose, twists[station])
        by_smooth = (root[station][:, :, None] * by_pose[:, None, :3]).reshape(len(station), -1)
        r = linear.residuals + by_smooth @ state.smooth.ravel()
        white = whitening(problem, linear, Noise())
        both = white(np.column_stack([linear.jacobian[:, problem.columns], by_arm, by_smooth, r]))
        return both[:, -1], both[:, :-1]

    def _at(self, T_base_flange: Array) -> Problem:
        return replace(self.problem, poses=in_mount(T_base_flange, self.problem.config))


def profiles_of(problem: Problem, q: Array, arm: Arm) -> tuple[Profiles, State]:
    """
    Return what samples show that agree, and the estimate with the arm as it is.

    problem: of all samples, its poses those of the arm; q: (n, joints) of these.
    """
    noise = replace(problem.config.noise, robot_smooth=INACCURATE)
    rough = replace(problem, config=replace(problem.config, noise=noise))
    agreed = consensus(rough, np.random.default_rng(SEED), SUBSETS)
    exact = replace(noise, robot_smooth=0.0)
    own = replace(agreed.solution.problem, config=replace(problem.config, noise=exact))
    estimate = agreed.solution.estimate
    state = State(estimate.X, estimate.target, arm, np.zeros((0, 3)))
    return Profiles(q[agreed.used], own, agreed.used), state
