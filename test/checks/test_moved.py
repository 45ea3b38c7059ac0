# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A target or sensor that moved in the middle of a recording is named."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import re

from cells import cell
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.least_squares import chi2_isf
from handeye_ros.simulate import FAULTS, settings, simulate_samples
import numpy as np
import pytest

pytestmark = pytest.mark.thorough

OTHER_TOOL = se3.perturb(np.eye(4), np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.2]))
BUMPED = se3.perturb(np.eye(4), np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.01]))


def later(samples: tuple[Sample, ...], change: Callable[[Array], Array]) -> list[Sample]:
    """Return samples in the order of time, the poses of the second half changed."""
    ordered = sorted(samples, key=lambda sample: sample.stamp)
    half = len(ordered) // 2
    return ordered[:half] + [replace(s, T_base_flange=change(s.T_base_flange))
                             for s in ordered[half:]]


@pytest.mark.parametrize('name', ['plate', 'sphere'])
@pytest.mark.parametrize(('change', 'words'), [
    (lambda T: T @ OTHER_TOOL, 'the sensor moved in flange by 5'),
    (lambda T: BUMPED @ T, 'the target moved in base, or'),
])
def test_what_moved_is_named(name: str, change: Callable[[Array], Array], words: str) -> None:
    made = cell(name, 3)
    with pytest.raises(DataError, match=words) as caught:
        pipeline.solve(later(made.samples, change), [], made.config, 'laser')
    parted = re.search(r'the first (\d+) samples .* the other (\d+),', str(caught.value))
    first, rest = map(int, parted.groups())
    n = len(made.samples)
    assert first + rest == n and abs(first - n // 2) <= 2


SLIGHT = se3.perturb(np.eye(4), np.array([4e-4, 0.0, 3e-4, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize(('change', 'what'), [
    (lambda T: T @ SLIGHT, 'sensor'), (lambda T: SLIGHT @ T, 'target')])
def test_a_small_move_is_reported_with_its_moment(
        change: Callable[[Array], Array], what: str) -> None:
    made = cell('plate', 5)
    samples = later(made.samples, change)
    half = len(samples) // 2
    try:
        answer = pipeline.solve(samples, [], made.config, 'laser')
        said = ' '.join(answer.provenance.get('warnings', ()))
    except DataError as refusal:
        said = str(refusal)
    # told with the answer, or a refusal where the evidence is very strong
    assert f'the first {half} ' in said and f'the {what} ' in said
    size = re.search('by about ([0-9.]+) mm', said)
    assert size is None or float(size[1]) == pytest.approx(0.5, abs=0.3)


@pytest.mark.parametrize('seed', [1, 4])
def test_a_small_move_is_reported_though_noise_and_scales_could_stand_for_it(seed: int) -> None:
    scenario, rng = FAULTS['plane'], np.random.default_rng(seed)
    config = with_values(Config(), settings(scenario), 'test')
    samples, truth = simulate_samples(scenario, rng)
    X, step = truth.T_flange_sensor, rng.normal(size=3)
    moved = se3.perturb(np.eye(4), np.append(5e-4 * step / np.linalg.norm(step), np.zeros(3)))
    seen = X @ se3.inverse(moved) @ se3.inverse(X)
    try:
        answer = pipeline.solve(later(samples, lambda T: T @ seen), [], config, 'laser')
        said = ' '.join(answer.provenance.get('warnings', ()))
    except DataError as refusal:
        said = str(refusal)
    assert re.search('the first [678] of 14 samples', said), said


@pytest.mark.parametrize(('name', 'seed'), [('plate', 2), ('sphere', 1)])
def test_an_answer_that_warns_of_a_move_is_as_uncertain_as_the_move(name: str, seed: int) -> None:
    made = cell(name, seed)
    slightly = se3.perturb(np.eye(4), np.array([8e-5, 0.0, 6e-5, 0.0, 0.0, 0.0]))
    found = pipeline.answer(later(made.samples, lambda T: T @ slightly), [], made.config, 'laser')
    answer = found.required()
    assert 'moved' in answer.provenance['warnings'][0]
    away = se3.difference(answer.T_flange_sensor, made.truth.T_flange_sensor)
    whole, move = answer.covariance, found.solution.added_covariances['possible move']
    assert away @ np.linalg.solve(whole, away) < chi2_isf(0.05, 6)
    assert away @ np.linalg.solve(whole - move, away) > chi2_isf(0.05, 6)


@pytest.mark.parametrize('name', ['baseline', 'joints and links 0.1 mm', 'sphere, smooth 0.2 mm'])
def test_a_robot_less_accurate_than_stated_is_no_move(name: str) -> None:
    samples, _ = simulate_samples(FAULTS[name], np.random.default_rng(0))
    config = with_values(Config(), settings(FAULTS[name]), 'test')
    assert 'warnings' not in pipeline.solve(samples, [], config, 'laser').provenance


def test_with_the_sensor_beside_the_robot_the_frames_change_sides() -> None:
    made = cell('eye_on_base', 3)
    with pytest.raises(DataError, match='the target moved in flange, or'):
        pipeline.solve(later(made.samples, lambda T: T @ OTHER_TOOL), [], made.config, 'laser')


def test_samples_that_contradict_each_other_anyhow_are_not_called_moved() -> None:
    made = cell('plate', 3)
    poses = np.roll([s.T_base_flange for s in made.samples], 1, axis=0)
    samples = [replace(s, T_base_flange=T) for s, T in zip(made.samples, poses, strict=True)]
    with pytest.raises(DataError) as caught:
        pipeline.solve(samples, [], made.config, 'laser')
    assert caught.value.reason != 'moved'
