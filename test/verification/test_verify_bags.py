# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every routine on recordings of rendered profiles, from the bag to the verdict."""
from __future__ import annotations

from dataclasses import replace

from command import assert_refused, handeye
from handeye_ros import se3
from handeye_ros.bags import bag_write
from handeye_ros.cli import command
from handeye_ros.config import Config, flatten
from handeye_ros.errors import InputError
from handeye_ros.results import verification_file
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.simulate import simulate
from handeye_ros.simulate.measuring import measuring_cell
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.verification.routines import ROUTINES
import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner
from verifications import bench, stated
import yaml

WRONG = np.array([6e-4, -6e-4, 6e-4, 5e-3, 5e-3, 5e-3])  # 1 mm and 0.5 degrees


def options(name, made):
    """Return what the command is told of the artefact."""
    keys = {'lengths': list(map(float, made.lengths))}
    if name in ('sphere', 'ball_bar'):
        keys['radius'] = bench.RADIUS
    if name == 'point':
        keys |= {'reference': list(map(float, made.reference)), 'aim': bench.FINE_AIM}
    return [word for key, value in keys.items() for word in ('--set', f'verify.{key}={value}')]


def within(result):
    """Tell whether the values, or the RMS, lie in their 95 % region."""
    if not result['freedom']:
        return result['scatter']['rms'] <= result['scatter']['expected']
    return result['region'] <= chi2.ppf(0.95, result['freedom'])


def verdicts(name, seed, folder):
    """Return what `handeye verify` says of a right calibration, and of a wrong one."""
    rng = np.random.default_rng(seed)
    made = bench.RENDERED[name](rng)
    bags = [folder / f'bag_{k}' for k in range(len(made.passes))]
    for bag, part in zip(bags, made.passes, strict=True):
        bag_write.write(bag, part.profiles, part.poses)
    X = se3.perturb(made.T_flange_sensor, bench.STD * rng.normal(size=6))
    for T, file in ((X, 'right'), (se3.perturb(X, WRONG), 'wrong')):
        write_calibration(stated(T, provenance={'config': flatten(Config(noise=bench.NOISE))}),
                          folder / f'{file}.yaml')
        run = CliRunner().invoke(command(), [
            'verify', name, *map(str, bags), '--calibration', str(folder / f'{file}.yaml'),
            '--out', str(folder / 'told.yaml'), *options(name, made)])
        assert run.exit_code == {'right': 0, 'wrong': 1}[file], (run.output, run.exception)
        yield yaml.safe_load((folder / 'told.yaml').read_text())


def test_every_routine_has_recordings():
    assert bench.RENDERED.keys() == ROUTINES.keys()


@pytest.mark.parametrize('name', bench.RENDERED)
def test_on_bags(tmp_path, name):
    right, wrong = verdicts(name, 2, tmp_path)
    assert within(right), right
    assert right['verdict'] == 'pass', right['reasons']
    assert wrong['verdict'] == 'fail'


def test_the_report_shows_verifications(tmp_path):
    *_, result = verdicts('sphere', 2, tmp_path)
    found = verification_file.read(tmp_path / 'told.yaml')
    title = f'sphere: {result["verdict"].upper()}, {result["stations"]} stations'
    assert found == result
    run = CliRunner().invoke(command(), [
        'report', str(tmp_path / 'right.yaml'), '--verification', str(tmp_path / 'told.yaml'),
        '--out', str(tmp_path / 'r.html')])
    assert run.exit_code == 0, (run.output, run.exception)
    page = (tmp_path / 'r.html').read_text()
    assert title in page and all(reason in page for reason in result['reasons'])
    assert dict(verification_file.rows_of(found))['radius'][0] in page
    run = CliRunner().invoke(command(), ['report', str(tmp_path / 'told.yaml')])
    assert run.exit_code == 0, (run.output, run.exception)
    assert 'ISO 14253-1' in (tmp_path / 'told.html').read_text()
    for text, words in (('format: handeye_ros/calibration/1', 'expected handeye_ros/verif'),
                        (f'format: {verification_file.FORMAT}', 'not the whole result'),
                        ('format: handeye_ros/verification/2', 'newer than this'),
                        ('[1]', 'no result of'), ('{', 'not valid YAML')):
        (tmp_path / 'told.yaml').write_text(text)
        with pytest.raises(InputError, match=words):
            verification_file.read(tmp_path / 'told.yaml')


@pytest.mark.thorough
def test_a_cell_is_calibrated_verified_and_measures_a_gauge(tmp_path):
    cell = measuring_cell(np.random.default_rng(0), columns=640)
    for name, recording in cell.recordings.items():
        bag_write.write(tmp_path / name, recording.profiles, recording.poses)
    passes = sorted(name for name in cell.recordings if name.startswith('pass_'))
    run = handeye('solve', 'plate', '--out', 'cal', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    known = ('--calibration', 'cal/calibration.yaml', '--out', 'v.yaml')
    run = handeye('verify', 'ball_bar', 'ball_1', 'ball_2', *known, '--set',
                  f'verify.radius={cell.ball_radius}', '--set', f'verify.lengths=[{cell.bar}]',
                  cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    result = yaml.safe_load((tmp_path / 'v.yaml').read_text())
    assert result['verdict'] == 'pass'
    assert abs(result['quantities'][2]['value'] - cell.bar) < 1e-4
    run = handeye('verify', 'tooth', *passes, *known, '--set',
                  f'verify.lengths=[{cell.gauge.pitch}, {cell.gauge.height}]', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    result = yaml.safe_load((tmp_path / 'v.yaml').read_text())
    assert result['verdict'] == 'pass'
    pitch, height = (quantity['value'] for quantity in result['quantities'])
    assert abs(pitch - cell.gauge.pitch) < 2e-5
    assert abs(height - cell.gauge.height) < 2e-5


@pytest.mark.thorough
def test_the_verb_on_rendered_profiles(tmp_path):
    scenario = replace(SCENARIOS['small_sphere'], stations=(10, 0))
    made = simulate(scenario, np.random.default_rng(3))
    X = made.truth.T_flange_sensor
    bag_write.write(tmp_path / 'ball', made.profiles, made.poses)
    for name, T in (('right', X), ('wrong', se3.perturb(X, np.array([1e-3, 0, 0, 0, 0.009, 0])))):
        write_calibration(bench.calibration(T, np.diag(bench.STD ** 2)), tmp_path / f'{name}.yaml')
        run = handeye('verify', 'sphere', 'ball', '--calibration', f'{name}.yaml', '--set',
                      f'verify.radius={1e3 * scenario.target.radius} mm', '--out', 'v.yaml',
                      '--stations', 's.csv', cwd=tmp_path)
        assert run.returncode == {'right': 0, 'wrong': 1}[name], run.stderr
        result = yaml.safe_load((tmp_path / 'v.yaml').read_text())
        assert result['verdict'] == {'right': 'pass', 'wrong': 'fail'}[name]
        assert result['inputs'] == ['ball']
        assert len((tmp_path / 's.csv').read_text().splitlines()) == 1 + len(result['per_station'])
        assert run.stdout.splitlines()[0].startswith(f'sphere: {result["verdict"].upper()}')
    run = handeye('verify', 'ball_bar', 'ball', '--calibration', 'right.yaml', cwd=tmp_path)
    assert_refused(run, 2, 'ball_bar needs 2 bags, and got 1')
    run = handeye('verify', 'sphere', 'ball', '--calibration', 'right.yaml', '--set',
                  'verify.tolerance=300 mm', cwd=tmp_path)
    assert run.returncode == 0 and 'the tolerance is 300 mm' in run.stdout
    run = handeye('verify', 'cube', 'ball', '--calibration', 'right.yaml', cwd=tmp_path)
    assert_refused(run, 2, 'no routine "cube"')
    run = handeye('verify', 'sphere', 'ball', '--calibration', 'none.yaml', cwd=tmp_path)
    assert_refused(run, 2, 'none.yaml')
