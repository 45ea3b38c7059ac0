"""The simulator's faults of real cells, each against what it is said to be."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.simulate import arm, distortion, FAULTS, optics, settings, simulate, Simulated
from handeye_ros.simulate.scenario import PlateTarget, SensorModel
from handeye_ros.simulate.slab import relief
from handeye_ros.simulate.stations import lift
import numpy as np
import pytest

CLEAN = {'noise': 0.0, 'rim_bias': 0.0, 'mixed': 0.0, 'lost': 0.0, 'lost_at_edge': 0.0,
         'outliers': 0.0}


def clean(name: str, **target: float) -> Simulated:
    scenario = FAULTS[name]
    assert isinstance(scenario.target, PlateTarget)
    return simulate(replace(scenario, sensor=replace(scenario.sensor, columns=640, **CLEAN),
                            target=replace(scenario.target, **target)), np.random.default_rng(5))


def in_target(made: Simulated) -> Array:
    """Return the points (n, 3) of all stations in the target frame."""
    found = []
    for station in made.truth.stations:
        T = se3.inverse(made.truth.T_base_target) @ station.T_base_flange @ (
            made.truth.T_flange_sensor)
        profile = next(p for p in made.profiles if station.start <= p.stamp < station.end)
        points = profile.points[np.isfinite(profile.points).all(axis=1)]
        found.append(se3.apply(T, lift(points)))
    return np.concatenate(found)


@pytest.mark.parametrize('name', FAULTS)
def test_every_fault_makes_an_ordered_recording_and_readable_settings(name: str) -> None:
    scenario = FAULTS[name]
    small = replace(scenario, sensor=replace(scenario.sensor, columns=64))
    made = simulate(small, np.random.default_rng(0))
    for stream in (made.profiles, made.poses):
        stamps = [item.stamp for item in stream]
        assert len(stamps) > 20 and stamps == sorted(set(stamps))
    assert len(made.truth.stations) == sum(scenario.stations) * scenario.repeats
    assert with_values(Config(), settings(scenario), name)


@pytest.mark.parametrize(('name', 'reach'), [('rounded 0.5 mm', 5e-4), ('bevelled 0.5 mm', 5e-4)])
def test_an_edge_that_is_not_sharp_lies_between_face_and_wall(name: str, reach: float) -> None:
    points = in_target(clean(name, table=None))
    off = points[:, :2].min(axis=1)  # from the nearer of the edges p and q, inwards
    z = points[:, 2]
    edge = (off < reach) & (z > -reach)
    assert edge.sum() > 100
    if name.startswith('rounded'):
        away = np.hypot(off[edge] - reach, z[edge] + reach)
        assert np.allclose(away, reach, atol=1e-6)
    else:
        assert np.allclose(off[edge] - z[edge], reach, atol=1e-6)
    assert np.allclose(z[(off > reach) & (z > -reach)], 0, atol=1e-6)


def test_a_bowed_face_is_as_high_as_its_bow_and_ends_at_the_same_edges() -> None:
    points = in_target(clean('bowed 0.1 mm', table=None))
    face = points[(points[:, 2] > -1e-6) & (points[:, :2].min(axis=1) > 1e-5)]
    length, width = 0.20, 0.15
    u, v = 2 * face[:, 0] / length - 1, 2 * face[:, 1] / width - 1
    assert np.allclose(face[:, 2], 1e-4 * (1 - (u * u + v * v) / 2), atol=1e-6)
    assert points[:, :2].min() > -1e-5


def test_waves_have_the_stated_size() -> None:
    x, y = np.meshgrid(np.linspace(0, 0.2, 80), np.linspace(0, 0.15, 80))
    rms = []
    for seed in range(20):
        made = relief(PlateTarget(waves=1e-5), np.random.default_rng(seed))
        assert made
        rms.append(made.heights(x, y).std())
    assert np.mean(rms) == pytest.approx(1e-5, rel=0.1)


def test_a_wide_spot_moves_the_end_of_the_face_by_the_brightness_of_the_ground() -> None:
    scenario = replace(FAULTS['baseline'], sensor=SensorModel(columns=2000))
    z = np.full((1, 2000), 0.175)
    z[:, 1000:] = 0.200
    T = se3.transform(np.diag([1.0, -1, -1]), np.array([0.0, 0, 0.175]))[None]
    pitch = 2 * 0.14 * 0.175 / 2000
    for ground, sigmas in ((1.0, 0.0), (4.0, -0.8416), (0.25, 0.8416)):
        sensor = replace(scenario.sensor, spot=2e-4, ground=ground)
        end = np.flatnonzero(optics.blurred(sensor, z, T)[0] < 0.18)[-1] + 1
        assert (end - 1000) * pitch == pytest.approx(sigmas * 2e-4, abs=1.5 * pitch)


def test_speckle_and_smoothing_act_along_the_line() -> None:
    sensor = SensorModel(speckle=2e-5, speckle_columns=5.0, smoothing=9)
    error = optics.speckle(sensor, (50, 1000), np.random.default_rng(1))
    assert error.std() == pytest.approx(2e-5)
    near, far = (np.mean(error[:, k:] * error[:, :-k]) / error.var() for k in (2, 40))
    assert near > 0.8 and abs(far) < 0.1
    white = np.random.default_rng(2).normal(size=(50, 1000))
    assert optics.smoothed(sensor, white)[:, 10:-10].std() == pytest.approx(1 / 3, rel=0.05)


@pytest.mark.parametrize('values', [{'distortion': 2e-5}, {'scale': 1e-3}, {'shear': 1e-3}],
                         ids=str)
def test_the_best_motion_leaves_less_of_a_distortion(values: dict[str, float]) -> None:
    sensor = SensorModel(**values)
    bent = distortion.draw(sensor, np.random.default_rng(3))
    assert bent
    z = np.linspace(*sensor.range, 50)[:, None] * np.ones(50)
    true = np.stack([z * np.linspace(-1, 1, 50) * sensor.half_width, z], axis=-1)
    seen = true.copy()
    seen[..., 1] += bent.ranges(z)
    seen[..., 0] *= seen[..., 1] / true[..., 1]
    seen = bent.points(seen)
    served = se3.apply(bent.T_true_reported, lift(seen.reshape(-1, 2)))[:, [0, 2]]
    before, after = (float(np.square(p.reshape(-1, 2) - true.reshape(-1, 2)).sum())
                     for p in (seen, served))
    assert after <= before * (1 + 1e-9)
    small = se3.perturb(bent.T_true_reported, np.array([2e-6, 0, 2e-6, 0, 2e-5, 0]))
    worse = se3.apply(small, lift(seen.reshape(-1, 2)))[:, [0, 2]]
    assert np.square(worse - true.reshape(-1, 2)).sum() > after


def test_the_arm_gets_where_it_is_told() -> None:
    rng = np.random.default_rng(0)
    joints = rng.uniform([-1, -.5, 1, -2, .3, -2], [1, .5, 2, 2, 1.5, 2], (20, 6))
    T = arm.forward(joints)
    assert np.allclose(arm.forward(arm.inverse(T)), T)
    error = arm.reported_error(T, arm.draw(1e-4, rng))
    assert 1e-5 < np.abs(error).mean() < 1e-3


def test_the_best_transform_serves_better_than_the_mount_of_an_arm_that_errs() -> None:
    """Points are mapped with less error over the stops, but for a motion of all of them."""
    left = []
    for seed in range(4):
        scenario = FAULTS['joints and links 0.3 mm']
        made = simulate(scenario, np.random.default_rng(seed))
        # what is drawn first, the mount, is the same without errors
        exact = simulate(replace(scenario, robot=replace(scenario.robot, geometry=1e-12)),
                         np.random.default_rng(seed)).truth.T_flange_sensor
        T = np.array([s.T_base_flange for s in made.truth.stations])
        reported = np.array([s.T_base_flange_reported for s in made.truth.stations])
        points = np.array([[0.0, 0, 0.15], [0.02, 0, 0.2], [-0.02, 0, 0.2]])
        left.append([_spread(reported @ X, T @ exact, points)
                     for X in (exact, made.truth.T_flange_sensor)])
    by_mount, by_best = np.mean(left, axis=0)
    assert by_best < by_mount


def _spread(T: Array, T_true: Array, points: Array) -> float:
    mapped, true = (se3.apply(each, points).reshape(-1, 3) for each in (T, T_true))
    centred, there = mapped - mapped.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(centred.T @ there)
    turn = (U * [1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.square(centred @ turn - there).sum(axis=1).mean()))
