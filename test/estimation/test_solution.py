# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The solver: invariances and derivatives; the same for every method."""
from __future__ import annotations

from dataclasses import replace

from cells import (
    ANY_POSE,
    apart,
    calibration_of,
    cell,
    every_target,
    map_solution,
    noisy,
    ONE_IN_1000,
    solution_of,
    solved,
)
from handeye_ros import se3
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.estimation.search import quick_solution
from handeye_ros.estimation.solution import Solution
from handeye_ros.simulate import SCENARIOS
from handeye_ros.targets import problem_of_known_poses
import numpy as np
import pytest

TURN = se3.transform(ANY_POSE[:3, :3], np.zeros(3))


@every_target
@pytest.mark.parametrize(('base', 'flange'), [(ANY_POSE, np.eye(4)), (np.eye(4), TURN)])
def test_in_other_frames_the_answer_is_the_same(name: str, base: Array, flange: Array) -> None:
    solution = solution_of(name)
    samples = [replace(s, T_base_flange=base @ s.T_base_flange @ flange)
               for s in noisy(name).samples]
    in_other_frames = solved(problem_of_known_poses(samples, noisy(name).config))
    assert apart(se3.inverse(flange) @ solution.estimate.X, in_other_frames.estimate.X) < 1e-9
    Q = np.kron(np.eye(2), flange[:3, :3].T)
    C, D = (each.posterior.covariance[:6, :6] for each in (solution, in_other_frames))
    assert np.abs(Q @ C @ Q.T - D).max() < 1e-6 * np.abs(C).max()


@every_target
def test_shuffled_samples_give_the_same_calibration_and_are_not_changed(name: str) -> None:
    simulated_cell, in_order = noisy(name), calibration_of(name)
    # it sorts them by their stamps, so which shuffle it is does not matter
    order = np.random.default_rng(6).permutation(len(simulated_cell.samples))
    shuffled = simulated_cell.solve(frozen(simulated_cell.samples[k]) for k in order)
    assert apart(in_order.T_flange_sensor, shuffled.T_flange_sensor) < 1e-9
    assert np.allclose(in_order.covariance, shuffled.covariance, rtol=1e-6, atol=1e-18)
    assert in_order.samples == shuffled.samples and in_order.target == shuffled.target


def frozen(sample: Sample) -> Sample:
    """Return a sample whose arrays raise when they are written to."""
    copy = replace(sample, T_base_flange=sample.T_base_flange.copy())
    copy.T_base_flange.setflags(write=False)
    for feature in copy.features:
        for value in vars(feature).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
    return copy


def test_of_very_many_stations_all_count_though_some_tell_the_noise() -> None:
    plate_cell = cell(replace(SCENARIOS['plate'], stops=(250, 250)), noise__robot_smooth=1e-4)
    first_solution = solved(plate_cell.problem)
    with_all, with_half = (map_solution(problem, first_solution.estimate) for problem in (
        first_solution.problem, first_solution.problem.subset(np.arange(0, 500, 2))))
    std, std_of_half = (np.sqrt(np.diag(solution.reported_covariance)[:6])
                        for solution in (with_all, with_half))
    assert (std < 0.9 * std_of_half).all() and (std > 0.6 * std_of_half).all()
    error = se3.difference(with_all.estimate.X, plate_cell.truth.T_flange_sensor)
    assert error @ np.linalg.solve(with_all.transform_covariance, error) < ONE_IN_1000


@pytest.mark.parametrize('seed', range(3))
def test_a_solve_that_diverges_reports_the_errors_of_any_other(seed: int) -> None:
    """A start that is off by metres and radians."""
    problem, at = noisy('sphere').problem, solution_of('sphere').estimate
    far = se3.perturb(at.X, np.random.default_rng(seed).normal(size=6))
    solution = map_solution(problem, replace(at, X=far))
    assert apart(solution.estimate.X, at.X) > 0.1, 'it has not found the answer'
    with_cause = replace(solution, added_covariances={'cause': 1e-6 * np.eye(6)})
    added = with_cause.reported_covariance - solution.reported_covariance
    np.testing.assert_allclose(added[:6, :6], 1e-6 * np.eye(6), atol=1e-12)
    beside = solution.report_posterior.covariance[:6, :6]
    assert np.linalg.eigvalsh(solution.transform_covariance - beside).min() > -1e-9 * beside.max()


def numerical(problem: Problem, at: Estimate, h: float = 1e-6) -> Array:
    """Return the Jacobian (m, 6 + k) by central differences, of all parameters."""
    k = len(problem.target.parameter_names)

    def residuals(delta: Array) -> Array:
        moved = Estimate(se3.perturb(at.X, delta[:6]), problem.target.retract(at.state, delta[6:]))
        return linearise(problem, moved).residuals
    steps = h * np.eye(6 + k)
    return np.column_stack([(residuals(d) - residuals(-d)) / (2 * h) for d in steps])


def somewhere(problem: Problem, solution: Solution, seed: int) -> tuple[Problem, Estimate]:
    """Return a problem and an estimate off the solution, where nothing vanishes by chance."""
    rng = np.random.default_rng(seed)
    at, target = solution.estimate, problem.target
    at = Estimate(se3.perturb(at.X, rng.normal(size=6) * 0.02),
                  target.retract(at.state, rng.normal(size=len(target.parameter_names)) * 0.02))
    kinds = rng.integers(0, len(target.kinds), len(problem.observations))
    return replace(problem, observations=replace(problem.observations, kind=kinds)), at


@every_target
@pytest.mark.parametrize('where', ('eye_in_hand', 'eye_on_base'))
def test_the_jacobian_is_that_of_differences(name: str, where: str) -> None:
    solution = solution_of(name, where)
    for seed in range(3):
        at_problem, at = somewhere(noisy(name, where).problem, solution, seed)
        analytic = linearise(at_problem, at).jacobian
        expected = numerical(at_problem, at)
        assert np.abs(analytic - expected).max() < 2e-7
        assert (np.abs(analytic).max(axis=0) > 1e-3)[at_problem.free_columns].all(), 'none is idle'


@every_target
def test_derivatives_by_pose_point_and_feature_are_those_of_differences(name: str) -> None:
    at_problem, at = somewhere(noisy(name).problem, solution_of(name), 7)
    linear, obs, h = linearise(at_problem, at), at_problem.observations, 1e-6

    def by(changed: list[Problem]) -> Array:
        plus, minus = (linearise(p, at).residuals for p in changed)
        return (plus - minus) / (2 * h)

    for k in range(6):
        delta = h * np.eye(6)[k]
        poses = [np.array([se3.perturb(T, s * delta) for T in at_problem.poses]) for s in (1, -1)]
        expected = by([replace(at_problem, poses=p) for p in poses])
        assert np.abs(linear.wrt_pose[:, k] - expected).max() < 2e-7
    for k in range(2):
        for derivative, direction in ((linear.wrt_point, np.tile(np.eye(2)[k], (len(obs), 1))),
                                      (linear.wrt_unit_errors, obs.error_root[:, :, k])):
            expected = by([replace(at_problem, observations=replace(
                obs, points=obs.points + s * h * direction)) for s in (1, -1)])
            assert np.abs(derivative[:, k] - expected).max() < 2e-7


@every_target
def test_samples_that_are_alike_have_a_start_too(name: str) -> None:
    problem = noisy(name).problem
    first, shifts = problem.poses[0], problem.poses[:, :3, 3]
    for position in (shifts, shifts * 0.0, np.broadcast_to(first[:3, 3], shifts.shape)):
        alike = replace(problem, poses=se3.transform(
            np.broadcast_to(first[:3, :3], (len(shifts), 3, 3)), position))
        start = next(problem.target.starts(alike, np.random.default_rng(0)))
        assert np.isfinite(start.X).all() and np.isfinite(start.state).all()


def test_a_quick_solution_needs_one_start_that_can_be_solved(monkeypatch: pytest.MonkeyPatch
                                                             ) -> None:
    problem = noisy('plate').problem
    truth = solution_of('plate').estimate
    nowhere = replace(truth, X=np.full((4, 4), np.nan))

    def quick(*estimates: Estimate) -> Solution | None:
        monkeypatch.setattr(type(problem.target), 'starts', lambda *_: iter(estimates))
        return quick_solution(problem)

    for estimates in ((truth,), (nowhere, truth)):
        solution = quick(*estimates)
        assert solution is not None
        assert apart(solution.estimate.X, truth.X) < 1e-6
    assert quick(nowhere) is None
