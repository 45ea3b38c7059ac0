"""A plan predicts what a verification will show, and its stops can be driven to."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.simulate import gauges
from handeye_ros.verification.errors import NoPlanError
from handeye_ros.verification.plan import csv_text, plan, sentences
from handeye_ros.verification.routines import ROUTINES
import numpy as np
import pytest
from verifications import bench, result

PLACE = (0.7, 0.1, 0.2)
CONFIG = Config(noise=bench.NOISE)


def planned(name, stops, turns, config=CONFIG, seed=0, **stated):
    X = gauges.sensor_on_flange(np.random.default_rng(seed))
    found = bench.calibration(X, bench.covariance(np.random.default_rng(seed)))
    config = replace(config, verify=VerifyConfig(**stated))
    return found, plan(ROUTINES[name], found, config, PLACE, stops, np.deg2rad(turns))


@pytest.mark.parametrize(('name', 'lengths'), [('plane', ()), ('step', (0.025, 0.05, 0.1))])
def test_a_prediction_is_what_the_stops_show(name, lengths):
    found, report = planned(name, 20, 40, lengths=lengths)
    shown = []
    for seed in range(10, 16):
        made = bench.SCENES[name](np.random.default_rng(seed), count=20, tilt=np.deg2rad(40))
        exact = replace(found, T_flange_sensor=made.T_flange_sensor)
        shown.append(result(name, made, exact).smallest_error)
    assert 0.6 * np.median(shown) < report.expected.smallest_error < 1.2 * np.median(shown)
    assert planned(name, 40, 40, lengths=lengths)[1].expected.smallest_error < (
        0.85 * report.expected.smallest_error)


def test_too_few_stops_are_called_so_before_anything_is_measured():
    few, more = planned('plane', 8, 20)[1], planned('plane', 45, 40)[1]
    assert few.expected.verdict == 'insensitive' and more.expected.verdict == 'pass'
    assert list(sentences(few, [more]))[-1].endswith('stop 45 times')


@pytest.mark.parametrize('values', [
    {}, {'profile.range_sign': -1}, {'profile.axes': ['y', '-x']},
    {'calibration_type': 'eye_on_base'}])
def test_the_stops_look_at_the_artefact(values):
    config = with_values(CONFIG, values, 'test')
    found, report = planned('sphere', 12, 30, config, radius=0.02)
    T = report.T_base_flange[0]
    T = se3.inverse(T) if config.calibration_type == 'eye_on_base' else T
    centre = se3.apply(se3.inverse(T @ found.T_flange_sensor), np.array([PLACE]))[:, 0]
    axes = ['xyz'.index(axis[-1]) for axis in config.profile.axes]
    depth = centre[:, axes[1]] * (-1 if config.profile.axes[1][0] == '-' else 1)
    limits = (-0.05, 0.025) if config.profile.range_sign < 0 else (0.15, 0.225)
    assert depth.min() > limits[0] and depth.max() < limits[1]
    across = np.delete(centre, axes, axis=1)
    assert np.abs(across).max() < 0.015
    assert len(csv_text(report).splitlines()) == 13


def test_what_is_not_planned_is_refused():
    with pytest.raises(NoPlanError, match='not for "tooth"'):
        planned('tooth', 12, 30, lengths=(0.015, 0.005))
