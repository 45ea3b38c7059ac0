# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets solved from files: every verb, and what is written."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
import hashlib
from pathlib import Path

from calibrations import equal
from command import ROOT
from file_scenes import given, Run, TABLES, target_of
from handeye_ros import se3, tabulated
from handeye_ros.bags import bag, bag_write
from handeye_ros.cli import simulated
from handeye_ros.config import Config, load, with_values
from handeye_ros.data import Array, Calibration
from handeye_ros.frames import sensor_axes
from handeye_ros.published.compare import compare_files
from handeye_ros.published.estimators import ESTIMATORS
from handeye_ros.results import calibration_file
from handeye_ros.results.truth_file import errors_against, true_transform
from handeye_ros.simulate import FILE_SCENES, measured
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.tabulated import FILE_METHODS
from handeye_ros.tabulated.method import calibrate
from handeye_ros.targets import FROM_FILES, METHODS
import numpy as np
import pytest

PERFECT = SensorModel(columns=640, rate=10.0, noise=1e-9, mixed=0.0, lost=0.0, lost_at_edge=0.0,
                      outliers=0.0, rim_bias=0.0)
EXACT: dict[str, Callable[[np.random.Generator], measured.Measured]] = {
    'points': lambda rng: measured.points(rng, 0.0),
    'hand_eye': lambda rng: measured.hand_eye(rng, noise=0.0),
    'hand_eye_on_base': lambda rng: measured.hand_eye(rng, True, 0.0),
    'tracker': lambda rng: measured.laser_tracker(rng, PERFECT, 0.0, 0.0)}


@pytest.fixture(scope='module', params=[name for name in FILE_SCENES if name != 'tracker'])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
          ) -> tuple[str, Path]:
    """Return the name of a scene and its folder; the small tracker will do."""
    path = tmp_path_factory.mktemp('scenes') / request.param
    simulated.write(request.param, 1, path)
    return request.param, path


def off(T: Array, T_true: Array) -> float:
    return float(np.abs(se3.difference(T, T_true)).max())


def read_configured(name: str, folder: Path) -> tuple[tabulated.FileMethod, object, Config]:
    """Return method, input and configuration of a scene in a folder."""
    path, _, file, *_ = given(name, folder)
    config = with_values(load(Path(str(file))), dict([str(given(name, folder)[-1]).split('=')]),
                         'test')
    method = tabulated.of(config)
    assert method is not None
    return method, method.read(Path(str(path)), config, bag.read), config


def test_every_target_has_all_that_belongs_to_it() -> None:
    assert FROM_FILES == tuple(FILE_METHODS)
    assert not METHODS.keys() & FILE_METHODS.keys()
    for name, method in FILE_METHODS.items():
        config = load(ROOT / 'config' / f'{name}.yaml')
        assert tabulated.of(config) is method
        assert name in FILE_SCENES
        assert ESTIMATORS[name][0].name == name == method.name
    assert tabulated.of(Config()) is None


@pytest.mark.parametrize('name', FILE_SCENES)
def test_simulate_writes_files_and_truth(name: str, handeye: Run, tmp_path: Path) -> None:
    simulated.write(name, 1, folder := tmp_path / 'again')
    code, out, err = handeye('simulate', name, 'made', '--seed', 1)
    assert (code, err) == (0, '')
    table = TABLES[target_of(name)]
    assert out.startswith(f'wrote {Path("made").absolute()}: ') and table in out
    for file in (table, 'truth.yaml'):
        assert Path('made', file).read_bytes() == (folder / file).read_bytes()
    assert f'simulate {name} --seed 1' in Path('made', 'truth.yaml').read_text()
    code, _, err = handeye('simulate', name, 'made', '--seed', 2)
    assert code == 2 and '--force' in err
    assert handeye('simulate', name, 'made', '--seed', 2, '--force')[0] == 0
    assert Path('made', table).read_bytes() != (folder / table).read_bytes()


def test_solve_answers_near_the_truth_and_says_how_near(scene: tuple[str, Path], handeye: Run
                                                        ) -> None:
    name, folder = scene
    code, out, err = handeye('solve', *given(name, folder), '--out', 'out')
    assert (code, err) == (0, '')
    found = calibration_file.read_calibration(Path('out', 'calibration.yaml'))
    T_true = true_transform(folder)
    assert T_true is not None
    delta = se3.difference(found.T_flange_sensor, T_true)
    assert delta @ np.linalg.solve(found.covariance, delta) < 25
    assert found.method == target_of(name)
    assert (found.parent_frame, found.child_frame) == (
        'base' if name in ('points', 'hand_eye_on_base') else 'flange',
        'laser' if 'tracker' in name else 'camera')
    quality = found.quality
    assert quality.residual_rms < quality.holdout_rms < 3e-4
    lost = [sample for sample in found.samples if not sample.used]
    # one profile of the sweep in fifty may be taken for one that contradicts the others
    assert len(lost) <= len(found.samples) / 50
    assert all(sample.edge.startswith('swept') for sample in lost)
    assert quality.samples_used + quality.samples_rejected >= 10
    assert all(sample.residual is not None for sample in found.samples if sample.used)
    _check_provenance(found, folder)
    method, read, _ = read_configured(name, folder)
    errors = errors_against(found.T_flange_sensor, T_true, method.field(read.data))
    assert f'mapped points {errors.mapped_points * 1e3:.3f} mm RMS over {method.over}' in out
    assert out.splitlines()[-1] == f'wrote {Path("out", "calibration.yaml").absolute()}'


def _check_provenance(found: Calibration, folder: Path) -> None:
    inputs = {entry['path']: entry['sha256'] for entry in found.provenance['inputs']}
    assert str(folder / TABLES[found.method]) in inputs
    assert len(inputs) == (2 if found.method == 'tracker' else 1)
    for path, digest in inputs.items():
        assert hashlib.sha256(Path(path).read_bytes()).hexdigest() == digest
    assert found.provenance['config']['target.type'] == found.method


def test_what_is_written_reads_back_equal(scene: tuple[str, Path], tmp_path: Path) -> None:
    method, read, config = read_configured(*scene)
    found = calibrate(method, read, config)
    calibration_file.write_calibration(found, tmp_path / 'calibration.yaml')
    back = calibration_file.read_calibration(tmp_path / 'calibration.yaml')
    back.provenance.pop('created')
    assert equal(found, back)


def test_compare_shows_every_estimator(scene: tuple[str, Path], handeye: Run,
                                       monkeypatch: pytest.MonkeyPatch) -> None:
    name, folder = scene
    quickly = partial(compare_files, folds=2)
    monkeypatch.setattr('handeye_ros.published.compare.compare_files', quickly)
    code, out, err = handeye('compare', *given(name, folder))
    assert (code, err) == (0, '')
    for estimator in ESTIMATORS[target_of(name)]:
        transform, figures = (row for row in out.splitlines()
                              if row.startswith(f' {estimator.name} '))
        assert 'failed' not in transform and ' - ' not in figures
    assert f'mapped: RMS over {FILE_METHODS[target_of(name)].over}' in out
    assert not Path('out').exists()


@pytest.mark.parametrize('name', EXACT)
def test_without_noise_all_find_the_truth(name: str, handeye: Run, tmp_path: Path) -> None:
    made, folder = EXACT[name](np.random.default_rng(3)), tmp_path / 'exact'
    if made.profiles:
        bag_write.write(folder, made.profiles, made.poses, tables=made.tables, layout='double')
    else:
        folder.mkdir()
        (folder / TABLES[target_of(name)]).write_text(next(iter(made.tables.values())))
    code, _, err = handeye('solve', *given(name, folder), '--out', 'out')
    assert code == 0, err
    found = calibration_file.read_calibration(Path('out', 'calibration.yaml'))
    assert off(found.T_flange_sensor, made.T_flange_sensor) < 1e-6
    method, read, config = read_configured(name, folder)
    comparison = compare_files(method, read, config, made.T_flange_sensor, folds=0)
    assert comparison.refusal is None
    for row in comparison.rows:
        assert row.T_flange_sensor is not None, row.failure
        assert off(row.T_flange_sensor, made.T_flange_sensor) < 1e-6, row.name
        assert row.residual_rms is not None and row.residual_rms < 1e-6


def test_compare_gives_all_the_samples_that_agree(tmp_path: Path) -> None:
    simulated.write('points', 1, tmp_path / 'cell')
    file = tmp_path / 'cell' / 'points.csv'
    header, first, *rest = file.read_text().splitlines()
    wrong = first.replace(first.split(',')[0], '500.0')
    file.write_text('\n'.join([header, wrong, *rest]))
    method, read, config = read_configured('points', tmp_path / 'cell')
    comparison = compare_files(method, read, config, folds=9)
    assert (comparison.used, comparison.rejected) == (9, 1)
    for row in comparison.rows:
        assert row.residual_rms < row.holdout_rms < 1e-4
    found = calibrate(method, read, config)
    assert [sample.used for sample in found.samples] == [False] + 9 * [True]
    assert found.samples[0].stamp == 1
    assert found.samples[0].reason == 'contradicts the others'
    assert found.samples[0].residual > 0.4
    assert (found.quality.samples_used, found.quality.samples_rejected) == (9, 1)
    assert comparison.rows[0].residual_rms == pytest.approx(found.quality.residual_rms)


def test_the_samples_of_the_tracker_are_its_rows_and_the_profiles(tmp_path: Path) -> None:
    simulated.write('small_tracker', 2, tmp_path / 'cell')
    file = tmp_path / 'cell' / 'tracker.csv'
    lines = file.read_text().splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith('face_d'))
    kind, x, y, z = lines[row].split(', ')
    lines[row] = f'{kind}, {float(x) + 3}, {y}, {float(z) - 3}'
    file.write_text('\n'.join(lines))
    method, read, config = read_configured('small_tracker', tmp_path / 'cell')
    found = calibrate(method, read, config)
    (lost,) = [sample for sample in found.samples
               if not (sample.used or sample.edge.startswith('swept'))]
    assert (lost.stamp, lost.edge) == (row, 'face_d')
    kinds = [sample.edge for sample in found.samples]
    assert [kinds.count(kind) for kind in ('arc', 'line', 'face_c', 'face_d')] == [40, 30, 40, 40]
    swept = {sample.stamp for sample in found.samples if sample.edge.startswith('swept')}
    assert kinds.count('swept ball') > 20 < kinds.count('swept faces')
    assert swept <= {profile.stamp for profile in bag.read(tmp_path / 'cell', config).profiles}
    part = method.subset(read.data, np.arange(20, len(kinds)))
    assert list(method.samples(part)) == list(method.samples(read.data))[20:]
    assert len(part.of['arc']) == 20
    assert part.of['arc'].tolist() == list(range(20))


def test_axes_other_than_x_z_turn_the_answer_of_the_tracker(tmp_path: Path) -> None:
    simulated.write('small_tracker', 3, tmp_path / 'cell')
    method, read, config = read_configured('small_tracker', tmp_path / 'cell')
    turned = with_values(config, {'profile.axes': ['y', 'z'], 'tracker.direction': [-1, 0, 0]},
                         'test')
    T, T_turned = (calibrate(method, read, c).T_flange_sensor for c in (config, turned))
    np.testing.assert_allclose(T_turned @ sensor_axes(turned), T, atol=1e-9)
