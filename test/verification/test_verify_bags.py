# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every routine on recordings of rendered profiles, from the bag to the verdict; sweeps."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import pipeline, se3
from handeye_ros.bags import writer
from handeye_ros.cli import command
from handeye_ros.config import Config, flatten, with_values
from handeye_ros.data import ClockEstimate
from handeye_ros.errors import DataError, InputError
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.simulate import SCENARIOS, settings, simulate
from handeye_ros.simulate.scenario import Sweep
from handeye_ros.verification import result_file
from handeye_ros.verification.routines import ROUTINES
from handeye_ros.verification.stations import stations_of
from handeye_ros.verification.verify import verify_stations
import numpy as np
import pytest
from quick import long_run
from scipy.stats import chi2
from typer.testing import CliRunner
from verifications import bench, bench_calibration
import yaml

WRONG = np.array([6e-4, -6e-4, 6e-4, 5e-3, 5e-3, 5e-3])  # 1 mm and 0.5 degrees
QUICK = 'point', 'sphere', 'ball_bar'


def output_of(*words, exit_code=0):
    run = CliRunner().invoke(command(), list(map(str, words)))
    assert run.exit_code == exit_code, (run.output, run.exception)
    return run.output


def options(name, artefact):
    """Return what the command is told of the artefact."""
    keys = {'lengths': list(map(float, artefact.lengths))}
    if name in ('sphere', 'ball_bar'):
        keys['radius'] = f'{1e3 * bench.RADIUS} mm'
    if name == 'point':
        keys |= {'reference': list(map(float, artefact.reference)), 'aim': bench.FINE_AIM}
    return [word for key, value in keys.items() for word in ('--set', f'verify.{key}={value}')]


def within(result):
    """Tell whether the values, or the distances, lie in their 95 % region."""
    if not result['freedom']:
        return result['scatter']['p'] > 0.05
    return result['region'] <= chi2.ppf(0.95, result['freedom'])


@pytest.mark.parametrize('name', [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.thorough)
    for name in ROUTINES])
def test_a_routine_passes_the_right_calibration_and_fails_a_wrong_one(tmp_path, name):
    rng = np.random.default_rng(2)
    artefact = bench.RENDERED[name](rng)
    bags = [tmp_path / f'bag_{k}' for k in range(len(artefact.passes))]
    for bag, part in zip(bags, artefact.passes, strict=True):
        writer.write(bag, part.profiles, part.poses)
    X = se3.perturb(artefact.T_flange_sensor, bench.STD * rng.normal(size=6))
    results = []
    for T, exit_code in ((X, 0), (se3.perturb(X, WRONG), 1)):
        provenance = {'config': flatten(Config(noise=bench.NOISE))}
        write_calibration(bench_calibration(T, provenance=provenance),
                          tmp_path / 'calibration.yaml')
        stdout = output_of('verify', name, *bags, '--calibration', tmp_path, '--out',
                           tmp_path / 'told.yaml', *options(name, artefact),  # or its file
                           exit_code=exit_code)
        results.append(yaml.safe_load((tmp_path / 'told.yaml').read_text()))
        assert stdout.startswith(f'{name}: {results[-1]["verdict"].upper()}')
    right, wrong = results
    assert within(right) and (right['verdict'], wrong['verdict']) == ('pass', 'fail')
    assert wrong['inputs'] == list(map(str, bags)) and wrong['recorded']
    assert len(wrong['per_station']) >= len(bags)
    if name == 'sphere':
        reported(tmp_path, wrong)


def reported(folder, result):
    """Expect the result as a protocol."""
    output_of('report', folder / 'told.yaml')
    page = (folder / 'told.html').read_text()
    assert f'sphere: FAIL, {result["stations"]} stations' in page and 'ISO 14253-1' in page
    assert all(reason in page for reason in result['reasons'])
    assert dict(result_file.table_rows(result))['radius'][0] in page
    parts = [{name: value for name, value in result.items() if name != missing}
             for missing in ('says', 'weakest_direction', 'per_station')]
    for damaged in (*parts, result | {'smallest_error': 10**400}):
        (folder / 'part.yaml').write_text(yaml.safe_dump(damaged))
        with pytest.raises(InputError, match='not the whole result of a verification'):
            result_file.protocol_of(folder / 'part.yaml')


@pytest.mark.parametrize(('text', 'words'), [
    (f'format: {result_file.FORMAT}', 'not the whole result'),
    ('format: handeye_ros/verification/2', 'newer than this'),
    ('{', 'not valid YAML')])
def test_files_of_no_verification_are_refused(tmp_path, text, words):
    (tmp_path / 'told.yaml').write_text(text)
    with pytest.raises(InputError, match=words):
        result_file.protocol_of(tmp_path / 'told.yaml')


def sweep(target, calibrated, knot, delay, **values):
    """Return the samples of a sweep in which the profiles come late, calibration and settings."""
    base, routine = SCENARIOS[target], ROUTINES[target]
    scenario = replace(base, stops=(8, 0), sweep=Sweep(knot=knot), **values,
                       sensor=replace(base.sensor, columns=320, delay=delay))
    recording = simulate(scenario, np.random.default_rng(5))
    config = routine.settings(with_values(Config(), settings(scenario) | {
        'sampling.mode': 'moving', 'time_offset': calibrated,
        'verify.radius': float(getattr(scenario.target, 'radius', 0.0))}, 'a test'), 1)
    calibration = bench_calibration(recording.truth.T_flange_sensor, target,
                                    {'config': flatten(config)}, ClockEstimate(calibrated, 2e-5))
    stamped = [replace(p, stamp=p.stamp + round(calibrated * 1e9)) for p in recording.profiles]
    return pipeline.gather(stamped, recording.poses, config).samples, calibration, config


def swept(target, *given, **values):
    """Return the verification of such a sweep."""
    samples, calibration, config = sweep(target, *given, **values)
    stations = stations_of(ROUTINES[target], [samples], calibration, config)
    return verify_stations(ROUTINES[target], stations, calibration)


@pytest.mark.parametrize('target', [
    'sphere', *long_run('line')])
def test_a_sweep_is_measured_at_the_time_offset_of_the_calibration(target):
    result = swept(target, 0.020, 0.9, -0.020)
    assert result.verdict == 'pass' and result.fit.scatter.rms < 1e-4
    with pytest.raises(DataError, match='of a sweep, that the clocks are as they were'):
        swept(target, 0.010, 0.9, -0.020)


def test_profiles_of_a_sweep_that_show_another_edge_do_not_refuse_it():
    assert swept('line', -0.15, 4.0, 0.15).verdict == 'pass'


def test_each_face_of_a_step_is_swept_by_itself():
    samples, calibration, config = sweep('plane', 0.02, 0.9, -0.02)
    stations = stations_of(ROUTINES['step'], [samples, samples], calibration, replace(
        config, verify=replace(config.verify, lengths=(0.02,))))
    assert stations.counts[0] == stations.counts[1] > 10
