"""The solver against differences, invariances and real refits; the same for every method."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from cells import ANY_POSE, Cell, cell, exact_cell, problem, scenario_of, solved
from handeye_ros import pipeline, se3
from handeye_ros.checks.errors import TooUncertainError
from handeye_ros.config import with_values
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.blocks import groups
from handeye_ros.estimation.method import Estimate, Method
from handeye_ros.estimation.problem import linearise, Problem
from handeye_ros.estimation.solve import (
    evaluate,
    fitted,
    move,
    Solution,
    station_statistic,
    without,
)
from handeye_ros.estimation.weights import covariances, Noise
from handeye_ros.methods import METHODS
from handeye_ros.results.outcome import measured_points
import numpy as np
import pytest

every_method = pytest.mark.parametrize('name', METHODS)
WHERE = ('eye_in_hand', 'eye_on_base')


def scenario_for(name: str, where: str = 'eye_in_hand'):
    return replace(scenario_of(METHODS[name]), calibration_type=where)


@lru_cache
def noisy(name: str, where: str = 'eye_in_hand', seed: int = 0) -> Cell:
    return cell(scenario_for(name, where), seed, method=name)


@lru_cache
def solution_of(name: str, where: str = 'eye_in_hand', seed: int = 0) -> Solution:
    return solved(noisy(name, where, seed).problem)


@lru_cache
def exact_solution(name: str, where: str, seed: int = 0) -> tuple[Cell, Solution]:
    made = exact_cell(scenario_for(name, where), seed, method=name)
    return made, solved(made.problem)


def apart(a: Array, b: Array) -> float:
    """Return the largest difference between two transforms, m or rad."""
    return float(np.abs(se3.difference(a, b)).max())


# -- derivatives


def numerical(problem: Problem, at: Estimate, h: float = 1e-6) -> Array:
    """Return the Jacobian (m, 6 + k) by central differences, of all parameters."""
    k = len(problem.method.labels)

    def residuals(delta: Array) -> Array:
        moved = Estimate(se3.perturb(at.X, delta[:6]),
                         problem.method.retract(at.target, delta[6:]))
        return linearise(problem, moved).residuals
    steps = h * np.eye(6 + k)
    return np.column_stack([(residuals(d) - residuals(-d)) / (2 * h) for d in steps])


def somewhere(problem: Problem, solution: Solution, seed: int) -> tuple[Problem, Estimate]:
    """Return a problem and an estimate off the solution, where nothing vanishes by chance."""
    rng = np.random.default_rng(seed)
    at, method = solution.estimate, problem.method
    at = Estimate(se3.perturb(at.X, rng.normal(size=6) * 0.02),
                  method.retract(at.target, rng.normal(size=len(method.labels)) * 0.02))
    kinds = rng.integers(0, len(method.kinds), len(problem.observations))
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


@every_method
def test_a_step_and_its_opposite_lead_back(name: str) -> None:
    made, solution = noisy(name).problem, solution_of(name)
    step = np.random.default_rng(0).normal(size=len(made.columns)) * 1e-5
    back = move(made, move(made, solution.estimate, step), -step)
    assert np.allclose(back.X, solution.estimate.X, atol=1e-9)
    assert np.allclose(back.target, solution.estimate.target, atol=1e-9)


# -- recovery and invariance


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


@every_method
def test_the_order_of_the_stations_is_no_matter(name: str) -> None:
    made, first = noisy(name), solution_of(name)
    rng = np.random.default_rng(5)
    for _ in range(8):
        shuffled = [made.samples[k] for k in rng.permutation(len(made.samples))]
        second = solved(problem(shuffled, made.config))
        assert apart(first.estimate.X, second.estimate.X) < 1e-9
        assert np.abs(first.covariance - second.covariance)[:6, :6].max() < (
            1e-6 * np.abs(first.covariance).max())


@pytest.mark.thorough
@every_method
def test_fifty_shuffles_of_the_samples_give_the_same_calibration(name: str) -> None:
    made = noisy(name)
    rng = np.random.default_rng(6)
    first = pipeline.solve(made.samples, [], made.config, 'laser')
    for _ in range(50 if name == 'plate' else 4):
        shuffled = [made.samples[k] for k in rng.permutation(len(made.samples))]
        second = pipeline.solve(shuffled, [], made.config, 'laser')
        assert apart(first.T_flange_sensor, second.T_flange_sensor) < 1e-9
        assert np.allclose(first.covariance, second.covariance, rtol=1e-6, atol=1e-18)
        assert first.samples == second.samples and first.target == second.target


@every_method
def test_the_same_samples_give_the_same_answer_to_the_last_bit(name: str) -> None:
    made = noisy(name)
    one, two = (pipeline.solve(made.samples, [], made.config, 'laser') for _ in range(2))
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


# -- covariance and residuals


@every_method
def test_the_solution_is_the_minimum(name: str) -> None:
    solution = solution_of(name)
    gradient = solution.jacobian.T @ solution.white
    scale = np.sqrt(np.diag(solution.covariance))
    assert np.abs(gradient * scale).max() < 1e-4, 'in sigmas'


@every_method
def test_the_covariance_is_symmetric_and_positive(name: str) -> None:
    made = noisy(name)
    C = pipeline.solve(made.samples, [], made.config, 'laser').covariance
    assert C.shape == (6, 6) and np.allclose(C, C.T, rtol=1e-12)
    assert np.linalg.eigvalsh(C).min() > 0


@pytest.mark.parametrize('factors', [(1.0, 1.0, 1.0), (0.1, 1e4, 1e-4), (1e4, 0.1, 1e-4)])
def test_the_noise_of_a_station_is_positive_whatever_its_size(
        factors: tuple[float, float, float]) -> None:
    solution = solution_of('plate')
    doubtful = replace(solution.problem, config=with_values(
        solution.problem.config, {'noise.distortion': 2e-5}, 'a test'))
    for rows in groups(doubtful.observations.station):
        noise = np.tensordot(factors, covariances(doubtful, solution.linear, rows), 1)
        assert np.array_equal(noise, np.swapaxes(noise, 1, 2))
        assert np.linalg.eigvalsh(noise).min() > 0


def trials(name: str) -> int:
    """Return as many seeds as take a few seconds: spheres are slower."""
    return {'plate': 60, 'sphere': 20}.get(name, 30)


@pytest.mark.thorough
@every_method
def test_the_stated_covariance_is_that_of_the_errors(name: str) -> None:
    squares = []
    for seed in range(trials(name)):
        # the smooth error of a sensor's field is not simulated here
        made = cell(scenario_for(name), seed, noise__distortion=0.0, method=name)
        try:
            answer = pipeline.solve(made.samples, [], made.config, 'laser')
        except TooUncertainError:
            continue
        error = se3.difference(answer.T_flange_sensor, made.truth.T_flange_sensor)
        squares.append(error @ np.linalg.solve(answer.covariance, error) / 6)
    assert len(squares) > 0.9 * trials(name)
    sigma = np.sqrt(2 / 6 / len(squares))  # of the mean of chi-squared over 6
    assert abs(np.mean(squares) - 1) < 3.5 * sigma
    assert np.max(squares) < 6, 'no trial is far outside'


@pytest.mark.thorough
@every_method
def test_residuals_are_as_large_as_the_noise(name: str) -> None:
    factors = []
    for seed in range(6):
        made = cell(scenario_for(name), seed, noise__distortion=0.0, method=name)
        solution = solved(made.problem)
        factors.append((solution.variance_factor, solution.degrees_of_freedom))
    mean = np.average([f for f, _ in factors], weights=[d for _, d in factors])
    assert mean == pytest.approx(1, abs=4 * np.sqrt(2 / sum(d for _, d in factors)))


@every_method
def test_residuals_without_a_station_are_those_of_a_real_refit(name: str) -> None:
    solution = solution_of(name)
    n = len(solution.problem.poses)
    std = np.sqrt(np.diag(solution.covariance)[:6])
    for station in range(0, n, 3):
        refit = refit_without(solution, station)
        first_order = without(solution, np.array([station]))
        effect = se3.difference(refit.X, solution.estimate.X) / std
        off = se3.difference(first_order.X, refit.X) / std
        assert np.linalg.norm(off) < 0.03 + 0.1 * np.linalg.norm(effect)
        assert np.linalg.norm(effect) > 1e-3, 'a station that is left out does something'


def refit_without(solution: Solution, station: int) -> Estimate:
    others = np.setdiff1d(np.arange(len(solution.problem.poses)), [station])
    return fitted(solution.problem.subset(others), solution.estimate, Noise())


@every_method
def test_the_deleted_residual_of_a_station_is_that_against_a_real_refit(name: str) -> None:
    solution = solution_of(name)
    obs = solution.problem.observations
    statistic, count = station_statistic(solution)
    for station in range(0, len(solution.problem.poses), 4):
        alone = solution.problem.subset(np.array([station]))
        others = evaluate(solution.problem.subset(np.setdiff1d(
            np.arange(len(solution.problem.poses)), [station])),
            refit_without(solution, station), Noise())
        there = evaluate(alone, others.estimate, Noise())
        S = np.eye(len(there.white)) + there.jacobian @ others.covariance @ there.jacobian.T
        expected = there.white @ np.linalg.solve(S, there.white)
        assert statistic[station] == pytest.approx(expected, rel=0.1, abs=0.05)
        assert count[station] == (obs.station == station).sum()


@every_method
def test_the_left_out_rms_is_that_of_real_refits(name: str) -> None:
    made = noisy(name)
    ordered = sorted(made.samples, key=lambda s: s.stamp)
    answer = pipeline.solve(made.samples, [], made.config, 'laser')
    agreed, solution = pipeline.estimate(ordered, [], made.config)
    assert len(agreed.used) == len(ordered) <= 20, 'each station is a fold of its own'
    measured = measured_points(ordered, solution.problem)
    squares, own = [], []
    for station in range(len(ordered)):
        others = np.setdiff1d(np.arange(len(ordered)), [station])
        refit = fitted(solution.problem.subset(others), solution.estimate, solution.noise)
        mine = measured.select(measured.station == station)
        squares.append(mine.residuals(solution.problem, refit) ** 2)
        own.append(mine.residuals(solution.problem, solution.estimate) ** 2)
    left_out, used = (np.sqrt(np.concatenate(s).mean()) for s in (squares, own))
    assert answer.quality.holdout_rms == pytest.approx(left_out, rel=0.03)
    assert answer.quality.residual_rms == pytest.approx(used, rel=1e-9)
    assert left_out > 1.01 * used


@every_method
def test_more_noise_is_more_uncertainty(name: str) -> None:
    solution = solution_of(name)
    made = solution.problem
    wider = evaluate(made, solution.estimate, Noise(4.0, 4.0, 4.0))
    same = evaluate(made, solution.estimate, Noise())
    assert np.allclose(wider.covariance, 4 * same.covariance, rtol=1e-6)


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


def test_observations_of_a_station_share_the_error_of_its_pose() -> None:
    """Move one pose: the residuals of its station agree on it, and weigh as one, not as many."""
    made = exact_cell('plate')
    solution = solved(made.problem)
    moved = made.problem.poses.copy()
    sigma = made.config.noise.robot_translation
    normal = solution.estimate.target[:16].reshape(4, 4)[:3, 2]
    moved[3] = se3.perturb(moved[3], np.append(sigma * normal, np.zeros(3)))
    there = evaluate(replace(solution.problem, poses=moved), solution.estimate, Noise())
    mine = there.problem.observations.station == 3
    assert (there.white[mine] ** 2).sum() == pytest.approx(1, abs=0.15)
    assert np.allclose(there.white[~mine], 0, atol=1e-3)


def test_every_method_says_what_it_is() -> None:
    for name, method in METHODS.items():
        assert isinstance(method, Method) and method.name == name
        assert method.minimum >= 3 and set(method.edges) <= set(method.kinds)
        estimate = solution_of(name).estimate
        moved = method.retract(estimate.target, np.zeros(len(method.labels)))
        assert np.allclose(moved, estimate.target)
        assert method.free(noisy(name).config).shape == (len(method.labels),)
