# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Covariance and residuals against trials and real refits, and what each cause contributes."""
from __future__ import annotations

from dataclasses import replace

from cells import (
    calibration_of,
    cell,
    every_target,
    exact_cell,
    map_solution,
    noisy,
    ONE_IN_20,
    settings_of,
    solution_of,
    solved,
    squared_error,
)
from handeye_ros import pipeline, se3
from handeye_ros.calibration import measured_points
from handeye_ros.config import with_values
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.budget import budget
from handeye_ros.estimation.contamination import (
    ONE_WRONG,
    POSE_ERROR,
    PRIOR_ODDS_WRONG,
    with_possibly_wrong_station,
)
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, covariance_parts, NoiseModel
from handeye_ros.estimation.posterior import posterior_at
from handeye_ros.estimation.search import least_squares_fit
from handeye_ros.estimation.solution import cover
from handeye_ros.simulate import FAULTS, SCENARIOS, simulate_samples
import numpy as np
import pytest
from streams import in_order


@every_target
def test_the_solution_is_the_minimum(name: str) -> None:
    posterior = solution_of(name).posterior
    gradient = posterior.jacobian.T @ posterior.postfit_residuals
    scale = np.sqrt(np.diag(posterior.covariance))
    assert np.abs(gradient * scale).max() < 1e-4, 'in sigmas'


@pytest.mark.parametrize('factors', [
    (1.0, 1.0, 1.0, 1.0), (0.1, 1e4, 1e-4, 1e-4), (1e4, 0.1, 1.0, 1e-4), (1e-4, 1e-4, 1e4, 1e-4)])
def test_the_noise_of_a_station_is_positive(factors: tuple[float, float, float, float]) -> None:
    solution = solution_of('plate')
    problem = replace(solution.problem, config=with_values(
        solution.problem.config, {'noise.distortion': 2e-5}, 'a test'))
    linear = replace(solution.posterior.linear, problem=problem)
    for stations in problem.observations.station_groups:
        noise = np.tensordot(factors, covariance_parts(linear, stations), 1)
        assert np.array_equal(noise, np.swapaxes(noise, 1, 2))
        assert np.linalg.eigvalsh(noise).min() > 0


@pytest.mark.thorough
@every_target
def test_the_stated_covariance_is_that_of_the_errors(name: str) -> None:
    squares, lost = [], []
    count = {'plate': 60, 'sphere': 20}.get(name, 30)  # spheres are slower
    for seed in range(count):
        simulated_cell = cell(name, seed)
        try:
            calibration = simulated_cell.solve()
        except DataError as error:
            assert error.code == 'uncertain'
            continue
        lost.append(calibration.quality.samples_rejected)
        squares.append(squared_error(calibration, simulated_cell.truth) / 6)
    assert len(squares) > 0.9 * count
    sigma = np.sqrt(2 / 6 / len(squares))  # of the mean of chi-squared over 6
    assert abs(np.mean(squares) - 1) < 3.5 * sigma
    assert np.max(squares) < 6, 'no trial is far outside'
    assert sum(lost[:8]) <= 1, 'one station in a thousand recordings'


@every_target
def test_the_left_out_rms_is_that_of_real_refits(name: str) -> None:
    simulated_cell = noisy(name)
    ordered = in_order(simulated_cell.samples)
    calibration = calibration_of(name)
    solution = pipeline.answer_samples(ordered, (), simulated_cell.config).require_solution()
    assert len(solution.used_stations) == len(ordered) <= 20, 'each station is a fold of its own'
    measured = measured_points(ordered, solution.problem)
    squares, in_fit = [], []
    for station in range(len(ordered)):
        others = np.setdiff1d(np.arange(len(ordered)), [station])
        refit = least_squares_fit(solution.problem.subset(others), solution.estimate,
                                  solution.posterior.noise).estimate
        at_station = measured.station == station
        squares.append(measured.residuals(solution.problem, refit)[at_station] ** 2)
        in_fit.append(measured.residuals(solution.problem, solution.estimate)[at_station] ** 2)
    left_out, used = (np.sqrt(np.concatenate(s).mean()) for s in (squares, in_fit))
    assert calibration.quality.holdout_rms == pytest.approx(left_out, rel=0.03)
    assert calibration.quality.residual_rms == pytest.approx(used, rel=1e-9)
    assert left_out > 1.01 * used


def test_observations_of_a_station_share_the_error_of_its_pose() -> None:
    """Move one pose: the residuals of its station agree on it, and weigh as one, not as many."""
    plate_cell = exact_cell('plate')
    solution = solved(plate_cell.problem)
    moved = plate_cell.problem.poses.copy()
    sigma = plate_cell.config.noise.robot_translation
    normal = solution.estimate.T_base_target[:3, 2]
    moved[3] = se3.perturb(moved[3], np.append(sigma * normal, np.zeros(3)))
    posterior = posterior_at(
        replace(solution.problem, poses=moved), solution.estimate, BLOCKS_AS_NOISE)
    at_station = posterior.problem.observations.station == 3
    assert (posterior.postfit_residuals[at_station] ** 2).sum() == pytest.approx(1, abs=0.15)
    assert np.allclose(posterior.postfit_residuals[~at_station], 0, atol=1e-3)


@pytest.mark.parametrize('target', ['plate', 'wedge'])
def test_a_station_that_may_be_wrong_adds_what_freeing_its_pose_changes(target: str) -> None:
    start = solved(cell(replace(SCENARIOS[target], stops=(10, 10)), 0).problem)
    solution = with_possibly_wrong_station(map_solution(start.problem, start.estimate))
    as_set = posterior_at(solution.problem, solution.estimate, NoiseModel())
    A, r, station = as_set.jacobian, as_set.prefit_residuals, as_set.problem.observations.station
    wrt_pose = as_set.whitening(as_set.linear.wrt_pose * POSE_ERROR)

    def solved_with(K: Array) -> tuple[Array, Array, float]:
        """Return X, its covariance and 2 log of the evidence, with more unknowns of columns K."""
        J = np.hstack([A, K])
        prior = np.append(as_set.prior_information, np.ones(K.shape[1]))
        N = J.T @ J + np.diag(prior)
        x = -np.linalg.solve(N, J.T @ r)
        remaining = r + J @ x
        return x[:6], np.linalg.inv(N)[:6, :6], -(
            remaining @ remaining + x @ (prior * x) + np.linalg.slogdet(N)[1])
    X, C, evidence = solved_with(np.zeros((len(r), 0)))
    odds, added = [], []
    for number in range(len(as_set.problem.poses)):
        X_freed, C_freed, evidence_freed = solved_with(
            np.where(station[:, None] == number, wrt_pose, 0.0))
        odds.append(PRIOR_ODDS_WRONG * np.exp((evidence_freed - evidence) / 2))
        added.append(np.outer(X_freed - X, X_freed - X) + C_freed - C)
    share = np.array(odds) / (1 + np.sum(odds))
    assert solution.probability_wrong == pytest.approx(share.sum(), rel=1e-4)
    expected, std = np.tensordot(share, added, 1), np.sqrt(np.diag(C))
    error = solution.added_covariances[ONE_WRONG] - expected
    assert np.abs(error / np.outer(std, std)).max() < 1e-6 * share.sum()


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_the_parts_add_up_to_what_is_reported(target: str) -> None:
    simulated_cell = cell(target, 0)
    config = settings_of(simulated_cell.scenario)
    solution = pipeline.answer_samples(simulated_cell.samples, (), config).require_solution()
    *terms, total = budget(solution)
    assert {'sensor, white', 'poses, white', 'robot_smooth', 'best-fit transform'} <= {
        term.name for term in terms}
    for size in ('translation', 'rotation', 'mapped'):
        squares = sum(getattr(term, size) ** 2 for term in terms)
        assert squares == pytest.approx(getattr(total, size) ** 2, rel=1e-6)
    std = np.sqrt(np.diag(solution.reported_covariance)[:3])
    assert total.translation == pytest.approx(np.sqrt((std ** 2).mean()))
    levers = np.array([[0.0, 0.1, 0.4], [0.05, 0.1, 0.2]])
    *terms, total = budget(solution, levers)
    of_points = float(se3.mapped_std(levers, solution.transform_covariance))
    assert total.mapped == pytest.approx(of_points), 'the points that are given'
    assert sum(term.mapped ** 2 for term in terms) == pytest.approx(of_points ** 2)


def test_a_covariance_that_covers_two_has_neither_less() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        first, second = (root @ root.T for root in rng.normal(size=(2, 6, 6)))
        least = cover(first, second)
        for covariance in (first, second):
            assert np.linalg.eigvalsh(least - covariance).min() > -1e-9 * least.max()
        assert np.allclose(cover(first, 0.5 * first), first)
        assert np.allclose(cover(first, 2 * first), 2 * first)


@pytest.mark.thorough
@pytest.mark.parametrize('name', ['joints and links 0.3 mm', 'line, smooth 0.2 mm'])
def test_the_region_that_is_stated_holds_what_serves_best(name: str) -> None:
    scenario, inside = FAULTS[name], []
    config = settings_of(scenario)
    for seed in range(20):
        samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
        calibration = pipeline.solve(samples, (), config, 'laser')
        inside.append(squared_error(calibration, truth) < ONE_IN_20)
    assert np.mean(inside) >= 0.9
