# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings: every scenario, what its robot does and what its driver sends."""
from __future__ import annotations

from handeye_ros.config import Config, with_values
from handeye_ros.simulate import SCENARIOS, settings, simulate, simulate_samples
from handeye_ros.simulate.robot import CONVENTION_ERRORS
import numpy as np
import pytest
from scenes import scenario
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
