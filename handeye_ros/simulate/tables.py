# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Simulated files of measured values from other instruments than a profiler.

The tracker is the cell of Jing 2020: a P1 R2 P3 arm, a laser tracker, a ball and a block. Frame of
the target: the ball's centre, axes along the block's edges; its ridge runs along y.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.output import csv_text
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.recording import timed_poses, timed_profiles
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.simulate.solids import Ball, box
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

TABLE_DIGITS = 9  # after the point in the tables
MIDDLE = (0.6, 0.1, 0.3)  # of the points of a tool in the base (m)
ROBOT_STDS, CAMERA_STDS = (3e-5, 1e-4), (1e-4, 1e-3)  # 1 sigma of poses, per axis (m, rad)


@dataclass(frozen=True, eq=False)
class SimulatedFiles:
    """
    Files, with their true values.

    tables: their texts by name
    T_flange_sensor: (4, 4), of the camera in the base with eye_on_base
    noise: 1 sigma each, in SI units
    settings: the configuration by dotted key
    profiles, poses: of the bag beside the tables, if there is one
    """

    tables: Mapping[str, str]
    T_flange_sensor: Array
    noise: Mapping[str, float]
    settings: Mapping[str, Any]
    profiles: tuple[Profile, ...] = ()
    poses: tuple[TimedPose, ...] = ()

    @property
    def true_values(self) -> dict[str, Any]:
        """Return the content of truth.yaml by key."""
        return {'T_flange_sensor': se3.transform_values(self.T_flange_sensor),
                'noise': self.noise, 'settings': self.settings}


def points_in_two_frames(rng: Generator, T_base_camera: Array, noise: float = 3e-5,
                         count: int = 10, middle: Sequence[float] = MIDDLE
                         ) -> tuple[Array, Array]:
    """
    Return points (count, 3) in the camera, which measures them with noise, and in the base (m).

    noise: 1 sigma per axis (m); middle: of the points in the base (m).
    """
    base = rng.uniform(-0.15, 0.15, (count, 3)) + middle
    camera = se3.apply(se3.inverse(T_base_camera), base)
    return camera + noise * rng.normal(size=base.shape), base


def points(rng: Generator, noise: float = 3e-5, count: int = 10) -> SimulatedFiles:
    """Return the tip of a tool at several positions, 0.5 m from a camera beside the robot."""
    R = Rotation.random(random_state=rng).as_matrix()
    X = se3.transform(R, MIDDLE - R @ [0.0, 0.0, 0.5])
    header = [f'{frame}_{axis} [mm]' for frame in ('camera', 'base') for axis in 'xyz']
    rows = 1e3 * np.hstack(points_in_two_frames(rng, X, noise, count))
    return SimulatedFiles({'points.csv': csv_text(header, rows.round(TABLE_DIGITS))}, X,
                          {'point': noise},
                          {'target.type': 'points', 'calibration_type': 'eye_on_base'})


def poses_of_target(rng: Generator, robot: Sequence[float] = ROBOT_STDS,
                    camera: Sequence[float] = CAMERA_STDS, eye_on_base: bool = False,
                    count: int = 12, tilts: Sequence[float] = (30.0, 30.0, 60.0)
                    ) -> tuple[Array, Array, Array, Array]:
    """
    Return X, Z, T_base_flange and T_camera_target of a camera that a target faces.

    X (4, 4) is the camera in its mount, Z (4, 4) the target where it is fixed; the other two are
    lists (count, 4, 4) of poses with noise.

    robot, camera: noise of their translations and rotations, 1 sigma by axis (m, rad)
    eye_on_base: whether the camera stands beside the robot, and the target is on the flange
    tilts: the largest ones about each axis of the camera (degrees)
    """
    near = se3.transform(Rotation.random(random_state=rng).as_matrix(), 0.1 * rng.normal(size=3))
    far = se3.transform(Rotation.random(random_state=rng).as_matrix(), np.array([0.7, 0.1, 0.2]))
    X, Z = (far, near) if eye_on_base else (near, far)
    turns = Rotation.from_euler('xyz', rng.uniform(-1, 1, (count, 3)) * tilts, degrees=True)
    views = se3.transform(turns.as_matrix() @ np.diag([1.0, -1.0, -1.0]),
                          rng.uniform([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3], (count, 3)))
    T_fixed_mount = Z @ se3.inverse(views) @ se3.inverse(X)
    T_base_flange = se3.inverse(T_fixed_mount) if eye_on_base else T_fixed_mount
    flange, seen = (se3.perturb(T, np.repeat(stds, 3) * rng.normal(size=(count, 6)))
                    for T, stds in ((T_base_flange, robot), (views, camera)))
    return X, Z, flange, seen


def hand_eye(rng: Generator, eye_on_base: bool = False, noise: float = 1.0,
             count: int = 12, tilts: Sequence[float] = (30.0, 30.0, 60.0)) -> SimulatedFiles:
    """Return a table of `poses_of_target`; noise: a factor."""
    robot, camera = ([noise * std for std in stds] for stds in (ROBOT_STDS, CAMERA_STDS))
    X, _, *lists = poses_of_target(rng, robot, camera, eye_on_base, count, tilts)
    columns = [column for T in lists for column in (1e3 * T[:, :3, 3], se3.quaternion(T))]
    header = [f'{name}_{column}' for name in ('flange', 'target')
              for column in ('x [mm]', 'y [mm]', 'z [mm]', 'qx', 'qy', 'qz', 'qw')]
    names = ('robot_translation', 'robot_rotation', 'target_translation', 'target_rotation')
    table = csv_text(header, np.hstack(columns).round(TABLE_DIGITS))
    return SimulatedFiles({'poses.csv': table}, X,
                          dict(zip(names, (*robot, *camera), strict=True)),
                          {'target.type': 'hand_eye', 'calibration_type': (
                              'eye_on_base' if eye_on_base else 'eye_in_hand')})


BALL_RADIUS = 0.01905  # m, of the reflector
H0, H1 = 0.02543, 0.031  # m: tracker.h0, tracker.h1
SWEEP_ANGLE = np.deg2rad(12.0)
RIDGE_X = 0.0145  # the block's ridge is at x = z = RIDGE_X
SOLIDS = (Ball(BALL_RADIUS), box((-0.05, 0.03, -0.05), (RIDGE_X, 0.10, RIDGE_X)))
FILE_SENSOR = SensorModel(columns=640, rate=10.0, noise=3.7e-5)
SMALL_SENSOR = replace(FILE_SENSOR, columns=320, resolution=2.0**-20)  # compresses well
TRACKER_NOISE = 2e-5  # m, 1 sigma by axis
JOINT_READING_STD = 1e-6  # 1 sigma of the readings of P3 (m)


def frame_3(turn: float, q3: float) -> Array:
    """Return frame 3 (4, 4) of the arm in its frame 1; turn: of R2 (rad); q3: of P3 (m)."""
    R = (Rotation.from_euler('z', turn) * Rotation.from_euler('x', np.pi / 2)).as_matrix()
    return se3.transform(R, R[:, 2] * q3)


def laser_tracker(rng: Generator, sensor: SensorModel = FILE_SENSOR,
                  noise: float = TRACKER_NOISE, reported: float = JOINT_READING_STD
                  ) -> SimulatedFiles:
    """
    Return a bag of the sweep over ball and block, and a table of the reflector's positions.

    noise: that of the tracker, 1 sigma by axis (m)
    reported: that of the reported positions of P3, 1 sigma by axis (m)
    """
    turn = Rotation.from_euler('xyz', [90, 0, 0] + rng.uniform(-1.5, 1.5, 3), degrees=True)
    X = se3.transform(turn.as_matrix(), rng.uniform([0.04, -0.13, 0.03], [0.07, -0.09, 0.06]))
    # at q3 = 0: 45 degrees to both faces, with some tilt
    nominal = np.array([[-1.0, 0, 1], [0, 2 ** 0.5, 0], [-1, 0, -1]]) / 2 ** 0.5
    tilt = Rotation.from_euler('xyz', rng.uniform(-8, 8, 3), degrees=True).as_matrix()
    T_sensor_target = se3.transform(tilt @ nominal, np.array([0.0, 0.0, 0.184]))
    T_base_target = frame_3(SWEEP_ANGLE, 0.0) @ X @ T_sensor_target

    q3 = np.linspace(-0.03, 0.11, 151)
    T = np.array([frame_3(SWEEP_ANGLE, q) for q in q3])
    times = np.arange(len(q3)) / sensor.rate
    exact = sensors.render(sensor, SOLIDS, se3.inverse(T_base_target) @ T @ X)
    profiles = timed_profiles(times, sensors.plane_points(
        sensor, sensors.measure(sensor, *exact, rng)))
    positions = T[:, :3, 3] + reported * rng.normal(size=(len(T), 3))
    reflector = [[kind, *point] for kind, points in _reflector(T_base_target, rng).items()
                 for point in (1e3 * (points + noise * rng.normal(size=points.shape))
                               ).round(TABLE_DIGITS)]
    return SimulatedFiles(
        {'tracker.csv': csv_text(['kind', 'x [mm]', 'y [mm]', 'z [mm]'], reflector)}, X,
        {'tracker': noise, 'sensor': sensor.noise, 'readings': reported},
        {'target.type': 'tracker', 'target.radius': BALL_RADIUS,
         'tracker.h0': H0, 'tracker.h1': H1,
         'tracker.first_reading': float(q3[0]), 'tracker.noise': max(noise, 1e-9),
         'noise.sensor': max(sensor.noise, 1e-9)},
        profiles, timed_poses(times, positions, se3.quaternion(T)))


def _reflector(T_base_target: Array, rng: Generator) -> dict[str, Array]:
    """Return the true positions (n, 3) of the reflector in the tracker's frame by kind (m)."""
    T_tracker_base = se3.transform(Rotation.from_euler('xyz', [3, -4, 50], degrees=True
                                                       ).as_matrix(), np.array([3.0, 1.7, -0.6]))
    reflector = np.array([[0.02, H0 + H1, 0.25]])
    arc = [se3.apply(frame_3(turn, 0.0), reflector)[0] for turn in np.linspace(-1.0, 1.0, 40)]
    line = [se3.apply(frame_3(SWEEP_ANGLE, q), reflector)[0] for q in np.linspace(-0.1, 0.1, 30)]
    along, down = rng.uniform([0.035, -0.04], [0.095, RIDGE_X - 0.003], (2, 40, 2)).transpose(
        2, 0, 1)
    top = np.full(40, RIDGE_X)
    target = {'ball': np.zeros((1, 3)), 'face_c': np.column_stack([top, along[0], down[0]]),
              'face_d': np.column_stack([down[1], along[1], top])}
    in_base = {'arc': np.array(arc), 'line': np.array(line),
               **{kind: se3.apply(T_base_target, points) for kind, points in target.items()}}
    return {kind: se3.apply(T_tracker_base, points) for kind, points in in_base.items()}


FILE_SCENES: dict[str, Callable[[Generator], SimulatedFiles]] = {
    'points': points,
    'hand_eye': hand_eye,
    'hand_eye_on_base': partial(hand_eye, eye_on_base=True),
    'tracker': laser_tracker,
    'small_tracker': partial(laser_tracker, sensor=SMALL_SENSOR),
}
"""Simulations for the targets that are solved from files, by name."""
