# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files that cannot be read or carry no answer, and settings that do not fit them."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from command import ROOT
from file_scenes import given, Run, TABLES, target_of
from handeye_ros import orientations
from handeye_ros.cli import simulated
from handeye_ros.config import Config, load, with_values
from handeye_ros.errors import BadValueError, InputError
from handeye_ros.simulate import measured
from handeye_ros.tables import Table
from handeye_ros.tabulated import FILE_METHODS
from handeye_ros.targets import method_for
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def refused(result: tuple[int, str, str], code: int, *words: str) -> None:
    """Check that a run ended with a sentence, and that nothing was answered or written."""
    assert (result[0], result[1]) == (code, ''), result
    assert 'Traceback' not in result[2] and len(result[2].splitlines()) == 1
    for word in words:
        assert word in result[2]
    assert not Path('out').exists()


def edited(name: str, folder: Path, change: Callable[[str], str]) -> tuple[object, ...]:
    """Return the arguments for a scene whose table was changed."""
    simulated.write(name, 1, folder)
    file = folder / TABLES[target_of(name)]
    file.write_text(change(file.read_text()))
    return given(name, folder)


def rows(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    """Return a change of the rows below the header."""
    def changed(text: str) -> str:
        header, *lines = text.splitlines()
        return '\n'.join([header, *change(lines)])
    return changed


def replaced(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(('name', 'change', 'words'), [
    ('points', replaced('camera_x [mm]', 'camera_x'), 'camera_x names no unit; write camera_x'),
    ('points', replaced('base_z [mm]', 'base_z [inch]'), 'base_z has the unit inch'),
    ('points', replaced('base_y', 'bass_y'), 'no column base_y; did you mean bass_y'),
    ('points', rows(lambda lines: []), 'holds no rows'),
    ('points', rows(lambda lines: ['1e30' + lines[0][lines[0].index(','):], *lines]),
     'row 1: camera_x is 1e30, which is beyond all measure'),
    ('hand_eye', replaced('target_qw', 'target_w'), 'has no column target_qw'),
    ('hand_eye', replaced('flange_x [mm]', 'flange_x [deg]'), 'flange_x has the unit deg'),
    ('hand_eye', replaced('flange_qx', 'flange_qx [rad]'), 'flange_qx has the unit rad'),
    ('small_tracker', replaced('x [mm]', 'x'), 'the column x names no unit'),
    ('small_tracker', replaced('arc', 'arch'), 'row 1: kind is "arch", expected arc'),
    ('small_tracker', replaced('ball', 'line'), 'holds 0 points of the kind ball')])
def test_files_that_cannot_be_read_end_with_2(name: str, change: Callable[[str], str],
                                              words: str, handeye: Run, tmp_path: Path) -> None:
    arguments = edited(name, tmp_path / 'cell', change)
    refused(handeye('solve', *arguments), 2, words.replace('did you mean bass_y', 'did you mean'))


@pytest.mark.parametrize(('name', 'change', 'words'), [
    ('points', rows(lambda lines: lines[:3]), 'needs at least 4 points, got 3'),
    ('points', rows(lambda lines: lines[:1] * 10), 'the points lie in one line'),
    ('points', replaced('base_x [mm], base_y [mm], base_z [mm]',
                        'base_x [m], base_y [m], base_z [m]'),
     '1000 times larger they fit: correct the unit'),
    ('hand_eye', rows(lambda lines: lines[:2]), 'needs at least 3 poses, got 2'),
    ('hand_eye', rows(lambda lines: lines[:1] * 5), 'all poses share one orientation'),
    ('hand_eye', replaced('flange_x [mm], flange_y [mm], flange_z [mm]',
                          'flange_x [m], flange_y [m], flange_z [m]'),
     'with positions of the flange in mm the residual falls from'),
    ('hand_eye', replaced('target_x [mm], target_y [mm], target_z [mm]',
                          'target_x [m], target_y [m], target_z [m]'),
     'write their unit in the header, as in target_x [mm]'),
    ('hand_eye', replaced('flange_qx, flange_qy, flange_qz, flange_qw',
                          'flange_qy, flange_qz, flange_qw, flange_qx'),
     'but with flange quaternions as w x y z the residual falls from'),
    ('hand_eye', replaced('target_qx, target_qy, target_qz, target_qw',
                          'target_qy, target_qz, target_qw, target_qx'),
     'but with target quaternions as w x y z the residual falls from'),
    ('small_tracker', rows(lambda lines: lines[:3] * 2 + lines[40:]), 'the arc spans 5.9 degrees'),
    ('small_tracker', rows(lambda lines: lines[:40] + lines[40:70][::-1] + lines[70:]),
     'that the line was measured towards larger readings'),
    ('small_tracker', lambda text: text.replace('face_c', 'x_').replace(
        'face_d', 'face_c').replace('x_', 'face_d'), 'check which face is which')])
def test_files_without_an_answer_end_with_3(name: str, change: Callable[[str], str],
                                            words: str, handeye: Run, tmp_path: Path) -> None:
    refused(handeye('solve', *edited(name, tmp_path / 'cell', change)), 3, words)


@pytest.mark.parametrize('name', ['hand_eye', 'hand_eye_on_base'])
def test_the_wrong_calibration_type_is_named(name: str, handeye: Run, tmp_path: Path) -> None:
    simulated.write(name, 1, tmp_path / 'cell')
    other = 'eye_in_hand' if name == 'hand_eye_on_base' else 'eye_on_base'
    result = handeye('solve', *given(name, tmp_path / 'cell'),
                     '--set', f'calibration_type={other}')
    refused(result, 3, 'with one of the two lists inverted the residual falls from',
            'set calibration_type to the other one')


@pytest.mark.parametrize(('written', 'length', 'words'), [
    ('ur-rotation-vector', 1e3, 'write the unit in the header, as in flange_x [mm]'),
    ('ur-rotation-vector', 1.0, 'set target.angles to ur-rotation-vector')])
def test_the_notation_of_another_controller_is_named(
        written: str, length: float, words: str, handeye: Run, tmp_path: Path) -> None:
    simulated.write('hand_eye', 1, tmp_path / 'cell')
    table = Table(tmp_path / 'cell' / 'poses.csv')
    flange, target = table.poses('flange'), table.poses('target')
    turned = orientations.of(written).numbers(Rotation.from_matrix(flange[:, :3, :3]))
    header = ('flange_x, flange_y, flange_z, flange_rx, flange_ry, flange_rz, target_x [m], '
              'target_y [m], target_z [m], target_qx, target_qy, target_qz, target_qw')
    values = np.hstack([flange[:, :3, 3] * length, turned, target[:, :3, 3],
                        Rotation.from_matrix(target[:, :3, :3]).as_quat()])
    np.savetxt(tmp_path / 'cell' / 'poses.csv', values, delimiter=',', header=header, comments='',
               fmt='%.12g')
    refused(handeye('solve', *given('hand_eye', tmp_path / 'cell'), '--set',
                    'target.angles=staubli'), 3, words)


@pytest.mark.parametrize('eye_on_base', [False, True])
def test_turns_about_one_axis_are_refused(eye_on_base: bool, handeye: Run, tmp_path: Path) -> None:
    made = measured.hand_eye(np.random.default_rng(0), eye_on_base, tilts=(0.0, 0.0, 60.0))
    (tmp_path / 'poses.csv').write_text(made.tables['poses.csv'])
    name = 'hand_eye_on_base' if eye_on_base else 'hand_eye'
    refused(handeye('solve', *given(name, tmp_path)), 3, 'all poses share one rotation axis',
            'about base' if eye_on_base else 'about flange')
    refused(handeye('compare', *given(name, tmp_path)), 3, 'all poses share one rotation axis')


def test_an_answer_beyond_the_limits_is_refused(handeye: Run, tmp_path: Path) -> None:
    simulated.write('points', 1, tmp_path / 'cell')
    arguments = ('solve', *given('points', tmp_path / 'cell'))
    for limit, words in (('translation=1e-6', 'the position along'),
                         ('rotation=1e-6', 'the rotation about')):
        result = handeye(*arguments, '--set', f'limits.{limit}')
        refused(result, 3, words, 'take more points, spread over a larger volume')
    refused(handeye(*arguments, '--set', 'limits.residual=1e-6'), 3, 'samples differ by 0.04')


def test_what_we_refuse_others_may_answer(handeye: Run, tmp_path: Path) -> None:
    simulated.write('points', 1, tmp_path / 'cell')
    code, out, err = handeye('compare', *given('points', tmp_path / 'cell'), '--set',
                             'limits.translation=1e-6')
    assert code == 3 and 'the position along' in err
    assert ' points    failed: the position along' in ' '.join(out.split()).replace(
        'points failed', 'points    failed')
    assert 'Wu 2017' in out


@pytest.mark.parametrize(('settings', 'words'), [
    (('target.type=points', 'calibration_type=eye_in_hand'),
     "calibration_type is 'eye_in_hand', expected eye_on_base with target.type points"),
    (('target.type=tracker', 'calibration_type=eye_on_base'), 'expected eye_in_hand with'),
    (('target.type=points', 'calibration_type=eye_on_base', 'method=plate'),
     "method is 'plate', expected auto or points with target.type points"),
    (('target.type=tracker', 'tracker.direction=[0, 0, 0]'), 'a direction that is not zero'),
    (('target.type=pointz',), "target.type is 'pointz', expected one of plate, line, ")])
def test_settings_that_do_not_fit_end_with_2(settings: tuple[str, ...], words: str, handeye: Run,
                                             tmp_path: Path) -> None:
    simulated.write('small_tracker', 1, tmp_path / 'cell')
    given = [argument for setting in settings for argument in ('--set', setting)]
    for verb in ('solve', 'compare'):
        refused(handeye(verb, tmp_path / 'cell', *given), 2, words)


def test_inputs_that_are_none_end_with_2(handeye: Run, tmp_path: Path) -> None:
    simulated.write('small_tracker', 1, tmp_path / 'cell')
    _, *settings = given('points', tmp_path)
    refused(handeye('solve', 'nowhere.csv', *settings), 2, 'nowhere.csv', 'cannot be read')
    refused(handeye('solve', 'cell', *settings), 2, 'is a folder; give the file in it')
    refused(handeye('solve', 'cell/small_tracker.mcap', *settings), 2, 'cannot be read')
    (tmp_path / 'cell' / 'tracker.csv').unlink()
    refused(handeye('solve', *given('small_tracker', tmp_path / 'cell')), 2,
            'tracker.csv: no such file', 'set tracker.file')
    _, *settings = given('small_tracker', tmp_path)
    refused(handeye('solve', 'nowhere', *settings), 2, 'no such file or folder')


@pytest.mark.parametrize('name', FILE_METHODS)
def test_what_takes_profiles_refuses_them(name: str) -> None:
    with pytest.raises(InputError, match=f'{name} is solved from files, .*: run "handeye '
                       'solve'):
        method_for(load(ROOT / 'config' / f'{name}.yaml'))
    with pytest.raises(BadValueError):
        method_for(with_values(Config(), {'method': name}, 'test'))


def test_a_tracker_without_what_changes_the_answer_by_its_full_size(
        handeye: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    bag = ROOT / 'bags' / 'tracker'
    code, _, said = handeye('solve', bag, '--set', 'target.type=tracker', '--set',
                            'tracker.h1=0.031', '--out', tmp_path / 'out')
    assert code == 2 and 'tracker.h0 and tracker.first_reading must be set' in said
    assert not (tmp_path / 'out').exists()
