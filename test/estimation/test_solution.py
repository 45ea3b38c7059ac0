# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The solver: recovery, invariances, and what a problem is made of; the same for every method."""
from __future__ import annotations

from dataclasses import replace

from cells import (
    ANY_POSE,
    apart,
    calibration_of,
    every_method,
    exact_solution,
    noisy,
    problem,
    solution_of,
    solved,
    WHERE,
)
from handeye_ros import pipeline, se3
from handeye_ros.data import Sample
from handeye_ros.estimation.least_squares import groups
from handeye_ros.estimation.problem import Target
from handeye_ros.targets import METHODS
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
    second = solved(problem(samples, noisy(name).config))
    assert apart(first.estimate.X, second.estimate.X) < 1e-9
    C, D = first.covariance[:6, :6], second.covariance[:6, :6]
    assert np.abs(C - D).max() < 1e-6 * np.abs(C).max()


@every_method
def test_a_turned_flange_frame_turns_transform_and_covariance(name: str) -> None:
    first = solution_of(name)
    turn = ANY_POSE.copy()
    turn[:3, 3] = 0
    samples = [replace(s, T_base_flange=s.T_base_flange @ turn) for s in noisy(name).samples]
    second = solved(problem(samples, noisy(name).config))
    assert apart(se3.inverse(turn) @ first.estimate.X, second.estimate.X) < 1e-9
    Q = np.kron(np.eye(2), turn[:3, :3].T)
    C, D = first.covariance[:6, :6], second.covariance[:6, :6]
    assert np.abs(Q @ C @ Q.T - D).max() < 1e-6 * np.abs(C).max()


@every_method
def test_a_moved_flange_frame_moves_the_exact_transform(name: str) -> None:
    made, first = exact_solution(name, 'eye_in_hand')
    samples = [replace(s, T_base_flange=s.T_base_flange @ ANY_POSE) for s in made.samples]
    second = solved(problem(samples, made.config))
    assert apart(se3.inverse(ANY_POSE) @ first.estimate.X, second.estimate.X) < 2e-9


@pytest.mark.thorough
@every_method
def test_the_order_of_the_stations_is_no_matter(name: str) -> None:
    made, first = noisy(name), solution_of(name)
    rng = np.random.default_rng(5)
    for _ in range(4):
        shuffled = [made.samples[k] for k in rng.permutation(len(made.samples))]
        second = solved(problem(shuffled, made.config))
        assert apart(first.estimate.X, second.estimate.X) < 1e-9
        assert np.abs(first.covariance - second.covariance)[:6, :6].max() < (
            1e-6 * np.abs(first.covariance).max())


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
def test_the_same_samples_give_the_same_answer_to_the_last_bit(name: str) -> None:
    made, one = noisy(name), calibration_of(name)
    two = pipeline.solve(made.samples, [], made.config, 'laser')
    assert np.array_equal(one.T_flange_sensor, two.T_flange_sensor)
    assert np.array_equal(one.covariance, two.covariance) and one.quality == two.quality


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


def test_groups_hold_every_row_once() -> None:
    station = np.array([0, 0, 0, 1, 3, 3, 3, 4, 6, 6])
    rows = [row.tolist() for group in groups(station) for row in group]
    assert sorted(sum(rows, [])) == list(range(10))
    assert all(len({int(station[k]) for k in row}) == 1 for row in rows)


def test_a_subset_keeps_what_belongs_to_its_stations() -> None:
    made = noisy('plate').problem
    part = made.subset(np.array([2, 5, 11]))
    assert np.array_equal(part.poses, made.poses[[2, 5, 11]])
    assert np.array_equal(np.unique(part.observations.station), [0, 1, 2])
    keep = made.observations.station == 5
    assert np.array_equal(part.observations.points[part.observations.station == 1],
                          made.observations.points[keep])


def test_every_method_says_what_it_is() -> None:
    for name, method in METHODS.items():
        assert isinstance(method, Target) and method.name == name
        assert method.minimum >= 3 and set(method.essential) <= set(method.kinds)
        estimate = solution_of(name).estimate
        moved = method.retract(estimate.target, np.zeros(len(method.labels)))
        assert np.allclose(moved, estimate.target)
        assert method.free(noisy(name).config).shape == (len(method.labels),)
