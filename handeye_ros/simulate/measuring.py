"""
A whole cell that is calibrated and then measures: one sensor, one robot, recordings of all.

`plate` is for the calibration; `ball_1` and `ball_2` are the ends of a ball bar; `pass_1` and so
on are a scan of a gauge of equal teeth, in passes of a robot that moves. Frame of the gauge: x
along the row, from the middle of its middle tooth, y along the teeth, z out of them, 0 in the
valleys.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.recording import simulate
from handeye_ros.simulate.scenario import RobotModel, Scenario, SensorModel, SphereTarget
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.solids import Box, Convex, Solid
from handeye_ros.simulate.stations import stamped_poses, stamped_profiles, stamps, Stops
import numpy as np
from scipy.spatial.transform import Rotation

RANGE = 0.175  # m from the sensor to the middle of the teeth
PASSES = ((0, 0, 0), (30, 0, 15), (-30, 0, -15), (0, 15, 180), (0, -15, 165), (30, 10, -165),
          (-30, -10, 0))
"""Turns of the sensor about its x, y and z for each pass (degrees)."""


@dataclass(frozen=True)
class Gauge:
    """A gauge: pitch, height and flank (horizontal way of it); count of teeth, their length."""

    pitch: float = 0.015
    height: float = 0.005
    flank: float = 0.005
    count: int = 5
    length: float = 0.06


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass over the gauge: profiles, poses of the flange as reported."""

    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]


def gauge_solids(gauge: Gauge) -> tuple[Solid, ...]:
    """Return the teeth on their bar."""
    slope = np.hypot(gauge.flank, gauge.height)
    half = gauge.length / 2
    outward = np.array([[gauge.height, 0, gauge.flank], [-gauge.height, 0, gauge.flank]]) / slope
    normals = np.vstack([outward, [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]]])
    teeth: list[Solid] = []
    for k in range(gauge.count):
        middle = (k - (gauge.count - 1) / 2) * gauge.pitch
        # the flanks are a quarter of the pitch from the middle at half the height
        at = np.array([[middle + gauge.pitch / 4, 0, gauge.height / 2],
                       [middle - gauge.pitch / 4, 0, gauge.height / 2]])
        offsets = np.concatenate([(outward * at).sum(axis=1),
                                  [gauge.height, 1e-3, half, half]])
        teeth.append(Convex(normals, offsets))
    width = gauge.count * gauge.pitch / 2
    return (Box((-width, -half, -0.01), (width, half, 0.0)), *teeth)


def scan_gauge(gauge: Gauge, T_flange_sensor: Array, T_base_gauge: Array, sensor: SensorModel,
               robot: RobotModel, rng: np.random.Generator) -> tuple[Pass, ...]:
    """Return the passes of a scan; the robot's error stays the same through a pass."""
    way, speed = gauge.length - 0.02, 0.01  # m, m/s along the teeth
    times = np.arange(0.0, way / speed, 1 / sensor.rate)
    passes = []
    for k, turn in enumerate(PASSES):
        R = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
        middle = np.array([rng.uniform(-0.004, 0.004), 0.0, gauge.height / 2])
        place = middle - R @ [0, 0, RANGE] + np.array([0, speed, 0]) * (
            times - times.mean())[:, None]
        T_gauge_sensor = se3.transform(np.repeat(R[None], len(times), axis=0), place)
        z, angle = sensors.render(sensor, gauge_solids(gauge), T_gauge_sensor)
        points = sensors.plane_points(sensor, sensors.measure(sensor, z, angle, rng))
        stamped = stamps(times + k * 100.0)
        T = T_base_gauge @ T_gauge_sensor @ se3.inverse(T_flange_sensor)
        error = cells.robot_error(robot, T[:1], rng)
        T = cells.perturbed(T, np.repeat(error, len(T), axis=0))
        T = cells.perturbed(T, rng.normal(size=(len(T), 6)) * robot.jitter)
        passes.append(Pass(stamped_profiles(stamped, points),
                           stamped_poses(stamped, T[:, :3, 3], se3.quaternion(T))))
    return tuple(passes)


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


def somewhere(rng: np.random.Generator) -> Array:
    """Draw where an artefact stands in the base (4, 4)."""
    turn = Rotation.from_euler('xyz', rng.uniform([-0.2, -0.2, -3], [0.2, 0.2, 3]))
    return se3.transform(turn.as_matrix(), rng.uniform([0.5, -0.3, 0.0], [0.9, 0.3, 0.4]))


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
              rng: np.random.Generator) -> tuple[Profile, ...]:
    times = np.arange(0.5 / sensor.rate, STOP, 1 / sensor.rate)
    ranges = sensors.measure(sensor, np.repeat(z[None], len(times), axis=0),
                             np.repeat(angle[None], len(times), axis=0), rng)
    return stamped_profiles(stamps(begin + times), sensors.plane_points(sensor, ranges))


def _poses(robot: RobotModel, T: Array, begin: float, rng: np.random.Generator
           ) -> tuple[TimedPose, ...]:
    times = np.arange(0.0, STOP, 1 / robot.rate)
    jittered = cells.perturbed(np.repeat(T[None], len(times), axis=0),
                               rng.normal(size=(len(times), 6)) * robot.jitter)
    return stamped_poses(stamps(begin + times), jittered[:, :3, 3], se3.quaternion(jittered))
