# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The time offset of a calibration, verified on a ball or an edge that the robot sweeps over."""
from __future__ import annotations

from dataclasses import replace
import re

from handeye_ros import pipeline
from handeye_ros.config import Config, flatten, with_values
from handeye_ros.data import TimeOffset
from handeye_ros.simulate import SCENARIOS, settings, simulate
from handeye_ros.simulate.scenario import Sweep
from handeye_ros.verification.routines import ROUTINES, settings_for
from handeye_ros.verification.stations import stations_of
from handeye_ros.verification.verify import verify
import numpy as np
import pytest
from verifications import stated


def swept(target, calibrated, knot, delay, **values):
    """Return what is seen of a sweep in which the profiles come late, and its verification."""
    base, routine = SCENARIOS[target], ROUTINES[target]
    scenario = replace(base, stations=(8, 0), sweep=Sweep(knot=knot), **values,
                       sensor=replace(base.sensor, columns=320, delay=delay))
    made = simulate(scenario, np.random.default_rng(5))
    config = settings_for(routine, with_values(Config(), settings(scenario) | {
        'sampling.mode': 'moving', 'time_offset': calibrated,
        'verify.radius': float(getattr(scenario.target, 'radius', 0.0))}, 'a test'), 1)
    found = stated(made.truth.T_flange_sensor, target, {'config': flatten(config)},
                   TimeOffset(calibrated, 2e-5))
    stamped = [replace(p, stamp=p.stamp + round(calibrated * 1e9)) for p in made.profiles]
    session = pipeline.gather(stamped, made.poses, config)
    seen = stations_of(routine, [session.samples], found, config)
    return seen.surface, verify(routine, seen, found, config)


@pytest.mark.parametrize(('target', 'calibrated'), [('sphere', 0.020), ('line', 0.017)])
def test_a_sweep_without_turns_tells_whether_the_offset_has_changed(target, calibrated):
    said, result = swept(target, calibrated, 0.9, -0.020, motion='one_orientation')
    change = float(re.search(r'by ([-+.\d]+) ms|was: ([-+.\d]+) ms', said).expand(r'\1\2'))
    assert abs(change - (0.020 - calibrated) * 1e3) < 0.2
    assert ('as it was' in said) == (calibrated == 0.020)
    assert said in result.surface and result.scatter.rms < 1e-4


def test_profiles_of_a_sweep_that_show_another_edge_do_not_refuse_it():
    said, result = swept('line', 0.0, 4.0, 0.15)
    assert re.search(r'set time_offset to -0.1(50|49)', said), said
    assert 'profiles show another surface' in said and result.verdict == 'pass'
