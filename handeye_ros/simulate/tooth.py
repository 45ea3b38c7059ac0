"""
A gauge of equal teeth, scanned in passes by a robot that moves.

Frame of the gauge: x along the row, from the middle of its middle tooth, y along the teeth, z out
of them, 0 in the valleys.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate import motion
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.scenario import RobotModel, SensorModel
from handeye_ros.simulate.solids import Box, Convex, Solid
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


def solids(gauge: Gauge) -> tuple[Solid, ...]:
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
               robot: RobotModel, rng: np.random.Generator, speed: float = 0.01
               ) -> tuple[Pass, ...]:
    """
    Return the passes of a scan; the robot's error stays the same through a pass.

    speed: of the sensor along the teeth (m/s).
    """
    way = gauge.length - 0.02
    times = np.arange(0.0, way / speed, 1 / sensor.rate)
    passes = []
    for k, turn in enumerate(PASSES):
        R = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
        middle = np.array([rng.uniform(-0.004, 0.004), 0.0, gauge.height / 2])
        place = middle - R @ [0, 0, RANGE] + np.array([0, speed, 0]) * (
            times - times.mean())[:, None]
        T_gauge_sensor = se3.transform(np.repeat(R[None], len(times), axis=0), place)
        z, angle = sensors.render(sensor, solids(gauge), T_gauge_sensor)
        points = sensors.plane_points(sensor, sensors.measure(sensor, z, angle, rng))
        stamps = motion.stamps(times + k * 100.0)
        T = T_base_gauge @ T_gauge_sensor @ se3.inverse(T_flange_sensor)
        error = cells.robot_error(robot, T[:1], rng)
        T = cells.perturbed(T, np.repeat(error, len(T), axis=0))
        T = cells.perturbed(T, rng.normal(size=(len(T), 6)) * robot.jitter)
        passes.append(Pass(
            tuple(Profile(int(s), 'laser', p) for s, p in zip(stamps, points, strict=True)),
            tuple(TimedPose(int(s), t, q) for s, t, q in zip(
                stamps, T[:, :3, 3], se3.quaternion(T), strict=True))))
    return tuple(passes)
