# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Doubts are unknowns with priors: what the data show is found, what they do not is stated."""
from __future__ import annotations

from dataclasses import replace
import math
import re

from cells import (
    Cell,
    cell,
    map_solution,
    NO_DOUBTS,
    ONE_IN_20,
    ONE_IN_1000,
    settings_of,
    simulated,
    solved,
    squared_error,
)
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, flatten
from handeye_ros.data import Array, EdgePoint
from handeye_ros.estimation.basis import bent_line, distortion_fields
from handeye_ros.estimation.blocks import line_bend, points_on_target, sensor_scale
from handeye_ros.estimation.noise import EDGE_INDEX, FACE_INDEX, POSE_INDEX
from handeye_ros.estimation.problem import linearise, PoseModel
from handeye_ros.simulate import FAULTS, SCENARIOS, sensor, simulate_samples
from handeye_ros.simulate.scenario import SensorModel
import numpy as np
import pytest
from quick import long_run

MANY = replace(SCENARIOS['plate'], stops=(24, 24))
ALL_BLOCKS = {key: flatten(Config())[key.replace('__', '.')] for key in NO_DOUBTS}


def squared(cell: Cell) -> float:
    """Return the squared Mahalanobis error of a cell's answer."""
    return squared_error(cell.solve(), cell.truth)


# -- noise


@pytest.mark.thorough
@pytest.mark.parametrize('factor', [1 / 3, 3.0])
def test_the_covariance_is_true_though_the_noise_was_stated_wrongly(factor: float) -> None:
    noise = settings_of(MANY).noise
    stated = {'noise__robot_translation': factor * noise.robot_translation,
              'noise__robot_rotation': factor * noise.robot_rotation}
    squares = [squared(cell(MANY, seed, **stated)) / 6 for seed in range(8)]
    assert 0.4 < np.mean(squares) < 1.7


@pytest.mark.thorough
def test_noise_that_was_stated_rightly_is_kept() -> None:
    agreed = [solved(cell('plate', seed).problem) for seed in range(10)]
    factors = [map_solution(each.problem, each.estimate).posterior.noise.variance_factors[
        [FACE_INDEX, EDGE_INDEX, POSE_INDEX]] for each in agreed]
    sensor, edge, robot = np.abs(np.log(factors)).max(axis=0)
    assert max(sensor, robot) < math.log(2.5)
    # the own noise of 18 edge points is a fifth of their residuals' variance: they say little
    assert edge < math.log(5)
    assert np.abs(np.log(np.median(factors, axis=0))).max() < 0.2


@pytest.mark.thorough
def test_a_nuisance_parameter_without_error_costs_the_estimate_little() -> None:
    squares = np.zeros((2, 2))
    for seed in range(12):
        sure = cell('plate', seed)
        for i, variant in enumerate((sure, replace(sure, config=settings_of(sure.scenario)))):
            error = se3.difference(variant.solve().T_flange_sensor, variant.truth.T_flange_sensor)
            squares[i] += [error[:3] @ error[:3], error[3:] @ error[3:]]
    assert (np.sqrt(squares[1] / squares[0]) < 1.35).all()


# -- robots


@pytest.mark.thorough
@pytest.mark.parametrize('systematic', [(0.0, 0.0), (1.5e-4, math.radians(0.02))])
def test_the_stated_uncertainty_holds_for_every_robot(systematic: tuple[float, float]) -> None:
    plate = SCENARIOS['plate']
    scenario = replace(plate, robot=replace(plate.robot, systematic=systematic))
    squares = [squared(cell(scenario, seed, **ALL_BLOCKS)) for seed in range(12)]
    assert np.mean(np.array(squares) < ONE_IN_20) >= 0.9
    assert 0.1 < np.mean(squares) / 6 < 1.5


# -- sensor, target, scale


def test_a_distortion_is_no_motion_of_the_plane() -> None:
    points = np.random.default_rng(0).uniform([-0.02, 0.15], [0.02, 0.2], (300, 2))
    (fields,) = distortion_fields(points, [2])
    x, z = (points - points.mean(axis=0)).T
    for motion in (np.stack([x * 0 + 1, x * 0], 1), np.stack([x * 0, x * 0 + 1], 1),
                   np.stack([z, -x], 1)):
        assert np.abs(np.einsum('mi,mik->k', motion, fields)).max() < 1e-9
    assert np.sqrt((fields ** 2).sum(axis=2).mean(axis=0)) == pytest.approx([1, 1], rel=0.1)


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_a_scale_of_the_sensor_changes_residuals_as_stretched_points_do(target: str) -> None:
    solution = solved(cell(target, 1, noise__robot_scale=7e-4).problem)
    linear, h = linearise(solution.problem, solution.estimate), 1e-4
    observations, middle = solution.problem.observations, points_on_target(linear).mean(axis=0)
    longer, shorter = (linearise(replace(solution.problem, observations=replace(
        observations, points=middle + (1 + scale) * (observations.points - middle))),
        solution.estimate).residuals for scale in (h, -h))
    [block] = sensor_scale(linear)
    assert block.std == 0.3 * solution.problem.config.noise.robot_scale
    assert block.columns[:, 0] / block.std == pytest.approx((longer - shorter) / (2 * h),
                                                            rel=1e-2, abs=1e-3)


@pytest.mark.thorough
def test_lengths_do_not_shrink_however_many_stations_there_are() -> None:
    scenario = replace(SCENARIOS['sphere'], stops=(1000, 1000))
    samples, truth = simulate_samples(scenario, np.random.default_rng(0))
    config = settings_of(scenario)
    solution = pipeline.answer_samples(samples, (), config).require_solution()
    report = solution.report_posterior
    _, following = report.estimated_tau_squares()
    assert following == pytest.approx(report.tau_squares, rel=0.1), 'they have converged'
    error = se3.difference(solution.estimate.X, truth.T_flange_sensor)
    assert np.abs(error).max() < 1e-4
    lengths = [b.std * solution.posterior.prior_tau(b) for b in solution.posterior.blocks
               if b.name in ('robot_scale', 'radius')]
    assert lengths and max(lengths) < 1e-4, 'nothing is wrong with them'


@pytest.mark.parametrize('off', [-1.5, 0.0, 1.5])
def test_edges_whose_shape_was_misjudged_move_the_answer_little(off: float) -> None:
    plate_cell = cell(MANY, 3)
    rng, doubt = np.random.default_rng(5), 2e-4

    def misplaced(feature: object) -> object:
        if not isinstance(feature, EdgePoint):
            return feature
        share = rng.uniform(0.2, 0.8)  # how much of a rounding is seen differs
        return replace(feature, shape_std=share * doubt,
                       point=feature.point + off * share * doubt * feature.direction)
    moved = replace(plate_cell, samples=[replace(s, features=tuple(map(misplaced, s.features)))
                                         for s in plate_cell.samples])
    assert squared(moved) < squared(plate_cell) + 2


TRUE = np.array([3e-4, -2e-4])  # by so much (rad), times what differs from pose to pose, it turns


def reported(true_poses: Array) -> PoseModel:
    """Return a robot that turns about its base by joints; it has the true poses at TRUE."""
    angles = 3.0 * np.arange(len(true_poses))
    about = [np.outer(np.cos(angles), [1, 0, 0]), np.outer(np.sin(angles), [0, 0, 1])]

    def evaluate(values: Array) -> tuple[Array, Array]:
        x, z = TRUE - values
        R = se3.exp_rotation(about[0] * x + about[1] * z)
        poses = se3.transform(R @ true_poses[:, :3, :3], (R @ true_poses[:, :3, 3, None])[..., 0])
        return poses, -np.stack([np.concatenate([np.cross(turn, poses[:, :3, 3]), turn], axis=1)
                                 for turn in about], axis=2)
    return PoseModel(evaluate, ('first', 'second'), (1e-3, 1e-3), np.arange(len(true_poses)))


@pytest.mark.parametrize('scenario', ['plate', 'eye_on_base', 'sphere'])
def test_what_poses_depend_on_is_found_and_the_poses_are_moved(scenario: str) -> None:
    simulated_cell = cell(scenario, 1)
    solution = solved(simulated_cell.problem)
    true, start = solution.problem, solution.estimate  # each edge point of its edge
    model = reported(true.robot_poses)
    problem = replace(true, pose_model=model).with_pose_parameters(np.zeros(2))
    solution = map_solution(problem, start)
    errors = solution.problem.pose_parameters - TRUE
    assert [b.name for b in solution.posterior.blocks[-2:]] == ['first', 'second']
    std = 1e-3 * np.sqrt(np.diag(solution.posterior.covariance)[-2:])
    assert (np.abs(errors) < 4 * std).all() and std.max() < 2e-4
    moved_poses, _ = model.at(solution.problem.pose_parameters)
    assert np.allclose(solution.problem.robot_poses, moved_poses)
    assert np.allclose(solution.posterior.corrected_poses(), solution.problem.poses)
    X, X_known = solution.estimate.X, map_solution(true, start).estimate.X
    assert simulated_cell.error(X) < simulated_cell.error(X_known) + 1e-5
    half_problem = problem.with_pose_parameters(TRUE).subset(np.arange(0, len(true.poses), 2))
    assert np.allclose(half_problem.poses, true.poses[::2])
    assert np.allclose(half_problem.with_pose_parameters(np.zeros(2)).poses, problem.poses[::2])


MM = 1e-3


@pytest.mark.parametrize('bend', [0.0, 0.15 * MM, 0.6 * MM])
@pytest.mark.parametrize('target', ['plate', *long_run('wedge')])
def test_a_bent_laser_line_is_told_and_the_truth_lies_inside(target: str, bend: float) -> None:
    scenario = FAULTS[f'{target}, line bent by 0.15 mm']
    scenario = replace(scenario, sensor=replace(scenario.sensor, line_bend=bend))
    recording = simulated(scenario, 3)
    calibration = recording.calibrate()
    assert squared_error(calibration, recording.truth) < ONE_IN_1000
    match = re.search(r'the laser line is bent .* by ([\d.]+) \+- ([\d.]+) mm',
                      calibration.target.get('note', ''))
    assert bool(match) == (bend > 0)
    if match:
        assert float(match[1]) == pytest.approx(bend / MM, abs=3 * float(match[2]))


def test_of_a_line_bent_like_an_s_the_truth_lies_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    straight = sensor.rays

    def bent(model: SensorModel) -> tuple[Array, Array]:
        origins, directions = straight(model)
        directions[1] += 0.6 * MM * np.linspace(-1, 1, model.columns) ** 3 / np.mean(model.range)
        return origins, directions
    monkeypatch.setattr(sensor, 'rays', bent)
    recording = simulated(SCENARIOS['wedge'], 1)
    assert squared_error(recording.calibrate(), recording.truth) < ONE_IN_1000


@pytest.mark.parametrize('origin', [0.0, 0.1])
def test_the_plane_along_the_middle_of_a_bent_line_touches_it(origin: float) -> None:
    plate_cell = cell('plate')
    problem, estimate = plate_cell.problem, solved(plate_cell.problem).estimate
    points = problem.observations.points + [origin, 0.0]  # x of some drivers is on one side of 0
    X = estimate.X @ se3.transform(np.eye(3), np.array([-origin, 0.0, 0.0]))
    linear = linearise(
        replace(problem, observations=replace(problem.observations, points=points)),
        replace(estimate, X=X))
    block, = line_bend(linear)
    assert block.best_fit is not None
    middle = (points[:, 0].min() + points[:, 0].max()) / 2 if origin else 0.0
    near = np.array([[middle, 0.17], [middle + 1e-5, 0.17]])
    levers = se3.apply(X, np.insert(near, 1, 0.0, axis=1)) - X[:3, 3]
    moved = X[:3, 1] @ se3.perturbation_jacobian(levers) @ block.best_fit(linear)
    np.testing.assert_allclose(moved[:, [0, 2]], bent_line(np.vstack([points, near]))[-2:, [0, 2]],
                               atol=1e-6)
