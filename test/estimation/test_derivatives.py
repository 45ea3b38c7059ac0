# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The derivatives of every method against differences."""
from __future__ import annotations

from dataclasses import replace

from cells import every_method, noisy, solution_of, WHERE
from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.estimation.solve import Solution
import numpy as np
import pytest


def numerical(problem: Problem, at: Estimate, h: float = 1e-6) -> Array:
    """Return the Jacobian (m, 6 + k) by central differences, of all parameters."""
    k = len(problem.target.labels)

    def residuals(delta: Array) -> Array:
        moved = Estimate(se3.perturb(at.X, delta[:6]),
                         problem.target.retract(at.state, delta[6:]))
        return linearise(problem, moved).residuals
    steps = h * np.eye(6 + k)
    return np.column_stack([(residuals(d) - residuals(-d)) / (2 * h) for d in steps])


def somewhere(problem: Problem, solution: Solution, seed: int) -> tuple[Problem, Estimate]:
    """Return a problem and an estimate off the solution, where nothing vanishes by chance."""
    rng = np.random.default_rng(seed)
    at, target = solution.estimate, problem.target
    at = Estimate(se3.perturb(at.X, rng.normal(size=6) * 0.02),
                  target.retract(at.state, rng.normal(size=len(target.labels)) * 0.02))
    kinds = rng.integers(0, len(target.kinds), len(problem.observations))
    return replace(problem, observations=replace(problem.observations, kind=kinds)), at


@every_method
@pytest.mark.parametrize('where', WHERE)
def test_the_jacobian_is_that_of_differences(name: str, where: str) -> None:
    solution = solution_of(name, where)
    for seed in range(3):
        at_problem, at = somewhere(noisy(name, where).problem, solution, seed)
        analytic = linearise(at_problem, at).jacobian
        expected = numerical(at_problem, at)
        assert np.abs(analytic - expected).max() < 2e-7
        assert (np.abs(analytic).max(axis=0) > 1e-3)[at_problem.columns].all(), 'none is idle'


@every_method
def test_the_derivatives_by_pose_point_and_feature_are_those_of_differences(name: str) -> None:
    at_problem, at = somewhere(noisy(name).problem, solution_of(name), 7)
    linear, obs, h = linearise(at_problem, at), at_problem.observations, 1e-6

    def by(changed: list[Problem]) -> Array:
        plus, minus = (linearise(p, at).residuals for p in changed)
        return (plus - minus) / (2 * h)

    for k in range(6):
        delta = h * np.eye(6)[k]
        poses = [np.array([se3.perturb(T, s * delta) for T in at_problem.poses])
                 for s in (1, -1)]
        expected = by([replace(at_problem, poses=p) for p in poses])
        assert np.abs(linear.by_pose[:, k] - expected).max() < 2e-7
    for k in range(2):
        for derivative, direction in ((linear.by_point, np.tile(np.eye(2)[k], (len(obs), 1))),
                                      (linear.by_feature, obs.noise[:, :, k])):
            expected = by([replace(at_problem, observations=replace(
                obs, points=obs.points + s * h * direction)) for s in (1, -1)])
            assert np.abs(derivative[:, k] - expected).max() < 2e-7
