# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stations that do not fit are left out, with a reason, and do no harm."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from cells import Cell, cell, exact_cell, scenario_of
from handeye_ros import pipeline, se3
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import DataError
from handeye_ros.targets import TARGETS
import numpy as np
import pytest

every_method = pytest.mark.parametrize('name', TARGETS)


def solve(samples: Iterable[Sample], made: Cell) -> Calibration:
    return pipeline.solve(list(samples), [], made.config, 'laser')


def moved(sample: Sample, by: Array) -> Sample:
    return replace(sample, T_base_flange=se3.perturb(sample.T_base_flange, by))


def rejected(answer: Calibration) -> set[int]:
    return {report.stamp for report in answer.samples if not report.used}


def assert_as_good(answer: Calibration, clean: Calibration, tolerance: float = 1e-6) -> None:
    """Check that an answer is that of the clean samples alone."""
    off = np.abs(se3.difference(answer.T_flange_sensor, clean.T_flange_sensor))
    assert off.max() < tolerance
    assert answer.quality.samples_used == clean.quality.samples_used


@pytest.mark.thorough
@every_method
@pytest.mark.parametrize('size', [3e-3, 0.05])
def test_stations_with_a_wrong_pose_are_left_out(name: str, size: float) -> None:
    for seed in range(2):
        made = cell(scenario_of(TARGETS[name]), seed, method=name)
        rng = np.random.default_rng(seed)
        bad = rng.permutation(len(made.samples))[:2]
        steps = rng.normal(size=(len(made.samples), 6))
        steps[:, :3] *= size / np.linalg.norm(steps[:, :3], axis=1)[:, None]
        # a plane does not see what moves along it: turn the poses too, by 1 degree
        steps[:, 3:] *= 0.02 / np.linalg.norm(steps[:, 3:], axis=1)[:, None]
        samples = [moved(s, steps[i]) if i in bad else s for i, s in enumerate(made.samples)]
        answer = solve(samples, made)
        assert rejected(answer) >= {made.samples[i].stamp for i in bad}
        assert len(rejected(answer)) <= 3
        clean = solve((s for s in made.samples if s.stamp not in rejected(answer)), made)
        assert_as_good(answer, clean)


def test_reasons_name_the_misfit() -> None:
    made = cell('plate', 1)
    samples = [moved(s, np.array([5e-3, 5e-3, 5e-3, 0, 0, 0])) if i == 4 else s
               for i, s in enumerate(made.samples)]
    answer = solve(samples, made)
    (report,) = [r for r in answer.samples if not r.used]
    assert report.stamp == made.samples[4].stamp
    assert 'contradicts the other stations' in report.reason and 'times' in report.reason
    assert report.residual is None and answer.quality.samples_rejected == 1
    assert [r.stamp for r in answer.samples] == sorted(s.stamp for s in samples)


@pytest.mark.thorough
@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_a_cluster_that_agrees_on_something_wrong_is_left_out(target: str, seed: int) -> None:
    made = cell(target, seed)
    rng = np.random.default_rng(seed)
    step = rng.normal(size=3)
    step = np.append(5e-3 * step / np.linalg.norm(step), np.zeros(3))
    count = int(0.28 * len(made.samples))
    bad = {made.samples[i].stamp for i in rng.permutation(len(made.samples))[:count]}
    answer = solve((moved(s, step) if s.stamp in bad else s for s in made.samples), made)
    assert rejected(answer) == bad
    assert_as_good(answer, solve((s for s in made.samples if s.stamp not in bad), made))


@pytest.mark.parametrize('seed', [13, 17])
def test_a_second_plate_that_some_stations_show_does_no_harm(seed: int) -> None:
    made = cell('plate', seed)
    bad = {made.samples[i].stamp
           for i in np.random.default_rng(seed).permutation(len(made.samples))[:4]}
    T = made.truth.T_base_target
    step = np.append(T[:3, :3] @ [0.25, 0.05, 0.004], np.zeros(3))
    answer = solve((moved(s, step) if s.stamp in bad else s for s in made.samples), made)
    assert rejected(answer) == bad


def test_samples_after_the_target_was_pushed_are_left_out_when_they_are_few() -> None:
    made = cell('plate', 3)
    step = np.array([2e-3, -1e-3, 2e-3, 0, 0, 0.01])
    late = sorted(s.stamp for s in made.samples)[-4:]
    answer = solve((moved(s, step) if s.stamp in late else s for s in made.samples), made)
    assert rejected(answer) == set(late)


def test_too_many_wrong_stations_are_refused() -> None:
    made = cell('plate', 1)
    rng = np.random.default_rng(0)
    samples = [moved(s, np.append(rng.normal(size=3) * 8e-3, rng.normal(size=3) * 0.02))
               if i % 2 else s for i, s in enumerate(made.samples)]
    with pytest.raises(DataError, match='contradict'):
        solve(samples, made)


@pytest.mark.parametrize('seed', range(2))
def test_edges_of_the_plate_that_are_not_ours_do_no_harm(seed: int) -> None:
    made = cell('wrong_edges', seed)
    answer = solve(made.samples, made)
    assert made.error(answer.T_flange_sensor) < 9e-5
    reports = {r.stamp: r for r in answer.samples}
    for station, sample in zip(made.truth.stations, made.samples, strict=True):
        report = reports[sample.stamp]
        if station.label.endswith('2'):
            assert report.edge == '' and report.reason, 'told, though its face may be used'
        else:
            assert report.used and report.edge in ('p', 'q')
    sides = {(station.label, reports[s.stamp].edge)
             for station, s in zip(made.truth.stations, made.samples, strict=True)
             if len(station.label) == 1}
    assert len(sides) == 2, 'one name for each edge'


def test_all_four_edges_are_used_when_the_size_is_known() -> None:
    made = cell('wrong_edges', 1, target__size=[0.2, 0.15])
    without = cell('wrong_edges', 1)
    answer = solve(made.samples, made)
    labels = {s.stamp: t.label for s, t in zip(made.samples, made.truth.stations, strict=True)}
    used = {(labels[r.stamp], r.edge) for r in answer.samples}
    assert all(edge for _, edge in used) and len(used) == len(set(labels.values()))
    assert np.trace(answer.covariance) < np.trace(
        solve(without.samples, without).covariance) * 1.05  # the noise is estimated in both


def test_exact_samples_with_one_wrong_one_give_the_truth() -> None:
    made = exact_cell('plate', 2)
    samples = [moved(s, np.array([0, 0, 2e-3, 0.01, 0, 0])) if i == 7 else s
               for i, s in enumerate(made.samples)]
    answer = solve(samples, made)
    assert rejected(answer) == {samples[7].stamp}
    error = se3.difference(answer.T_flange_sensor, made.truth.T_flange_sensor)
    assert np.abs(error).max() < 1e-8
