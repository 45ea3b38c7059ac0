# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Clamps over a third of the edges: the stops that show them are named, and left out."""
from __future__ import annotations

from dataclasses import replace
from functools import partial
import re

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import FaceLine
from handeye_ros.simulate import Scenario, SCENARIOS, scenes, settings, simulate
from handeye_ros.simulate.solids import box, Solid
import numpy as np
import pytest


def clamped(scenario: Scenario, height: float) -> tuple[Solid, ...]:
    """Return a plate with three clamps on each of two edges, 15 mm wide."""
    clamps = []
    for along, length in enumerate(scenario.target.size):
        for middle in (length / 6, length / 2, length * 5 / 6):
            low, high = [-0.01] * 3, [0.015] * 3
            low[along], high[along] = middle - length / 18, middle + length / 18
            clamps.append(box((*low[:2], 0.0), (*high[:2], height)))
    return (*scenes.SCENES['plate'].solids(scenario), *clamps)


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'seed', 'height', 'answered'), [
    ('line', 0, 15, False), ('plate', 0, 15, True),
    ('plate', 1, 3, True)])  # without the question it would look like a move
def test_the_stops_that_show_a_clamp_are_named_and_left_out(
        monkeypatch: pytest.MonkeyPatch, name: str, seed: int, height: int, answered: bool
) -> None:
    monkeypatch.setitem(scenes.SCENES, 'clamped', replace(
        scenes.SCENES[SCENARIOS[name].scene], solids=partial(clamped, height=height * 1e-3)))
    scenario = replace(SCENARIOS[name], scene='clamped')
    made = simulate(scenario, np.random.default_rng(seed))
    values = settings(scenario) | {'target.type': name}
    config = with_values(Config(), values, 'the test')
    session = pipeline.gather(made.profiles, made.poses, config)
    T_target_base = se3.inverse(made.truth.T_base_target)
    on_clamps = []
    for stop in (stop for stop in session.stops if stop.sample):
        face = next(f for f in stop.sample.features if isinstance(f, FaceLine))
        T = T_target_base @ stop.sample.T_base_flange @ made.truth.T_flange_sensor
        if T[2, [0, 2]] @ face.centre + T[2, 3] > height * 1e-3 / 2:
            on_clamps.append(stop)
    answer = pipeline.answer_of(session, config)
    if answered:  # the others are enough
        [told] = answer.calibration.provenance['warnings']
        assert {report.stamp for report in answer.calibration.samples
                if not report.used} >= {stop.sample.stamp for stop in on_clamps}
        error = se3.difference(answer.calibration.T_flange_sensor, made.truth.T_flange_sensor)
        assert error @ np.linalg.solve(answer.calibration.covariance, error) < 16.8
    else:
        told = str(answer.refusal)
        assert answer.refusal.reason == 'surface'
    assert f'{height}.0 mm above' in told
    named = re.search(r'the stops ([\d, ]+) show', told)
    assert [int(number) for number in named[1].split(', ')] == [stop.number for stop in on_clamps]
