"""
The maximum a posteriori estimate with all blocks of nuisance parameters (estimator.md, section 3).

With whitened residuals r + J xi + K n = e, parameters n and noise e of unit variance, the least
squares of [J K; 0 I] give the best linear unbiased xi (Henderson 1975, Biometrics 31:423). The
variances of the noise are estimated by restricted maximum likelihood in multiplicative fixed-point
steps (Patterson and Thompson 1971, Biometrika 58:545), held to the configured ones by a weak
prior; the scales of the parameters from prior and likelihood (see noise).

The estimate and its reported covariance have different prior scales: an error without evidence in
the data must not move the estimate, but it may exist.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros.data import Array
from handeye_ros.estimation.blocks import ParameterBlock, prepared
from handeye_ros.estimation.jacobian import FactoredJacobian
from handeye_ros.estimation.linalg import from_information, from_rows
from handeye_ros.estimation.linearise import Linear, linearise, MANY, Problem, State
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import (
    covariances,
    Noise,
    PRIOR_FREEDOM,
    prior_scales,
    Scales,
    Whitening,
    whitening,
)
from handeye_ros.estimation.solution import columns_of, Solution
import numpy as np
from numpy.typing import NDArray

STEPS, LAST_STEPS = 2, 3  # iterations of the scales: in each round, in the last
MAP_FACTORS = np.array([1.0, 1.0, 1e-4, 1.0, 1.0])  # prior variance factors for the estimate


def map_solution(problem: Problem, start: Estimate, noise: Noise | None = None) -> Solution:
    """
    Return the MAP solution near a start, with prior scales and noise estimated from residuals.

    noise: initial noise, None: as configured. With very many stations a part is solved first.
    """
    noise, every = noise or Noise(lumped=False), len(problem.poses) // MANY
    state = State.of(problem, start)
    if every > 1:
        some = problem.subset(np.arange(0, len(problem.poses), every))
        system, diverged = _iterated(_System.of(State.of(some, start), noise))
        if not diverged:
            state, noise = system.state, system.noise
            if problem.pose_model is not None:
                problem = problem.with_pose_values(state.problem.pose_values)
            state = replace(state, problem=problem)
    system, diverged = _iterated(_System.of(state, noise))
    return system.solution() if diverged else system.answer()


def _iterated(system: _System) -> tuple[_System, bool]:
    """Return the converged system and False, or the best one before divergence and True."""
    least, best, resting = np.inf, system, False
    for count in range(10):  # linearisations
        x, covariance = system.solved
        size = float(np.abs(x[:system.u] / np.sqrt(np.diag(covariance)[:system.u])).max())
        diverged = size > 4.0 * max(least, 1.0)
        if diverged and count > 1:  # the first steps may grow with the scale of a block
            return best, True
        best, least = best if diverged else system, min(size, least)
        state = system.retracted(x)
        noise, before = system.with_noise(x, covariance), system.noise.factors
        change = np.abs(np.log(noise.factors / before)).max()
        relinearised, steady = system.at(state, noise), change < 0.1
        system = relinearised if resting and steady else relinearised.rescaled(STEPS)[0]
        resting = system is relinearised
        if size < 0.03 and steady:  # sigmas
            break
    return system, False


def evaluated(problem: Problem, estimate: Estimate, noise: Noise) -> Solution:
    """Return the solution at an estimate, with noise and prior scales as given."""
    state = State.of(problem, estimate)
    return _System.of(state, replace(noise, lumped=False)).solution()


def reestimated(solution: Solution, further: tuple[ParameterBlock, ...] = ()) -> Solution:
    """Return a solution with noise and prior scales estimated again, and further blocks."""
    system = _System.of(State.of(solution.problem, solution.estimate), solution.noise)
    system = system.reweighted(system.noise, further)
    for _ in range(LAST_STEPS):
        system = system.reweighted(system.with_noise(*system.solved)).rescaled(STEPS)[0]
    return system.solution()


@dataclass(frozen=True, eq=False)
class _System:
    """
    The whitened least squares at an estimate, (4).

    r: (m,) whitened residuals with nuisance parameters at 0; columns: derivatives by u unknowns
    and by q nuisance parameters in prior sigmas; group: (q,) the block of each parameter.
    """

    state: State
    linear: Linear
    noise: Noise
    blocks: tuple[ParameterBlock, ...]
    white: Whitening
    r: Array
    columns: FactoredJacobian
    group: NDArray[np.intp]
    blocks_at: Callable[[Linear], tuple[ParameterBlock, ...]]

    @classmethod
    def of(cls, state: State, noise: Noise) -> _System:
        """Return the system at a first state, which fixes the bases of the blocks."""
        linear = linearise(state.problem, state.estimate)
        blocks_at = prepared(linear)
        return cls.built(state, linear, noise, blocks_at(linear), blocks_at)

    @classmethod
    def built(cls, state: State, linear: Linear, noise: Noise,
              blocks: tuple[ParameterBlock, ...],
              blocks_at: Callable[[Linear], tuple[ParameterBlock, ...]]) -> _System:
        """Return the system of a linearised problem, whitened by a noise."""
        problem, residuals = state.problem, linear.residuals
        white: Whitening = whitening(linear, noise)
        for block in blocks:
            if block.retract and block.name in state.values:
                residuals = residuals - block.columns @ (state.values[block.name] / block.std)
        parts = [linear.jacobian[:, problem.columns], *(b.columns for b in blocks)]
        own = white(np.column_stack([*parts, residuals]))
        axes = sum(b.columns.shape[1] for b in blocks if b.functions is not None)
        group = np.repeat(np.arange(len(blocks)), [b.count for b in blocks])
        columns, r = columns_of(problem, own[:, :-1], axes), own[:, -1]
        return cls(state, linear, noise, blocks, white, r, columns, group, blocks_at)

    def at(self, state: State, noise: Noise) -> _System:
        """Return the system at another state, with the same bases of its blocks."""
        linear = linearise(state.problem, state.estimate)
        return _System.built(state, linear, noise, self.blocks_at(linear), self.blocks_at)

    def reweighted(self, noise: Noise, further: tuple[ParameterBlock, ...] = ()) -> _System:
        """Return the system with another noise, and further blocks."""
        return _System.built(self.state, self.linear, noise, (*further, *self.blocks),
                             self.blocks_at)

    @property
    def problem(self) -> Problem:
        return self.state.problem

    @property
    def u(self) -> int:
        return self.columns.count - len(self.group)

    @property
    def first(self) -> NDArray[np.intp]:
        """Return the index (d,) of each block's first parameter among those of all blocks."""
        return np.searchsorted(self.group, np.arange(len(self.blocks)))

    @property
    def variances(self) -> Array:
        """Return the variance of each block (d,) relative to the configured one."""
        return np.array([self.noise.scales.get(d.name, 1.0) for d in self.blocks])

    @cached_property
    def scales(self) -> Array:
        """Return the scale of each parameter (u + q,): 1 for unknowns."""
        return np.append(np.ones(self.u), np.sqrt(self.variances)[self.group])

    @cached_property
    def solved(self) -> tuple[Array, Array]:
        """Return the unknowns and nuisance parameters (u + q,) and their covariance C, (5)."""
        if len(self.r) < self.columns.count:
            return from_rows(self.columns.dense * self.scales, self.r, len(self.group))
        gradient = self.columns.gradient_of(self.r, self.columns.rows)
        return from_information(self.columns.gram, gradient, self.scales, len(self.group))

    def rescaled(self, steps: int) -> tuple[_System, Scales | None]:
        """
        Return the system at estimated conservative prior scales, and these scales.

        Ends early if a step hardly changes the variances. Without blocks the scales are None.
        """
        system, scales = self, None
        for _ in range(steps if self.blocks else 0):
            before, scales = system.variances, system.estimated_scales
            if np.abs(np.log(scales.conservative / before)).max() < 0.03:
                break
            system = system.with_variances(scales.conservative)
        return system, scales

    @cached_property
    def estimated_scales(self) -> Scales:
        """Return the prior scales estimated from the data."""
        (x, covariance), u = self.solved, self.u
        largest = np.array([d.largest for d in self.blocks])
        return prior_scales(covariance[u:, u:], x[u:], self.first, self.variances, largest)

    def with_noise(self, x: Array, covariance: Array, believed: Array | float = 1.0) -> Noise:
        """Return the noise with factors estimated from residuals and a prior, (7)."""
        sums, columns = np.zeros((len(MAP_FACTORS), 2)), self.columns.scaled(self.scales)
        every = -(-len(self.problem.poses) // MANY)
        for stations, factors in zip(self.problem.stations, self.white.factors, strict=True):
            at, root = stations.every(every), factors[::every]
            V = covariances(self.linear, at)
            W = (root @ V @ np.swapaxes(root, 1, 2)).reshape(len(V), -1)
            r = self.r[at.rows] + columns.change(x, at.rows)
            left = np.eye(r.shape[1]) - columns.predicted_covariance(covariance, at.rows)
            both = r[:, :, None] * r[:, None]
            sums[:len(V)] += W @ np.column_stack([both.ravel(), left.ravel()])
        before = self.noise.factors
        sums *= before[:, None]
        after = before * (sums[:, 0] + PRIOR_FREEDOM * believed / before) / (
            np.maximum(sums[:, 1], 0.0) + PRIOR_FREEDOM)
        return self.noise.with_factors(np.clip(after, 1e-4, 1e8))

    def retracted(self, x: Array) -> State:
        """Return the state after a step x (u + q,) of the unknowns and the blocks that retract."""
        problem, values = self.problem, dict(self.state.values)
        estimate = problem.retracted(self.state.estimate, x[:self.u])
        scaled = x * self.scales
        for first, block in zip(self.u + self.first, self.blocks, strict=True):
            if block.retract:
                after = scaled[first:first + block.count] * block.std
                change = after - values.get(block.name, 0.0)
                problem, estimate = block.retract(problem, estimate, change)
                values[block.name] = after
        return State(problem, estimate, values)

    def with_variances(self, variances: Array) -> _System:
        """Return the system with variances (d,) of the blocks, relative to the configured ones."""
        named = {d.name: max(float(v), d.least)
                 for d, v in zip(self.blocks, variances, strict=True)}
        return replace(self, noise=replace(self.noise, scales=named))

    def answer(self) -> Solution:
        """Return the solution at the MAP scales, together with that at the conservative scales."""
        _, scales = self.rescaled(LAST_STEPS)
        best, conservative = (self, self) if scales is None else (
            self.with_variances(scales.map_scales), self.with_variances(scales.conservative))
        for _ in range(LAST_STEPS):
            best = best.reweighted(best.with_noise(*best.solved, MAP_FACTORS))
        best = self.at(best.retracted(best.solved[0]), best.noise)
        state = replace(best.state, problem=best.problem.of_long_errors)
        conservative = best.at(state, conservative.noise).rescaled(LAST_STEPS)[0]
        return replace(best.solution(), conservative=conservative.solution())

    def solution(self) -> Solution:
        """Return the solution after one more step, which is close to the minimum."""
        (x, covariance), s = self.solved, self.scales
        columns = self.columns.scaled(s)
        blocks = tuple(replace(block, std=block.std * float(tau)) for block, tau
                       in zip(self.blocks, s[self.u:][self.first], strict=True))
        estimate = self.problem.retracted(self.state.estimate, x[:self.u])
        return Solution(self.problem, estimate, self.noise, self.linear, self.r + columns.times(x),
                        columns, covariance, x[self.u:], blocks)
