"""The simulator: its recordings against geometry worked out another way, its noise as stated."""
from __future__ import annotations

from dataclasses import replace
import math

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Profile
from handeye_ros.simulate import (
    distortion,
    Scenario,
    SCENARIOS,
    settings,
    simulate,
    simulate_samples,
    Simulated,
    Station,
)
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.layout import FRAMES
from handeye_ros.simulate.scenario import PlateTarget, SensorModel, SphereTarget
from handeye_ros.simulate.slips import SLIPS
from handeye_ros.simulate.solids import Ball, Box
from handeye_ros.simulate.stations import lift, MOTIONS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

CLEAN = {'noise': 0.0, 'rim_bias': 0.0, 'mixed': 0.0, 'lost': 0.0, 'lost_at_edge': 0.0,
         'outliers': 0.0}
DOWN = se3.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.175]))


def scenario(name: str, columns: int = 320, rate: float = 6.0, **sensor: float) -> Scenario:
    """Return a scenario in a size that is quick to render."""
    found = SCENARIOS[name]
    return replace(found, sensor=replace(found.sensor, columns=columns, rate=rate, **sensor),
                   robot=replace(found.robot, rate=20.0))


def clean(name: str, **sensor: float) -> Simulated:
    """Return a recording without noise and faults; what the light does not reach is lost."""
    return simulate(scenario(name, **CLEAN, **sensor), np.random.default_rng(3))


def seen_at(recording: Simulated, station: Station) -> list[Profile]:
    delay = int(recording.scenario.sensor.delay * 1e9)
    return [p for p in recording.profiles if station.start <= p.stamp - delay < station.end]


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


# -- every scenario


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_scenario_makes_an_ordered_recording_and_readable_settings(name: str) -> None:
    recording = simulate(scenario(name, columns=64, rate=3.0), np.random.default_rng(0))
    for stream in (recording.profiles, recording.poses):
        stamps = [item.stamp for item in stream]
        assert len(stamps) > 20 and stamps == sorted(set(stamps))
    assert len(recording.truth.stations) == sum(recording.scenario.stations)
    quaternions = np.array([pose.quaternion for pose in recording.poses])
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1)
    config = with_values(Config(), settings(recording.scenario), name)
    assert config.profile.axes == recording.profiles[0].axes


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_scenario_makes_samples(name: str) -> None:
    samples, truth = simulate_samples(SCENARIOS[name], np.random.default_rng(0))
    assert len(samples) == len(truth.stations) == sum(SCENARIOS[name].stations)
    assert all(sample.features for sample in samples)


def test_the_seed_decides_everything() -> None:
    one, same, other = (simulate(scenario('plate'), np.random.default_rng(s)) for s in (1, 1, 2))
    for a, b in zip(one.profiles, same.profiles, strict=True):
        assert a.stamp == b.stamp and np.array_equal(a.points, b.points, equal_nan=True)
    for p, q in zip(one.poses, same.poses, strict=True):
        assert np.array_equal(p.translation, q.translation)
    assert np.array_equal(one.truth.T_flange_sensor, same.truth.T_flange_sensor)
    assert not np.allclose(one.truth.T_flange_sensor, other.truth.T_flange_sensor)


# -- geometry


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
    floor = Box((-1, -1, -0.1), (1, 1, 0))
    wall = Box((-1, 0.010, 0), (1, 0.012, 0.02))  # along the light plane, 10 mm beside it
    for y, seen in [(0.07, True), (-0.07, True), (0.1, True), (-0.1, False)]:
        # the sensor looks down, so its y runs against the world's; from the light plane's foot a
        # camera at 0.175 m is seen over the wall up to 0.0875 m beside the laser
        sensor = SensorModel(columns=65, camera=(y, 0.0))
        assert np.isfinite(sensors.render(sensor, (floor,), DOWN[None])[0]).all()
        assert np.isfinite(sensors.render(sensor, (floor, wall), DOWN[None])[0]).all() == seen


def test_a_step_casts_a_shadow_where_the_geometry_says() -> None:
    # a step of height h at y = x / 2: from the camera at +y (world: -y) points next to it are hid
    step, floor = Box((0.0, -1, -0.1), (1, 1, 0.0)), Box((-1, -1, -0.2), (1, 1, -0.02))
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
    floor = (Box((-1, -1, -1), (1, 1, 0)),)
    for sampling in ('fan', 'x'):
        sensor = SensorModel(columns=801, sampling=sampling)
        for range_ in (0.151, 0.199):
            T = DOWN.copy()
            T[2, 3] = range_
            points = sensors.plane_points(sensor, sensors.render(sensor, floor, T[None])[0])[0]
            assert np.nanmax(points[:, 0]) == pytest.approx(0.14 * range_, abs=8e-5)
        T[2, 3] = 0.201
        assert np.isnan(sensors.render(sensor, floor, T[None])[0]).all()


def test_the_stations_fill_the_field_of_view_and_tilt_as_told() -> None:
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


# -- noise


def test_the_range_noise_is_as_stated() -> None:
    quiet, loud = {**CLEAN}, {**CLEAN, 'noise': 3e-5}
    sensor = SensorModel(columns=640, **loud)
    z, angle = sensors.render(sensor, (Box((-1, -1, -1), (1, 1, 0)),), DOWN[None])
    z, angle = np.tile(z, (40, 1)), np.tile(angle, (40, 1))
    noise = sensors.measure(sensor, z, angle, np.random.default_rng(8)) - z
    assert noise.std() == pytest.approx(3e-5, rel=0.02) and abs(noise.mean()) < 1e-6
    still = sensors.measure(SensorModel(columns=640, **quiet), z, angle, np.random.default_rng(8))
    assert np.abs(still - z).max() < 1e-7


def test_faults_occur_as_often_as_stated() -> None:
    sensor = SensorModel(columns=640, lost=0.01, outliers=0.02, mixed=0.0)
    z, angle = sensors.render(sensor, (Box((-1, -1, -1), (1, 1, 0)),), DOWN[None])
    z, angle = np.tile(z, (60, 1)), np.tile(angle, (60, 1))
    measured = sensors.measure(sensor, z, angle, np.random.default_rng(9))
    assert np.isnan(measured).mean() == pytest.approx(0.01, rel=0.15)
    assert (np.abs(measured - z) > 3e-4).mean() == pytest.approx(0.02, rel=0.15)


def test_mixed_points_lie_between_the_levels_of_a_step() -> None:
    sensor = SensorModel(columns=640, **{**CLEAN, 'mixed': 1.0})
    solids = (Box((-1, -1, -1), (1, 1, 0)), Box((0, -1, 0), (1, 1, 0.01)))
    z, angle = (np.tile(a, (50, 1)) for a in sensors.render(sensor, solids, DOWN[None]))
    measured = sensors.measure(sensor, z, angle, np.random.default_rng(10))
    between = (measured > 0.1652) & (measured < 0.1748)
    assert between.any(axis=1).mean() > 0.8 and between.sum(axis=1).max() == 1
    without = sensors.measure(replace(sensor, mixed=0.0), z, angle, np.random.default_rng(10))
    assert not ((without > 0.1652) & (without < 0.1748)).any()


def test_more_points_are_lost_at_a_step_than_elsewhere() -> None:
    sensor = SensorModel(columns=640, **{**CLEAN, 'lost_at_edge': 0.5})
    z, angle = (np.tile(a, (50, 1)) for a in sensors.render(
        sensor, (Box((0, -1, -1), (1, 1, 0)),), DOWN[None]))
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
        bent = distortion.draw(sensor, rng)
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


# -- samples


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


# -- streams


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


@pytest.mark.parametrize(('name', 'undo'), [
    ('inverted', lambda t, q: (-Rotation.from_quat(q).inv().apply(t),
                               Rotation.from_quat(q).inv().as_quat())),
    ('wxyz', lambda t, q: (t, q[:, [1, 2, 3, 0]])),
    ('millimetres', lambda t, q: (t / 1000, q)),
    ('degrees', None),
    ('intrinsic', lambda t, q: (t, Rotation.from_euler(
        'xyz', Rotation.from_quat(q).as_euler('XYZ')).as_quat())),
])
def test_slips_are_what_they_are_called(name: str, undo) -> None:
    good, bad = (simulate(scenario(n, columns=16), np.random.default_rng(16)) for n in (
        'plate', 'inverted_poses' if name == 'inverted' else name))
    (t, q), (t_bad, q_bad) = ((np.array([p.translation for p in r.poses]),
                               np.array([p.quaternion for p in r.poses])) for r in (good, bad))
    assert set(SLIPS) == {'inverted', 'wxyz', 'millimetres', 'degrees', 'intrinsic'}
    if undo is None:  # degrees wrap around: they cannot be undone, but done again
        angles = np.degrees(Rotation.from_quat(q).as_euler('xyz'))
        t_bad, q_bad, q = t_bad, q_bad, Rotation.from_euler('xyz', angles).as_quat()
    else:
        t_bad, q_bad = undo(t_bad, q_bad)
    assert np.allclose(t, t_bad)
    assert se3.angle(Rotation.from_quat(q).as_matrix()
                     @ Rotation.from_quat(q_bad).inv().as_matrix()).max() < 1e-9


@pytest.mark.parametrize(('name', 'mark'), [
    ('plate', np.isnan), ('plate_inf', np.isposinf)])
def test_lost_points_are_marked_as_the_driver_does(name: str, mark) -> None:
    recording = simulate(scenario(name), np.random.default_rng(17))
    points = np.concatenate([profile.points for profile in recording.profiles])
    lost = ~np.isfinite(points).all(axis=1)
    assert lost.any() and mark(points[lost]).all()
    omitted = simulate(scenario('plate_omit'), np.random.default_rng(17))
    left = np.concatenate([profile.points for profile in omitted.profiles])
    assert np.array_equal(left, points[~lost])


def test_nothing_in_sight_gives_no_more_than_stray_points() -> None:
    recording = simulate(scenario('nothing_in_sight'), np.random.default_rng(18))
    points = np.concatenate([profile.points for profile in recording.profiles])
    assert np.isfinite(points).all(axis=1).mean() < 0.005
