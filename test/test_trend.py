# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The calibrations of a folder over time: since when one differs from the one before."""
from __future__ import annotations

from dataclasses import replace

from command import assert_refused, handeye, succeeds
from handeye_ros import se3, trend
from handeye_ros.data import SampleReport
from handeye_ros.errors import DataError
from handeye_ros.results.calibration_file import read_calibration, write_calibration
import numpy as np
import pytest
from verifications import bench, bench_calibration

DAY = 86_400_000_000_000  # ns


def write(folder, days, jump_at=np.inf):
    """Write calibrations, solved in the order of their names and recorded on days."""
    rng = np.random.default_rng(0)
    for k, day in enumerate(days):
        step = bench.STD * rng.normal(size=6) + (5e-4 if day >= jump_at else 0.0)
        stamp = 1_700_000_000_000_000_000 + day * DAY
        calibration = replace(bench_calibration(se3.perturb(np.eye(4), step)),
                              samples=(SampleReport(stamp, True),),
                              provenance={'created': f'2026-01-{k + 1:02d}T08:00:00+00:00'})
        write_calibration(calibration, folder / f'day_{day}' / 'calibration.yaml')


def test_a_trend_goes_by_the_time_of_the_recordings_and_tells_since_when(tmp_path):
    write(tmp_path / 'jump', (2, 0, 5, 4, 3, 1), jump_at=4)
    entries, warnings = trend.trend(tmp_path / 'jump')
    assert [e.path.parent.name for e in entries] == [f'day_{k}' for k in range(6)]
    assert [e.p_before < 0.01 for e in entries] == [False] * 4 + [True, False]
    assert 'between 2023-11-18' in trend.since_when(entries) and not warnings
    assert len(trend.csv_text(entries).splitlines()) == 7
    (tmp_path / 'jump/day_0/calibration.yaml').write_text('no')
    entries, warnings = trend.trend(tmp_path / 'jump')
    assert len(entries) == 5 and len(warnings) == 1


def test_of_one_recording_the_answers_are_in_the_order_of_their_making(tmp_path):
    write(tmp_path, (2, 1, 0))
    sample = (SampleReport(1_700_000_000_000_000_000, True),)
    for file in tmp_path.rglob('calibration.yaml'):
        write_calibration(replace(read_calibration(file), samples=sample), file)
    entries, _ = trend.trend(tmp_path)
    assert [entry.path.parent.name for entry in entries] == ['day_2', 'day_1', 'day_0']


def test_a_calibration_without_times_of_its_samples_is_placed_by_its_own(tmp_path):
    write(tmp_path, range(3))
    calibration = read_calibration(tmp_path / 'day_0')
    write_calibration(replace(calibration, samples=(SampleReport(7 * DAY, True),),  # of an uptime
                              provenance={'created': '2023-11-15T23:00:00+00:00'}),
                      tmp_path / 'uptime/calibration.yaml')
    entries, _ = trend.trend(tmp_path)
    assert [entry.path.parent.name for entry in entries] == ['day_0', 'day_1', 'uptime', 'day_2']


def test_only_calibrations_of_one_sensor_are_compared(tmp_path):
    write(tmp_path, range(3))
    calibration = read_calibration(tmp_path / 'day_0/calibration.yaml')
    write_calibration(replace(calibration, child_frame='rear'), tmp_path / 'rear/calibration.yaml')
    for reference in (None, calibration):
        entries, (warning,) = trend.trend(tmp_path, reference)
        assert len(entries) == 3 and 'rear on flange, not of laser on flange' in warning
    entries, warnings = trend.trend(tmp_path, replace(calibration, child_frame='rear'))
    assert len(entries) == 1 and len(warnings) == 3
    for day in (1, 2):
        write_calibration(replace(calibration, covariance=np.zeros((6, 6))),
                          tmp_path / f'day_{day}/calibration.yaml')
    with pytest.raises(DataError, match='1 readable calibration.yaml of laser on flange: '):
        trend.trend(tmp_path)


def test_a_drift_in_small_steps_is_told(tmp_path):
    for k in range(20):
        step = np.repeat([k * 0.8, 0], 3) * bench.STD
        created = {'created': f'{k:02}'}
        write_calibration(bench_calibration(se3.perturb(np.eye(4), step), provenance=created),
                          tmp_path / f'{k}/calibration.yaml')
    entries, _ = trend.trend(tmp_path)
    assert min(entry.p_before for entry in entries) > 0.5
    assert trend.since_when(entries).startswith('the calibration drifted: 05 differs')


def test_the_verb_shows_writes_and_refuses(tmp_path):
    write(tmp_path / 'steady', range(5))
    run = succeeds('trend', 'steady', '--csv', 't.csv', cwd=tmp_path)
    assert 'no calibration differs' in run.stdout and 'steady/day_4' in run.stdout
    head, *rows = (tmp_path / 't.csv').read_text().splitlines()
    assert head == ('recorded,path,x,y,z,rx,ry,rz,x_std,y_std,z_std,rx_std,ry_std,rz_std,'
                    'p_reference,p_before,residual')
    assert [row.split(',')[1] for row in rows] == [
        f'steady/day_{k}/calibration.yaml' for k in range(5)]
    assert_refused(handeye('trend', 'steady/day_0', cwd=tmp_path), 3, 'steady')
    (tmp_path / 'empty').mkdir()
    assert_refused(handeye('trend', 'empty', cwd=tmp_path), 2, 'empty holds 0 readable')
    assert_refused(handeye('trend', 'nights', cwd=tmp_path), 2, 'no folder nights: ')
    succeeds('trend', 'steady/day_0', '--against', 'steady/day_1', cwd=tmp_path)
