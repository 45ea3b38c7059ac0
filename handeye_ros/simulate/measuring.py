# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A cell that is calibrated and then measures: recordings of one sensor and one robot.

`plate` is for the calibration; `ball_1` and `ball_2` are the ends of a ball bar; `pass_1` and so
on are a scan of a gauge of equal teeth, in passes of a moving robot. Frame of the gauge: x along
the row, from the middle of its middle tooth, y along the teeth, z out of them, 0 in the valleys.

Also a curved preform with a seam, as a cloud, and the true seam: the sheet is z = f(x, y), the
seam y = g(x) in plan. In a lap seam the upper sheet lies on the lower one where y > g(x); in a
butt seam two sheets end on either side of a gap.
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
    """A gauge: pitch, height and flank (its horizontal width); count of teeth, their length."""

    pitch: float = 0.015
    height: float = 0.005
    flank: float = 0.005
    count: int = 5
    length: float = 0.06


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass over the gauge: profiles and reported poses of the flange."""

    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]


def gauge_solids(gauge: Gauge) -> tuple[Solid, ...]:
    """Return the teeth on their bar."""
    slope = np.hypot(gauge.flank, gauge.height)
    half_length = gauge.length / 2
    outward = np.array([[gauge.height, 0, gauge.flank], [-gauge.height, 0, gauge.flank]]) / slope
    normals = np.vstack([outward, [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]]])
    teeth: list[Solid] = []
    for k in range(gauge.count):
        middle = (k - (gauge.count - 1) / 2) * gauge.pitch
        # the flanks are a quarter of the pitch from the middle at half the height
        flank_points = np.array([[middle + gauge.pitch / 4, 0, gauge.height / 2],
                                 [middle - gauge.pitch / 4, 0, gauge.height / 2]])
        offsets = np.concatenate([(outward * flank_points).sum(axis=1),
                                  [gauge.height, 1e-3, half_length, half_length]])
        teeth.append(Convex(normals, offsets))
    width = gauge.count * gauge.pitch / 2
    return (Box((-width, -half_length, -0.01), (width, half_length, 0.0)), *teeth)


def scan_gauge(gauge: Gauge, T_flange_sensor: Array, T_base_gauge: Array, sensor: SensorModel,
               robot: RobotModel, rng: np.random.Generator) -> tuple[Pass, ...]:
    """Return the passes of a scan; the robot's error is constant during a pass."""
    distance, speed = gauge.length - 0.02, 0.01  # m, m/s along the teeth
    times = np.arange(0.0, distance / speed, 1 / sensor.rate)
    passes = []
    for k, turn in enumerate(PASSES):
        R = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
        middle = np.array([rng.uniform(-0.004, 0.004), 0.0, gauge.height / 2])
        position = middle - R @ [0, 0, RANGE] + np.array([0, speed, 0]) * (
            times - times.mean())[:, None]
        T_gauge_sensor = se3.transform(np.repeat(R[None], len(times), axis=0), position)
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


MEASURING_CELL = 'measuring_cell'  # its name for `handeye simulate`
BALL = SphereTarget(0.02, table=None, clutter=False)
BAR = 0.2
STOP = 0.6  # s of a stop at a ball
GAP = 1.0  # s between two stops


@dataclass(frozen=True, eq=False)
class MeasuringCell:
    """Recordings by name, T_flange_sensor (4, 4), and the true sizes of the artefacts (m)."""

    recordings: dict[str, Pass]
    T_flange_sensor: Array
    ball_radius: float
    bar: float
    gauge: Gauge


def draw_pose(rng: np.random.Generator) -> Array:
    """Draw the pose of an artefact in the base (4, 4)."""
    turn = Rotation.from_euler('xyz', rng.uniform([-0.2, -0.2, -3], [0.2, 0.2, 3]))
    return se3.transform(turn.as_matrix(), rng.uniform([0.5, -0.3, 0.0], [0.9, 0.3, 0.4]))


def measuring_cell(rng: np.random.Generator, columns: int = 1280) -> MeasuringCell:
    """Return a cell with sensor noise of 0.03 mm and the robot of the plate scenario."""
    plate = SCENARIOS['plate']
    sensor, robot = replace(plate.sensor, columns=columns), plate.robot
    simulated = simulate(replace(plate, sensor=sensor), rng)
    X, T_bar, gauge = simulated.truth.T_flange_sensor, draw_pose(rng), Gauge()
    recordings = {'plate': Pass(simulated.profiles, simulated.poses)}
    wide = replace(SCENARIOS['sphere'], target=BALL, stations=(12, 0), robot=robot)
    wide = replace(wide, sensor=replace(wide.sensor, columns=columns, noise=sensor.noise))
    for k in range(2):
        T_ball = np.eye(4)
        T_ball[0, 3] = k * BAR
        stops = SCENES[wide.scene].stops(wide, rng)
        recordings[f'ball_{k + 1}'] = rendered(wide, X, T_bar @ T_ball, stops, rng,
                                               1000.0 * (k + 1))
    passes = scan_gauge(gauge, X, draw_pose(rng), sensor, robot, rng)
    recordings |= {f'pass_{k + 1}': recorded_pass for k, recorded_pass in enumerate(passes)}
    return MeasuringCell(recordings, X, BALL.radius, BAR, gauge)


def rendered(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array, stops: Stops,
             rng: np.random.Generator, start: float = 0.0) -> Pass:
    """Return the messages at stops from start (s) on, without those between the stops."""
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


@dataclass(frozen=True)
class Preform:
    """
    Geometry and noise of a preform; metres. noise: 1 sigma per axis.

    kind: lap or butt; thickness: height of the lap's step; gap: width of the butt's gap; bend,
    arch: radii along and across the seam; sway: deviation of the seam from a straight line.
    missing: unscanned fraction of its length (from, to). seams: number, side by side.
    """

    kind: str = 'lap'
    thickness: float = 5e-3
    gap: float = 3e-3
    length: float = 0.2
    width: float = 0.06
    spacing: float = 4e-4
    noise: float = 1e-4
    bend: float = 0.25
    arch: float = 0.15
    sway: float = 8e-3
    missing: tuple[float, float] = (0.0, 0.0)
    seams: int = 1


@dataclass(frozen=True, eq=False)
class PreformCloud:
    """Points (n, 3) in the base; centre (m, 3) of the seam and normals (m, 3) of the sheet."""

    points: Array
    centre: Array
    normals: Array


def preform_cloud(preform: Preform, rng: np.random.Generator) -> PreformCloud:
    """Return a cloud of a preform at a random pose, and its true seam."""
    counts = np.ceil([preform.length / preform.spacing, preform.width / preform.spacing])
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts.astype(int)), indexing='ij'), -1)
    grid = (cells.reshape(-1, 2) + rng.random((cells.shape[0] * cells.shape[1], 2)))
    x, y = (grid * preform.spacing - [preform.length / 2, preform.width / 2]).T
    missing = (np.array(preform.missing) - 0.5) * preform.length
    keep = ~((x > missing[0]) & (x < missing[1]))
    side = np.zeros(len(x))
    for offset in (np.arange(preform.seams) - (preform.seams - 1) / 2) * preform.width / 2:
        across = (y - offset - _seam(preform, x)) / np.hypot(1, _slope(preform, x))
        side += across > 0
        if preform.kind == 'butt':
            keep &= np.abs(across) > preform.gap / 2
    sheet = _sheet(preform, x, y)
    if preform.kind == 'lap':
        sheet = sheet + preform.thickness * side[:, None] * _normals(preform, x, y)
    T = se3.transform(
        Rotation.from_euler('xyz', rng.uniform([-0.5, -0.5, -3], [0.5, 0.5, 3])).as_matrix(),
        rng.uniform([0.5, -0.3, 0.1], [0.9, 0.3, 0.4]))
    points = sheet[keep] + preform.noise * rng.normal(size=(int(keep.sum()), 3))
    along = np.linspace(-0.5, 0.5, 2001) * preform.length
    line, normals = (make(preform, along, _seam(preform, along)) for make in (_sheet, _normals))
    if preform.kind == 'lap':
        line = line + 0.5 * preform.thickness * normals
    return PreformCloud(se3.apply(T, points), se3.apply(T, line), normals @ T[:3, :3].T)


def _seam(preform: Preform, x: Array) -> Array:
    u = 2 * x / preform.length
    return np.asarray(preform.sway * (u ** 2 - 0.6 * u ** 3 - 0.4))


def _slope(preform: Preform, x: Array) -> Array:
    u = 2 * x / preform.length
    return np.asarray(preform.sway * (2 * u - 1.8 * u ** 2) * 2 / preform.length)


def _sheet(preform: Preform, x: Array, y: Array) -> Array:
    return np.stack([x, y, -x ** 2 / (2 * preform.bend) - y ** 2 / (2 * preform.arch)], axis=-1)


def _normals(preform: Preform, x: Array, y: Array) -> Array:
    normals = np.stack([x / preform.bend, y / preform.arch, np.ones_like(x)], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
