# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings: every scenario, what its robot does and what its driver sends."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.simulate import SCENARIOS, settings, simulate, simulate_samples
from handeye_ros.simulate.robot import CONVENTION_ERRORS
import numpy as np
import pytest
from scenes import scenario, seen_at
from scipy.spatial.transform import Rotation


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_scenario_makes_an_ordered_recording_samples_and_settings(name: str) -> None:
    recording = simulate(scenario(name, columns=64, rate=3.0), np.random.default_rng(0))
    for stream in (recording.profiles, recording.poses):
        stamps = [item.stamp for item in stream]
        assert len(stamps) > 20 and stamps == sorted(set(stamps))
    quaternions = np.array([pose.quaternion for pose in recording.poses])
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
    config = with_values(Config(), settings(recording.scenario), name)
    assert config.profile.axes == recording.profiles[0].axes
    samples, truth = simulate_samples(SCENARIOS[name], np.random.default_rng(0))
    assert all(sample.features for sample in samples)
    assert {len(samples), len(truth.stations), len(recording.truth.stations)} == {
        sum(SCENARIOS[name].stations)}


def test_the_seed_decides_everything() -> None:
    one, same, other = (simulate(scenario('plate'), np.random.default_rng(s)) for s in (1, 1, 2))
    for a, b in zip(one.profiles, same.profiles, strict=True):
        assert a.stamp == b.stamp and np.array_equal(a.points, b.points, equal_nan=True)
    assert all(np.array_equal(p.translation, q.translation)
               for p, q in zip(one.poses, same.poses, strict=True))
    assert not np.allclose(one.truth.T_flange_sensor, other.truth.T_flange_sensor)


def test_the_robot_stands_still_at_its_stations_and_moves_in_between() -> None:
    recording = simulate(SCENARIOS['plate'], np.random.default_rng(14))
    stamps = np.array([pose.stamp for pose in recording.poses])
    T = np.array([se3.from_quaternion(p.translation, p.quaternion) for p in recording.poses])
    for station in recording.truth.stations:
        still = T[(stamps >= station.start) & (stamps <= station.end)]
        assert len(still) >= 100
        assert np.allclose(still, station.T_base_flange_reported, atol=1e-5)
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    assert 1e-3 < steps.max() < 0.02
    assert len(recording.profiles) == pytest.approx(30 * 38.4, abs=2)


def test_every_nth_profile_is_recorded_on_the_way() -> None:
    all_of_them, thinned = (
        simulate(scenario('plate', thinning=n), np.random.default_rng(15)) for n in (1, 3))
    stamps = {profile.stamp for profile in thinned.profiles}
    for station in all_of_them.truth.stations:
        assert all(p.stamp in stamps for p in seen_at(all_of_them, station))
    assert len(thinned.profiles) < 0.7 * len(all_of_them.profiles)


@pytest.mark.parametrize('name', CONVENTION_ERRORS)
def test_convention_errors_are_what_they_are_called(name: str) -> None:
    good, bad = (simulate(scenario(n, columns=16), np.random.default_rng(16)) for n in (
        'plate', 'inverted_poses' if name == 'inverted' else name))
    (t, q), (t_bad, q_bad) = ((np.array([p.translation for p in r.poses]),
                               np.array([p.quaternion for p in r.poses])) for r in (good, bad))
    R, angles = Rotation.from_quat(q), Rotation.from_quat(q).as_euler('xyz')
    t_expected, R_expected = {
        'inverted': (-R.inv().apply(t), R.inv()),
        'wxyz': (t, Rotation.from_quat(q[:, [3, 0, 1, 2]])),
        'millimetres': (1000 * t, R),
        'degrees': (t, Rotation.from_euler('xyz', np.degrees(angles))),
        'intrinsic': (t, Rotation.from_euler('XYZ', angles))}[name]
    assert np.allclose(t_bad, t_expected)
    assert (R_expected * Rotation.from_quat(q_bad).inv()).magnitude().max() < 1e-9


def test_lost_points_are_marked_as_the_driver_does() -> None:
    points = {}
    for name in ('plate', 'plate_inf', 'plate_omit'):
        recording = simulate(scenario(name), np.random.default_rng(17))
        points[name] = np.concatenate([profile.points for profile in recording.profiles])
    lost = np.isnan(points['plate']).any(axis=1)
    assert lost.any() and np.isposinf(points['plate_inf'][lost]).all()
    for name in ('plate_inf', 'plate_omit'):
        left = points[name][np.isfinite(points[name]).all(axis=1)]
        assert np.array_equal(left, points['plate'][~lost])
    assert len(points['plate_omit']) == np.count_nonzero(~lost)


def test_nothing_in_sight_gives_no_more_than_stray_points() -> None:
    recording = simulate(scenario('nothing_in_sight'), np.random.default_rng(18))
    points = np.concatenate([profile.points for profile in recording.profiles])
    assert np.isfinite(points).all(axis=1).mean() < 0.005
