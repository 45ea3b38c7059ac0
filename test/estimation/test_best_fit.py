# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where no transform is right, what is stated holds the one that serves best."""
from __future__ import annotations

from cells import cell
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.estimation.basis import box, field_motions, motions_by_poses
from handeye_ros.estimation.solve import covering
from handeye_ros.simulate import FAULTS, settings, simulate_samples
import numpy as np
import pytest
from scipy.stats import chi2

FIELD = np.array([[x, z] for x in (-0.02, 0.0, 0.02) for z in (0.15, 0.2)])


def inverted(T: Array, error: Array, eye_on_base: bool) -> Array:
    """Return poses (n, 4, 4) of a problem with an error (n, 6) added to the robot's."""
    robot = se3.inverse(T) if eye_on_base else T
    wrong = se3.transform(se3.exp_rotation(error[:, 3:]) @ robot[:, :3, :3],
                          robot[:, :3, 3] + error[:, :3])
    return se3.inverse(wrong) if eye_on_base else wrong


@pytest.mark.parametrize('scenario', ['plate', 'eye_on_base'])
def test_a_robot_that_errs_moves_what_serves_best_as_least_squares_does(scenario: str) -> None:
    made = cell(scenario, 3)
    problem, X, rng = made.problem, made.truth.T_flange_sensor, np.random.default_rng(1)
    on_base = problem.config.calibration_type != 'eye_in_hand'
    error = rng.normal(size=(len(problem.poses), 6)) * 1e-6
    off = inverted(problem.poses, error, on_base)
    points = np.column_stack([FIELD[:, 0], np.zeros(len(FIELD)), FIELD[:, 1]])

    def mapped(T: Array, mount: Array) -> Array:
        return np.asarray(se3.apply(T @ mount, points))

    goal, here = mapped(off, X), mapped(problem.poses, X)
    columns = [(mapped(problem.poses, se3.perturb(X, step)) - here).ravel() / 1e-7
               for step in np.eye(6) * 1e-7]
    columns += [(here - se3.apply(se3.perturb(np.eye(4), step), here)).ravel() / 1e-7
                for step in np.eye(6) * 1e-7]
    best = np.linalg.lstsq(np.array(columns).T, (goal - here).ravel(), rcond=1e-9)[0][:6]
    moved = np.einsum('xna,na->x', motions_by_poses(
        problem.poses, X, FIELD, problem.in_hand), error)
    assert np.allclose(moved, best, atol=1e-3 * np.abs(best).max())


def test_no_motion_serves_points_better_that_are_all_of_a_field() -> None:
    across = np.linspace(-1, 1, 15)
    points = box(np.array([[-0.02, 0.15], [0.02, 0.2]]), across)
    first, second = field_motions(points, [1, 3])
    assert np.abs(first).max() < 1e-9 and np.abs(second).max() > 0.1


def test_a_covariance_that_covers_two_has_neither_less() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        first, second = (root @ root.T for root in rng.normal(size=(2, 6, 6)))
        least = covering(first, second)
        for given in (first, second):
            assert np.linalg.eigvalsh(least - given).min() > -1e-9 * least.max()
        assert np.allclose(covering(first, 0.5 * first), first)
        assert np.allclose(covering(first, 2 * first), 2 * first)


@pytest.mark.thorough
@pytest.mark.parametrize('name', ['joints and links 0.3 mm', 'line, smooth 0.2 mm'])
def test_the_region_that_is_stated_holds_what_serves_best(name: str) -> None:
    scenario, inside = FAULTS[name], []
    config = with_values(Config(), settings(scenario), name)
    for seed in range(20):
        samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
        found = pipeline.solve(samples, (), config, 'laser')
        error = se3.difference(found.T_flange_sensor, truth.T_flange_sensor)
        inside.append(error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.95, 6))
    assert np.mean(inside) >= 0.9
