# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The comparison of estimators: what every row says, and that it says it of the same samples."""
from __future__ import annotations

from dataclasses import replace
import re

from cells import Cell, cell, exact_cell, settings_of
from command import assert_refused, handeye, ROOT
from handeye_ros import pipeline, se3
from handeye_ros.compare import compare, Comparison, EstimatorResult, ESTIMATORS
from handeye_ros.frames import T_sensor_plane
from handeye_ros.results.truth import errors_against
from handeye_ros.simulate import SCENARIOS
from handeye_ros.targets import TARGETS
import numpy as np
import pytest
from quick import long_run
import yaml

CHEN_RIGID = 'Chen 2023, on SE(3)'


def compared(cell: Cell, **values: object) -> Comparison:
    return compare(cell.samples, (), cell.config, cell.truth.T_flange_sensor,
                   **({'folds': 0} | values))


@pytest.fixture
def only(monkeypatch):
    """Return a function that leaves only some of a target's estimators."""
    def leave(target: str, *names: str) -> None:
        chosen = tuple(e for e in ESTIMATORS[target] if e.name in names)
        assert len(chosen) == len(names)
        monkeypatch.setitem(ESTIMATORS, target, chosen)
    return leave


def by_name(comparison: Comparison) -> dict[str, EstimatorResult]:
    return {row.name: row for row in comparison.rows}


def mapped(row: EstimatorResult) -> float:
    assert not row.failure
    return row.figures['error_mapped_points']


@pytest.mark.parametrize('target', [
    'plate', *long_run(*(name for name in TARGETS if name != 'plate'))])
def test_without_noise_all_estimators_find_the_truth(target: str) -> None:
    simulated_cell = exact_cell(target)
    comparison = compared(simulated_cell)
    assert comparison.refusal is None
    assert (comparison.used, comparison.rejected) == (len(simulated_cell.samples), 0)
    for row in comparison.rows:
        assert mapped(row) < 2e-6, row.name  # Powell and trust-constr stop a little early
        assert row.figures['residual_rms'] < 1e-6, row.name


@pytest.mark.thorough
def test_the_first_row_is_the_answer_of_solve_in_any_order(only) -> None:
    only('plate', 'plate', CHEN_RIGID)
    plate_cell = cell('plate', 2)
    ours, chen = compared(plate_cell, folds=18).rows
    calibration = pipeline.solve(plate_cell.samples, (), plate_cell.config, 'laser')
    T_solved = calibration.T_flange_sensor
    np.testing.assert_allclose(ours.T_flange_sensor, T_solved, rtol=0, atol=1e-12)
    ours_figures, quality = ours.figures, calibration.quality
    assert ours_figures['residual_rms'] == pytest.approx(quality.residual_rms, rel=1e-3)
    errors = errors_against(T_solved, plate_cell.truth.T_flange_sensor)
    assert (ours_figures['error_translation'], mapped(ours)) == (
        errors.translation, errors.mapped_points)
    assert ours_figures['holdout_rms'] == pytest.approx(quality.holdout_rms, rel=0.05)
    assert chen.figures['holdout_rms'] > chen.figures['residual_rms']
    order = np.random.default_rng(0).permutation(len(plate_cell.samples))
    shuffled = replace(plate_cell, samples=tuple(plate_cell.samples[i] for i in order))
    for row, shuffled_row in zip((ours, chen), compared(shuffled, folds=18).rows, strict=True):
        np.testing.assert_array_equal(row.T_flange_sensor, shuffled_row.T_flange_sensor)
        assert row.figures['holdout_rms'] == shuffled_row.figures['holdout_rms']


def test_stations_that_disagree_are_given_to_nobody(only) -> None:
    only('plate', 'plate', CHEN_RIGID)
    plate_cell = cell('plate', 1)
    wrong_sample = replace(plate_cell.samples[4], T_base_flange=plate_cell.samples[4].T_base_flange
                           @ se3.transform(np.eye(3), np.array([0.0, 0.004, 0.003])))
    samples = (*plate_cell.samples[:4], wrong_sample, *plate_cell.samples[5:])
    comparison = compared(replace(plate_cell, samples=samples))
    assert (comparison.used, comparison.rejected) == (17, 1)
    assert mapped(by_name(comparison)[CHEN_RIGID]) < 5e-4


def test_axes_other_than_x_z_turn_every_answer(only) -> None:
    only('plate', 'plate', 'plane, the face lines alone', CHEN_RIGID)
    plate_cell = exact_cell('plate')
    profile = settings_of(SCENARIOS['plate_y_along_line']).profile
    turned = replace(plate_cell.config, profile=profile)
    assert turned.profile.axes == ('y', 'z')
    T_true = plate_cell.truth.T_flange_sensor @ se3.inverse(T_sensor_plane(turned))
    for row in compare(plate_cell.samples, (), turned, T_true, folds=0).rows:
        assert row.T_flange_sensor is not None, row.failure
        np.testing.assert_allclose(row.T_flange_sensor, T_true, rtol=0, atol=5e-5)
        assert mapped(row) < 2e-6, row.name


def test_an_answer_too_uncertain_for_us_is_none(only) -> None:
    only('plate', 'plate', CHEN_RIGID)
    comparison = compared(cell('plate', limits__translation=1e-6))
    assert comparison.refusal.code == 'uncertain'
    rows = by_name(comparison)
    assert rows['plate'].T_flange_sensor is None
    assert mapped(rows[CHEN_RIGID]) < 1e-3


def test_the_verb_shows_writes_and_refuses(tmp_path) -> None:
    arguments = ('--config', ROOT / 'config' / 'sphere.yaml', '--out', 'c.yaml')
    run = handeye('compare', ROOT / 'bags' / 'sphere', *arguments, cwd=tmp_path)
    assert (run.returncode, run.stderr) == (0, '')
    rows = yaml.safe_load((tmp_path / 'c.yaml').read_text())['estimators']
    assert [row['name'] for row in rows] == [e.name for e in ESTIMATORS['sphere']]
    assert 0 < rows[0]['error_mapped_points'] < 2e-4
    for row in rows:
        shown, = re.findall(rf'\n {row["name"]} +(-?[\d. ]+)\n', run.stdout.split('residual')[1])
        assert f'{1e3 * row["error_mapped_points"]:.4f}' in shown.split()
    run = handeye('compare', ROOT / 'bags' / 'one_orientation', cwd=tmp_path)
    assert_refused(run, 3, 'all poses share one orientation')
