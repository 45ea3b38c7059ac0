"""
What a calibrated robot measures for its verification, sample by sample, with known truth.

Every routine has an artefact; its stations are those of the simulated targets, drawn for each of
its bags, with the sensor and the robot the same throughout.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array, EdgePoint, FaceLine, Sample
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate.scenario import (
    PlateTarget,
    RobotModel,
    Scenario,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.stations import Stops
from handeye_ros.simulate.tooth import Gauge, Pass, scan_gauge
import numpy as np
from scipy.spatial.transform import Rotation

TILT = np.deg2rad(40)  # of the sensor over faces
PLAIN = SensorModel(columns=320, rate=5.0, rim_bias=0.0, mixed=0.0, lost=0.0, lost_at_edge=0.0,
                    outliers=0.0)
AIM = 5e-5  # m: how exactly the laser is put to a point


@dataclass(frozen=True, eq=False)
class Measured:
    """
    The samples of each bag, T_flange_sensor (4, 4), and what is true of the artefact.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; reference:
    the true point (3,) in the base; passes: of a scan, where there are no samples.
    """

    bags: tuple[tuple[Sample, ...], ...]
    T_flange_sensor: Array
    lengths: tuple[float, ...] = ()
    reference: tuple[float, ...] = ()
    passes: tuple[Pass, ...] = ()


def sensor_on_flange(rng: np.random.Generator) -> Array:
    """Draw where the sensor sits (4, 4)."""
    return se3.transform(Rotation.random(random_state=rng).as_matrix(),
                         rng.uniform(-0.12, 0.12, 3))


def somewhere(rng: np.random.Generator) -> Array:
    """Draw where an artefact stands in the base (4, 4)."""
    turn = Rotation.from_euler('xyz', rng.uniform([-0.2, -0.2, -3], [0.2, 0.2, 3]))
    return se3.transform(turn.as_matrix(), rng.uniform([0.5, -0.3, 0.0], [0.9, 0.3, 0.4]))


def stations(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array,
             rng: np.random.Generator) -> tuple[Sample, ...]:
    """Return the samples of the stops of a scenario, at a target that stands there."""
    scene = SCENES[scenario.scene]
    stops = scene.stops(scenario, rng)
    features = scene.features(scenario, stops, rng)
    T = T_base_target @ stops.T_target_sensor @ se3.inverse(T_flange_sensor)
    reported = cells.perturbed(T, cells.robot_error(scenario.robot, T, rng))
    return tuple(Sample(k * 2_000_000_000, T_k, f, scenario.profiles_per_stop)
                 for k, (T_k, f) in enumerate(zip(reported, features, strict=True)))


def line(rng: np.random.Generator, count: int = 14, robot: RobotModel | None = None) -> Measured:
    """Return a straight edge."""
    scenario = replace(SCENARIOS['line'], stations=(count, 0), robot=robot or RobotModel())
    X = sensor_on_flange(rng)
    return Measured((stations(scenario, X, somewhere(rng), rng),), X)


def planes(rng: np.random.Generator, places: Array, count: int = 20,
           robot: RobotModel | None = None) -> tuple[tuple[tuple[Sample, ...], ...], Array]:
    """Return planes at places (k, 4, 4) in the artefact: samples of each, T_flange_sensor."""
    target = PlateTarget((0.2, 0.15), table=None)
    scenario = replace(SCENARIOS['plane'], target=target, stations=(count, 0), tilt=TILT,
                       robot=robot or RobotModel())
    X, T = sensor_on_flange(rng), somewhere(rng)
    return tuple(stations(scenario, X, T @ place, rng) for place in places), X


def plane(rng: np.random.Generator, **values: object) -> Measured:
    """Return a flat face."""
    bags, X = planes(rng, np.eye(4)[None], **values)  # type: ignore[arg-type]
    return Measured(bags, X)


def step_block(rng: np.random.Generator, heights: tuple[float, ...] = (0.025, 0.05, 0.1),
               **values: object) -> Measured:
    """Return parallel faces above each other, square to x, y or z of the base."""
    places = np.repeat(np.eye(4)[None], 1 + len(heights), axis=0)
    places[1:, 2, 3] = heights
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler('zyx', [[0, 0, 0], [0, np.pi / 2, 0], [0, 0, np.pi / 2]][
        int(rng.integers(3))]).as_matrix()
    bags, X = planes(rng, turn @ places, **values)  # type: ignore[arg-type]
    return Measured(bags, X, heights)


def square(rng: np.random.Generator, **values: object) -> Measured:
    """Return two faces at a right angle."""
    places = np.repeat(np.eye(4)[None], 2, axis=0)
    places[1, :3, :3] = Rotation.from_euler('x', np.pi / 2).as_matrix()
    places[1, :3, 3] = [0, 0.15, 0]
    bags, X = planes(rng, places, **values)  # type: ignore[arg-type]
    return Measured(bags, X)


def ball_bar(rng: np.random.Generator, balls: int = 2, length: float = 0.2, radius: float = 0.02,
             count: int = 14, robot: RobotModel | None = None) -> Measured:
    """Return balls in a row (one: a sphere)."""
    scenario = replace(SCENARIOS['sphere'], target=SphereTarget(radius, table=None,
                                                                clutter=False),
                       stations=(count, 0), robot=robot or RobotModel())
    X, T = sensor_on_flange(rng), somewhere(rng)
    bags = []
    for k in range(balls):
        place = np.eye(4)
        place[0, 3] = k * length
        bags.append(stations(scenario, X, T @ place, rng))
    return Measured(tuple(bags), X, (length,) * (balls - 1))


def sphere(rng: np.random.Generator, **values: object) -> Measured:
    """Return one ball."""
    return ball_bar(rng, balls=1, **values)  # type: ignore[arg-type]


def fixed_point(rng: np.random.Generator, count: int = 12, aim: float = AIM,
                robot: RobotModel | None = None) -> Measured:
    """Return the corner of a plate, which the laser is put to with some error."""
    scenario = replace(SCENARIOS['line'], stations=(count, 0), robot=robot or RobotModel())
    X, T_base_target = sensor_on_flange(rng), somewhere(rng)
    drawn = SCENES['line'].stops(scenario, rng)
    R, points = drawn.T_target_sensor[:, :3, :3], drawn.points
    inside = np.column_stack([points[:, 0], np.zeros(count), points[:, 1]])
    T = se3.transform(R, -(R @ inside[:, :, None])[:, :, 0] + aim * rng.normal(size=(count, 3)))
    stops = Stops(T, drawn.labels, points)
    std = scenario.sensor.noise / np.sqrt(scenario.profiles_per_stop)
    truth = T_base_target @ stops.T_target_sensor @ se3.inverse(X)
    reported = cells.perturbed(truth, cells.robot_error(scenario.robot, truth, rng))
    samples = []
    for k, pose in enumerate(reported):
        e = rng.normal(size=2) * std
        edge = EdgePoint(points[k] + e, np.array([1.0, 0.0]), float(std), float(std))
        face = FaceLine(points[k] - [5e-3, 0], np.array([1.0, 0.0]), 3e-3, float(std))
        samples.append(Sample(k * 2_000_000_000, pose, (face, edge)))
    return Measured((tuple(samples),), X, reference=tuple(map(float, T_base_target[:3, 3])))


def tooth(rng: np.random.Generator, sensor: SensorModel = PLAIN, robot: RobotModel | None = None
          ) -> Measured:
    """Return a gauge of teeth, scanned; sensor: without other faults than noise if not given."""
    gauge, X = Gauge(), sensor_on_flange(rng)
    passes = scan_gauge(gauge, X, somewhere(rng), sensor, robot or RobotModel(), rng)
    return Measured((), X, (gauge.pitch, gauge.height), passes=passes)
