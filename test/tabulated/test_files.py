# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets solved from files: the verbs, what is written, and what is refused."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import hashlib
from pathlib import Path
from subprocess import CompletedProcess

from calibrations import equal
import command
from command import assert_refused, ROOT
from handeye_ros import read_bag, se3, tabulated
from handeye_ros.bags import writer
from handeye_ros.cli.simulated import write_simulated
from handeye_ros.compare import compare_files
from handeye_ros.config import load, with_assignments, with_values
from handeye_ros.csv_tables import CsvTable
from handeye_ros.errors import DataError, InputError
from handeye_ros.frames import T_sensor_plane
from handeye_ros.results import calibration_file
from handeye_ros.results.truth import errors_against, true_transform
from handeye_ros.simulate import FILE_SCENES, tables
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.tabulated import FILE_TARGETS
from handeye_ros.tabulated.problem import calibrate_table, TableProblem
import numpy as np
import pytest
from quick import long_run
from scipy.spatial.transform import Rotation

TABLES = {'points': 'points.csv', 'hand_eye': 'poses.csv', 'tracker': 'tracker.csv'}
Run = Callable[..., CompletedProcess[str]]


@pytest.fixture
def handeye(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Return what runs the command in the folder of the test, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return partial(command.handeye, cwd=tmp_path)


def target_of(name: str) -> str:
    return next(target for target in FILE_TARGETS if target in name)


def given(name: str, folder: Path) -> tuple[object, ...]:
    """Return the arguments that solve or compare what is in the folder of a scene."""
    target = target_of(name)
    where = 'eye_on_base' if name in ('points', 'hand_eye_on_base') else 'eye_in_hand'
    return (folder if target == 'tracker' else folder / TABLES[target], '--config',
            ROOT / 'config' / f'{target}.yaml', '--set', f'calibration_type={where}')


PERFECT = SensorModel(columns=640, rate=10.0, noise=1e-9, mixed=0.0, lost=0.0, lost_at_edge=0.0,
                      outliers=0.0, rim_bias=0.0)
EXACT: dict[str, Callable[[np.random.Generator], tables.SimulatedFiles]] = {
    'points': lambda rng: tables.points(rng, 0.0, 4),
    'hand_eye': lambda rng: tables.hand_eye(rng, noise=0.0, count=5),
    'hand_eye_on_base': lambda rng: tables.hand_eye(rng, True, 0.0),
    'tracker': lambda rng: tables.laser_tracker(rng, PERFECT, 0.0, 0.0)}


def read_configured(name: str, folder: Path) -> TableProblem:
    """Return what is read of a scene in a folder."""
    path, _, file, _, assignment = map(str, given(name, folder))
    return tabulated.read_table(Path(path), with_assignments(load(Path(file)), [assignment]))


@pytest.mark.parametrize('name', [
    *(name for name in FILE_SCENES if 'tracker' not in name), *long_run('small_tracker')])
def test_solve_answers_near_the_truth_and_says_how_near(name, handeye, tmp_path):
    folder, table = tmp_path / 'cell', TABLES[target_of(name)]
    for seed, options, expected in ((2, (), 0), (1, (), 2), (1, ('--force',), 0)):
        run = handeye('simulate', name, folder, '--seed', seed, *options)
        assert run.returncode == expected and (table in run.stdout or expected)
    run = handeye('solve', *given(name, folder), '--out', 'out')
    assert (run.returncode, run.stderr) == (0, '')
    calibration = calibration_file.read_calibration(Path('out', 'calibration.yaml'))
    T_true = true_transform(folder)
    assert T_true is not None
    delta = se3.difference(calibration.T_flange_sensor, T_true)
    assert delta @ np.linalg.solve(calibration.covariance, delta) < 25
    assert (calibration.method, calibration.parent_frame, calibration.child_frame) == (
        target_of(name), 'base' if name in ('points', 'hand_eye_on_base') else 'flange',
        'laser' if 'tracker' in name else 'camera')
    assert calibration.quality.residual_rms < calibration.quality.holdout_rms < 3e-4
    lost = [sample for sample in calibration.samples if not sample.used]
    # one profile of the sweep in fifty may be taken for one that contradicts the others
    assert len(lost) <= len(calibration.samples) / 50
    assert all(sample.edge.startswith('swept') for sample in lost)
    inputs = {entry['path']: entry['sha256'] for entry in calibration.provenance['inputs']}
    assert str(folder / table) in inputs
    assert len(inputs) == (2 if calibration.method == 'tracker' else 1)
    for path, digest in inputs.items():
        assert hashlib.sha256(Path(path).read_bytes()).hexdigest() == digest
    read = read_configured(name, folder)
    errors = errors_against(calibration.T_flange_sensor, T_true, read.error_points())
    mapped = f'mapped points {errors.mapped_points * 1e3:.3f} mm RMS over '
    assert mapped + read.error_points_text in run.stdout
    calibration.provenance.pop('created')
    assert equal(calibration, calibrate_table(read))


@pytest.mark.parametrize('name', [
    'points', 'hand_eye', *long_run('hand_eye_on_base', 'tracker')])
def test_without_noise_all_find_the_truth(name: str, handeye: Run, tmp_path: Path) -> None:
    cell, folder = EXACT[name](np.random.default_rng(3)), tmp_path / 'exact'
    if cell.profiles:
        writer.write(folder, cell.profiles, cell.poses, texts=cell.tables, dtype='f8')
    else:
        folder.mkdir()
        (folder / TABLES[target_of(name)]).write_text(next(iter(cell.tables.values())))
    run = handeye('solve', *given(name, folder), '--out', 'out')
    assert run.returncode == 0, run.stderr
    calibration = calibration_file.read_calibration(Path('out', 'calibration.yaml'))
    answers = [('solve', calibration.T_flange_sensor)]
    if name != 'tracker':
        comparison = compare_files(read_configured(name, folder), cell.T_flange_sensor, folds=0)
        assert comparison.refusal is None
        answers += [(row.name, row.T_flange_sensor) for row in comparison.rows]
    for row, X in answers:
        assert X is not None, row
        limit = 5e-6 if name == 'tracker' else 1e-6  # the mean of an arc's bin is inside the arc
        assert np.abs(se3.difference(X, cell.T_flange_sensor)).max() < limit, row


def test_a_wrong_row_is_dropped_and_reported(tmp_path: Path) -> None:
    write_simulated('points', 1, tmp_path / 'cell')
    file = tmp_path / 'cell' / 'points.csv'
    header, row, *rest = file.read_text().splitlines()
    file.write_text('\n'.join([header, row.replace(row.split(',')[0], '500.0'), *rest]))
    read = read_configured('points', tmp_path / 'cell')
    comparison = compare_files(read, folds=9)
    assert (comparison.used, comparison.rejected) == (9, 1)
    assert all(row.figures['residual_rms'] < row.figures['holdout_rms'] < 1e-4
               for row in comparison.rows)
    calibration = calibrate_table(read)
    assert [sample.used for sample in calibration.samples] == [False] + 9 * [True]
    first = calibration.samples[0]
    assert (first.stamp, first.reason) == (1, 'contradicts the others')
    assert first.residual > 0.4


@pytest.mark.thorough
def test_the_samples_of_the_tracker_are_its_rows_and_the_profiles(tmp_path: Path) -> None:
    write_simulated('small_tracker', 2, tmp_path / 'cell')
    file = tmp_path / 'cell' / 'tracker.csv'
    text = file.read_text()
    lines = text.splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith('face_d'))
    kind, x, y, z = lines[row].split(',')
    lines[row] = f'{kind}, {float(x) + 3}, {y}, {float(z) - 3}'
    file.write_text('\n'.join(lines))
    with pytest.raises(DataError, match=f'face_d of row {row}, by .* or leave that row out'):
        calibrate_table(read_configured('small_tracker', tmp_path / 'cell'))
    file.write_text(text)
    read = read_configured('small_tracker', tmp_path / 'cell')
    with pytest.raises(InputError, match='one estimator alone: use "handeye solve"'):
        compare_files(read)
    calibration = calibrate_table(read)
    kinds = [sample.edge for sample in calibration.samples]
    assert [kinds.count(kind) for kind in ('arc', 'line', 'face_c', 'face_d')] == [40, 30, 40, 40]
    swept = {sample.stamp for sample in calibration.samples if sample.edge.startswith('swept')}
    assert kinds.count('swept_ball') > 20 < kinds.count('swept_face_c')
    config = read.config
    assert swept <= {profile.stamp for profile in read_bag(tmp_path / 'cell', config).profiles}
    turned = with_values(config, {'profile.axes': ['y', 'z'], 'tracker.direction': [-1, 0, 0]},
                         'test')
    T_turned = calibrate_table(replace(read, config=turned)).T_flange_sensor
    T = calibration.T_flange_sensor
    np.testing.assert_allclose(T_turned @ T_sensor_plane(turned), T, atol=1e-9)


def refused(run: CompletedProcess[str], code: int, *words: str) -> None:
    """Check that a run ended with a sentence, and that nothing was answered or written."""
    assert_refused(run, code, *words)
    assert len(run.stderr.splitlines()) == 1 and not Path('out').exists()


def rows(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    """Return a change of the rows below the header."""
    def changed(text: str) -> str:
        header, *lines = text.splitlines()
        return '\n'.join([header, *change(lines)])
    return changed


def replaced(*pairs: tuple[str, str]) -> Callable[[str], str]:
    def changed(text: str) -> str:
        for old, new in pairs:
            text = text.replace(old, new)
        return text
    return changed


def in_unit(prefix: str, unit: str, *others: str) -> Callable[[str], str]:
    return replaced(*((f'{name}_{axis} [mm]', f'{name}_{axis} [{unit}]')
                      for name in (prefix, *others) for axis in 'xyz'))


def numbered(row: str, count: int = 6) -> list[str]:
    return [row.format(k) for k in range(count)]


def shifted(lines: list[str]) -> list[str]:
    """Return rows with the points of the robot one row later."""
    values = [line.split(',') for line in lines]
    return [','.join(row[:3] + later[3:]) for row, later in zip(values, values[1:], strict=False)]


def in_order(prefix: str, order: str) -> Callable[[str], str]:
    """Return a change of the names of the columns of quaternions, which are x y z w."""
    return replaced(*((f'{prefix}_q{old}', f'{prefix}_Q{new}')
                      for old, new in zip('xyzw', order, strict=True)), ('_Q', '_q'))


INVERTED = 'set calibration_type to the other one, or, if it is right, give the flange'


@pytest.mark.parametrize(('name', 'change', 'code', 'words'), [
    ('points', replaced(('camera_x [mm]', 'camera_x')), 2, 'camera_x names no unit; write'),
    ('small_tracker', replaced(('arc', 'arch')), 2, 'row 1: kind is "arch", expected arc'),
    ('small_tracker', replaced(('ball', 'line')), 2, 'holds 0 points of the kind ball'),
    ('points', rows(lambda lines: lines[:3]), 3, 'needs at least 4 points, got 3'),
    ('points', rows(lambda lines: numbered(lines[0].rpartition(',')[0] + ',{}')), 3,
     'the points lie in one line'),
    ('points', rows(lambda lines: lines + lines[2:4]), 3,
     '2 rows repeat others to the last digit, first row 11: the answer would seem'),
    ('points', in_unit('camera', 'm', 'base'), 3,
     'of camera_x, camera_y, camera_z and base_x, base_y, base_z'),
    ('points', in_unit('camera', 'um', 'base'), 3, 'from the origin, those of the '),
    ('hand_eye', in_unit('target', 'm', 'flange'), 3, 'from the origin, those of the '),
    ('hand_eye', in_unit('target', 'um', 'flange'), 3, 'target_z and flange_x, flange_y'),
    ('points', replaced(('camera_x', 'camera_Y'), ('camera_y', 'camera_x'), ('_Y', '_y')), 3,
     'with one of the two lists mirrored they agree to 0.0'),
    ('points', rows(shifted), 3, 'of 9 that agree best differ by '),
    ('points', in_unit('base', 'm'), 3, 'of the base 1000 times smaller they agree'),
    ('hand_eye', rows(lambda lines: lines[:4]), 3, 'needs at least 5 poses, got 4'),
    ('hand_eye', rows(lambda lines: numbered('{},' + lines[0].partition(',')[2])), 3,
     'all poses share one orientation'),
    ('hand_eye', in_unit('flange', 'um'), 3, 'of the flange 1000 times larger they agree'),
    ('hand_eye', in_order('flange', 'yzwx'), 3, 'flange quaternions as w x y z they agree'),
    ('hand_eye', lambda text: in_order('flange', 'yzwx')(in_order('target', 'yzwx')(text)), 3,
     'with flange and target quaternions as w x y z they agree'),
    ('hand_eye', replaced(*((f'flange_{old}', f'flange_{new}') for old, new in (
        ('qx', 'rx'), ('qy', 'ry'), ('qz', 'rz')))), 2, '--angles ur-rotation-vector or '
     'staubli-rxryrz or yaskawa-rxryrz reads'),
    ('small_tracker', rows(lambda lines: sorted(lines[:3] * 2, key=lines.index) + lines[40:]), 3,
     'measure a longer arc'),
    ('hand_eye calibration_type=eye_on_base', str, 3, INVERTED),
    ('hand_eye_on_base calibration_type=eye_in_hand', str, 3, INVERTED), *long_run(
        ('points', in_unit('camera', 'm'), 3, 'of the camera 1000 times smaller they agree'),
        ('hand_eye', in_unit('flange', 'm'), 3, 'of the flange 1000 times smaller they agree'),
        ('hand_eye', in_unit('target', 'm'), 3, 'of the target 1000 times smaller they agree'),
        ('hand_eye_on_base', in_order('flange', 'yzwx'), 3, 'flange quaternions as w x y z'),
        ('hand_eye', in_order('target', 'yzwx'), 3, 'target quaternions as w x y z they agree'),
        ('small_tracker', rows(lambda lines: lines[:40] + lines[40:70][::-1] + lines[70:]), 3,
         'that the line was measured towards larger readings'),
        ('small_tracker', replaced(('face_c', 'x_'), ('face_d', 'face_c'), ('x_', 'face_d')), 3,
         'check which face is which'),
        ('small_tracker', replaced(('[mm]', '[m]')), 3,
         'by more than a metre: measure again or leave that row out, and check which face'))])
def test_files_without_an_answer_are_refused_in_a_sentence(
        name, change, code, words, handeye, tmp_path):
    name, *settings = name.split()
    write_simulated(name, 1, tmp_path / 'cell')
    file = tmp_path / 'cell' / TABLES[target_of(name)]
    file.write_text(change(file.read_text()))
    refused(handeye('solve', *given(name, tmp_path / 'cell'),
                    *(word for setting in settings for word in ('--set', setting))), code, words)


NUMBERS: dict[str, Callable[[Rotation], np.ndarray]] = {
    'vector': Rotation.as_rotvec, 'xyz': partial(Rotation.as_euler, seq='xyz'),
    'zyx': partial(Rotation.as_euler, seq='ZYX')}


@pytest.mark.parametrize(('written', 'unit', 'length', 'columns', 'angles', 'words'), [
    ('vector', 'rad', 'm', 'rx ry rz', 'staubli', 'set target.angles to ur-rotation-vector'),
    ('zyx', 'deg', 'm', 'roll[deg] pitch[deg] yaw[deg]', '', 'kuka-abc and name the columns'),
    *long_run(
        ('vector', 'rad', 'm', 'a b c', 'kuka', 'the columns flange_rx, flange_ry, flange_rz'),
        ('xyz', 'deg', 'mm', 'rx ry rz', 'ur', 'set target.angles to yaskawa-rxryrz'),
        ('xyz', 'deg', 'mm', 'a b c', 'kuka', 'with the flange written as fanuc-wpr they agree'))])
def test_the_notation_of_a_controller_is_named(
        written, unit, length, columns, angles, words, handeye, tmp_path):
    write_simulated('hand_eye', 1, tmp_path / 'cell')
    table = CsvTable(tmp_path / 'cell' / 'poses.csv')
    flange, target = table.poses('flange'), table.poses('target')
    turned = NUMBERS[written](Rotation.from_matrix(flange[:, :3, :3]))
    of_length = '' if angles else ' [m]'
    header = ', '.join([*(f'flange_{axis}{of_length}' for axis in 'xyz'),
                        *(f'flange_{column}' for column in columns.split()),
                        *(f'target_{axis} [m]' for axis in 'xyz'),
                        'target_qx, target_qy, target_qz, target_qw'])
    values = np.hstack([flange[:, :3, 3] * (1e3 if length == 'mm' else 1.0),
                        np.degrees(turned) if unit == 'deg' else turned, target[:, :3, 3],
                        Rotation.from_matrix(target[:, :3, :3]).as_quat()])
    np.savetxt(tmp_path / 'cell' / 'poses.csv', values, delimiter=',', header=header, comments='',
               fmt='%.12g')
    line = ['solve', *given('hand_eye', tmp_path / 'cell'),
            *(('--angles', angles) if angles else ())]
    refused(handeye(*line), 3, words)
    if angles_key := words.partition('set target.angles to ')[2]:
        assert handeye(*line, '--set', f'target.angles={angles_key}').returncode == 0


@pytest.mark.parametrize('seed', [8, 12, 19])
def test_one_orientation_is_no_misreading(seed: int, handeye: Run, tmp_path: Path) -> None:
    # angles in the other unit are as noisy as small turns
    cell = tables.hand_eye(np.random.default_rng(seed), noise=4.0, tilts=(0.0, 0.0, 0.0))
    (tmp_path / 'poses.csv').write_text(cell.tables['poses.csv'])
    T = CsvTable(tmp_path / 'poses.csv').poses('flange')
    abc = Rotation.from_matrix(T[:, :3, :3]).as_euler('ZYX', degrees=True)
    header, *lines = cell.tables['poses.csv'].splitlines()
    text = ['flange_a,flange_b,flange_c,' + header, *(
        ','.join([*map(str, angles), line]) for angles, line in zip(abc, lines, strict=True))]
    (tmp_path / 'poses.csv').write_text('\n'.join(text))
    refused(handeye('solve', *given('hand_eye', tmp_path), '--set', 'target.angles=kuka'), 3,
            'all poses share one orientation')


@pytest.mark.parametrize('eye_on_base', [False, True])
def test_turns_about_one_axis_are_refused(eye_on_base: bool, handeye: Run, tmp_path: Path) -> None:
    cell = tables.hand_eye(np.random.default_rng(0), eye_on_base, tilts=(0.0, 0.0, 60.0))
    (tmp_path / 'poses.csv').write_text(cell.tables['poses.csv'])
    name = 'hand_eye_on_base' if eye_on_base else 'hand_eye'
    refused(handeye('solve', *given(name, tmp_path)), 3, 'all poses share one rotation axis',
            'the position along it is free', 'about base' if eye_on_base else 'about flange')
    refused(handeye('compare', *given(name, tmp_path)), 3, 'all poses share one rotation axis')


def test_an_answer_beyond_the_limits_is_refused_and_others_may_answer(handeye, tmp_path):
    write_simulated('points', 1, tmp_path / 'cell')
    arguments = given('points', tmp_path / 'cell')
    for limit, words in (('translation', 'the position along'), ('rotation', 'the rotation about'),
                         ('residual', 'samples differ by 0.04')):
        refused(handeye('solve', *arguments, '--set', f'limits.{limit}=1e-6'), 3, words)
    run = handeye('compare', *arguments, '--set', 'limits.translation=1e-6')
    assert run.returncode == 3 and 'the position along' in run.stderr
    assert 'points failed: the position along' in ' '.join(run.stdout.split())
    assert 'Wu 2017' in run.stdout


@pytest.mark.parametrize(('settings', 'words'), [
    (('target.type=points', 'calibration_type=eye_in_hand'),
     "calibration_type is 'eye_in_hand', expected eye_on_base with target.type points"),
    (('target.type=tracker', 'calibration_type=eye_on_base'), 'expected eye_in_hand with'),
    (('target.type=points', 'calibration_type=eye_on_base', 'method=plate'),
     "method is 'plate', expected auto or points with target.type points"),
    (('target.type=tracker', 'tracker.direction=[0, 0, 0]'), 'a direction that is not zero'),
    (('target.type=tracker', 'tracker.h1=0.031'),
     'tracker.h0 and tracker.first_reading must be set'),
    (('target.type=pointz',), "target.type is 'pointz', expected one of plate, line, ")])
def test_settings_that_do_not_fit_end_with_2(settings, words, handeye):
    assignments = [argument for setting in settings for argument in ('--set', setting)]
    for verb in ('solve', 'compare'):
        refused(handeye(verb, ROOT / 'bags' / 'tracker', *assignments), 2, words)


def test_inputs_that_are_none_end_with_2(handeye: Run, tmp_path: Path) -> None:
    write_simulated('small_tracker', 1, tmp_path / 'cell')
    _, *settings = given('points', tmp_path)
    refused(handeye('solve', 'nowhere.csv', *settings), 2, 'nowhere.csv', 'cannot be read')
    refused(handeye('solve', 'cell/tracker.csv', '--set', 'target.type=pointz'), 2,
            'target.type pointz is not solved from one')
    refused(handeye('solve', 'cell/small_tracker.mcap', *settings), 2, 'cannot be read')
    (tmp_path / 'cell' / 'tracker.csv').unlink()
    refused(handeye('solve', *given('small_tracker', tmp_path / 'cell')), 2,
            'tracker.csv: no such file', 'set tracker.file')
