# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scenarios: the recordings and samples that they make."""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros import se3
from handeye_ros.cli.simulated import CELLS
from handeye_ros.config import Config, with_values
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine
from handeye_ros.simulate import (
    FAULTS,
    Scenario,
    SCENARIOS,
    settings,
    simulate,
    simulate_samples,
    TrueStop,
    Truth,
)
from handeye_ros.simulate.sensor import lift
import numpy as np
import pytest


def scenario(name: str, columns: int = 320, rate: float = 6.0) -> Scenario:
    """Return a scenario in a size that is quick to render."""
    full = CELLS[name]
    return replace(full, sensor=replace(full.sensor, columns=columns, rate=rate),
                   robot=replace(full.robot, rate=20.0))


@pytest.mark.parametrize('name', [*SCENARIOS, *(
    pytest.param(name, marks=pytest.mark.thorough) for name in FAULTS)])
def test_every_scenario_makes_an_ordered_recording_samples_and_settings(name: str) -> None:
    recording = simulate(scenario(name, columns=64, rate=3.0), np.random.default_rng(0))
    for stream in (recording.profiles, recording.poses):
        stamps = [item.stamp for item in stream]
        assert len(stamps) > 15 and stamps == sorted(set(stamps))
    quaternions = np.array([pose.quaternion for pose in recording.poses])
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
    config = with_values(Config(), settings(recording.scenario), name)
    assert config.profile.axes == recording.profiles[0].axes
    samples, truth = simulate_samples(CELLS[name], np.random.default_rng(0))
    assert all(sample.features for sample in samples)
    assert {len(samples), len(truth.stops), len(recording.truth.stops)} == {
        sum(CELLS[name].stops) * CELLS[name].repeats}


def test_lost_points_are_marked_as_the_driver_does() -> None:
    points = {}
    for name in ('plate', 'plate_inf', 'plate_omit'):
        recording = simulate(scenario(name), np.random.default_rng(17))
        points[name] = np.concatenate([profile.points for profile in recording.profiles])
    lost = np.isnan(points['plate']).any(axis=1)
    assert lost.any() and np.isposinf(points['plate_inf'][lost]).all()
    for name in ('plate_inf', 'plate_omit'):
        returned = points[name][np.isfinite(points[name]).all(axis=1)]
        assert np.array_equal(returned, points['plate'][~lost])
    assert len(points['plate_omit']) == np.count_nonzero(~lost)


def test_the_stops_fill_the_field_of_view_in_an_order_as_asked() -> None:
    _, truth = simulate_samples(SCENARIOS['plate'], np.random.default_rng(6))
    x, z = np.array([stop.point for stop in truth.stops]).T
    assert x.min() < -7e-3 and x.max() > 7e-3 and np.abs(x).max() < 0.02
    assert 0.160 < z.min() < 0.166 and 0.184 < z.max() < 0.190
    assert [s.label for s in truth.stops] != sorted(s.label for s in truth.stops)
    _, truth = simulate_samples(SCENARIOS['plate_in_order'], np.random.default_rng(6))
    assert [s.label for s in truth.stops] == ['p'] * 9 + ['q'] * 9


def T_target_sensor(stop: TrueStop, truth: Truth) -> Array:
    return se3.inverse(truth.T_base_target) @ stop.T_base_flange @ truth.T_flange_sensor


def of_face(face: FaceLine, T: Array, axis: int) -> list[float]:
    """Return the heights at +- spread over the face with its normal on an axis, in sigmas."""
    ends = face.centre + np.array([[-1], [1]]) * face.spread * face.direction
    # a height above the face is an offset in the sensor plane, over the plane's slope
    slope = np.hypot(*T[axis, [0, 2]])
    return list(se3.apply(T, lift(ends))[:, axis] / slope / (math.sqrt(2) * face.std))


@pytest.mark.parametrize('name', ['plate', 'plane', 'wedge'])
def test_lines_and_edges_have_the_noise_that_they_state(name: str) -> None:
    pulls = []
    for seed in range(50):
        samples, truth = simulate_samples(CELLS[name], np.random.default_rng(seed))
        for sample, stop in zip(samples, truth.stops, strict=True):
            T = T_target_sensor(stop, truth)
            face, *others = sample.features
            if name == 'wedge':  # which face is which, its normal tells
                pulls += [min((of_face(f, T, axis) for axis in (1, 2)),
                              key=lambda pull: np.abs(pull).max()) for f in sample.features]
                continue
            pulls.append(of_face(face, T, 2))
            for edge in others:
                assert isinstance(edge, EdgePoint)
                away, normal = edge.point - face.centre, edge.direction[::-1] * [-1, 1]
                assert abs(away @ normal) < 1e-12 and away @ edge.direction > face.spread
                error = edge.point - stop.point
                pulls[-1] += [error @ edge.direction / edge.std, error @ normal / edge.std_across]
    assert np.allclose(np.std(pulls, axis=0), 1, atol=0.09)
    assert np.allclose(np.mean(pulls, axis=0), 0, atol=0.12)


def test_arcs_have_the_noise_that_they_state() -> None:
    pulls, raw = [], []
    for seed in range(20):
        samples, truth = simulate_samples(SCENARIOS['sphere'], np.random.default_rng(seed))
        for sample, stop in zip(samples, truth.stops, strict=True):
            arc, = sample.features
            assert isinstance(arc, Arc)
            points = se3.apply(T_target_sensor(stop, truth), lift(arc.points))
            radial = np.linalg.norm(points, axis=1) - 0.04
            pulls.append(radial / (arc.radius / 0.04) / arc.std)
            raw.append(np.linalg.norm(arc.measured - arc.centre, axis=1) - arc.radius)
    assert np.std(np.concatenate(pulls)) == pytest.approx(1, abs=0.05)
    assert 1.5e-5 < np.std(np.concatenate(raw)) < 3e-5
