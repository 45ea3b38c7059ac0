# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A target that is not as configured is told, not absorbed."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
import re

from cells import cell, refused, settings_of
from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import Calibration, Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import Scenario, SCENARIOS, simulate_samples
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
import pytest
from quick import long_run


def scaled(samples: Iterable[Sample], scale: float) -> list[Sample]:
    """Return samples of a robot whose lengths are scaled."""
    return [replace(s, T_base_flange=se3.transform(
        s.T_base_flange[:3, :3], scale * s.T_base_flange[:3, 3])) for s in samples]


def solved(scenario: Scenario, seed: int, scale: float = 1.0, **changes: object
           ) -> tuple[Calibration, float]:
    """
    Return the calibration of simulated samples and the error of its translation.

    scale: of the lengths of the robot.
    """
    samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
    config = settings_of(scenario, **({'noise__distortion': 0.0} | changes))
    calibration = pipeline.solve(scaled(samples, scale), (), config, 'laser')
    return calibration, float(np.linalg.norm(
        se3.difference(calibration.T_flange_sensor, truth.T_flange_sensor)[:3]))


@pytest.mark.thorough
@pytest.mark.parametrize('degrees', [87.0, 88.0, 89.0, 89.5, 91.0, 92.0, 93.0])
def test_a_plate_that_is_not_square_is_measured_and_named(degrees: float) -> None:
    target = PlateTarget(edge_angle=np.radians(degrees))
    calibration, error = solved(replace(SCENARIOS['plate'], target=target), 0)
    assert abs(calibration.target['edge_angle'] - np.radians(degrees)) < 4 * (
        calibration.target['edge_angle_std'])
    assert f'{np.degrees(calibration.target["edge_angle"]):.3f}' in calibration.target['note']
    assert 'not the configured 90.000' in calibration.target['note']
    assert calibration.quality.samples_used == 18
    assert {sample.edge for sample in calibration.samples} == {'p', 'q'}
    assert error < 1.5e-4


@pytest.mark.thorough
@pytest.mark.parametrize(('off', 'seed'), [
    (off, seed) for off in (0.7e-3, 0.8e-3, 1e-3, 1.1e-3, -1e-3, 2e-3, -5e-3) for seed in (0, 1)
    if (off, seed) != (1e-3, 0)])  # of which the few samples at the far edge are left out
def test_a_plate_of_another_size_is_reported(off: float, seed: int) -> None:
    length, width = SCENARIOS['plate'].target.size
    scenario = replace(SCENARIOS['plate'], wrong_edges=8)
    calibration, error = solved(scenario, seed, target__size=[length + off, width])
    assert error < 1.5e-4
    assert f'{1e3 * (length + off):.1f}' in calibration.target['note']
    assert re.search(r' (200\.0|199\.9)', calibration.target['note'])


@pytest.mark.parametrize(('off', 'seed'), [
    (0.3e-3, 0), (1e-3, 0), *long_run(
        *((0.3e-3, seed) for seed in (1, 4, 25, 42, 52)), (1e-3, 1), (1e-3, 4))])
def test_lengths_that_are_both_wrong_are_not_taken_for_a_scale(off: float, seed: int) -> None:
    length, width = SCENARIOS['plate'].target.size
    calibration, error = solved(replace(SCENARIOS['plate'], wrong_edges=6), seed,
                                target__size=[length + off, width + off])
    for size in (length + off, width + off):
        words = f'not the configured {size * 1e3:.3f}: the answer uses'
        assert words in calibration.target['note']
    assert error < 1e-4


@pytest.mark.parametrize('seed', [1, 3, 4])
def test_of_two_stated_lengths_only_the_wrong_one_is_named(seed: int) -> None:
    length = SCENARIOS['plate'].target.size[0]
    square = replace(SCENARIOS['plate'].target, size=(length, length))
    calibration, error = solved(replace(SCENARIOS['plate'], target=square, wrong_edges=6), seed,
                                target__size=[length + 1e-3, length])
    assert f'not the configured {(length + 1e-3) * 1e3:.3f}: the' in calibration.target['note']
    assert calibration.target['note'].count('not the configured') == 1
    assert error < 1e-4


def test_a_size_given_the_other_way_round_is_the_same_plate() -> None:
    length, width = SCENARIOS['plate'].target.size
    for size in ([length, width], [width, length]):
        for seed in range(3):
            calibration, error = solved(replace(SCENARIOS['plate'], wrong_edges=8), seed,
                                        target__size=size)
            assert {sample.edge for sample in calibration.samples} == {'p', 'q', 'p_far', 'q_far'}
            assert 'note' not in calibration.target and error < 2e-4


@pytest.mark.parametrize('name', ['sphere', 'line'])
def test_a_size_that_a_target_does_not_have_is_ignored(name: str) -> None:
    calibration, _ = solved(SCENARIOS[name], 1, target__size=[0.2, 0.15])
    assert 'size' not in calibration.target.get('note', '')


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [0, 5])
def test_faces_alone_do_not_answer_for_edges_that_fit_nowhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples, _ = simulate_samples(SCENARIOS['plate'], rng)
    bent = []
    for face, edge, sample in ((*s.features, s) for s in samples):
        shift = 8e-3 * rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1) * (rng.random() < 0.6)
        moved = replace(edge, point=edge.point + shift * edge.direction)
        bent.append(replace(sample, features=(face, moved)))
    config = settings_of(SCENARIOS['plate'])
    with pytest.raises(DataError, match='agree on the target, and such an answer'):
        pipeline.solve(bent, (), config, 'laser')


@pytest.mark.parametrize('seed', range(4))
def test_a_square_plate_is_not_accused(seed: int) -> None:
    target = solved(SCENARIOS['plate'], seed)[0].target
    assert 'note' not in target
    assert abs(target['edge_angle'] - np.pi / 2) < 4 * target['edge_angle_std']


@pytest.mark.thorough
@pytest.mark.parametrize('radius', [0.0403, 0.05])
def test_a_sphere_of_another_radius_is_measured_and_named(radius: float) -> None:
    calibration, error = solved(SCENARIOS['sphere'], 1, target__radius=radius)
    assert calibration.target['radius'] == pytest.approx(0.04, abs=1e-5)
    assert f'not the configured {1e3 * radius:.3f}' in calibration.target['note']
    assert error < 3e-4


@pytest.mark.parametrize('scale', [1.0, 1.0015, 0.999])
@pytest.mark.parametrize('name', ['plate', 'sphere'])
def test_the_scale_between_robot_and_sensor_is_reported(name: str, scale: float) -> None:
    target = solved(SCENARIOS[name], 2, scale)[0].target
    assert 0 < target['scale_std'] < 7e-4
    assert target['scale'] == pytest.approx(scale, abs=3 * target['scale_std'])


@pytest.mark.parametrize('target', ['plate', 'eye_on_base', 'sphere', 'line', 'plane', 'wedge'])
@pytest.mark.parametrize('scale', [0.98, 1.02])
def test_lengths_that_differ_are_named(target: str, scale: float) -> None:
    with refused('scale') as refusal:
        solved(SCENARIOS[target], 3, scale, noise__distortion=Config().noise.distortion)
    named = float(str(refusal.value).split('differ by ')[1].split(' ')[0])
    assert named == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize('seed', [7, 12])
def test_lengths_that_differ_little_are_named(seed: int) -> None:
    with refused('scale', r'differ by 0\.[456]'):
        solved(SCENARIOS['wedge'], seed, 1.006)


def test_lengths_that_may_differ_are_noted() -> None:
    calibration, error = solved(SCENARIOS['sphere'], 7, 1.003)
    assert calibration.target['scale'] == pytest.approx(1.003, abs=1e-3) and error < 5e-4
    assert 'lengths of robot and sensor differ by 0.2' in calibration.target['note']


def test_a_scale_is_no_move_of_a_few_samples() -> None:
    line_cell = cell('line', 2)
    with refused('scale'):
        line_cell.solve(scaled(line_cell.samples, 1.005))


@pytest.mark.parametrize(('target', 'count', 'seed'), [
    ('line', 11, 9), *long_run(('plate', 9, 1))])
def test_one_wrong_pose_is_no_scale(target: str, count: int, seed: int) -> None:
    """Though a scale would explain that pose by chance."""
    scenario, rng = replace(SCENARIOS[target], stops=(count, 0)), np.random.default_rng(
        [seed, count])
    samples, truth = simulate_samples(scenario, rng)
    wrong, step, turn = int(rng.integers(count)), rng.normal(size=3), rng.normal(size=3)
    slip = se3.perturb(np.eye(4), np.append(5e-3 * step / np.linalg.norm(step),
                                            np.radians(0.5) * turn / np.linalg.norm(turn)))
    samples = [replace(s, T_base_flange=s.T_base_flange @ slip) if k == wrong else s
               for k, s in enumerate(samples)]
    calibration = pipeline.solve(samples, [], settings_of(scenario), 'laser')
    assert calibration.quality.samples_used == count - 1
    error = se3.difference(calibration.T_flange_sensor, truth.T_flange_sensor)[:3]
    assert np.linalg.norm(error) < 5e-4
