# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The solver: recovery, invariances, and what a problem is made of; the same for every method."""
from __future__ import annotations

from dataclasses import replace

from cells import (
    ANY_POSE,
    apart,
    calibration_of,
    cell,
    every_method,
    exact_solution,
    noisy,
    solution_of,
    solved,
    WHERE,
)
from handeye_ros import pipeline, se3
from handeye_ros.data import Sample
from handeye_ros.estimation import solve
from handeye_ros.estimation.solve import map_solution
from handeye_ros.sampling.sweep import problem_at_poses
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest


@every_method
@pytest.mark.parametrize('where', WHERE)
@pytest.mark.parametrize('seed', range(3))
def test_samples_without_noise_give_the_truth(name: str, where: str, seed: int) -> None:
    made, solution = exact_solution(name, where, seed)
    assert apart(solution.estimate.X, made.truth.T_flange_sensor) < 1e-9
    assert np.abs(solution.linear.residuals).max() < 1e-10


@every_method
def test_another_base_frame_changes_nothing(name: str) -> None:
    first = solution_of(name)
    samples = [replace(s, T_base_flange=ANY_POSE @ s.T_base_flange)
               for s in noisy(name).samples]
    second = solved(problem_at_poses(samples, noisy(name).config))
    assert apart(first.estimate.X, second.estimate.X) < 1e-9
    C, D = first.covariance[:6, :6], second.covariance[:6, :6]
    assert np.abs(C - D).max() < 1e-6 * np.abs(C).max()


@every_method
def test_a_turned_flange_frame_turns_transform_and_covariance(name: str) -> None:
    first = solution_of(name)
    turn = ANY_POSE.copy()
    turn[:3, 3] = 0
    samples = [replace(s, T_base_flange=s.T_base_flange @ turn) for s in noisy(name).samples]
    second = solved(problem_at_poses(samples, noisy(name).config))
    assert apart(se3.inverse(turn) @ first.estimate.X, second.estimate.X) < 1e-9
    Q = np.kron(np.eye(2), turn[:3, :3].T)
    C, D = first.covariance[:6, :6], second.covariance[:6, :6]
    assert np.abs(Q @ C @ Q.T - D).max() < 1e-6 * np.abs(C).max()


@every_method
def test_a_moved_flange_frame_moves_the_exact_transform(name: str) -> None:
    made, first = exact_solution(name, 'eye_in_hand')
    samples = [replace(s, T_base_flange=s.T_base_flange @ ANY_POSE) for s in made.samples]
    second = solved(problem_at_poses(samples, made.config))
    assert apart(se3.inverse(ANY_POSE) @ first.estimate.X, second.estimate.X) < 2e-9


@every_method
def test_shuffled_samples_give_the_same_calibration(name: str) -> None:
    made, first = noisy(name), calibration_of(name)
    rng = np.random.default_rng(6)
    for _ in range(2):  # it sorts them by their stamps, so which shuffle it is does not matter
        shuffled = [made.samples[k] for k in rng.permutation(len(made.samples))]
        second = pipeline.solve(shuffled, [], made.config, 'laser')
        assert apart(first.T_flange_sensor, second.T_flange_sensor) < 1e-9
        assert np.allclose(first.covariance, second.covariance, rtol=1e-6, atol=1e-18)
        assert first.samples == second.samples and first.target == second.target


@every_method
def test_samples_are_not_changed(name: str) -> None:
    samples = [frozen(s) for s in noisy(name).samples]
    pipeline.solve(samples, [], noisy(name).config, 'laser')


def frozen(sample: Sample) -> Sample:
    """Return a sample whose arrays raise when they are written to."""
    copy = replace(sample, T_base_flange=sample.T_base_flange.copy())
    copy.T_base_flange.setflags(write=False)
    for feature in copy.features:
        for value in vars(feature).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
    return copy


def test_some_of_many_stations_lead_to_the_answer_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    made = cell(replace(SCENARIOS['plate'], stations=(30, 30)), noise__robot_smooth=1e-4)
    start = solved(made.problem).estimate
    plain = map_solution(made.problem, start)
    monkeypatch.setattr(solve, 'MANY', 20)
    quick = map_solution(made.problem, start)
    off = se3.difference(quick.estimate.X, plain.estimate.X)
    std = np.sqrt(np.diag(plain.reported)[:6])
    assert 0 < np.abs(off / std).max() < 0.2
    np.testing.assert_allclose(np.sqrt(np.diag(quick.reported)[:6]), std, rtol=0.2)
