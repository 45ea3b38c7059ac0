# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Clocks that differ are named, with the time offset that mends them."""
from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import lru_cache, partial
import re

from cells import Recorded, simulated
from handeye_ros import pipeline
from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.config import Config
from handeye_ros.data import Calibration, NS, Profile
from handeye_ros.errors import DataError
from handeye_ros.sampling.stops import Stop
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS
import numpy as np
import pytest


@lru_cache(maxsize=2)
def at_20_hz(target: str) -> Recorded:
    scenario = SCENARIOS[target]
    return simulated(replace(scenario, sensor=replace(scenario.sensor, rate=20.0)), 1)


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
    (replace(FAULTS['wedge, joints and links 1 mm'], stops=(100, 0)), 1),
    (FAULTS['4 + 3, two bad'], 16)], ids=['one stop that ends early', 'few samples, two wrong'])
def test_clocks_are_not_blamed_for_few_wrong_stops(scenario: Scenario, seed: int) -> None:
    recording = simulated(scenario, seed)
    config = recording.config
    require_same_clock(pipeline.gather(recording.profiles, recording.poses, config), config)


def test_to_compare_clocks_each_stored_stop_is_read_once() -> None:
    recording, reads = at_20_hz('plate'), Counter[int]()
    session = pipeline.gather(recording.profiles, recording.poses, recording.config)

    def read(stop: Stop, _: Config) -> Stop:
        reads[stop.stamp] += 1
        return stop
    for stop in session.stops:
        session.add_stop(replace(stop, poses=(), profiles=(), load_messages=partial(read, stop)))
    require_same_clock(session, recording.config)
    assert reads == Counter(stop.stamp for stop in session.stops)


@pytest.mark.filterwarnings('error')
def test_the_clocks_of_one_stop_are_not_blamed() -> None:
    recording = at_20_hz('plate')
    end = recording.truth.stops[0].end
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
    rng, stops = np.random.default_rng(0), recording.truth.stops

    def shaken(profile: Profile) -> Profile:
        for k, at in enumerate(stops):
            share = (profile.stamp - at.start) / (at.end - at.start)
            if 0 <= share <= 1 and (share < 0.4 if k % 3 else share > 0.6):
                return replace(profile, points=profile.points + [0, rng.normal(0, 1e-3)])
        return profile
    session = pipeline.gather(map(shaken, recording.profiles), recording.poses, recording.config)
    require_same_clock(session, recording.config)


def test_a_stop_half_of_whose_arcs_moved_is_no_sample() -> None:
    late, in_time = solved_late('sphere', 0.3), solved_late('sphere', 0.0)
    assert late.quality.residual_rms < 3 * in_time.quality.residual_rms
