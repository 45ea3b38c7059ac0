# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The noise and the faults of the simulator are as they are stated."""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine
from handeye_ros.simulate import Scenario, SCENARIOS, simulate_samples, Station
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.simulate.sensor import lift
from handeye_ros.simulate.solids import box
import numpy as np
import pytest
from scenes import CLEAN, DOWN


def test_the_range_noise_is_as_stated() -> None:
    quiet, loud = {**CLEAN}, {**CLEAN, 'noise': 3e-5}
    sensor = SensorModel(columns=640, **loud)
    z, angle = sensors.render(sensor, (box((-1, -1, -1), (1, 1, 0)),), DOWN[None])
    z, angle = np.tile(z, (40, 1)), np.tile(angle, (40, 1))
    noise = sensors.measure(sensor, z, angle, np.random.default_rng(8)) - z
    assert noise.std() == pytest.approx(3e-5, rel=0.02) and abs(noise.mean()) < 1e-6
    still = sensors.measure(SensorModel(columns=640, **quiet), z, angle, np.random.default_rng(8))
    assert np.abs(still - z).max() < 1e-7


def test_faults_occur_as_often_as_stated() -> None:
    sensor = SensorModel(columns=640, lost=0.01, outliers=0.02, mixed=0.0)
    z, angle = sensors.render(sensor, (box((-1, -1, -1), (1, 1, 0)),), DOWN[None])
    z, angle = np.tile(z, (60, 1)), np.tile(angle, (60, 1))
    measured = sensors.measure(sensor, z, angle, np.random.default_rng(9))
    assert np.isnan(measured).mean() == pytest.approx(0.01, rel=0.15)
    assert (np.abs(measured - z) > 3e-4).mean() == pytest.approx(0.02, rel=0.15)


def test_mixed_points_lie_between_the_levels_of_a_step() -> None:
    sensor = SensorModel(columns=640, **{**CLEAN, 'mixed': 1.0})
    solids = (box((-1, -1, -1), (1, 1, 0)), box((0, -1, 0), (1, 1, 0.01)))
    z, angle = (np.tile(a, (50, 1)) for a in sensors.render(sensor, solids, DOWN[None]))
    measured = sensors.measure(sensor, z, angle, np.random.default_rng(10))
    between = (measured > 0.1652) & (measured < 0.1748)
    assert between.any(axis=1).mean() > 0.8 and between.sum(axis=1).max() == 1
    without = sensors.measure(replace(sensor, mixed=0.0), z, angle, np.random.default_rng(10))
    assert not ((without > 0.1652) & (without < 0.1748)).any()


def test_more_points_are_lost_at_a_step_than_elsewhere() -> None:
    sensor = SensorModel(columns=640, **{**CLEAN, 'lost_at_edge': 0.5})
    z, angle = (np.tile(a, (50, 1)) for a in sensors.render(
        sensor, (box((0, -1, -1), (1, 1, 0)),), DOWN[None]))
    lost = np.isnan(sensors.measure(sensor, z, angle, np.random.default_rng(11))) & np.isfinite(z)
    first = int(np.argmax(np.isfinite(z[0])))
    assert lost[:, first:first + 3].mean() == pytest.approx(0.5, abs=0.1)
    assert not lost[:, first + 3:].any()


def test_the_distortion_is_smooth_and_of_the_stated_size() -> None:
    rms = []
    for seed in range(40):
        sensor = SensorModel(columns=200, **{**CLEAN, 'distortion': 1e-4})
        z = np.tile(np.linspace(*sensor.range, 100)[:, None], (1, 200))
        rng = np.random.default_rng(seed)
        bent = sensors.draw_distortion(sensor, rng)
        error = sensors.measure(sensor, z, np.zeros_like(z), rng, bent) - z
        assert np.abs(np.diff(error, axis=1)).max() < 6e-5
        rms.append(np.sqrt((error**2).mean()))
    assert np.median(rms) == pytest.approx(1e-4, rel=0.1)


def test_the_robot_errs_as_stated() -> None:
    errors = np.concatenate([_pose_errors(SCENARIOS['plate'], seed) for seed in range(60)])
    sigma = np.repeat(SCENARIOS['plate'].robot.repeatability, 3)
    assert np.allclose(errors.std(axis=0) / sigma, 1, atol=0.1)
    assert np.allclose(errors.mean(axis=0) / sigma, 0, atol=0.15)


def test_a_real_robot_errs_systematically() -> None:
    made = SCENARIOS['plate_real_robot']
    errors = np.concatenate([_pose_errors(made, seed) for seed in range(150)])
    rms = np.sqrt((errors.reshape(-1, 2, 3)**2).sum(axis=2).mean(axis=0))
    assert rms == pytest.approx([1.5e-4, math.radians(0.02)], rel=0.15)
    # each direction of the error is shared by the stations of a recording, in part
    per_recording = [_pose_errors(made, seed).mean(axis=0)[:3] for seed in range(50)]
    assert np.linalg.norm(per_recording, axis=1).mean() > 4e-5


def _pose_errors(made: Scenario, seed: int) -> Array:
    _, truth = simulate_samples(made, np.random.default_rng(seed))
    return np.array([se3.difference(s.T_base_flange_reported, s.T_base_flange)
                     for s in truth.stations])


def test_a_bumped_station_stands_out() -> None:
    errors = np.linalg.norm(_pose_errors(SCENARIOS['bumped'], 12)[:, :3], axis=1)
    assert (errors > 1e-3).sum() == 1


def test_features_have_the_noise_that_they_state() -> None:
    pulls = []
    for seed in range(60):
        samples, truth = simulate_samples(SCENARIOS['plate'], np.random.default_rng(seed))
        for sample, station in zip(samples, truth.stations, strict=True):
            pulls.append(_pulls(sample.features, station, truth))
    assert np.allclose(np.std(pulls, axis=0), 1, atol=0.08)
    assert np.allclose(np.mean(pulls, axis=0), 0, atol=0.12)


def _pulls(features, station: Station, truth) -> list[float]:
    """Return the errors in units of their sigma: face at +- spread, edge along and across."""
    face, edge = features
    assert isinstance(face, FaceLine) and isinstance(edge, EdgePoint)
    T = se3.inverse(truth.T_base_target) @ station.T_base_flange @ truth.T_flange_sensor
    ends = np.stack([face.centre - face.spread * face.direction,
                     face.centre + face.spread * face.direction])
    # a height above the face is an offset in the sensor plane, over the plane's slope
    slope = np.hypot(*T[2, [0, 2]])
    heights = se3.apply(T, lift(ends))[:, 2] / slope / (math.sqrt(2) * face.std)
    error = edge.point - station.point
    normal = np.array([-edge.direction[1], edge.direction[0]])
    return [*heights, error @ edge.direction / edge.std, error @ normal / edge.std_across]


def test_edge_points_lie_on_their_face_line_and_look_out_of_the_face() -> None:
    samples, _ = simulate_samples(SCENARIOS['plate'], np.random.default_rng(13))
    for sample in samples:
        face, edge = sample.features
        assert isinstance(face, FaceLine) and isinstance(edge, EdgePoint)
        away = edge.point - face.centre
        assert abs(away[0] * face.direction[1] - away[1] * face.direction[0]) < 1e-12
        assert away @ edge.direction > face.spread


def test_arcs_have_the_noise_that_they_state() -> None:
    pulls, raw = [], []
    for seed in range(20):
        samples, truth = simulate_samples(SCENARIOS['sphere'], np.random.default_rng(seed))
        for sample, station in zip(samples, truth.stations, strict=True):
            arc, = sample.features
            assert isinstance(arc, Arc)
            T = se3.inverse(truth.T_base_target) @ station.T_base_flange @ truth.T_flange_sensor
            radial = np.linalg.norm(se3.apply(T, lift(arc.points)), axis=1) - 0.04
            pulls.append(radial / (arc.radius / 0.04) / arc.std)
            raw.append(np.linalg.norm(arc.raw - arc.centre, axis=1) - arc.radius)
    assert np.std(np.concatenate(pulls)) == pytest.approx(1, abs=0.05)
    assert 1.5e-5 < np.std(np.concatenate(raw)) < 3e-5
