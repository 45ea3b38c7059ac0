# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Finds the time offset of a moving robot's profiles without a start value.

A profile with stamp t has the pose T(t + dt). The derivative of a condition by dt is its
derivative by the flange pose times the twist: one more column. A robot may report its rotation
later than its position: T then has the position at t + dt and the rotation at t + dt + lag. Far
from the solution, fits start from several offsets, on some of the samples, until one is good.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.estimation.least_squares import believed, graduated, Rows, System, White
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.problem import Estimate, Linear, linearise, Problem
from handeye_ros.estimation.search import relabelled
from handeye_ros.sampling.passes import Pairing, problem_of
import numpy as np
from numpy.typing import NDArray

NO_POSES = 'there are no poses of that time'
CONVINCING = 4.0  # squared residual of the believed share, in variances, of a good start


@dataclass(frozen=True, eq=False)
class Synchronised:
    """
    Samples with the poses at one time offset, and an estimate near their solution.

    rejects: samples without poses at their time.
    """

    samples: list[Sample]
    rejects: list[Reject]
    estimate: Estimate | None = None


def synchronised(samples: Sequence[Sample], config: Config) -> Synchronised:
    """
    Return samples of a moving robot with the poses at the most likely time offset.

    At most 400 samples are used. Raises DataError where no estimate can be started.
    """
    if not any(sample.motion for sample in samples):
        return Synchronised(list(samples), [])
    samples = [samples[i] for i in evenly_chosen(len(samples), 400)]
    problem = problem_of(samples, config)
    found = _searched(problem.subset(evenly_chosen(len(samples), 60)), np.random.default_rng(0))
    found = _refined(problem.with_pose_values(found.values), found.estimate)
    poses, paired, rejects = Pairing.of(samples).at(*found.values), [], []
    for sample, T, inside in zip(samples, poses.T_base_flange, poses.inside, strict=True):
        if inside:
            paired.append(replace(sample, T_base_flange=T, offsets=tuple(found.values)))
        else:
            rejects.append(Reject(sample.stamp, NO_POSES))
    return Synchronised(paired, rejects, found.estimate)


def _searched(problem: Problem, rng: np.random.Generator) -> _At:
    """Return the best fit over several offsets, or the first convincing one."""
    best: _At | None = None
    for offset in sorted(np.arange(-10, 11, 2), key=abs):  # prior sigmas
        values = np.zeros(len(problem.pose_values))
        values[0] = offset * problem.config.time_offset_std
        shifted = problem.with_pose_values(values)
        for start in islice(shifted.guesses(rng), 3):
            found = _refined(shifted, start)
            best = found if best is None or found.loss < best.loss else best
        if best and believed(best.squares) < CONVINCING:
            break
    assert best is not None
    return best


def _refined(problem: Problem, start: Estimate) -> _At:
    """Return the result of graduated non-convexity from an estimate, with the offset unknown."""
    def refit(at: _At, weights: Array) -> _At:
        system = System(_At.rows, _At.retracted, at.blocks)
        at = system.reweighted(at, np.append(weights, 1.0))
        return labelled(at.problem, at.estimate)

    def labelled(now: Problem, estimate: Estimate) -> _At:
        whole = replace(now, observations=problem.observations)
        return _At(relabelled(whole, estimate, now), estimate)

    return graduated(labelled(problem, start), lambda at: at.squares, refit)


@dataclass(frozen=True, eq=False)
class _At:
    """A labelled problem at an estimate; offset and lag are its pose values."""

    problem: Problem
    estimate: Estimate

    @property
    def values(self) -> Array:
        return self.problem.pose_values

    @property
    def prior_stds(self) -> Array:
        assert self.problem.pose_model is not None
        return np.array(self.problem.pose_model.stds)

    @cached_property
    def linear(self) -> Linear:
        return linearise(self.problem, self.estimate)

    @cached_property
    def white(self) -> White:
        return whitening(self.linear, Noise())

    @cached_property
    def squares(self) -> Array:
        """Return the mean squared whitened residual (n,) of each sample."""
        station, n = self.problem.observations.station, len(self.problem.poses)
        squares = np.bincount(station, self.white(self.linear.residuals) ** 2, minlength=n)
        return np.asarray(squares / np.maximum(np.bincount(station, minlength=n), 1))

    @property
    def loss(self) -> float:
        return float(np.log1p(self.squares).mean())

    @property
    def blocks(self) -> NDArray[np.intp]:
        """Return the block of each row: its sample, or the block of the priors."""
        stations = np.full(len(self.values), len(self.problem.poses))
        return np.append(self.problem.observations.station, stations)

    def rows(self) -> Rows:
        """Return the residuals; the last ones are those of the priors."""
        return Rows(np.append(self.linear.residuals, self.values / self.prior_stds),
                    self._jacobian, lambda: self._whitened)

    def _jacobian(self) -> Array:
        linear, problem, model = self.linear, self.problem, self.problem.pose_model
        assert model is not None
        J = np.hstack([linear.jacobian[:, problem.columns],
                       linear.by_twists(model.at(self.values)[1])])
        priors = np.eye(J.shape[1])[-len(self.values):] / self.prior_stds[:, None]
        return np.vstack([J, priors])

    def _whitened(self, values: Array) -> Array:
        k = len(self.values)
        return np.concatenate([self.white(values[:-k]), values[-k:]])

    def retracted(self, step: Array) -> _At:
        """Return the problem after a step of all unknowns, offset and lag the last."""
        k = len(self.values)
        estimate = self.problem.retracted(self.estimate, step[:-k])
        return _At(self.problem.with_pose_values(self.values + step[-k:]), estimate)


def evenly_chosen(n: int, most: int) -> NDArray[np.intp]:
    """Return the indices of at most a number of n samples, evenly spaced."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(np.intp)
