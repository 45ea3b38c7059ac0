# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Simulated measurements of artefacts for verifications, with known truth.

Every routine has an artefact; its stations are those of the simulated targets, drawn for each bag,
with one sensor and robot. They are samples, or recordings of rendered profiles: `take` is stations
(in this file) or measuring.rendered.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from handeye_ros import se3
from handeye_ros.data import Array, EdgePoint, FaceLine, Sample
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate.measuring import draw_pose, Gauge, Pass, scan_gauge
from handeye_ros.simulate.scenario import (
    PlateTarget,
    RobotModel,
    Scenario,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.stations import lift, Stops, tilts
import numpy as np
from scipy.spatial.transform import Rotation

TILT = np.deg2rad(40)  # of the sensor over faces
PLAIN = SensorModel(columns=320, rate=5.0, rim_bias=0.0, mixed=0.0, lost=0.0, lost_at_edge=0.0,
                    outliers=0.0)
AIM = 5e-5  # m: 1 sigma of the aim of the laser at a point
INTO_CORNER = np.array([[1, 1, 0], [1, -1, 0], [0, 0, -2 ** 0.5]]).T / 2 ** 0.5  # T_target_sensor

Mounted: TypeAlias = tuple[Array, Array]
"""T_flange_sensor and T_base_target, (4, 4)."""
Taken: TypeAlias = tuple[Sample, ...] | Pass
Take: TypeAlias = Callable[[Scenario, Array, Array, Stops, np.random.Generator], Taken]


@dataclass(frozen=True, eq=False)
class Measured:
    """
    The samples of each bag, T_flange_sensor (4, 4), and the true values of the artefact.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; reference:
    the true point (3,) in the base; passes: recordings, where there are no samples.
    """

    bags: tuple[tuple[Sample, ...], ...]
    T_flange_sensor: Array
    lengths: tuple[float, ...] = ()
    reference: tuple[float, ...] = ()
    passes: tuple[Pass, ...] = ()


def sensor_on_flange(rng: np.random.Generator) -> Array:
    """Draw the pose of the sensor on the flange (4, 4)."""
    return se3.transform(Rotation.random(random_state=rng).as_matrix(),
                         rng.uniform(-0.12, 0.12, 3))


def stations(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array, stops: Stops,
             rng: np.random.Generator) -> tuple[Sample, ...]:
    """Return the samples of stops at a fixed target."""
    features = SCENES[scenario.scene].features(scenario, stops, rng)
    T = T_base_target @ stops.T_target_sensor @ se3.inverse(T_flange_sensor)
    reported = cells.perturbed(T, cells.robot_error(scenario.robot, T, rng))
    return tuple(Sample(k * 2_000_000_000, T_k, f, scenario.profiles_per_stop)
                 for k, (T_k, f) in enumerate(zip(reported, features, strict=True)))


def measured(bags: Sequence[Taken], T_flange_sensor: Array, lengths: tuple[float, ...] = (),
             reference: tuple[float, ...] = ()) -> Measured:
    """Return the samples, or recordings."""
    return Measured(tuple(bag for bag in bags if not isinstance(bag, Pass)), T_flange_sensor,
                    lengths, reference, tuple(bag for bag in bags if isinstance(bag, Pass)))


def cell_of(name: str, rng: np.random.Generator, count: int, mounted: Mounted | None,
            **changes: Any) -> tuple[Scenario, Array, Array]:
    """Return scenario, T_flange_sensor and T_base_target, drawn if not given."""
    scenario = replace(SCENARIOS[name], stations=(count, 0), **{'robot': RobotModel()} | changes)
    return scenario, *(mounted or (sensor_on_flange(rng), draw_pose(rng)))


def line(rng: np.random.Generator, count: int = 14, take: Take = stations,
         mounted: Mounted | None = None, **changes: Any) -> Measured:
    """Return a straight edge."""
    scenario, X, T = cell_of('line', rng, count, mounted, **changes)
    return measured([take(scenario, X, T, SCENES['line'].stops(scenario, rng), rng)], X)


def planes(rng: np.random.Generator, poses: Array, lengths: tuple[float, ...] = (),
           count: int = 20, take: Take = stations, mounted: Mounted | None = None,
           **changes: Any) -> Measured:
    """Return planes at poses (k, 4, 4) in the artefact, one bag each."""
    face = PlateTarget((0.2, 0.15), table=None, clutter=None)
    scenario, X, T = cell_of('plane', rng, count, mounted, **{
        'target': face, 'tilt': TILT} | changes)
    return measured([take(scenario, X, T @ pose, SCENES['plane'].stops(scenario, rng), rng)
                     for pose in poses], X, lengths)


def plane(rng: np.random.Generator, **values: Any) -> Measured:
    """Return a flat face."""
    return planes(rng, np.eye(4)[None], **values)


def step_block(rng: np.random.Generator, heights: tuple[float, ...] = (0.025, 0.05, 0.1),
               **values: Any) -> Measured:
    """Return parallel faces at several heights, orthogonal to x, y or z of the base."""
    poses = np.repeat(np.eye(4)[None], 1 + len(heights), axis=0)
    poses[1:, 2, 3] = heights
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler('zyx', [[0, 0, 0], [0, np.pi / 2, 0], [0, 0, np.pi / 2]][
        int(rng.integers(3))]).as_matrix()
    return planes(rng, turn @ poses, heights, **values)


def step_directions(rng: np.random.Generator, heights: Sequence[float] = (0.025, 0.05, 0.1),
                    **values: Any) -> Measured:
    """Return a block laid along x, y and z of the base in turn: two faces each."""
    poses = np.repeat(np.eye(4)[None], 2 * len(heights), axis=0)
    poses[1::2, 2, 3] = heights
    poses[:, :3, :3] = Rotation.from_euler('zyx', np.repeat(
        [[0, 0, 0], [0, np.pi / 2, 0], [0, 0, np.pi / 2]], 2, axis=0)).as_matrix()
    poses[:, :3, 3] = np.einsum('kij,kj->ki', poses[:, :3, :3], poses[:, :3, 3])
    return planes(rng, poses, tuple(heights), **values)


def square(rng: np.random.Generator, **values: Any) -> Measured:
    """Return two faces at a right angle."""
    poses = np.repeat(np.eye(4)[None], 2, axis=0)
    poses[1, :3, :3] = Rotation.from_euler('x', np.pi / 2).as_matrix()
    poses[1, :3, 3] = [0, 0.15, 0]
    return planes(rng, poses, **values)


def ball_bar(rng: np.random.Generator, balls: int = 2, length: float = 0.2, radius: float = 0.02,
             count: int = 14, take: Take = stations, mounted: Mounted | None = None,
             **changes: Any) -> Measured:
    """Return balls in a row (one: a sphere)."""
    ball = SphereTarget(radius, table=None, clutter=False)
    scenario, X, T = cell_of('sphere', rng, count, mounted, target=ball, **changes)
    bags = []
    for k in range(balls):
        T_ball = np.eye(4)
        T_ball[0, 3] = k * length
        stops = SCENES['sphere'].stops(scenario, rng)
        bags.append(take(scenario, X, T @ T_ball, stops, rng))
    return measured(bags, X, (length,) * (balls - 1))


def sphere(rng: np.random.Generator, **values: Any) -> Measured:
    """Return one ball."""
    return ball_bar(rng, balls=1, **values)


def at_corner(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array, stops: Stops,
              rng: np.random.Generator) -> tuple[Sample, ...]:
    """Return the samples of stops with the corner of a plate as edge point, like stations()."""
    truth = T_base_target @ stops.T_target_sensor @ se3.inverse(T_flange_sensor)
    reported = cells.perturbed(truth, cells.robot_error(scenario.robot, truth, rng))
    std = scenario.sensor.noise / np.sqrt(scenario.profiles_per_stop)
    samples = []
    for k, pose in enumerate(reported):
        point = stops.points[k] + rng.normal(size=2) * std
        edge = EdgePoint(point, np.array([1.0, 0.0]), float(std), float(std))
        face = FaceLine(stops.points[k] - [5e-3, 0], np.array([1.0, 0.0]), 3e-3, float(std))
        samples.append(Sample(k * 2_000_000_000, pose, (face, edge)))
    return tuple(samples)


def fixed_point(rng: np.random.Generator, count: int = 12, aim: float = AIM,
                take: Take = at_corner, mounted: Mounted | None = None, **changes: Any
                ) -> Measured:
    """Return the corner of a plate, to which the laser is aimed with some error."""
    scenario, X, T = cell_of('line', rng, count, mounted, target=PlateTarget(clutter=None),
                             **changes)
    points = SCENES['line'].stops(scenario, rng).points
    R = INTO_CORNER @ tilts(scenario, rng, (count,))
    aim_error = aim * rng.normal(size=(count, 3))
    position = aim_error - (R @ lift(points)[:, :, None])[:, :, 0]
    stops = Stops(se3.transform(R, position), ('p',) * count, points)
    return measured([take(scenario, X, T, stops, rng)], X, reference=tuple(
        map(float, T[:3, 3])))


def tooth(rng: np.random.Generator, sensor: SensorModel = PLAIN, robot: RobotModel | None = None
          ) -> Measured:
    """Return a scanned gauge of teeth; sensor: by default without faults other than noise."""
    gauge, X = Gauge(), sensor_on_flange(rng)
    passes = scan_gauge(gauge, X, draw_pose(rng), sensor, robot or RobotModel(), rng)
    return Measured((), X, (gauge.pitch, gauge.height), passes=passes)
