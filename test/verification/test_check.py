# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Does a calibration still hold: what moved is named, and chance is not taken for a change."""
from __future__ import annotations

from dataclasses import replace

from command import assert_refused, handeye
from handeye_ros import pipeline, se3, trend
from handeye_ros.bags import bag_write
from handeye_ros.data import SampleReport
from handeye_ros.errors import DataError, InputError
from handeye_ros.results.calibration_file import read_calibration, write_calibration
from handeye_ros.simulate import gauges, simulate
from handeye_ros.simulate.scenario import RobotModel
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.verification.check import check
import numpy as np
import pytest
from verifications import bench, stated
import yaml


@pytest.fixture(scope='module')
def calibrated():
    """Return for each kind of target what was calibrated: scenario, config, calibration, X, T."""
    found = {}
    for kind in bench.TARGETS:
        rng = np.random.default_rng(7)
        scenario, config, X, T = bench.cell(kind, rng)
        solved = pipeline.solve(bench.samples(scenario, 18, X, T, rng), [], config, 'laser')
        found[kind] = scenario, config, solved, X, T
    return found


def said(calibrated, kind, change, seed):
    return bench.one_check(change, *calibrated[kind], np.random.default_rng(seed))


def checked(calibrated, kind, count=8, moved=(0.0, 0.0, 0.0), **scenario):
    """Return the check of a cell whose target has moved, or that is otherwise another."""
    cell, config, solved, X, T = calibrated[kind]
    T = T @ se3.transform(np.eye(3), np.array(moved))
    return check(bench.samples(replace(cell, **scenario), count, X, T, np.random.default_rng(3)),
                 solved, config)


@pytest.mark.parametrize('change', bench.TRUTH)
def test_what_changed_is_named_and_nothing_else(calibrated, change):
    found = [(kind, said(calibrated, kind, change, seed).verdict)
             for kind in bench.TARGETS for seed in range(4)]
    right = [bench.TRUTH[change] in verdict.split(' or ') for _, verdict in found]
    least = {'unchanged': 1.0, 'joint 0.05': 0.8}.get(change, 0.95)  # as the bench measures
    assert sum(right) >= least * len(found), found


def test_a_change_is_measured(calibrated):
    found = said(calibrated, 'sphere', 'target', 0)
    assert found.target_moved == pytest.approx(3e-4, rel=0.2)
    assert 'the target, or the base of the robot, moved by up to 0.3' in found.sentence
    found = said(calibrated, 'plate', 'sensor', 0)
    assert found.sensor_moved == pytest.approx(3e-4, rel=0.3)
    assert found.points_off > 2 * found.points_off_std
    far = said(calibrated, 'plate', 'joint 0.2', 0)  # 0.7 mm at the flange, and no extrapolation
    assert far.points_off < 2e-3


def test_what_cannot_be_seen_or_told_apart_is_said(calibrated):
    slid = checked(calibrated, 'plane', moved=(5e-3, 0, 0))
    assert slid.verdict == 'unchanged'
    assert 'would have shown from' in slid.sentence and 'cannot be seen' in slid.sentence
    assert slid.target_shows[0] < 1e-4 and np.isnan(slid.target_shows[1:]).all()
    assert np.abs(slid.target_axes[0] @ calibrated['plane'][4][:3, 2]) > 0.99
    assert max(said(calibrated, 'plate', 'unchanged', 1).target_shows) < 5e-4  # by its edges
    level = checked(calibrated, 'plane', 6, (0, 0, 4e-4), tilt=np.deg2rad(2))  # one orientation
    assert set(level.verdict.split(' or ')) >= {'target', 'sensor'}
    assert 'these stops cannot decide' in level.sentence
    assert 'Repeat some of them with the sensor turned' in level.sentence
    assert sum(level.odds.values()) == pytest.approx(1.0)
    loose = checked(calibrated, 'sphere', robot=RobotModel(repeatability=(5e-4, 1e-3)))
    assert loose.verdict == 'robot' and 'noise.robot_*' in loose.sentence


def test_a_stop_that_contradicts_the_others_is_left_out(calibrated):
    scenario, config, solved, X, T = calibrated['plate']
    seen = bench.samples(scenario, 8, X, T, np.random.default_rng(3))
    off = se3.perturb(seen[2].T_base_flange, np.array([0, 0, 1e-3, 0, 0, 0]))
    seen[2] = replace(seen[2], T_base_flange=off)
    found = check(seen, solved, config)
    assert (found.verdict, found.left_out, found.stations) == ('unchanged', [3], 7)
    assert found.sentence.endswith('stops [3]')


def test_what_cannot_be_checked_is_refused(calibrated):
    scenario, config, solved, X, T = calibrated['sphere']
    seen = bench.samples(scenario, 8, X, T, np.random.default_rng(3))
    for samples, calibration, error, words in (
            (seen[:3], solved, DataError, '3 usable'),
            (seen, replace(solved, method='points'), InputError, 'points'),
            (seen, replace(solved, target={'centre': {}}), InputError, 'does not hold')):
        with pytest.raises(error, match=words):
            check(samples, calibration, config)


def calibrations(folder, count, jump_at=None):
    rng = np.random.default_rng(0)
    X = gauges.sensor_on_flange(rng)
    for k in range(count):
        off = bench.STD * rng.normal(size=6)
        off = off + (5e-4 if jump_at is not None and k >= jump_at else 0.0)
        write_calibration(stated(se3.perturb(X, off), provenance={
            'created': f'2026-01-{k + 1:02d}T08:00:00+00:00'}),
            folder / f'day_{k}' / 'calibration.yaml')


def test_a_trend_tells_since_when(tmp_path):
    calibrations(tmp_path / 'jump', 6, jump_at=4)
    entries, warnings = trend.trend(tmp_path / 'jump')
    assert [e.p_before < 0.01 for e in entries] == [False] * 4 + [True, False]
    assert '2026-01-05' in trend.since_when(entries) and not warnings
    (tmp_path / 'jump/day_0/calibration.yaml').write_text('no')
    entries, warnings = trend.trend(tmp_path / 'jump')
    assert len(entries) == 5 and len(warnings) == 1
    calibrations(tmp_path / 'steady', 5)
    assert 'no calibration differs' in trend.since_when(trend.trend(tmp_path / 'steady')[0])
    with pytest.raises(DataError):
        trend.trend(tmp_path / 'steady/day_0')


def test_a_trend_goes_by_the_time_of_the_recordings(tmp_path):
    calibrations(tmp_path, 3)
    for k, day in ((0, 2), (1, 0), (2, 1)):  # solved in another order than recorded
        path = tmp_path / f'day_{k}' / 'calibration.yaml'
        stamp = 1_700_000_000_000_000_000 + day * 86_400_000_000_000
        write_calibration(replace(read_calibration(path), samples=(
            SampleReport(stamp, True),)), path)
    entries, _ = trend.trend(tmp_path)
    assert [e.path.parent.name for e in entries] == ['day_1', 'day_2', 'day_0']
    assert entries[0].recorded.startswith('2023-11-14')
    assert len(trend.csv_text(entries).splitlines()) == 4


@pytest.mark.thorough
def test_the_verbs_on_recordings_and_a_folder(tmp_path):
    made = simulate(replace(SCENARIOS['small_plate'], stations=(6, 6)), np.random.default_rng(5))
    bag_write.write(tmp_path / 'today', made.profiles, made.poses)
    run = handeye('solve', 'today', '--out', 'a', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    solved = read_calibration(tmp_path / 'a' / 'calibration.yaml')
    moved = replace(solved, T_flange_sensor=se3.perturb(solved.T_flange_sensor, np.full(6, 3e-3)))
    write_calibration(moved, tmp_path / 'b' / 'calibration.yaml')
    run = handeye('check', 'today', '--against', 'a/calibration.yaml', '--out', 'c.yaml',
                  cwd=tmp_path)
    assert run.returncode == 0 and 'UNCHANGED' in run.stdout, run.stderr
    assert yaml.safe_load((tmp_path / 'c.yaml').read_text())['checks'][0]['stations'] == 12
    run = handeye('check', 'today', 'today', '--against', 'b/calibration.yaml', cwd=tmp_path)
    assert run.returncode == 1, run.stderr
    assert 'UNCHANGED' not in run.stdout and run.stdout.endswith('since today\n')
    run = handeye('trend', '.', '--picture', 't.png', '--csv', 't.csv', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'CHANGED' in run.stdout and 'x [mm]' in run.stdout
    assert (tmp_path / 't.png').stat().st_size > 1000
    assert (tmp_path / 't.csv').read_text().startswith('recorded,path,x,')
    assert_refused(handeye('trend', 'today', cwd=tmp_path), 3, 'today')
