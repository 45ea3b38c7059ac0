# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the sensor sees of solids, and its own errors, are as stated."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.simulate.sensor import lift
from handeye_ros.simulate.solids import box, Solid
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

DOWN = se3.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.175]))
CLEAN = {'noise': 0.0, 'rim_bias': 0.0, 'mixed': 0.0, 'lost': 0.0, 'lost_at_edge': 0.0,
         'outliers': 0.0}
FLOOR = box((-1, -1, -1), (1, 1, 0))


def rendered(sensor: SensorModel, solids: list[Solid], T: Array = DOWN) -> tuple[Array, Array]:
    """Return ranges and angles (columns,)."""
    z, angle = sensors.render(sensor, solids, T[None])
    return z[0], angle[0]


def measure(solids: list[Solid], seed: int = 8, times: int = 50, **values: float
            ) -> tuple[Array, Array]:
    """Return exact and measured ranges (times, 640) of a sensor with only the faults given."""
    sensor = SensorModel(columns=640, **{**CLEAN, **values})
    z, angle = (np.tile(array, (times, 1)) for array in rendered(sensor, solids))
    return z, sensors.measure(sensor, z, angle, np.random.default_rng(seed))


def test_a_step_casts_a_shadow_where_the_geometry_says() -> None:
    # a step of height h at y = x / 2: from the camera at +y (world: -y) points next to it are hid
    step, floor = box((0.0, -1, -0.1), (1, 1, 0.0)), box((-1, -1, -0.2), (1, 1, -0.02))
    turned = DOWN.copy()
    turned[:3, :3] = Rotation.from_rotvec([0, 0, 0.5]).as_matrix() @ DOWN[:3, :3]
    sensor = SensorModel(columns=2001, camera=(0.07, 0.0))
    z, _ = rendered(sensor, [step, floor], turned)
    world = se3.apply(turned, lift(sensors.plane_points(sensor, z[None])[0][np.isfinite(z)]))
    eye = se3.apply(turned, np.array([[0.0, 0.07, 0.0]]))[0]
    # the line of sight over the top edge x = 0, z = 0 meets the floor at x = -0.02 eye_x / eye_z
    shadow = -0.02 * eye[0] / eye[2]
    assert eye[0] > 0.01 and shadow < -1e-3
    assert world[world[:, 2] < -0.01][:, 0].max() == pytest.approx(shadow, abs=1e-4)
    assert world[world[:, 2] > -0.01][:, 0].min() == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize('sampling', ['fan', 'x'])
def test_the_field_of_view_is_a_trapezoid(sampling: str) -> None:
    sensor, T = SensorModel(columns=801, sampling=sampling), DOWN.copy()
    for range_ in (0.151, 0.199):
        T[2, 3] = range_
        points = sensors.plane_points(sensor, rendered(sensor, [FLOOR], T)[0][None])[0]
        assert np.nanmax(points[:, 0]) == pytest.approx(0.14 * range_, abs=8e-5)
    T[2, 3] = 0.201
    assert np.isnan(rendered(sensor, [FLOOR], T)[0]).all()


def test_noise_and_faults_are_as_large_and_as_many_as_stated() -> None:
    exact, noisy = measure([FLOOR], noise=3e-5)
    assert (noisy - exact).std() == pytest.approx(3e-5, rel=0.02)
    assert abs((noisy - exact).mean()) < 1e-6
    assert np.abs(np.subtract(*measure([FLOOR]))).max() < 1e-7
    exact, faulty = measure([FLOOR], lost=0.01, outliers=0.02)
    assert np.isnan(faulty).mean() == pytest.approx(0.01, rel=0.15)
    assert (np.abs(faulty - exact) > 3e-4).mean() == pytest.approx(0.02, rel=0.15)


def test_at_a_step_points_lie_between_the_levels_and_more_are_lost() -> None:
    step = [FLOOR, box((0, -1, 0), (1, 1, 0.01))]
    between = [(z > 0.1652) & (z < 0.1748) for _, z in (measure(step, mixed=1.0), measure(step))]
    assert between[0].any(axis=1).mean() > 0.8 and between[0].sum(axis=1).max() == 1
    assert not between[1].any()
    exact, with_lost = measure([box((0, -1, -1), (1, 1, 0))], lost_at_edge=0.5)
    lost, first = np.isnan(with_lost) & np.isfinite(exact), int(np.argmax(np.isfinite(exact[0])))
    assert lost[:, first:first + 3].mean() == pytest.approx(0.5, abs=0.1)
    assert not lost[:, first + 3:].any()


def test_the_distortion_is_smooth_and_of_the_stated_size() -> None:
    sensor, rms = SensorModel(columns=200, **{**CLEAN, 'distortion': 1e-4}), []
    z = np.tile(np.linspace(*sensor.range, 100)[:, None], (1, 200))
    for seed in range(40):
        error = sensors.draw_distortion(sensor, np.random.default_rng(seed)).range_errors(z)
        assert np.abs(np.diff(error, axis=1)).max() < 6e-5
        rms.append(np.sqrt((error**2).mean()))
    assert np.median(rms) == pytest.approx(1e-4, rel=0.1)
