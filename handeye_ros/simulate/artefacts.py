# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A cell that is calibrated and then measures: recordings of one sensor and one robot.

`plate` is for the calibration; `ball_1` and `ball_2` are the ends of a ball bar; `pass_1` and so
on are a scan of a gauge of equal teeth, in passes of a moving robot. Frame of the gauge: x along
the row, from the middle of its middle tooth, y along the teeth, z out of them, 0 in the valleys.
Also a curved preform with a seam, as a cloud.
"""
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.recording import simulate, timed_poses, timed_profiles
from handeye_ros.simulate.robot import pose_error
from handeye_ros.simulate.scenario import (
    changed,
    RobotModel,
    Scenario,
    SCENARIOS,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenes import Placements, SCENES
from handeye_ros.simulate.solids import box, Polyhedron, Solid
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

STOP_TIME = 0.6  # s of a stop
GAP_TIME = 1.0  # s between two stops


@dataclass(frozen=True, eq=False)
class Messages:
    """Profiles and reported poses of the flange."""

    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]


def draw_pose(rng: Generator, tilt: float = 0.2, low: float = 0.0) -> Array:
    """Draw the pose (4, 4) of an artefact in the base, tilted at most so (rad), above low (m)."""
    turn = Rotation.from_euler('xyz', rng.uniform([-tilt, -tilt, -3], [tilt, tilt, 3]))
    return se3.transform(turn.as_matrix(), rng.uniform([0.5, -0.3, low], [0.9, 0.3, 0.4]))


def messages_at_stops(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array,
                      placed: Placements, rng: Generator, start: float = 0.0) -> Messages:
    """
    Return the messages of a robot at stops, without those between the stops.

    start: the time of the first stop, since the start of the recording (s)
    """
    sensor, robot = scenario.sensor, scenario.robot
    T = T_base_target @ placed.T_target_sensor @ se3.inverse(T_flange_sensor)
    T = se3.perturb(T, pose_error(robot, T, rng))
    z, angle = sensors.render(sensor, SCENES[scenario.scene].solids(scenario),
                              placed.T_target_sensor)
    profiles: list[Profile] = []
    poses: list[TimedPose] = []
    for k, pose in enumerate(T):
        begin = start + k * (STOP_TIME + GAP_TIME)
        times = np.arange(0.5 / sensor.rate, STOP_TIME, 1 / sensor.rate)
        again = np.full(len(times), k)
        ranges = sensors.measure(sensor, z[again], angle[again], rng)
        profiles += timed_profiles(begin + times, sensors.plane_points(sensor, ranges))
        poses += _streamed(robot, pose, begin + np.arange(0.0, STOP_TIME, 1 / robot.rate), rng)
    return Messages(tuple(profiles), tuple(poses))


def _streamed(robot: RobotModel, T: Array, times: Array, rng: Generator) -> tuple[TimedPose, ...]:
    """Return the poses T (4, 4) or (n, 4, 4) as they are streamed at times (n,)."""
    T = se3.perturb(np.broadcast_to(T, (len(times), 4, 4)),
                    rng.normal(size=(len(times), 6)) * robot.jitter)
    return timed_poses(times, T[:, :3, 3], se3.quaternion(T))


# -- a gauge of teeth


TEETH_RANGE = 0.175  # m from the sensor to the middle of the teeth
GAUGE_PASSES = ((0, 0, 0), (30, 0, 15), (-30, 0, -15), (0, 15, 180), (0, -15, 165), (30, 10, -165),
                (-30, -10, 0))
"""Turns of the sensor about its x, y and z for each pass (degrees)."""


@dataclass(frozen=True)
class Gauge:
    """A gauge: pitch, height, flank (its horizontal width) and length of count teeth (m)."""

    pitch: float = 0.015
    height: float = 0.005
    flank: float = 0.005
    count: int = 5
    length: float = 0.06

    def solids(self) -> tuple[Solid, ...]:
        """Return the teeth on their bar."""
        out, _, up = np.array([self.height, 0, self.flank]) / np.hypot(self.flank, self.height)
        normals = np.array([[out, 0, up], [-out, 0, up], [0, 0, 1], [0, 1, 0]])
        # the flanks are a quarter of the pitch from the middle at half the height
        flank = out * self.pitch / 4 + up * self.height / 2
        half, width = self.length / 2, self.count * self.pitch / 2
        low = np.array([-np.inf, -np.inf, -1e-3, -half])
        teeth = [Polyhedron(normals, low, np.array([flank + x, flank - x, self.height, half]))
                 for x in out * (np.arange(self.count) - (self.count - 1) / 2) * self.pitch]
        return (box((-width, -half, -0.01), (width, half, 0.0)), *teeth)


def scan_gauge(gauge: Gauge, T_flange_sensor: Array, T_base_gauge: Array, sensor: SensorModel,
               robot: RobotModel, rng: Generator) -> tuple[Messages, ...]:
    """Return the passes of a scan; the robot's error is constant during a pass."""
    distance, speed = gauge.length - 0.02, 0.01  # m, m/s along the teeth
    times = np.arange(0.0, distance / speed, 1 / sensor.rate)
    passes = []
    for k, turn in enumerate(GAUGE_PASSES):
        R = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
        middle = np.array([rng.uniform(-0.004, 0.004), 0.0, gauge.height / 2])
        position = middle - R @ [0, 0, TEETH_RANGE] + np.array([0, speed, 0]) * (
            times - times.mean())[:, None]
        T_gauge_sensor = se3.transform(R, position)
        z, angle = sensors.render(sensor, gauge.solids(), T_gauge_sensor)
        points = sensors.plane_points(sensor, sensors.measure(sensor, z, angle, rng))
        T = T_base_gauge @ T_gauge_sensor @ se3.inverse(T_flange_sensor)
        T = se3.perturb(T, np.repeat(pose_error(robot, T[:1], rng), len(T), axis=0))
        passes.append(Messages(timed_profiles(times + k * 100.0, points),
                               _streamed(robot, T, times + k * 100.0, rng)))
    return tuple(passes)


# -- a cell that is calibrated and then measures


MEASURING_CELL = 'measuring_cell'  # its name for `handeye simulate`
GAUGE_BALL = SphereTarget(0.02, table=None, clutter=False)
BALL_BAR_LENGTH = 0.2  # m between two balls


def measuring_cell(rng: Generator) -> tuple[dict[str, Messages], dict[str, Any]]:
    """
    Return recordings by name, and what the truth.yaml of each holds.

    The artefacts are two GAUGE_BALLs, BALL_BAR_LENGTH apart, and Gauge(). Sensor and robot are
    those of the plate scenario.
    """
    plate = SCENARIOS['plate']
    simulated = simulate(plate, rng)
    X, T_bar = simulated.truth.T_flange_sensor, draw_pose(rng)
    recordings = {'plate': Messages(simulated.profiles, simulated.poses)}
    wide = changed(SCENARIOS['sphere'], 'ball', target=GAUGE_BALL, stops=(12, 0))
    for k in range(2):
        T_ball = se3.transform(np.eye(3), np.array([k * BALL_BAR_LENGTH, 0.0, 0.0]))
        placed = SCENES[wide.scene].placements(wide, rng)
        recordings[f'ball_{k + 1}'] = messages_at_stops(
            wide, X, T_bar @ T_ball, placed, rng, 1000.0 * (k + 1))
    passes = scan_gauge(Gauge(), X, draw_pose(rng), plate.sensor, plate.robot, rng)
    recordings |= {f'pass_{k}': messages for k, messages in enumerate(passes, 1)}
    return recordings, {'T_flange_sensor': se3.transform_values(X), 'artefacts': {
        'ball_radius': GAUGE_BALL.radius, 'bar': BALL_BAR_LENGTH, 'gauge': asdict(Gauge())}}


# -- a preform with a seam


PREFORM_WIDTH = 0.06  # m
STEP = 5e-3  # m: thickness of the upper sheet, which is the height of the seam
BEND, ARCH = 0.25, 0.15  # radii of the sheets along and across the seam (m)
SWAY = 8e-3  # m: deviation of the seam from a straight line
PREFORM_NOISE = 1e-4  # 1 sigma of each coordinate of a point (m)


@dataclass(frozen=True, eq=False)
class PreformCloud:
    """Points (n, 3) in the base; centre (m, 3) of the seam and normals (m, 3) of the sheet."""

    points: Array
    centre: Array
    normals: Array


def preform_cloud(rng: Generator, length: float = 0.2, spacing: float = 4e-4) -> PreformCloud:
    """
    Return a cloud of a preform at a random pose in the base, and its true seam.

    A sheet of this length lies on another one; its rim is the seam. Both sheets are curved, the
    lower one is z = f(x, y). spacing: of the points (m).
    """
    size = np.array([length, PREFORM_WIDTH])
    cells = np.argwhere(np.ones(np.ceil(size / spacing).astype(int)))
    x, y = ((cells + rng.random(cells.shape)) * spacing - size / 2).T
    points, normals = _sheet(x, y)
    points += STEP * (y > _seam(x, length))[:, None] * normals
    along = np.linspace(-0.5, 0.5, 2001) * length
    centre, upwards = _sheet(along, _seam(along, length))
    centre += 0.5 * STEP * upwards
    T = draw_pose(rng, 0.5, 0.1)
    points += PREFORM_NOISE * rng.normal(size=points.shape)
    return PreformCloud(se3.apply(T, points), se3.apply(T, centre), upwards @ T[:3, :3].T)


def _sheet(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the points (n, 3) of the lower sheet, and its normals (n, 3)."""
    points = np.stack([x, y, -x ** 2 / (2 * BEND) - y ** 2 / (2 * ARCH)], axis=-1)
    return points, se3.unit(np.stack([x / BEND, y / ARCH, np.ones_like(x)], axis=-1))


def _seam(x: Array, length: float) -> Array:
    """Return y (n,) of the seam in plan."""
    u = 2 * x / length
    return SWAY * (u ** 2 - 0.6 * u ** 3 - 0.4)
