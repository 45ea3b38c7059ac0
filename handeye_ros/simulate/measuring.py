"""
A whole cell that is calibrated and then measures: one sensor, one robot, recordings of all.

`plate` is for the calibration; `ball_1` and `ball_2` are the ends of a ball bar; `pass_1` and so
on are a scan of a tooth gauge.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate import motion
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.gauges import somewhere
from handeye_ros.simulate.recording import simulate
from handeye_ros.simulate.scenario import RobotModel, Scenario, SensorModel, SphereTarget
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.stations import Stops
from handeye_ros.simulate.tooth import Gauge, Pass, scan_gauge
import numpy as np

MEASURING_CELL = 'measuring_cell'  # what `handeye simulate` calls it
BALL = SphereTarget(0.02, table=None, clutter=False)
BAR = 0.2
STOP = 0.6  # s of a stop at a ball
GAP = 1.0  # s between two stops


@dataclass(frozen=True, eq=False)
class MeasuringCell:
    """Recordings by name, T_flange_sensor (4, 4), and the artefacts' true sizes (m)."""

    recordings: dict[str, Pass]
    T_flange_sensor: Array
    ball_radius: float
    bar: float
    gauge: Gauge


def measuring_cell(rng: np.random.Generator, columns: int = 1280) -> MeasuringCell:
    """Return a cell with the sensor noise (0.03 mm) and the robot of the main job."""
    plate = SCENARIOS['plate']
    sensor, robot = replace(plate.sensor, columns=columns), plate.robot
    made = simulate(replace(plate, sensor=sensor), rng)
    X, T_bar, gauge = made.truth.T_flange_sensor, somewhere(rng), Gauge()
    recordings = {'plate': Pass(made.profiles, made.poses)}
    wide = replace(SCENARIOS['sphere'], target=BALL, stations=(12, 0), robot=robot)
    wide = replace(wide, sensor=replace(wide.sensor, columns=columns, noise=sensor.noise))
    for k in range(2):
        place = np.eye(4)
        place[0, 3] = k * BAR
        stops = SCENES[wide.scene].stops(wide, rng)
        recordings[f'ball_{k + 1}'] = rendered(wide, X, T_bar @ place, stops, rng,
                                               1000.0 * (k + 1))
    passes = scan_gauge(gauge, X, somewhere(rng), sensor, robot, rng)
    recordings |= {f'pass_{k + 1}': part for k, part in enumerate(passes)}
    return MeasuringCell(recordings, X, BALL.radius, BAR, gauge)


def rendered(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array, stops: Stops,
             rng: np.random.Generator, start: float = 0.0) -> Pass:
    """Return what is recorded at stops, from a time on (s); nothing of the ways between them."""
    scene, sensor, robot = SCENES[scenario.scene], scenario.sensor, scenario.robot
    T_target_sensor = stops.T_target_sensor
    T = T_base_target @ T_target_sensor @ se3.inverse(T_flange_sensor)
    T = cells.perturbed(T, cells.robot_error(robot, T, rng))
    z, angle = sensors.render(sensor, scene.solids(scenario), T_target_sensor)
    profiles: list[Profile] = []
    poses: list[TimedPose] = []
    for k, pose in enumerate(T):
        begin = start + k * (STOP + GAP)
        profiles += _profiles(sensor, z[k], angle[k], begin, rng)
        poses += _poses(robot, pose, begin, rng)
    return Pass(tuple(profiles), tuple(poses))


def _profiles(sensor: SensorModel, z: Array, angle: Array, begin: float,
              rng: np.random.Generator) -> list[Profile]:
    times = np.arange(0.5 / sensor.rate, STOP, 1 / sensor.rate)
    ranges = sensors.measure(sensor, np.repeat(z[None], len(times), axis=0),
                             np.repeat(angle[None], len(times), axis=0), rng)
    return [Profile(int(s), 'laser', p) for s, p in zip(
        motion.stamps(begin + times), sensors.plane_points(sensor, ranges), strict=True)]


def _poses(robot: RobotModel, T: Array, begin: float, rng: np.random.Generator
           ) -> list[TimedPose]:
    times = np.arange(0.0, STOP, 1 / robot.rate)
    jittered = cells.perturbed(np.repeat(T[None], len(times), axis=0),
                               rng.normal(size=(len(times), 6)) * robot.jitter)
    return [TimedPose(int(s), t, q) for s, t, q in zip(
        motion.stamps(begin + times), jittered[:, :3, 3], se3.quaternion(jittered), strict=True)]
