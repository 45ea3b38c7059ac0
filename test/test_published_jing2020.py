"""Jing 2020: the chain through the laser tracker, its fits and its errors."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.published import jing2020
from handeye_ros.published.errors import TooFewError
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

H0, H1, Q30, RADIUS = 0.02543, 0.031, 0.00298, 0.01905
T_flange_sensor = se3.transform(Rotation.from_euler('xyz', [89.2, 0.9, -1.3], True).as_matrix(),
                                np.array([0.057, -0.11, 0.049]))


def link(turn: float, q3: float) -> Array:
    """Return frame 3 (4, 4) in the frame of joint 1 (turn in degrees, q3 in metres)."""
    R = (Rotation.from_euler('z', turn, degrees=True)
         * Rotation.from_euler('x', np.pi / 2)).as_matrix()
    return se3.transform(R, R[:, 2] * q3)


def block(rng: np.random.Generator, skew: float) -> tuple[Array, tuple[Array, Array], Array]:
    """Return a point on the ridge, the faces' normals and the ball's centre, sensor at q30."""
    tilt = Rotation.from_euler('xyz', rng.uniform(-12, 12, 3), degrees=True).as_matrix()
    slopes = np.deg2rad([-40.0, 50.0 + skew])
    normals = np.column_stack([np.sin(slopes), np.zeros(2), -np.cos(slopes)]) @ tilt.T
    return (np.array([0.004, 0.02, 0.172]), (normals[0], normals[1]),
            np.array([-0.003, -0.025, 0.178]))


def face_profiles(normal: Array, ridge: Array, x: Array, steps: Array, along: Array) -> Array:
    """Return x, z and q3 (n, 3) of a face seen by a sensor moved by steps along a direction."""
    across, step = (g.ravel() for g in np.meshgrid(x, steps))
    z = (normal @ ridge - across * normal[0] - step * (along @ normal)) / normal[2]
    return np.column_stack([across, z, step + Q30])


def ball_profiles(ball: Array, steps: Array, along: Array) -> Array:
    """Return x, z and q3 (n, 3) of the near side of the ball, sensor moved as above."""
    rows = []
    for step in steps:
        centre = ball - step * along
        room = RADIUS ** 2 - centre[1] ** 2
        for angle in np.deg2rad(np.linspace(-60, 60, 41)) if room > 0 else ():
            rows.append([centre[0] + np.sqrt(room) * np.sin(angle),
                         centre[2] - np.sqrt(room) * np.cos(angle), step + Q30])
    return np.array(rows)


def session(seed: int, tracker_noise: float = 0.0, sensor_noise: float = 0.0,
            skew: float = 0.0) -> tuple[jing2020.Tracker, jing2020.Sweep]:
    """Return what tracker and profiler see of arm, ball and block (1 sigma in metres)."""
    rng = np.random.default_rng(seed)
    T_tracker_arm = se3.transform(Rotation.from_euler('xyz', [3, -4, 50], True).as_matrix(),
                                  np.array([3.0, 1.7, -0.6]))
    reflector = np.array([[0.02, H0 + H1, 0.25]])
    arc = np.array([se3.apply(link(t, 0.0), reflector)[0] for t in np.linspace(-60, 60, 40)])
    line = np.array([se3.apply(link(12, q), reflector)[0] for q in np.linspace(-0.1, 0.1, 30)])
    ridge, normals, ball = block(rng, skew)
    along = T_flange_sensor[2, :3]
    x = np.linspace(0.002, 0.018, 30)
    steps = np.linspace(-0.06, 0.06, 121)
    faces = [face_profiles(n, ridge, ridge[0] + s * x, steps[60:], along)
             for n, s in zip(normals, (-1, 1), strict=True)]
    T_tracker_sensor = T_tracker_arm @ link(12, Q30) @ T_flange_sensor
    spots = [se3.apply(T_tracker_sensor, jing2020.swept(f[::53], Q30, along)) for f in faces]
    truth = [se3.apply(T_tracker_arm, arc), se3.apply(T_tracker_arm, line),
             se3.apply(T_tracker_sensor, ball[None])[0], *spots]
    noisy = [p + tracker_noise * rng.normal(size=p.shape) for p in truth]
    swept = [p + sensor_noise * rng.normal(size=p.shape) * [1, 1, 0]
             for p in (ball_profiles(ball, steps, along), *faces)]
    return jing2020.Tracker(*noisy, H0, H1), jing2020.Sweep(*swept, Q30)


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('skew', [0.0, 4.0])
def test_the_truth_without_noise(seed: int, skew: float) -> None:
    """From the sweep's nominal direction, which is 1.2 degrees off; the block may be crooked."""
    found = jing2020.solve(*session(seed, skew=skew))
    assert np.abs(se3.difference(found.T_flange_sensor, T_flange_sensor)).max() < 1e-6
    np.testing.assert_allclose(found.direction, T_flange_sensor[2, :3], atol=1e-6)
    np.testing.assert_allclose(found.angles, np.deg2rad(90.0 + skew), atol=1e-7)
    assert found.radius == pytest.approx(RADIUS, abs=1e-8)


def test_accuracy_with_the_papers_noise() -> None:
    """0.02 mm tracker, 0.037 mm sensor: the paper's bounds, but against the truth."""
    found = [jing2020.solve(*session(seed, 2e-5, 3.7e-5)) for seed in range(10)]
    off = np.array([jing2020.errors(f.T_flange_sensor, T_flange_sensor) for f in found])
    assert off[:, 0].max() < 0.0015
    assert off[:, 1].max() < np.deg2rad(0.07)
    assert off[:, 2].max() < 0.25e-3
    assert off[:, 2].min() > 1e-6


def test_the_sweep_backwards_is_told_by_its_direction() -> None:
    tracker, sweep = session(0)
    back = {name: getattr(sweep, name) * [1, 1, -1] for name in ('ball', 'face_c', 'face_d')}
    found = jing2020.fit_swept_ball(back['ball'], -Q30, -jing2020.SWEEP)[0]
    np.testing.assert_allclose(found, -T_flange_sensor[2, :3], atol=1e-6)


@pytest.mark.parametrize('sense', [1, -1])
def test_arc_has_centre_and_axis_of_its_sense(sense: int) -> None:
    T = se3.transform(Rotation.from_euler('xyz', [20, 40, 5], True).as_matrix(), np.arange(3.0))
    angle = sense * np.linspace(0.2, 1.4, 9)
    points = se3.apply(T, 0.3 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    centre, axis = jing2020.fit_arc(points)
    np.testing.assert_allclose(centre, T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(axis, sense * T[:3, 2], atol=1e-12)


def test_axis_angle_shift_and_errors() -> None:
    vector = np.deg2rad(89.8) * np.array([0.6, 0.0, 0.8])
    T = se3.transform(se3.exp_rotation(vector), np.array([0.01, 0.02, 0.03]))
    v, angle, p = jing2020.axis_angle_shift(T)
    np.testing.assert_allclose(v, [0.6, 0.0, 0.8], atol=1e-12)
    assert angle == pytest.approx(np.deg2rad(89.8))
    np.testing.assert_allclose(p, [0.01, 0.02, 0.03])
    other = se3.transform(se3.exp_rotation(vector * 1.01), p + [0.0, 0.003, 0.004])
    assert jing2020.errors(other, T) == pytest.approx((0.0, np.deg2rad(0.898), 0.005), abs=1e-9)


def test_the_printed_table_2_contradicts_itself() -> None:
    """Two faces of one block are 63.9 degrees apart in one frame, 66.7 in the other."""
    tracker = np.array([[-0.6459, -0.1634, 0.7457], [-0.1089, 0.7451, 0.6581]])
    laser = np.array([[0.0309, -0.6509, 0.7585], [0.7177, 0.2033, 0.6669]])
    angles = [np.rad2deg(np.arccos(n[0] @ n[1])) for n in (tracker, laser)]
    np.testing.assert_allclose(angles, [63.9, 66.7], atol=0.05)


@pytest.mark.parametrize(('name', 'count', 'what'), [
    ('arc', 2, 'reflector points on the arc'), ('line', 1, 'reflector points on the line'),
    ('face_c', 2, 'points on each face'), ('ball', 5, 'profile points on the ball')])
def test_too_few_points_are_refused(name: str, count: int, what: str) -> None:
    tracker, sweep = session(0)
    if name == 'ball':
        sweep = replace(sweep, ball=sweep.ball[:count])
    else:
        tracker = replace(tracker, **{name: getattr(tracker, name)[:count]})
    with pytest.raises(TooFewError, match=f'{what}, got {count}'):
        jing2020.solve(tracker, sweep)
