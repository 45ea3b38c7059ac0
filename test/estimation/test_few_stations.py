# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Few samples: no answer where they cannot judge it, or where another one fits as well."""
from __future__ import annotations

from dataclasses import replace

from cells import cell
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.search import robust_solution, with_blocks
from handeye_ros.estimation.solve import evaluated
from handeye_ros.results.truth_file import errors_against
from handeye_ros.simulate import FAULTS, SCENARIOS, settings, simulate, simulate_samples
import numpy as np
import pytest

RANKS = {'plate': 3, 'line': 2, 'plane': 2, 'sphere': 3, 'wedge': 4}  # of one station


def test_fewer_conditions_than_unknowns_leave_a_direction_free() -> None:
    made = cell('plane', 0)
    whole = robust_solution(made.problem, np.random.default_rng(0))
    few = made.problem.subset(np.arange(4))
    covariance = evaluated(few, whole.estimate).covariance
    assert np.linalg.eigvalsh(covariance)[-1] > 1.0, 'm^2: 8 conditions, 9 unknowns'


@pytest.mark.parametrize(('name', 'rank'), RANKS.items())
def test_a_station_says_as_much_as_its_target_shows(name: str, rank: int) -> None:
    made = cell(name, 0)
    solution = robust_solution(made.problem, np.random.default_rng(0))
    assert (solution.ranks == rank).all()
    assert solution.redundancy == rank * len(made.samples) - solution.columns.shape[1]


def wrong(sample: Sample, rng: np.random.Generator) -> Sample:
    step = np.concatenate([rng.normal(size=3) * 3e-3, rng.normal(size=3) * 0.01])
    return replace(sample, T_base_flange=se3.perturb(sample.T_base_flange, step))


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'stations', 'bad'), [
    ('plane', (6, 0), 1), ('plane', (8, 0), 2), ('plate', (3, 3), 1), ('plate', (4, 3), 2),
    ('line', (7, 0), 1), ('sphere', (6, 0), 2)])
def test_few_samples_with_wrong_ones_give_no_wrong_answer(name: str, stations: tuple[int, int],
                                                          bad: int) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        made = cell(replace(SCENARIOS[name], stations=stations), seed)
        chosen = rng.permutation(len(made.samples))[:bad]
        samples = [wrong(s, rng) if i in chosen else s for i, s in enumerate(made.samples)]
        try:
            answer = pipeline.solve(samples, [], made.config, 'laser')
        except DataError:
            continue
        error = se3.difference(answer.T_flange_sensor, made.truth.T_flange_sensor)
        assert error @ np.linalg.solve(answer.covariance, error) / 6 < 6


def test_what_is_left_after_dropping_must_judge() -> None:
    made = cell(replace(SCENARIOS['plane'], stations=(7, 0)), 0)
    samples = [wrong(s, np.random.default_rng(1)) if i == 3 else s
               for i, s in enumerate(made.samples)]
    with pytest.raises(DataError, match='take more'):
        pipeline.solve(samples, [], made.config, 'laser')


@pytest.mark.parametrize('seed', range(3))
def test_one_wrong_of_ten_stands_out_though_a_poor_robot_would_explain_it(seed: int) -> None:
    made = cell(replace(SCENARIOS['plate'], stations=(5, 5)), seed)
    rng = np.random.default_rng(seed)
    samples = [wrong(s, rng) if i == seed else s for i, s in enumerate(made.samples)]
    answer = pipeline.solve(samples, [], made.config, 'laser')
    assert [report.used for report in answer.samples] == [i != seed for i in range(10)]
    assert errors_against(answer.T_flange_sensor, made.truth.T_flange_sensor).mapped_points < 2e-4


def test_no_station_of_a_poor_robot_is_taken_for_wrong() -> None:
    poor = replace(SCENARIOS['plate'].robot, systematic=(3e-4, 1e-3))
    made = cell(replace(SCENARIOS['plate'], stations=(5, 5), robot=poor), 0,
                noise__robot_smooth=1.5e-4)
    answer = pipeline.solve(made.samples, [], made.config, 'laser')
    assert answer.quality.samples_rejected == 0


def test_what_a_wrong_station_would_do_is_stated_of_few_and_next_to_nothing_of_many() -> None:
    grown = []
    for stations in ((3, 3), (9, 9)):
        made = cell(replace(SCENARIOS['plate'], stations=stations), 0)
        solution = with_blocks(robust_solution(made.problem, np.random.default_rng(0)))
        without = replace(solution, added_covariances={})
        grown.append(np.diag(solution.reported)[:6] / np.diag(without.reported)[:6])
    few, many = grown
    assert few.max() > 1.01 > many.max()


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'seed'), [
    ('6 poses x 4', 17),  # a rival that has no use for two of the six edges
    ('6 poses x 4, smooth 0.15 mm', 4),  # hard to start
    ('6 poses x 4, joints 0.1 mm', 7)])  # started wrong, positions in mm seemed to explain it
def test_six_poses_visited_four_times_carry_an_answer(name: str, seed: int) -> None:
    scenario = FAULTS[name]
    recording = simulate(scenario, np.random.default_rng(seed))
    config = with_values(Config(), settings(scenario), 'test')
    answer = pipeline.calibrate(recording.profiles, recording.poses, config)
    assert answer.quality.samples_used == 6, 'a pose that is taken again says nothing new'
    error = se3.difference(answer.T_flange_sensor, recording.truth.T_flange_sensor)
    assert error @ np.linalg.solve(answer.covariance, error) < 20


@pytest.mark.thorough
def test_six_stations_of_which_one_is_wrong_are_refused_and_why() -> None:
    scenario = FAULTS['3 + 3, one bad']
    config = with_values(Config(), settings(scenario), 'test')
    contaminated = 0
    for seed in range(6):
        samples, _ = simulate_samples(scenario, np.random.default_rng(seed))
        with pytest.raises(DataError) as refusal:
            pipeline.solve(samples, [], config, 'laser')
        contaminated += refusal.value.reason == 'outlier'
    assert contaminated >= 4, 'two answers, of others'
