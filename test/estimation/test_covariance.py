# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Covariance and residuals against trials and real refits; the same for every method."""
from __future__ import annotations

from dataclasses import replace

from cells import (
    calibration_of,
    cell,
    every_method,
    exact_cell,
    noisy,
    scenario_for,
    solution_of,
    solved,
)
from handeye_ros import pipeline, se3
from handeye_ros.calibration import measured_points
from handeye_ros.config import with_values
from handeye_ros.errors import DataError
from handeye_ros.estimation.noise import covariances
from handeye_ros.estimation.problem import Estimate
from handeye_ros.estimation.search import fit
from handeye_ros.estimation.solve import evaluated, Solution
import numpy as np
import pytest


@every_method
def test_the_solution_is_the_minimum(name: str) -> None:
    solution = solution_of(name)
    gradient = solution.columns.T @ solution.whitened
    scale = np.sqrt(np.diag(solution.covariance))
    assert np.abs(gradient * scale).max() < 1e-4, 'in sigmas'


@pytest.mark.parametrize('factors', [
    (1.0, 1.0, 1.0, 1.0), (0.1, 1e4, 1e-4, 1e-4), (1e4, 0.1, 1.0, 1e-4), (1e-4, 1e-4, 1e4, 1e-4)])
def test_the_noise_of_a_station_is_positive_whatever_its_size(
        factors: tuple[float, float, float, float]) -> None:
    solution = solution_of('plate')
    problem = replace(solution.problem, config=with_values(
        solution.problem.config, {'noise.distortion': 2e-5}, 'a test'))
    linear = replace(solution.linear, problem=problem)
    for stations in problem.groups:
        noise = np.tensordot(factors, covariances(linear, stations), 1)
        assert np.array_equal(noise, np.swapaxes(noise, 1, 2))
        assert np.linalg.eigvalsh(noise).min() > 0


def trials(name: str) -> int:
    """Return as many seeds as take a few seconds: spheres are slower."""
    return {'plate': 60, 'sphere': 20}.get(name, 30)


@pytest.mark.thorough
@every_method
def test_the_stated_covariance_is_that_of_the_errors_and_good_samples_are_kept(name: str
                                                                               ) -> None:
    squares, lost = [], []
    for seed in range(trials(name)):
        # the smooth error of a sensor's field is not simulated here
        made = cell(scenario_for(name), seed, noise__distortion=0.0, method=name)
        try:
            answer = pipeline.solve(made.samples, [], made.config, 'laser')
        except DataError as error:
            assert error.reason == 'uncertain'
            continue
        lost.append(answer.quality.samples_rejected)
        error = se3.difference(answer.T_flange_sensor, made.truth.T_flange_sensor)
        squares.append(error @ np.linalg.solve(answer.covariance, error) / 6)
    assert len(squares) > 0.9 * trials(name)
    sigma = np.sqrt(2 / 6 / len(squares))  # of the mean of chi-squared over 6
    assert abs(np.mean(squares) - 1) < 3.5 * sigma
    assert np.max(squares) < 6, 'no trial is far outside'
    assert sum(lost[:8]) <= 1, 'one station in a thousand recordings'


def refit_without(solution: Solution, station: int) -> Estimate:
    others = np.setdiff1d(np.arange(len(solution.problem.poses)), [station])
    return fit(solution.problem.subset(others), solution.estimate)


@every_method
def test_the_deleted_residual_of_a_station_is_that_against_a_real_refit(name: str) -> None:
    solution = solution_of(name)
    obs = solution.problem.observations
    mean_square, _ = solution.left_out()
    for station in range(0, len(solution.problem.poses), 4):
        alone = solution.problem.subset(np.array([station]))
        others = evaluated(solution.problem.subset(np.setdiff1d(
            np.arange(len(solution.problem.poses)), [station])),
            refit_without(solution, station))
        there = evaluated(alone, others.estimate)
        S = np.eye(len(there.whitened)) + there.columns @ others.covariance @ there.columns.T
        expected = there.whitened @ np.linalg.solve(S, there.whitened)
        count = (obs.station == station).sum()
        assert mean_square[station] * count == pytest.approx(expected, rel=0.1, abs=0.05)


@every_method
def test_the_left_out_rms_is_that_of_real_refits(name: str) -> None:
    made = noisy(name)
    ordered = sorted(made.samples, key=lambda s: s.stamp)
    answer = calibration_of(name)
    solution = pipeline.answer(ordered, (), made.config).consensus()
    assert len(solution.used) == len(ordered) <= 20, 'each station is a fold of its own'
    measured = measured_points(ordered, solution.problem)
    squares, own = [], []
    for station in range(len(ordered)):
        others = np.setdiff1d(np.arange(len(ordered)), [station])
        refit = fit(solution.problem.subset(others), solution.estimate, solution.noise)
        mine = measured.select(measured.station == station)
        squares.append(mine.residuals(solution.problem, refit) ** 2)
        own.append(mine.residuals(solution.problem, solution.estimate) ** 2)
    left_out, used = (np.sqrt(np.concatenate(s).mean()) for s in (squares, own))
    assert answer.quality.holdout_rms == pytest.approx(left_out, rel=0.03)
    assert answer.quality.residual_rms == pytest.approx(used, rel=1e-9)
    assert left_out > 1.01 * used


def test_observations_of_a_station_share_the_error_of_its_pose() -> None:
    """Move one pose: the residuals of its station agree on it, and weigh as one, not as many."""
    made = exact_cell('plate')
    solution = solved(made.problem)
    moved = made.problem.poses.copy()
    sigma = made.config.noise.robot_translation
    normal = solution.estimate.state[:16].reshape(4, 4)[:3, 2]
    moved[3] = se3.perturb(moved[3], np.append(sigma * normal, np.zeros(3)))
    there = evaluated(replace(solution.problem, poses=moved), solution.estimate)
    mine = there.problem.observations.station == 3
    assert (there.whitened[mine] ** 2).sum() == pytest.approx(1, abs=0.15)
    assert np.allclose(there.whitened[~mine], 0, atol=1e-3)
