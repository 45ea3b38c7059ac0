# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What moved in the middle of a recording is named, and told with its moment."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import re

from cells import cell, refused, settings_of, simulated, solution_of
from handeye_ros import pipeline, se3
from handeye_ros.checks.moved import outliers_at_one_end
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.least_squares import chi2_isf
from handeye_ros.guidance.advice import advise
from handeye_ros.simulate import FAULTS, SCENARIOS, simulate_samples
import numpy as np
import pytest
from quick import long_run
from streams import in_order

Change = Callable[[Array], Array]  # of poses

OTHER_TOOL = se3.perturb(np.eye(4), np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.2]))
BUMPED = se3.perturb(np.eye(4), np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.01]))
FAR = se3.perturb(np.eye(4), np.array([0.03, 0.02, 0.04, 0.1, 0.05, 0.0]))


def later(samples: tuple[Sample, ...], change: Change) -> list[Sample]:
    """Return samples in the order of time, the poses of the second half changed."""
    ordered = in_order(samples)
    half = len(ordered) // 2
    return ordered[:half] + [replace(s, T_base_flange=change(s.T_base_flange))
                             for s in ordered[half:]]


@pytest.mark.parametrize(('name', 'change', 'words'), [
    ('sphere', lambda T: T @ OTHER_TOOL, 'the sensor moved in flange by 5'),
    *long_run(
        ('sphere', lambda T: BUMPED @ T, 'the target moved in base, or'),
        ('plate', lambda T: T @ OTHER_TOOL, 'the sensor moved in flange by 5'),
        ('plate', lambda T: BUMPED @ T, 'the target moved in base, or'),
        # 7 of their 14 samples have few conditions to spare
        ('plane', lambda T: T @ OTHER_TOOL, 'the (sensor|target) moved in '),
        ('line', lambda T: T @ OTHER_TOOL, 'the (sensor|target) moved in '),
        ('eye_on_base', lambda T: T @ OTHER_TOOL, 'the target moved in flange, or'))])
def test_what_moved_is_named(name: str, change: Change, words: str) -> None:
    simulated_cell = cell(name, 3)
    with pytest.raises(DataError, match=words) as caught:
        simulated_cell.solve(later(simulated_cell.samples, change))
    match = re.search(r'the first (\d+) samples .* the other (\d+),', str(caught.value))
    (first, others), n = map(int, match.groups()), len(simulated_cell.samples)
    assert first + others == n and abs(first - n // 2) <= 2


@pytest.mark.thorough
@pytest.mark.parametrize('name', ['plane', 'sphere'])
def test_parts_with_neither_one_target_nor_one_transform_name_no_move(name: str) -> None:
    # as parts of a few samples with wrong poses fit, by chance
    simulated_cell = cell(name, 3)
    with refused('misfit', 'contradict'):
        simulated_cell.solve(later(simulated_cell.samples, lambda T: FAR @ T @ OTHER_TOOL))


@pytest.mark.thorough
def test_a_target_that_moved_is_no_other_surface() -> None:
    recording = simulated(SCENARIOS['plate'], 8)
    middle = recording.poses[len(recording.poses) // 2].stamp
    poses = [replace(pose, translation=pose.translation + (pose.stamp > middle) * np.array(
        [1.8e-3, 1.44e-3, 1.92e-3])) for pose in recording.poses]
    with pytest.raises(DataError, match='the target seems to have moved in base by about '):
        recording.calibrate(poses=poses)


def warnings_or_refusal(samples: list[Sample], config: Config) -> str:
    """Return the warnings of an answer, or the refusal where the evidence is very strong."""
    answer = pipeline.answer_samples(samples, [], config, 'laser')
    return str(answer.refusal or ' '.join(answer.calibration.provenance.get('warnings', ())))


SLIGHT = se3.perturb(np.eye(4), np.array([4e-4, 0.0, 3e-4, 0.0, 0.0, 0.0]))


@pytest.mark.thorough
@pytest.mark.parametrize(('change', 'culprit'), [
    (lambda T: T @ SLIGHT, 'sensor'), (lambda T: SLIGHT @ T, 'target')])
def test_a_small_move_is_reported_with_its_moment(change: Change, culprit: str) -> None:
    plate_cell = cell('plate', 5)
    samples = later(plate_cell.samples, change)
    sentence = warnings_or_refusal(samples, plate_cell.config)
    assert f'the first {len(samples) // 2} ' in sentence and f'the {culprit} ' in sentence
    match = re.search('by (?:about )?([0-9.]+) mm', sentence)
    assert match and float(match[1]) == pytest.approx(0.5, abs=0.3)


@pytest.mark.parametrize('seed', [1, *long_run(4, 114, 118)])
def test_a_small_move_is_reported_though_noise_could_explain_it(seed: int) -> None:
    scenario, rng = FAULTS['plane, baseline'], np.random.default_rng(seed)
    samples, truth = simulate_samples(scenario, rng)
    X, step = truth.T_flange_sensor, rng.normal(size=3)
    moved = se3.perturb(np.eye(4), np.append(5e-4 * step / np.linalg.norm(step), np.zeros(3)))
    slip = X @ se3.inverse(moved) @ se3.inverse(X)
    sentence = warnings_or_refusal(later(samples, lambda T: T @ slip), settings_of(scenario))
    assert re.search('the first [678] of 14 samples', sentence), sentence


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'first'), [
    ('sphere', False), ('sphere', True), ('wedge', False), ('wedge', True)])
def test_a_move_is_told_while_few_samples_lie_beyond_it(name: str, first: bool) -> None:
    simulated_cell = cell(name, 2)
    rng = np.random.default_rng(1)
    mixed = [replace(simulated_cell.samples[k], stamp=stamp)
             for stamp, k in enumerate(rng.permutation(len(simulated_cell.samples))[:12])]
    bumped = se3.transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    beyond = mixed[:3] if first else mixed[-3:]
    samples = [replace(s, T_base_flange=bumped @ s.T_base_flange) if s in beyond else s
               for s in mixed]
    words = ('the first 3 of 12 samples contradict the 9 after them' if first else
             'the last 3 of 12 samples contradict the 9 before them')
    assert words in warnings_or_refusal(samples, simulated_cell.config)
    answer = pipeline.answer_samples(samples, [], simulated_cell.config, 'laser')
    advice = advise(samples, simulated_cell.config, answer)
    assert words in advice.why and not advice.enough
    # a single sample may be wrong for another reason, and so may others in any place
    scattered = [replace(s, T_base_flange=bumped @ s.T_base_flange) if k in (1, 5, 9) else s
                 for k, s in enumerate(mixed)]
    assert 'moved' not in warnings_or_refusal(scattered, simulated_cell.config)
    assert 'moved' not in warnings_or_refusal([*mixed[:9], samples[-1]], simulated_cell.config)


def test_outliers_at_one_end_are_told_of_however_many_samples() -> None:
    solution = solution_of('plate')
    many = replace(solution.full_problem, poses=np.resize(solution.problem.poses, (3000, 4, 4)))
    assert outliers_at_one_end(replace(
        solution, full_problem=many, used_stations=np.arange(2800))).startswith(
        'the last 200 of 3000 samples contradict the 2800 before them')


@pytest.mark.parametrize(('name', 'seed'), [('plate', 2), ('sphere', 1)])
def test_an_answer_that_warns_of_a_move_is_as_uncertain_as_the_move(name: str, seed: int) -> None:
    simulated_cell = cell(name, seed)
    slightly = se3.perturb(np.eye(4), np.array([8e-5, 0.0, 6e-5, 0.0, 0.0, 0.0]))
    answer = pipeline.answer_samples(later(simulated_cell.samples, lambda T: T @ slightly), [],
                                     simulated_cell.config, 'laser')
    calibration = answer.require_calibration()
    assert 'moved' in calibration.provenance['warnings'][0]
    error = se3.difference(calibration.T_flange_sensor, simulated_cell.truth.T_flange_sensor)
    covariance, move = calibration.covariance, answer.solution.added_covariances['possible move']
    assert error @ np.linalg.solve(covariance, error) < chi2_isf(0.05, 6)
    assert error @ np.linalg.solve(covariance - move, error) > chi2_isf(0.05, 6)


@pytest.mark.parametrize('name', [
    'plate, baseline', 'joints and links 0.1 mm', 'sphere, smooth 0.2 mm'])
def test_a_robot_less_accurate_than_stated_is_no_move(name: str) -> None:
    samples, _ = simulate_samples(FAULTS[name], np.random.default_rng(0))
    config = settings_of(FAULTS[name])
    assert 'warnings' not in pipeline.solve(samples, [], config, 'laser').provenance
