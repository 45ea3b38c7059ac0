"""A target that is not as configured is told, not absorbed."""
from dataclasses import replace

from handeye_ros import config as configs
from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import Calibration
from handeye_ros.simulate import Scenario, SCENARIOS, simulate_samples
from handeye_ros.simulate.scenario import PlateTarget
from handeye_ros.simulate.settings import settings
import numpy as np
import pytest


def solved(scenario: Scenario, seed: int, scale: float = 1.0, **changes: object
           ) -> tuple[Calibration, float]:
    """
    Return the calibration of simulated samples and the error of its translation.

    scale: of the lengths of the robot.
    """
    samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
    samples = [replace(s, T_base_flange=se3.transform(
        s.T_base_flange[:3, :3], scale * s.T_base_flange[:3, 3])) for s in samples]
    values = settings(scenario) | {'noise.distortion': 0.0}
    values |= {key.replace('__', '.'): value for key, value in changes.items()}
    config = configs.with_values(Config(), values, 'the test')
    found = pipeline.solve(samples, (), config, 'laser')
    return found, float(np.linalg.norm(
        se3.difference(found.T_flange_sensor, truth.T_flange_sensor)[:3]))


@pytest.mark.parametrize('degrees', [88.0, 89.5])
def test_a_plate_that_is_not_square_is_measured_and_named(degrees: float) -> None:
    target = PlateTarget(edge_angle=np.radians(degrees))
    found, error = solved(replace(SCENARIOS['plate'], target=target), 0)
    assert abs(found.target['edge_angle'] - np.radians(degrees)) < 4 * (
        found.target['edge_angle_std'])
    assert f'{np.degrees(found.target["edge_angle"]):.3f}' in found.target['note']
    assert 'not the configured 90.000' in found.target['note']
    assert found.quality.samples_used >= 16
    assert error < 1.5e-4


@pytest.mark.parametrize('seed', range(4))
def test_a_square_plate_is_not_accused(seed: int) -> None:
    found, _ = solved(SCENARIOS['plate'], seed)
    assert 'note' not in found.target
    assert abs(found.target['edge_angle'] - np.pi / 2) < 4 * found.target['edge_angle_std']


@pytest.mark.parametrize('radius', [0.0403, 0.05])
def test_a_sphere_of_another_radius_is_measured_and_named(radius: float) -> None:
    found, error = solved(SCENARIOS['sphere'], 1, target__radius=radius)
    assert found.target['radius'] == pytest.approx(0.04, abs=1e-5)
    assert 'mm' in found.target['note']
    assert error < 3e-4


def test_an_unknown_radius_is_estimated_without_a_note() -> None:
    found, _ = solved(SCENARIOS['sphere'], 2, target__radius=0.0)
    assert found.target['radius'] == pytest.approx(0.04, abs=4 * found.target['radius_std'])
    assert 'note' not in found.target


@pytest.mark.parametrize('scale', [1.0, 1.0015, 0.999])
@pytest.mark.parametrize('name', ['plate', 'sphere'])
def test_the_scale_between_robot_and_sensor_is_told(name: str, scale: float) -> None:
    found, _ = solved(SCENARIOS[name], 2, scale)
    assert 0 < found.target['scale_std'] < 7e-4
    assert found.target['scale'] == pytest.approx(scale, abs=3 * found.target['scale_std'])
