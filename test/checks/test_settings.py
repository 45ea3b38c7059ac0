# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong settings, clocks that differ and a tilted light plane are named, with the right value."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
import math
from pathlib import Path
import re

from cells import cell, ONE_IN_20, Recorded, recorded, settings_of, squared_error
from command import ROOT
from handeye_ros import config as configs
from handeye_ros import pipeline, se3
from handeye_ros.bags.bag import read
from handeye_ros.bags.messages import view
from handeye_ros.bags.reader import CLOUD_TYPE, Raw
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.hypotheses import (
    Fit,
    fit_of_samples,
    refuse_by_best,
    stops_deviance,
)
from handeye_ros.checks.settings import setting_hypotheses, with_few_profiles
from handeye_ros.config import flipped_range
from handeye_ros.data import Array, Calibration, EdgePoint, NS, Profile
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.simulate import (
    FAULTS,
    Scenario,
    SCENARIOS,
    scenes,
    simulate,
)
from handeye_ros.simulate.scenario import Layout
from handeye_ros.simulate.solids import box, Solid
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from live_sessions import computed, fed, new
import numpy as np
import pytest
from recordings import scan, TYPES, with_messages


@lru_cache
def fault_recording(name: str) -> Recorded:
    return recorded(FAULTS[name], rate=8.0)


def test_a_stored_stop_is_thinned_as_one_of_a_bag_is() -> None:
    recording = fault_recording('sphere')
    stop = pipeline.gather(recording.profiles, recording.poses, recording.config).stops[0]
    stored_stop = replace(stop, poses=(), profiles=(), reader=lambda config: stop)
    stored, read = (with_few_profiles(s, recording.config) for s in (stored_stop, stop))
    assert stored.profiles == read.profiles and len(stored.profiles) < len(stop.profiles)


@pytest.mark.parametrize(('name', 'values', 'words'), [
    ('sphere', {'target__type': 'plate'}, 'target.type to sphere$'),
    ('sphere', {'target__radius': 0.012}, 'target.radius to 0.040'),
    ('baseline', {'target__type': 'wedge', 'profile__range_sign': -1},
     'target.type to plate and profile.range_sign to 1$'),
    *(pytest.param(name, {'target__type': wrong}, f'target.type to {right}$',
                   marks=pytest.mark.thorough)
      for name, wrong, right in (('baseline', 'sphere', 'plate'), ('baseline', 'line', 'plate'),
                                 ('wedge', 'sphere', 'wedge')))])
def test_wrong_settings_are_named(name: str, values: dict[str, object], words: str) -> None:
    with pytest.raises(DataError, match=f'set {words}'):
        fault_recording(name).calibrate(**values)


@pytest.mark.parametrize('seed', [23, pytest.param(24, marks=pytest.mark.thorough)])
def test_one_edge_is_a_line_or_a_plane_and_no_plate(seed: int) -> None:
    """The other edge of a plate is seen by no stop, or by one stop by chance."""
    recording = recorded(FAULTS['line'], seed, rate=8.0)
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
    scenario = replace(FAULTS['wedge'], scene='beside', stated=(('target.type', 'wedge'),),
                       layout=Layout(no_return='omit'), stations=(18, 0))
    config = settings_of(scenario)
    recording = simulate(scenario, np.random.default_rng(seed))
    calibration = pipeline.calibrate(recording.profiles, recording.poses, config)
    assert squared_error(calibration, recording.truth) < ONE_IN_20


def test_what_no_setting_mends_is_not_blamed_on_one() -> None:
    poses = [replace(p, quaternion=se3.quaternion(se3.from_quaternion(
        np.zeros((1, 3)), np.random.default_rng(k // 20).normal(size=(1, 4))))[0])
        for k, p in enumerate(fault_recording('baseline').poses)]
    with pytest.raises(DataError) as caught:
        fault_recording('baseline').calibrate(poses=poses)
    assert caught.value.reason != 'settings'


@pytest.mark.thorough
def test_right_settings_are_not_blamed() -> None:
    recording = fault_recording('baseline')
    session = pipeline.gather(recording.profiles, recording.poses, recording.config)
    stated = fit_of_samples(session.samples, recording.config, [s.stamp for s in session.samples])
    refuse_by_best(stated, setting_hypotheses(session, recording.config, stated))


def test_stops_read_again_are_of_the_whole_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first stops of this plate show one edge only: they fit a line."""
    monkeypatch.setattr('handeye_ros.checks.settings.MOST_STOPS', 9)
    with pytest.raises(DataError, match='set target.type to plate$'):
        recorded('plate_in_order', rate=8.0).calibrate(target__type='sphere', target__size=())


@lru_cache(maxsize=2)
def at_20_hz(target: str) -> Recorded:
    scenario = replace(SCENARIOS[target], sensor=replace(SCENARIOS[target].sensor, rate=20.0))
    recording = simulate(scenario, np.random.default_rng(1))
    return Recorded(scenario, recording.profiles, recording.poses, recording.truth,
                    settings_of(scenario))


def solved_late(target: str, late: float, **values: object) -> Calibration:
    """Return the calibration from profiles that are stamped too late (s)."""
    recording = at_20_hz(target)
    profiles = [replace(p, stamp=p.stamp + round(late * NS)) for p in recording.profiles]
    return recording.calibrate(profiles, **values)


@pytest.mark.thorough
@pytest.mark.parametrize(('target', 'late'), [
    ('plate', 0.7), ('plate', 2.2), ('plate', -1.8), ('sphere', 1.3), ('sphere', -0.8)])
def test_clocks_apart_are_reported_and_mended(target: str, late: float) -> None:
    with pytest.raises(DataError, match='set time_offset to') as caught:
        solved_late(target, late)
    assert ('late' if late > 0 else 'early') in str(caught.value)
    advised = float(re.search('time_offset to ([-0-9.]+)', str(caught.value))[1])
    assert advised == pytest.approx(-late, abs=0.16)
    assert solved_late(target, late + advised)


@pytest.mark.thorough
def test_no_time_offset_is_advised_that_no_key_takes() -> None:
    with pytest.raises(DataError, match='sensor and robot differ; give both the same clock'):
        solved_late('plate', -0.7, time_offset=9.8)


@pytest.mark.thorough
def test_clocks_are_not_blamed_for_what_else_is_wrong() -> None:
    recording = at_20_hz('plate')
    wrong_poses = [replace(p, quaternion=p.quaternion[[3, 0, 1, 2]]) for p in recording.poses]
    with pytest.raises(DataError, match='quaternions read as w x y z'):
        recording.calibrate(poses=wrong_poses)
    config = recording.config
    require_same_clock(pipeline.gather(recording.profiles, recording.poses, config), config)


@pytest.mark.thorough
@pytest.mark.parametrize(('scenario', 'seed'), [
    (replace(FAULTS['wedge, joints and links 1 mm'], stations=(100, 0)), 1),
    (FAULTS['4 + 3, two bad'], 16)], ids=['one stop that ends early', 'few samples, two wrong'])
def test_clocks_are_not_blamed_for_few_wrong_stops(scenario: Scenario, seed: int) -> None:
    recording = simulate(scenario, np.random.default_rng(seed))
    config = settings_of(scenario)
    require_same_clock(pipeline.gather(recording.profiles, recording.poses, config), config)


@pytest.mark.filterwarnings('error')
def test_the_clocks_of_one_stop_are_not_blamed() -> None:
    recording = at_20_hz('plate')
    end = recording.truth.stations[0].end
    session = pipeline.gather([p for p in recording.profiles if p.stamp < end],
                              [p for p in recording.poses if p.stamp < end], recording.config)
    assert len(session.stops) == 1
    require_same_clock(session, recording.config)


def test_clocks_are_compared_in_the_order_of_time_not_of_stop_numbers() -> None:
    """A sample that is taken while another stop waits for profiles has the smaller number."""
    recording, late = at_20_hz('plate'), round(2.2 * NS)
    session = pipeline.gather([replace(p, stamp=p.stamp + late) for p in recording.profiles],
                              recording.poses, recording.config)
    for stop in session.stops:  # 1 and 2 exchanged, 3 and 4, ...
        session.add_stop(replace(stop, number=stop.number - 1 if stop.number % 2 == 0
                                 else stop.number + 1))
    with pytest.raises(DataError, match='2.[123] s late'):
        require_same_clock(session, recording.config)


def test_clocks_are_not_blamed_for_profiles_that_shake_in_stops() -> None:
    """They rest for shorter than the robot, but neither earlier nor later."""
    recording = at_20_hz('plate')
    rng, stations = np.random.default_rng(0), recording.truth.stations

    def shaken(profile: Profile) -> Profile:
        for k, at in enumerate(stations):
            share = (profile.stamp - at.start) / (at.end - at.start)
            if 0 <= share <= 1 and (share < 0.4 if k % 3 else share > 0.6):
                return replace(profile, points=profile.points + [0, rng.normal(0, 1e-3)])
        return profile
    session = pipeline.gather(map(shaken, recording.profiles), recording.poses, recording.config)
    require_same_clock(session, recording.config)


def test_a_stop_half_of_whose_arcs_moved_is_no_sample() -> None:
    late, in_time = solved_late('sphere', 0.3), solved_late('sphere', 0.0)
    assert late.quality.residual_rms < 3 * in_time.quality.residual_rms


@pytest.mark.parametrize('name, seed', [
    ('plate_z_up', 1), *(pytest.param(name, 0, marks=pytest.mark.thorough)
                         for name in ('plate', 'small_plate_sweep'))])
def test_a_range_counted_the_wrong_way_is_named(name: str, seed: int) -> None:
    recording = recorded(name, seed, sampling__mode='moving' if SCENARIOS[name].sweep else 'still')
    with pytest.raises(DataError, match=f'range_sign {recording.config.profile.range_sign}, '):
        pipeline.calibrate(recording.profiles, recording.poses, flipped_range(recording.config))


# from 0.8: without a stop that is far worse than all others, the rest may be explained better
@given(arrays(float, 12, elements=st.floats(0.8, 4.0)), st.floats(1.05, 4.0), st.integers(0, 11))
def test_a_worse_fit_of_the_same_stops_explains_less(q: Array, worse: float, lost: int) -> None:
    """With more conditions a stop, a sign of 0.104 mm once explained better than one of 0.056."""
    assert stops_deviance(worse * q, 3) > stops_deviance(q, 3)
    assert stops_deviance(np.where(np.arange(12) == lost, np.inf, q), 3) > stops_deviance(q, 3)


def test_edges_that_are_less_certain_do_not_explain_more() -> None:
    """Waves of a face end it by chance with the wrong sign, at points of which little is known."""
    plate_cell, rng = cell('plate'), np.random.default_rng(0)

    def fit_of(error: float, stated: float) -> Fit:
        samples = [replace(s, features=tuple(
            replace(f, point=f.point + rng.normal(0, error) * f.direction, std=stated)
            if isinstance(f, EdgePoint) else f for f in s.features)) for s in plate_cell.samples]
        return fit_of_samples(samples, plate_cell.config, [s.stamp for s in samples])

    waved, stray = fit_of(6e-5, 2e-5), fit_of(2e-4, 3e-4)
    assert stray.variance_factor < waved.variance_factor
    assert stray.evidence_over(waved) < 0


def tilted(raw: Raw, types: dict[str, str], degrees: float, each: bool = True) -> Raw:
    """Return a message whose points (x, 0, z) are turned about x; each: or all by the same y."""
    if types[raw.topic] != CLOUD_TYPE:
        return raw
    cloud = TYPES.deserialize_cdr(raw.data, CLOUD_TYPE)
    cloud.data = cloud.data.copy()
    z = np.array(view(cloud, 'z'))
    y = z if each or np.isnan(z).all() else np.nanmean(z)
    view(cloud, 'y')[...] = y * math.sin(math.radians(degrees))
    view(cloud, 'z')[...] = z * math.cos(math.radians(degrees))
    return raw._replace(data=bytes(TYPES.serialize_cdr(cloud, CLOUD_TYPE)))


@pytest.mark.parametrize(('name', 'degrees'), [('plate', 3.0), ('sphere', 12.0)])
def test_a_tilted_light_plane_is_refused(name: str, degrees: float, tmp_path: Path) -> None:
    types, _ = scan(ROOT / 'bags' / name)
    bag = with_messages(ROOT / 'bags' / name, tmp_path, lambda raw: tilted(raw, types, degrees))
    config = configs.load(ROOT / 'config' / f'{name}.yaml')
    with pytest.raises(HandeyeError, match='tilted') as refused:
        recording = read(bag, config)
        pipeline.calibrate(recording.profiles, recording.poses, config)
    assert 'static transform' in str(refused.value)


def test_a_tilted_light_plane_is_told_again_by_a_session_that_continues(tmp_path: Path) -> None:
    types, _ = scan(ROOT / 'bags' / 'plate')
    bag = with_messages(ROOT / 'bags' / 'plate', tmp_path,
                        lambda raw: tilted(raw, types, 3.0, False))
    config = replace(configs.load(ROOT / 'config' / 'plate.yaml'), output_dir=str(tmp_path))
    live = fed(config, read(bag, config))
    live.files.close()
    for session in (live, new(replace(live.config, session='last'))):
        with pytest.raises(HandeyeError, match='light plane that is tilted'):
            computed(session)
