# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong settings and clocks that differ are named, with the right value."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
import re

from handeye_ros import pipeline, se3
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.settings import require_settings
from handeye_ros.config import Config, with_values
from handeye_ros.errors import DataError
from handeye_ros.simulate import (
    FAULTS,
    Scenario,
    SCENARIOS,
    scenes,
    settings,
    simulate,
    Simulated,
)
from handeye_ros.simulate.scenario import Layout
from handeye_ros.simulate.solids import box, Solid
import numpy as np
import pytest


@lru_cache
def made(name: str) -> Simulated:
    return simulate(FAULTS[name], np.random.default_rng(0))


def solved(name: str, **values: object) -> object:
    config = with_values(Config(), settings(FAULTS[name]) | {
        key.replace('__', '.'): value for key, value in values.items()}, 'the test')
    return pipeline.calibrate(made(name).profiles, made(name).poses, config)


@pytest.mark.parametrize(('name', 'wrong', 'right'), [
    ('sphere', 'plate', 'sphere'),
    pytest.param('baseline', 'sphere', 'plate', marks=pytest.mark.thorough),
    pytest.param('baseline', 'line', 'plate', marks=pytest.mark.thorough),
    pytest.param('wedge', 'sphere', 'wedge', marks=pytest.mark.thorough)])
def test_another_target_is_named(name: str, wrong: str, right: str) -> None:
    with pytest.raises(DataError, match=f'set target.type to {right}$'):
        solved(name, target__type=wrong)


@pytest.mark.parametrize('radius', [0.012])
def test_a_wrong_radius_is_named_with_the_right_one(radius: float) -> None:
    with pytest.raises(DataError, match='set target.radius to 0.040'):
        solved('sphere', target__radius=radius)


def test_two_wrong_settings_are_named_together() -> None:
    with pytest.raises(DataError,
                       match='set target.type to plate and profile.range_sign to 1$'):
        solved('baseline', target__type='wedge', profile__range_sign=-1)


def beside_another(scenario: Scenario) -> tuple[Solid, ...]:
    """Return a block, and 2 mm beside it another one that is 1 mm lower: a plane fits both."""
    length, width = scenario.target.length, 0.05
    return (box((0.0, 0.0, -width), (length, width, 0.0)),
            box((0.0, -0.022, -width), (length, -0.002, -0.001)))


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [8, 11, 12])
def test_a_wedge_beside_another_block_is_answered(monkeypatch: pytest.MonkeyPatch, seed: int
                                                  ) -> None:
    monkeypatch.setitem(scenes.SCENES, 'beside', replace(
        scenes.SCENES['wedge'], solids=beside_another))
    cell = replace(FAULTS['wedge'], scene='beside', stated=(('target.type', 'wedge'),),
                   layout=Layout(no_return='omit'), stations=(18, 0))
    config = with_values(Config(), settings(cell), 'the test')
    recording = simulate(cell, np.random.default_rng(seed))
    found = pipeline.calibrate(recording.profiles, recording.poses, config)
    error = se3.difference(found.T_flange_sensor, recording.truth.T_flange_sensor)
    assert error @ np.linalg.solve(found.covariance, error) < 12.6


def test_what_no_setting_mends_is_not_blamed_on_one() -> None:
    poses = [replace(p, quaternion=se3.quaternion(se3.from_quaternion(
        np.zeros((1, 3)), np.random.default_rng(k // 20).normal(size=(1, 4))))[0])
        for k, p in enumerate(made('baseline').poses)]
    config = with_values(Config(), settings(FAULTS['baseline']), 'the test')
    with pytest.raises(DataError) as caught:
        pipeline.calibrate(made('baseline').profiles, poses, config)
    assert caught.value.reason != 'settings'


@pytest.mark.parametrize('name', ['baseline'])
def test_right_settings_are_not_blamed(name: str) -> None:
    config = with_values(Config(), settings(FAULTS[name]), 'the test')
    require_settings(pipeline.gather(made(name).profiles, made(name).poses, config), config)


NS = 1_000_000_000


@lru_cache(maxsize=2)
def recorded(target: str) -> tuple[Simulated, Config]:
    scenario = replace(SCENARIOS[target], sensor=replace(SCENARIOS[target].sensor, rate=20.0))
    return (simulate(scenario, np.random.default_rng(1)),
            with_values(Config(), settings(scenario), 'the test'))


def solved_late(target: str, late: float) -> object:
    made, config = recorded(target)
    profiles = [replace(p, stamp=p.stamp + round(late * NS)) for p in made.profiles]
    return pipeline.calibrate(profiles, made.poses, config)


@pytest.mark.thorough
@pytest.mark.parametrize(('target', 'late'), [
    ('plate', 0.7), ('plate', 2.2), ('plate', -1.8), ('sphere', 1.3), ('sphere', -0.8)])
def test_clocks_apart_are_reported_and_mended(target: str, late: float) -> None:
    with pytest.raises(DataError, match='set time_offset to') as caught:
        solved_late(target, late)
    assert ('late' if late > 0 else 'early') in str(caught.value)
    result = float(re.search('time_offset to ([-0-9.]+)', str(caught.value))[1])
    assert result == pytest.approx(-late, abs=0.16)
    assert solved_late(target, late + result)


def test_clocks_are_not_blamed_for_what_else_is_wrong() -> None:
    made, config = recorded('plate')
    wrong = [replace(p, quaternion=p.quaternion[[3, 0, 1, 2]]) for p in made.poses]
    with pytest.raises(DataError, match='quaternions read as w x y z'):
        pipeline.calibrate(made.profiles, wrong, config)
    require_same_clock(pipeline.gather(made.profiles, made.poses, config), config)


@pytest.mark.thorough
@pytest.mark.parametrize(('scenario', 'seed'), [
    (replace(FAULTS['wedge, joints and links 1 mm'], stations=(100, 0)), 1),
    (FAULTS['4 + 3, two bad'], 16)], ids=['one stop that ends early', 'few samples, two wrong'])
def test_clocks_are_not_blamed_for(scenario: Scenario, seed: int) -> None:
    made = simulate(scenario, np.random.default_rng(seed))
    config = with_values(Config(), settings(scenario), 'the test')
    require_same_clock(pipeline.gather(made.profiles, made.poses, config), config)


def test_a_stop_half_of_whose_arcs_moved_is_no_sample() -> None:
    answer = solved_late('sphere', 0.3)
    made, config = recorded('sphere')
    good = pipeline.calibrate(made.profiles, made.poses, config)
    assert answer.quality.residual_rms < 3 * good.quality.residual_rms
