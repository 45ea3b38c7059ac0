# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The simulator against geometry that is worked out another way."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate import SCENARIOS, simulate, simulate_samples, Simulated, Station
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.scenario import PlateTarget, SensorModel, SphereTarget
from handeye_ros.simulate.scenes import MOTIONS
from handeye_ros.simulate.sensor import FRAMES, lift
from handeye_ros.simulate.solids import Ball, box
import numpy as np
import pytest
from scenes import CLEAN, DOWN, scenario, seen_at
from scipy.spatial.transform import Rotation


def clean(name: str, **sensor: float) -> Simulated:
    """Return a recording without noise and faults; what the light does not reach is lost."""
    return simulate(scenario(name, **CLEAN, **sensor), np.random.default_rng(3))


def in_target(recording: Simulated, station: Station, points: Array) -> Array:
    """Return points (n, 2) of a profile in the target frame (n, 3), lost ones left out."""
    axes = ['xyz'.index(axis) for axis in FRAMES[recording.scenario.layout.frame].axes]
    embedded = np.zeros((len(points), 3))
    embedded[:, axes] = points
    truth, T = recording.truth, station.T_base_flange
    if recording.scenario.calibration_type == 'eye_on_base':
        T = se3.inverse(T)
    T_target_sensor = se3.inverse(truth.T_base_target) @ T @ truth.T_flange_sensor
    return se3.apply(T_target_sensor, embedded[np.isfinite(points).all(axis=1)])


@pytest.mark.parametrize('name', [
    'plate_in_air', 'plate_x_reversed', 'plate_z_up', 'plate_y_along_line', 'plate_omit',
    'plate_inf', 'eye_on_base', 'plate_resampled', 'tilt_only', 'wrong_edges', 'yaw_only'])
def test_profiles_lie_on_the_surface_of_the_plate(name: str) -> None:
    recording = simulate(
        replace(scenario(name, **CLEAN), target=PlateTarget(table=None)), np.random.default_rng(4))
    length, width = recording.scenario.target.size
    for station in recording.truth.stations:
        points = in_target(recording, station, seen_at(recording, station)[0].points)
        depth, (x, y) = points[:, 2], points[:, :2].T
        face = np.abs(depth) < 5e-6
        sides = np.abs(np.stack([x, x - length, y, y - width])).min(axis=0) < 5e-6
        assert face.sum() > 20
        assert (face | sides).all()
        assert ((x > -5e-6) & (x < length + 5e-6) & (y > -5e-6) & (y < width + 5e-6)).all()


def test_clutter_stands_beside_the_plate_at_its_height() -> None:
    recording = clean('plate_clutter_high')
    seen = np.concatenate([in_target(recording, s, seen_at(recording, s)[0].points)
                           for s in recording.truth.stations])
    tops = seen[np.abs(seen[:, 2] - 0.002) < 1e-9]
    assert len(tops) > 200
    x, y = tops[:, :2].T
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


def test_profiles_of_the_sphere_lie_on_ball_block_or_table() -> None:
    recording = simulate(replace(scenario('sphere', **CLEAN)),
                         np.random.default_rng(5))
    target = recording.scenario.target
    assert isinstance(target, SphereTarget) and target.table is not None
    for station in recording.truth.stations:
        points = in_target(recording, station, seen_at(recording, station)[0].points)
        radius = np.linalg.norm(points, axis=1)
        ball = np.abs(radius - target.radius) < 1e-9
        table = np.abs(points[:, 2] + target.table) < 1e-9
        block = (points[:, 0] > 0.048 - 1e-9) & (points[:, 2] < -0.015 + 1e-9)
        assert ball.sum() > 50
        assert (ball | table | block).all()
        centre = in_target(recording, station, station.point[None])[0]
        assert np.linalg.norm(centre) < 0.6 * target.radius + 1e-9


def test_a_wall_hides_from_the_camera_what_is_behind_it() -> None:
    floor = box((-1, -1, -0.1), (1, 1, 0))
    wall = box((-1, 0.010, 0), (1, 0.012, 0.02))  # along the light plane, 10 mm beside it
    for y, seen in [(0.07, True), (-0.07, True), (0.1, True), (-0.1, False)]:
        # the sensor looks down, so its y runs against the world's; from the light plane's foot a
        # camera at 0.175 m is seen over the wall up to 0.0875 m beside the laser
        sensor = SensorModel(columns=65, camera=(y, 0.0))
        assert np.isfinite(sensors.render(sensor, (floor,), DOWN[None])[0]).all()
        assert np.isfinite(sensors.render(sensor, (floor, wall), DOWN[None])[0]).all() == seen


def test_a_step_casts_a_shadow_where_the_geometry_says() -> None:
    # a step of height h at y = x / 2: from the camera at +y (world: -y) points next to it are hid
    step, floor = box((0.0, -1, -0.1), (1, 1, 0.0)), box((-1, -1, -0.2), (1, 1, -0.02))
    turned = DOWN.copy()
    turned[:3, :3] = Rotation.from_rotvec([0, 0, 0.5]).as_matrix() @ DOWN[:3, :3]
    sensor = SensorModel(columns=2001, camera=(0.07, 0.0))
    z, _ = sensors.render(sensor, (step, floor), turned[None])
    points = sensors.plane_points(sensor, z)[0]
    world = se3.apply(turned, lift(points[np.isfinite(z[0])]))
    eye = se3.apply(turned, np.array([[0.0, 0.07, 0.0]]))[0]
    lower = world[world[:, 2] < -0.01]
    # the line of sight over the top edge x = 0, z = 0 meets the floor at x = -0.02 eye_x / eye_z
    shadow = -0.02 * eye[0] / eye[2] if eye[0] > 0 else 0.0
    assert eye[0] > 0.01 and shadow < -1e-3
    assert lower[:, 0].max() == pytest.approx(shadow, abs=1e-4)
    assert world[world[:, 2] > -0.01][:, 0].min() == pytest.approx(0.0, abs=1e-4)


def test_rays_meet_the_ball_where_the_circle_is() -> None:
    sensor = SensorModel(columns=201, range=(0.05, 0.5), half_width=0.3, max_incidence=1.0)
    z, angle = sensors.render(sensor, (Ball(0.04),), DOWN[None])
    points = sensors.plane_points(sensor, z)[0]
    seen = np.isfinite(z[0])
    towards = points[seen] / np.linalg.norm(points[seen], axis=1, keepdims=True)
    outwards = (points[seen] - [0, 0.175]) / 0.04
    assert np.allclose(np.linalg.norm(outwards, axis=1), 1)
    assert np.allclose(np.cos(angle[0, seen]), -(towards * outwards).sum(axis=1))
    assert 0.9 < angle[0, seen].max() < 1.0 and not seen.all()


def test_the_field_of_view_is_a_trapezoid() -> None:
    floor = (box((-1, -1, -1), (1, 1, 0)),)
    for sampling in ('fan', 'x'):
        sensor = SensorModel(columns=801, sampling=sampling)
        for range_ in (0.151, 0.199):
            T = DOWN.copy()
            T[2, 3] = range_
            points = sensors.plane_points(sensor, sensors.render(sensor, floor, T[None])[0])[0]
            assert np.nanmax(points[:, 0]) == pytest.approx(0.14 * range_, abs=8e-5)
        T[2, 3] = 0.201
        assert np.isnan(sensors.render(sensor, floor, T[None])[0]).all()


def test_the_stations_fill_the_field_of_view_and_tilt_as_reported() -> None:
    _, truth = simulate_samples(SCENARIOS['plate'], np.random.default_rng(6))
    x, z = np.array([station.point for station in truth.stations]).T
    assert x.min() < -7e-3 and x.max() > 7e-3 and np.abs(x).max() < 0.02
    assert 0.160 < z.min() < 0.166 and 0.184 < z.max() < 0.190
    assert [s.label for s in truth.stations] != sorted(s.label for s in truth.stations)
    ordered, truth = simulate_samples(SCENARIOS['plate_in_order'], np.random.default_rng(6))
    assert [s.label for s in truth.stations] == ['p'] * 9 + ['q'] * 9


@pytest.mark.parametrize(('motion', 'rank'), [
    ('general', 3), ('one_orientation', 0), ('tilt_only', 1), ('yaw_only', 1)])
def test_motions_turn_about_as_many_axes_as_they_say(motion: str, rank: int) -> None:
    made = replace(SCENARIOS['plate'], motion=motion)
    _, truth = simulate_samples(made, np.random.default_rng(7))
    R = np.array([station.T_base_flange[:3, :3] for station in truth.stations])
    turns = se3.log_rotation(R @ R[0].T)
    assert np.linalg.matrix_rank(turns, tol=1e-6) == rank
    assert motion in MOTIONS


def test_one_orientation_per_edge_has_two() -> None:
    _, truth = simulate_samples(SCENARIOS['one_orientation_per_edge'], np.random.default_rng(7))
    for label in 'pq':
        R = np.array([s.T_base_flange[:3, :3] for s in truth.stations if s.label == label])
        assert np.allclose(R, R[0])
