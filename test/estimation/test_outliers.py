# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stations that do not fit are left out, with a reason; few of them judge, or give no answer."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import Cell, cell, every_target, settings_of, simulated, solved, squared_error
from handeye_ros import pipeline, se3
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.contamination import ONE_WRONG
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE
from handeye_ros.estimation.posterior import posterior_at
from handeye_ros.estimation.search import refined_solution
from handeye_ros.results.truth import errors_against
from handeye_ros.simulate import FAULTS, SCENARIOS, simulate_samples
import numpy as np
import pytest
from quick import long_run


def moved(sample: Sample, by: Array) -> Sample:
    return replace(sample, T_base_flange=se3.perturb(sample.T_base_flange, by))


def rejected(calibration: Calibration) -> set[int]:
    return {report.stamp for report in calibration.samples if not report.used}


def assert_as_good(calibration: Calibration, clean: Calibration) -> None:
    """Check that an answer is that of the clean samples alone."""
    error = np.abs(se3.difference(calibration.T_flange_sensor, clean.T_flange_sensor))
    assert error.max() < 1e-6
    assert calibration.quality.samples_used == clean.quality.samples_used


@pytest.mark.thorough
@every_target
@pytest.mark.parametrize('size', [3e-3, 0.05])
def test_stations_with_a_wrong_pose_are_left_out(name: str, size: float) -> None:
    for seed in range(2):
        simulated_cell = cell(name, seed)
        rng = np.random.default_rng(seed)
        wrong_stations = rng.permutation(len(simulated_cell.samples))[:2]
        steps = rng.normal(size=(len(simulated_cell.samples), 6))
        steps[:, :3] *= size / np.linalg.norm(steps[:, :3], axis=1)[:, None]
        # a plane does not see what moves along it: turn the poses too, by 1 degree
        steps[:, 3:] *= 0.02 / np.linalg.norm(steps[:, 3:], axis=1)[:, None]
        samples = [moved(s, steps[i]) if i in wrong_stations else s
                   for i, s in enumerate(simulated_cell.samples)]
        calibration = simulated_cell.solve(samples)
        assert rejected(calibration) >= {simulated_cell.samples[i].stamp for i in wrong_stations}
        assert len(rejected(calibration)) <= 3
        assert_as_good(calibration, simulated_cell.solve(
            s for s in simulated_cell.samples if s.stamp not in rejected(calibration)))


def aside(cell: Cell, rng: np.random.Generator) -> Array:
    """Return a step of 5 mm."""
    step = rng.normal(size=3)
    return 5e-3 * step / np.linalg.norm(step)


def to_a_second_plate(cell: Cell, rng: np.random.Generator) -> Array:
    return cell.truth.T_base_target[:3, :3] @ [0.25, 0.05, 0.004]


@pytest.mark.parametrize(('target', 'seed', 'step', 'share'), [
    ('plate', 13, to_a_second_plate, 0.24),
    *long_run(
        ('plate', 17, to_a_second_plate, 0.24),
        *((target, seed, aside, 0.28) for target in ('plate', 'sphere') for seed in range(6)))])
def test_a_cluster_that_agrees_on_something_wrong_is_left_out(
        target: str, seed: int, step: Callable[..., Array], share: float) -> None:
    simulated_cell, rng = cell(target, seed), np.random.default_rng(seed)
    by, samples = np.append(step(simulated_cell, rng), np.zeros(3)), simulated_cell.samples
    order = rng.permutation(len(samples))
    wrong_stamps = {samples[i].stamp for i in order[:int(share * len(samples))]}
    calibration = simulated_cell.solve(
        moved(s, by) if s.stamp in wrong_stamps else s for s in samples)
    assert rejected(calibration) == wrong_stamps
    assert_as_good(calibration, simulated_cell.solve(
        s for s in samples if s.stamp not in wrong_stamps))


@pytest.mark.thorough
def test_too_many_wrong_stations_are_refused() -> None:
    plate_cell = cell('plate', 1)
    rng = np.random.default_rng(0)
    samples = [moved(s, np.append(rng.normal(size=3) * 8e-3, rng.normal(size=3) * 0.02))
               if i % 2 else s for i, s in enumerate(plate_cell.samples)]
    with pytest.raises(DataError, match='contradict'):
        plate_cell.solve(samples)


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [0, 1])
def test_edges_of_the_plate_that_are_not_ours_do_no_harm(seed: int) -> None:
    plate_cell = cell('wrong_edges', seed)
    calibration = plate_cell.solve()
    assert plate_cell.error(calibration.T_flange_sensor) < 9e-5
    reports = {r.stamp: r for r in calibration.samples}
    sides = set()
    for stop, sample in zip(plate_cell.truth.stops, plate_cell.samples, strict=True):
        report = reports[sample.stamp]
        if stop.label.endswith('_far'):
            assert report.edge == '' and report.reason, 'told, though its face may be used'
        else:
            assert report.used and report.edge in ('p', 'q')
            sides.add((stop.label, report.edge))
    assert len(sides) == 2, 'one name for each edge'


def test_fewer_conditions_than_unknowns_leave_a_direction_free() -> None:
    plane_cell = cell('plane', 0)
    solution = solved(plane_cell.problem)
    few_stations = plane_cell.problem.subset(np.arange(4))
    covariance = posterior_at(few_stations, solution.estimate, BLOCKS_AS_NOISE).covariance
    assert np.linalg.eigvalsh(covariance)[-1] > 1.0, 'm^2: 8 conditions, 9 unknowns'


@pytest.mark.parametrize(('name', 'rank'), [
    ('plate', 3), ('line', 2), ('plane', 2), ('sphere', 3), ('wedge', 4)])
def test_a_station_says_as_much_as_its_target_shows(name: str, rank: int) -> None:
    simulated_cell = cell(name, 0)
    posterior = solved(simulated_cell.problem).posterior
    assert (posterior.ranks == rank).all()
    assert posterior.redundancy == rank * len(simulated_cell.samples) - posterior.unknown_count


def wrong(sample: Sample, rng: np.random.Generator) -> Sample:
    return moved(sample, np.append(rng.normal(size=3) * 3e-3, rng.normal(size=3) * 0.01))


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'stations', 'wrong_count'), [
    ('plane', (6, 0), 1), ('plane', (8, 0), 2), ('plate', (3, 3), 1), ('plate', (4, 3), 2),
    ('line', (7, 0), 1), ('sphere', (6, 0), 2)])
def test_few_with_wrong_ones_are_refused(name: str, stations: tuple[int, int], wrong_count: int
                                         ) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        few_samples = cell(replace(SCENARIOS[name], stops=stations), seed)
        chosen = rng.permutation(len(few_samples.samples))[:wrong_count]
        samples = [wrong(s, rng) if k in chosen else s for k, s in enumerate(few_samples.samples)]
        with pytest.raises(DataError):
            few_samples.solve(samples)


@pytest.mark.thorough
def test_what_is_left_after_dropping_must_judge() -> None:
    plane_cell = cell(replace(SCENARIOS['plane'], stops=(7, 0)), 0)
    samples = [wrong(s, np.random.default_rng(1)) if i == 3 else s
               for i, s in enumerate(plane_cell.samples)]
    with pytest.raises(DataError, match='take more'):
        plane_cell.solve(samples)


@pytest.mark.parametrize('seed', range(3))
def test_one_wrong_of_ten_stands_out_from_a_poor_robot(seed: int) -> None:
    plate_cell = cell(replace(SCENARIOS['plate'], stops=(5, 5)), seed)
    rng = np.random.default_rng(seed)
    samples = [wrong(s, rng) if i == seed else s for i, s in enumerate(plate_cell.samples)]
    calibration = plate_cell.solve(samples)
    assert [report.used for report in calibration.samples] == [i != seed for i in range(10)]
    assert [report.stamp for report in calibration.samples] == sorted(s.stamp for s in samples)
    report = calibration.samples[seed]
    assert 'contradicts the other samples' in report.reason and report.residual is None
    errors = errors_against(calibration.T_flange_sensor, plate_cell.truth.T_flange_sensor)
    assert errors.mapped_points < 2e-4


def test_no_station_of_a_poor_robot_is_taken_for_wrong() -> None:
    poor = replace(SCENARIOS['plate'].robot, systematic=(3e-4, 1e-3))
    plate_cell = cell(replace(SCENARIOS['plate'], stops=(5, 5), robot=poor), 0,
                      noise__robot_smooth=1.5e-4)
    assert plate_cell.solve().quality.samples_rejected == 0


def test_a_possibly_wrong_station_counts_only_among_few() -> None:
    shares = []
    for stations in ((3, 3), (9, 9)):
        plate_cell = cell(replace(SCENARIOS['plate'], stops=stations), 0)
        solution = refined_solution(solved(plate_cell.problem))
        added = solution.added_covariances[ONE_WRONG]
        shares.append((np.diag(added) / np.diag(solution.transform_covariance)).max())
    assert shares[0] > 0.01 > shares[1]


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'seed'), [
    ('6 poses x 4', 17),  # a rival that has no use for two of the six edges
    ('6 poses x 4, smooth 0.15 mm', 4),  # hard to start
    ('6 poses x 4, joints 0.1 mm', 7)])  # started wrong, positions in mm seemed to explain it
def test_six_poses_visited_four_times_carry_an_answer(name: str, seed: int) -> None:
    recording = simulated(FAULTS[name], seed)
    calibration = recording.calibrate()
    assert calibration.quality.samples_used == 6, 'a pose that is taken again says nothing new'
    assert squared_error(calibration, recording.truth) < 20


@pytest.mark.thorough
def test_six_stations_of_which_one_is_wrong_are_refused_and_why() -> None:
    scenario, contaminated = FAULTS['3 + 3, one bad'], 0
    config = settings_of(scenario)
    for seed in range(6):
        samples, _ = simulate_samples(scenario, np.random.default_rng(seed))
        with pytest.raises(DataError) as refusal:
            pipeline.solve(samples, [], config, 'laser')
        contaminated += refusal.value.code == 'outlier'
    assert contaminated >= 4, 'two answers, of others'
