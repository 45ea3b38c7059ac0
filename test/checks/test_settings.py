# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong settings are named, with the right value."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from cells import ONE_IN_20, Recorded, recorded, simulated, squared_error
from handeye_ros import pipeline, se3
from handeye_ros.checks.hypotheses import explain_samples, refuse_by_best
from handeye_ros.checks.settings import setting_hypotheses, with_few_profiles
from handeye_ros.config import Config, with_flipped_range, with_values
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.stops import Stop
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS, scenes
from handeye_ros.simulate.solids import box, Solid
import numpy as np
import pytest
from quick import long_run


@lru_cache
def baseline_recording(name: str) -> Recorded:
    return recorded(FAULTS[f'{name}, baseline'], rate=8.0)


def test_a_stored_stop_is_thinned_as_one_of_a_bag_is() -> None:
    recording = baseline_recording('sphere')
    stop = pipeline.gather(recording.profiles, recording.poses, recording.config).stops[0]
    stored_stop = replace(stop, poses=(), profiles=(), load_messages=lambda config: stop)
    stored, read = (with_few_profiles(s, recording.config) for s in (stored_stop, stop))
    assert stored.profiles == read.profiles and len(stored.profiles) < len(stop.profiles)


@pytest.mark.parametrize(('name', 'values', 'words'), [
    ('plate', {'target__type': 'wedge', 'profile__range_sign': -1},
     'target.type to plate and profile.range_sign to 1$'),
    *long_run(
        ('sphere', {'target__radius': 0.012}, 'target.radius to 0.040'),
        ('wedge', {'noise__sensor': 5e-7}, 'noise.sensor to 5e-06$'),
        *((name, {'target__type': wrong}, f'target.type to {right}$')
          for name, wrong, right in (
              ('sphere', 'plate', 'sphere'), ('plate', 'sphere', 'plate'),
              ('plate', 'line', 'plate'), ('wedge', 'sphere', 'wedge'))))])
def test_wrong_settings_are_named(name: str, values: dict[str, object], words: str) -> None:
    with pytest.raises(DataError, match=f'set {words}'):
        baseline_recording(name).calibrate(**values)


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [23, 24])
def test_one_edge_is_a_line_or_a_plane_and_no_plate(seed: int) -> None:
    """The other edge of a plate is seen by no stop, or by one stop by chance."""
    recording = recorded(FAULTS['line, baseline'], seed, rate=8.0)
    with pytest.raises(DataError, match='set target.type to line, or to plane, if it is one$'):
        recording.calibrate(target__type='sphere', method='auto')


@pytest.mark.thorough
def test_a_plate_seen_one_edge_after_the_other_is_no_line_that_moved() -> None:
    with pytest.raises(DataError, match='set target.type to plate$'):
        recorded('plate_in_order').calibrate(target__type='line', target__size=())


def beside_another(scenario: Scenario) -> tuple[Solid, ...]:
    """Return a block, and 2 mm beside it another one that is 1 mm lower: a plane fits both."""
    length, width = scenario.target.length, 0.05
    return (box((0.0, 0.0, -width), (length, width, 0.0)),
            box((0.0, -0.022, -width), (length, -0.002, -0.001)))


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [8, 11, 12])
def test_a_wedge_beside_a_block_is_answered(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setitem(scenes.SCENES, 'beside', replace(
        scenes.SCENES['wedge'], solids=beside_another))
    scenario = replace(FAULTS['wedge, baseline'], scene='beside',
                       stated=(('target.type', 'wedge'),), no_return='omit', stops=(18, 0))
    recording = simulated(scenario, seed)
    assert squared_error(recording.calibrate(), recording.truth) < ONE_IN_20


def test_what_no_setting_mends_is_not_blamed_on_one() -> None:
    poses = [replace(p, quaternion=se3.quaternion(se3.from_quaternion(
        np.zeros((1, 3)), np.random.default_rng(k // 20).normal(size=(1, 4))))[0])
        for k, p in enumerate(baseline_recording('plate').poses)]
    with pytest.raises(DataError) as caught:
        baseline_recording('plate').calibrate(poses=poses)
    assert caught.value.code != 'settings'


@pytest.mark.thorough
def test_right_settings_are_not_blamed() -> None:
    recording = baseline_recording('plate')
    session = pipeline.gather(recording.profiles, recording.poses, recording.config)
    stated = explain_samples(session.samples, recording.config, [s.stamp for s in session.samples])
    refuse_by_best(stated, setting_hypotheses(session, recording.config, stated))


@pytest.mark.thorough
def test_stops_read_again_are_of_the_whole_recording() -> None:
    """Of many some are read; the first stops of this plate show one edge only: they fit a line."""
    scenario = replace(SCENARIOS['plate_in_order'], stops=(45, 10))
    with pytest.raises(DataError, match='set target.type to plate$'):
        recorded(scenario, rate=8.0).calibrate(target__type='sphere', target__size=())


@pytest.mark.thorough
@pytest.mark.parametrize('name, seed', [
    ('plate_z_up', 1), ('plate', 0), ('small_plate_sweep', 0)])
def test_a_range_counted_the_wrong_way_is_named(name: str, seed: int) -> None:
    recording = recorded(name, seed, sampling__mode='moving' if SCENARIOS[name].sweep else 'still')
    with pytest.raises(DataError, match=f'range_sign {recording.config.profile.range_sign}, '):
        pipeline.calibrate(recording.profiles, recording.poses,
                           with_flipped_range(recording.config))


def test_a_refusal_stands_where_the_file_of_a_stop_is_gone() -> None:
    recording = baseline_recording('plate')
    config = with_values(recording.config, {'target.type': 'sphere'}, 'test')
    session = pipeline.gather(recording.profiles, recording.poses, config)
    with pytest.raises(DataError, match='set target.type to plate'):
        pipeline.calibrate_session(session, config)

    def gone(config: Config) -> Stop:
        raise InputError('the file of a stop is gone')
    for stop in session.stops:
        session.add_stop(replace(stop, load_messages=gone))
    with pytest.raises(DataError, match='usable samples') as refused:
        pipeline.calibrate_session(session, config)
    assert 'set target.type' not in str(refused.value)
