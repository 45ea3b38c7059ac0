# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The time offset of a calibration, verified on a ball or an edge that the robot sweeps over."""
from __future__ import annotations

from dataclasses import replace
import re

from handeye_ros import pipeline
from handeye_ros.config import Config, flatten, with_values
from handeye_ros.data import Calibration, Quality, TimeOffset
from handeye_ros.simulate import SCENARIOS, settings, simulate
from handeye_ros.simulate.scenario import Sweep
from handeye_ros.verification.routines import ROUTINES, settings_for
from handeye_ros.verification.stations import stations_of
from handeye_ros.verification.verify import verify
import numpy as np
import pytest


@pytest.mark.parametrize('target', ['sphere', 'line'])
@pytest.mark.parametrize('calibrated', [0.020, 0.017])
def test_a_sweep_without_turns_tells_whether_the_offset_has_changed(
        target: str, calibrated: float) -> None:
    base = SCENARIOS[target]
    scenario = replace(base, stations=(8, 0), motion='one_orientation', sweep=Sweep(knot=0.9),
                       sensor=replace(base.sensor, columns=320, delay=-0.020))
    made = simulate(scenario, np.random.default_rng(5))
    config = with_values(Config(), settings(scenario) | {
        'sampling.mode': 'moving', 'time_offset': calibrated,
        'verify.radius': float(getattr(scenario.target, 'radius', 0.0))}, 'a test')
    found = Calibration('ball', target, 'flange', 'laser', made.truth.T_flange_sensor,
                        np.diag([1e-5] * 3 + [1e-4] * 3) ** 2, {}, Quality(0, 0, 0, 0, '', 0), (),
                        {'config': flatten(config)}, TimeOffset(calibrated, 2e-5))
    routine = ROUTINES[target]
    config = settings_for(routine, config, 1)
    stamped = [replace(p, stamp=p.stamp + round(calibrated * 1e9)) for p in made.profiles]
    session = pipeline.gather(stamped, made.poses, config)
    seen = stations_of(routine, session.samples, found, config)
    change = float(re.search(r'by ([-+.\d]+) ms|was: ([-+.\d]+) ms', seen.surface).expand(
        r'\1\2'))
    assert abs(change - (0.020 - calibrated) * 1e3) < 0.2
    assert ('as it was' in seen.surface) == (calibrated == 0.020)
    result = verify(routine, [seen], found, config)
    assert seen.surface in result.surface and result.scatter.rms < 1e-4


def test_profiles_of_a_sweep_that_show_another_edge_do_not_refuse_it() -> None:
    base = SCENARIOS['line']
    scenario = replace(base, stations=(8, 0), sweep=Sweep(knot=4.0),
                       sensor=replace(base.sensor, columns=320, delay=0.15))
    made = simulate(scenario, np.random.default_rng(5))
    config = with_values(Config(), settings(scenario) | {'sampling.mode': 'moving'}, 'a test')
    found = Calibration('line', 'line', 'flange', 'laser', made.truth.T_flange_sensor,
                        np.diag([1e-5] * 3 + [1e-4] * 3) ** 2, {}, Quality(0, 0, 0, 0, '', 0), (),
                        {'config': flatten(config)}, TimeOffset(0.0, 2e-5))
    routine = ROUTINES['line']
    config = settings_for(routine, config, 1)
    session = pipeline.gather(made.profiles, made.poses, config)
    seen = stations_of(routine, session.samples, found, config)
    assert 'set time_offset to -0.15' in seen.surface or '-0.149' in seen.surface, seen.surface
    assert 'profiles show another surface' in seen.surface
    assert verify(routine, [seen], found, config).verdict == 'pass'
