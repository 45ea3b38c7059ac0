# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets, stops and features against geometry that is worked out another way."""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine
from handeye_ros.simulate import (
    SCENARIOS,
    simulate,
    simulate_samples,
    Simulated,
    Station,
    Truth,
)
from handeye_ros.simulate.scenario import PlateTarget
from handeye_ros.simulate.sensor import FRAMES, lift
import numpy as np
import pytest
from scenes import CLEAN, scenario, seen_at


def clean(name: str, **values: object) -> Simulated:
    """Return a recording without noise and faults; what the light does not reach is lost."""
    return simulate(replace(scenario(name, **CLEAN), **values), np.random.default_rng(3))


def in_target(recording: Simulated, station: Station, points: Array) -> Array:
    """Return points (n, 2) of a profile in the target frame (n, 3), lost ones left out."""
    axes = ['xyz'.index(axis) for axis in FRAMES[recording.scenario.layout.frame].axes]
    embedded = np.zeros((len(points), 3))
    embedded[:, axes] = points
    T = station.T_base_flange
    if recording.scenario.calibration_type == 'eye_on_base':
        T = se3.inverse(T)
    truth = recording.truth
    T_target_sensor = se3.inverse(truth.T_base_target) @ T @ truth.T_flange_sensor
    return se3.apply(T_target_sensor, embedded[np.isfinite(points).all(axis=1)])


def seen(recording: Simulated) -> list[Array]:
    """Return the points in the target frame of the first profile of each station."""
    return [in_target(recording, station, seen_at(recording, station)[0].points)
            for station in recording.truth.stations]


@pytest.mark.parametrize('name', [
    'plate_in_air', 'plate_x_reversed', 'plate_z_up', 'plate_y_along_line', 'plate_omit',
    'plate_inf', 'eye_on_base', 'plate_resampled', 'tilt_only', 'wrong_edges', 'yaw_only'])
def test_profiles_lie_on_the_surface_of_the_plate(name: str) -> None:
    recording = clean(name, target=PlateTarget(table=None))
    length, width = recording.scenario.target.size
    for points in seen(recording):
        depth, (x, y) = points[:, 2], points[:, :2].T
        face = np.abs(depth) < 5e-6
        sides = np.abs(np.stack([x, x - length, y, y - width])).min(axis=0) < 5e-6
        assert face.sum() > 20 and (face | sides).all()
        assert ((x > -5e-6) & (x < length + 5e-6) & (y > -5e-6) & (y < width + 5e-6)).all()


def test_clutter_stands_beside_the_plate_at_its_height() -> None:
    points = np.concatenate(seen(clean('plate_clutter_high')))
    x, y, _ = points[np.abs(points[:, 2] - 0.002) < 1e-9].T
    assert len(x) > 200
    assert (((x > -0.0181) & (x < -0.0079)) | ((y > -0.0181) & (y < -0.0079))).all()


def test_the_face_ends_within_one_column_of_the_true_edge_point() -> None:
    recording = clean('plate')
    pitch = 2 * recording.scenario.sensor.half_width * 0.2 / 320
    for station in recording.truth.stations:
        (x, y, z), = in_target(recording, station, station.point[None])
        assert abs(z) < 1e-9 and abs(y if station.label == 'p' else x) < 1e-9
        points = seen_at(recording, station)[0].points
        points = points[np.isfinite(points).all(axis=1)]
        face = points[np.abs(in_target(recording, station, points)[:, 2]) < 1e-9]
        assert np.linalg.norm(face - station.point, axis=1).min() < 1.5 * pitch


def test_the_stations_fill_the_field_of_view_in_an_order_as_asked() -> None:
    _, truth = simulate_samples(SCENARIOS['plate'], np.random.default_rng(6))
    x, z = np.array([station.point for station in truth.stations]).T
    assert x.min() < -7e-3 and x.max() > 7e-3 and np.abs(x).max() < 0.02
    assert 0.160 < z.min() < 0.166 and 0.184 < z.max() < 0.190
    assert [s.label for s in truth.stations] != sorted(s.label for s in truth.stations)
    _, truth = simulate_samples(SCENARIOS['plate_in_order'], np.random.default_rng(6))
    assert [s.label for s in truth.stations] == ['p'] * 9 + ['q'] * 9


@pytest.mark.parametrize(('motion', 'rank'), [
    ('general', 3), ('one_orientation', 0), ('tilt_only', 1), ('yaw_only', 1),
    ('one_orientation_per_edge', 1)])
def test_motions_turn_about_as_many_axes_as_they_say(motion: str, rank: int) -> None:
    _, truth = simulate_samples(replace(SCENARIOS['plate'], motion=motion),
                                np.random.default_rng(7))
    R = np.array([station.T_base_flange[:3, :3] for station in truth.stations])
    assert np.linalg.matrix_rank(se3.log_rotation(R @ R[0].T), tol=1e-6) == rank
    if motion == 'one_orientation_per_edge':
        assert len(np.unique(R.round(9), axis=0)) == 2


def T_target_sensor(station: Station, truth: Truth) -> Array:
    return se3.inverse(truth.T_base_target) @ station.T_base_flange @ truth.T_flange_sensor


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
        samples, truth = simulate_samples(SCENARIOS[name], np.random.default_rng(seed))
        for sample, station in zip(samples, truth.stations, strict=True):
            T = T_target_sensor(station, truth)
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
                error = edge.point - station.point
                pulls[-1] += [error @ edge.direction / edge.std, error @ normal / edge.std_across]
    assert np.allclose(np.std(pulls, axis=0), 1, atol=0.09)
    assert np.allclose(np.mean(pulls, axis=0), 0, atol=0.12)


def test_arcs_have_the_noise_that_they_state() -> None:
    pulls, raw = [], []
    for seed in range(20):
        samples, truth = simulate_samples(SCENARIOS['sphere'], np.random.default_rng(seed))
        for sample, station in zip(samples, truth.stations, strict=True):
            arc, = sample.features
            assert isinstance(arc, Arc)
            points = se3.apply(T_target_sensor(station, truth), lift(arc.points))
            radial = np.linalg.norm(points, axis=1) - 0.04
            pulls.append(radial / (arc.radius / 0.04) / arc.std)
            raw.append(np.linalg.norm(arc.raw - arc.centre, axis=1) - arc.radius)
    assert np.std(np.concatenate(pulls)) == pytest.approx(1, abs=0.05)
    assert 1.5e-5 < np.std(np.concatenate(raw)) < 3e-5
