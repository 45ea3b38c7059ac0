# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Zheng 2018: the truth from the nominal mounting, the line search, sensor model and filter."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.published import zheng2018
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def cell(rng: np.random.Generator, count: int, noise: float = 0.0) -> tuple[Array, Array, Array]:
    """Return T_flange_sensor (plane x = 0), poses and points of a simulated edge (metres)."""
    offset = rng.normal(size=3)
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                      rng.uniform(0.1, 0.2) * offset / np.linalg.norm(offset))
    turn = Rotation.from_euler('xyz', [*rng.uniform(-10, 10, 2), rng.uniform(-180, 180)], True)
    T_base_line = se3.transform(turn.as_matrix(), np.array([0.8, 0.1, 0.3]))
    poses, points = [], []
    for _ in range(count):
        R = (Rotation.from_euler('z', rng.uniform(-30, 30), degrees=True)
             * Rotation.from_euler('xy', rng.uniform(-25, 25, 2), degrees=True)
             * Rotation.from_euler('y', np.pi)).as_matrix()
        y, z = rng.uniform(-0.02, 0.02), rng.uniform(0.16, 0.19)
        T_line_sensor = se3.transform(R, [rng.uniform(0.02, 0.18), 0, 0] - R @ [0.0, y, z])
        poses.append(T_base_line @ T_line_sensor @ se3.inverse(X))
        points.append([y, z])
    return X, np.array(poses), np.array(points) + noise * rng.normal(size=(count, 2))


def nominal(rng: np.random.Generator, X: Array, millimetres: float, degrees: float) -> Array:
    """Return X moved by about so much in every direction."""
    shift, turn = rng.normal(size=(2, 3)) / np.sqrt(3)
    return se3.perturb(X, np.append(shift * millimetres * 1e-3, turn * np.deg2rad(degrees)))


@pytest.mark.parametrize(('seed', 'count'), [(0, 30), (1, 30), (2, 18), (3, 18), (4, 12)])
def test_the_truth_from_the_nominal_mounting(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    X, poses, points = cell(rng, count)
    found = zheng2018.solve(poses, points, nominal(rng, X, 20, 10))
    assert np.abs(se3.difference(found.T_flange_sensor, X)).max() < 1e-6
    assert found.distances.max() < 1e-7


def test_noise_is_fitted_and_the_factor_converges() -> None:
    rng = np.random.default_rng(7)
    X, poses, points = cell(rng, 30, 3e-5)
    found = zheng2018.solve(poses, points, nominal(rng, X, 10, 5))
    error = se3.difference(found.T_flange_sensor, X)
    assert np.linalg.norm(error[:3]) < 1e-3
    assert 1e-5 < np.sqrt(np.mean(found.distances ** 2)) < 6e-5
    assert 3 < found.rounds < 40
    assert found.factor < 1e-5
    p = se3.apply(poses @ found.T_flange_sensor, np.insert(points, 0, 0.0, axis=1)[:, None])[:, 0]
    off = np.linalg.norm(np.cross(p - found.point, found.direction), axis=1)
    np.testing.assert_allclose(off, found.distances, atol=1e-8)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.floats(1e-3, 10))
def test_line_search_never_climbs_and_finds_a_minimum(c: list[float], top: float) -> None:
    a, b, d = c
    line = [float(v) for v in np.polynomial.polynomial.polymul([a, b, 1.0], [a, d, 1.0])]
    line[4] = top
    s = zheng2018.line_search(line)
    value = zheng2018.quartic(line, s)
    assert value <= line[0]
    assert min(zheng2018.quartic(line, s + h) for h in (-1e-4, 1e-4)) >= value - 1e-9


def test_too_few_points_are_refused() -> None:
    _, poses, points = cell(np.random.default_rng(0), 4)
    with pytest.raises(TooFewError, match='at least 5 points on the edge, got 4'):
        zheng2018.solve(poses, points, np.eye(4))


SENSOR = zheng2018.Sensor.from_tilt(np.deg2rad(25), 0.21, 0.016, (5e-6, 6e-6), (640, 500))


def test_sensor_projects_as_its_camera_does() -> None:
    points = np.random.default_rng(0).uniform([-0.03, -0.04], [0.03, 0.04], (50, 2))
    in_camera = se3.apply(SENSOR.T_camera_sensor, np.insert(points, 0, 0.0, axis=1))
    image = -SENSOR.f * in_camera[:, :2] / in_camera[:, 2:]
    pixels = image / SENSOR.pitch + SENSOR.centre
    np.testing.assert_allclose(zheng2018.to_plane(pixels, SENSOR), points, atol=1e-15)
    axis = np.array([[0.0, 0.0, np.hypot(SENSOR.L, SENSOR.H)]])
    np.testing.assert_allclose(se3.apply(SENSOR.T_camera_sensor, np.zeros((1, 3))), axis,
                               atol=1e-15)
    assert np.tan(SENSOR.theta) == pytest.approx(SENSOR.L / SENSOR.H)


def test_sensor_sees_nothing_beyond_the_horizon() -> None:
    horizon = SENSOR.f * SENSOR.L / SENSOR.H / SENSOR.pitch[0] + SENSOR.centre[0]
    assert np.isnan(zheng2018.to_plane(np.array([[horizon + 1, 0.0]]), SENSOR)).all()


def test_derivatives_of_a_line_and_a_parabola() -> None:
    i = np.arange(30.0)
    slope, second = zheng2018.derivatives(3.0 * i + i ** 2 / 2)
    np.testing.assert_allclose(slope[4:-4], 3.0 + i[4:-4])
    np.testing.assert_allclose(second[4:-4], 1.0)
    assert np.isnan(np.concatenate([slope[:4], second[-4:]])).all()


@pytest.mark.parametrize('side', [1, -1])
@pytest.mark.parametrize('range_sign', [1, -1])
def test_edge_point_is_the_plates_last_point(side: int, range_sign: int) -> None:
    """A step of 5 mm, with noise, spikes of 20 mm and lost points."""
    rng = np.random.default_rng(4)
    y = side * np.linspace(-0.02, 0.02, 640)
    plate = y < 0.0072
    z = range_sign * np.where(plate, 0.17 + 0.1 * y, 0.175) + 2e-5 * rng.normal(size=640)
    last = int(np.flatnonzero(plate)[np.argmax(y[plate])])
    spikes = rng.choice(np.flatnonzero(np.abs(y - 0.0072) > 0.002), 20, replace=False)
    z[spikes[:10]] += 0.02
    z[spikes[10:]] = np.nan
    found = zheng2018.edge_point(np.column_stack([y, z]), range_sign=range_sign)
    assert found[0] == y[last]
    assert found[1] == pytest.approx(z[last], abs=1e-4)


def test_edge_point_needs_nine_points() -> None:
    points = np.full((40, 2), np.nan)
    points[:8] = 0.1
    with pytest.raises(TooFewError, match='at least 9 points, got 8'):
        zheng2018.edge_point(points)
