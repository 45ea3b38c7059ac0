# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The robot cell: true transforms of sensor and target, and the poses that the robot reports."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate import arm
from handeye_ros.simulate.scenario import RobotModel, Scenario
from handeye_ros.simulate.sensor import Distortion
from handeye_ros.simulate.stations import FRAMES, Stops
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Station:
    """
    A station of the robot with its true values.

    start, end: stamps of the stop (0, 0 without streams). label: the edge that the line crosses
    ('p', 'q', 'p2', 'q2'), or 'sphere'. point: (2,) true edge point, or centre of the arc, along
    the line and range in the standard sensor frame. T_base_flange, T_base_flange_reported: (4, 4).
    """

    start: int
    end: int
    label: str
    point: Array
    T_base_flange: Array
    T_base_flange_reported: Array


@dataclass(frozen=True, eq=False)
class Truth:
    """
    The true values of a calibration; (4, 4) transforms.

    T_flange_sensor: with errors of robot or sensor, the best-fit transform over the volume of the
    stops and the field of view. With eye_on_base it is the sensor's pose in the base, and
    T_base_target the target's pose in the flange. The sensor frame is the published one
    (Scenario.layout). time_offset: to be added to the profiles' stamps (s), of a sweep.
    """

    T_flange_sensor: Array
    T_base_target: Array
    stations: tuple[Station, ...]
    time_offset: float | None = None


@dataclass(frozen=True, eq=False)
class Cell:
    """
    The unknowns and the poses at n stations; standard sensor frame.

    T_mount_sensor: the sensor in the flange (eye_in_hand) or in the base (eye_on_base);
    T_world_target: the target in the base, or in the flange. T_base_flange and the reported poses:
    (n, 4, 4). T_mount_best: best-fit transform with the reported poses. arm: its errors.
    """

    T_mount_sensor: Array
    T_world_target: Array
    T_base_flange: Array
    T_base_flange_reported: Array
    T_mount_best: Array
    arm: arm.ArmErrors | None = None

    def T_target_sensor(self, T_base_flange: Array, calibration_type: str) -> Array:
        """Return the sensor's poses (n, 4, 4) in the target at flange poses (n, 4, 4)."""
        T = se3.inverse(T_base_flange) if calibration_type == 'eye_on_base' else T_base_flange
        return np.asarray(se3.inverse(self.T_world_target) @ T @ self.T_mount_sensor)


def draw(scenario: Scenario, stops: Stops, anywhere: Stops, rng: np.random.Generator) -> Cell:
    """
    Draw a cell in which the sensor reaches the stops, and the robot's errors.

    anywhere: many stops, for the best-fit transform.
    """
    T_near = _sensor_on_flange(scenario, rng)
    T_far = _target_in_base(rng)
    T_sensor_target = se3.inverse(stops.T_target_sensor)
    if scenario.calibration_type == 'eye_on_base':
        # the target on the flange, the sensor in place of the target
        T_true = T_far @ T_sensor_target @ se3.inverse(T_near)
        T_mount_sensor, T_world_target = T_far, T_near
    else:
        T_true = T_far @ stops.T_target_sensor @ se3.inverse(T_near)
        T_mount_sensor, T_world_target = T_near, T_far
    reported = perturbed(T_true, robot_error(scenario.robot, T_true, rng))
    best, errors = T_mount_sensor, None
    if scenario.robot.geometry:
        errors = arm.draw(scenario.robot.geometry, rng)
        reported = perturbed(reported, arm.reported_error(T_true, errors))
        T_many = T_far @ anywhere.T_target_sensor @ se3.inverse(T_near)
        best = _best_mount(T_many, arm.reported_error(T_many, errors), T_mount_sensor, scenario)
    reported[:, :3, 3] *= 1 + scenario.robot.scale
    reported = _bumped(reported, scenario.bumped, rng)
    return Cell(T_mount_sensor, T_world_target, T_true, reported, best, errors)


def _sensor_on_flange(scenario: Scenario, rng: np.random.Generator) -> Array:
    direction = rng.normal(size=3)
    translation = direction / np.linalg.norm(direction) * rng.uniform(*scenario.lever)
    if scenario.robot.geometry:  # an arm whose flange must look down
        turn = Rotation.from_euler('ZY', rng.uniform([-np.pi, -0.4], [np.pi, 0.4]))
        return se3.transform(turn.as_matrix(), translation)
    turn = Rotation.from_quat(rng.normal(size=4))
    return se3.transform(turn.as_matrix(), translation)


def _best_mount(T: Array, error: Array, X: Array, scenario: Scenario) -> Array:
    """
    Return the best-fit mount (4, 4) for poses T (n, 4, 4) reported with errors (n, 6).

    It minimises the errors of points mapped from the field of view, up to a common motion of all
    points, which the pose of the target absorbs.
    """
    (near, far), w = scenario.sensor.range, scenario.sensor.half_width
    field = np.array([[x * z, 0.0, z] for z in (near, far) for x in (-w, 0.0, w)])
    lever = field @ X[:3, :3].T
    a, R = T[:, None, :3, 3], T[:, :3, :3]
    points = se3.apply(T, lever + X[:3, 3])
    shift = error[:, None, :3] + np.cross(error[:, None, 3:], points - a)
    by_turn = -np.einsum('nij,kjl->nkil', R, se3.skew(lever))
    by_shift = np.broadcast_to(R[:, None], by_turn.shape)
    by_target = np.concatenate([np.broadcast_to(-np.eye(3), by_turn.shape), se3.skew(points)],
                               axis=3)
    A = np.concatenate([by_shift, by_turn, by_target], axis=3).reshape(-1, 12)
    step = np.linalg.lstsq(A, -shift.reshape(-1), rcond=1e-9)[0]
    return se3.perturb(X, step[:6])


def _target_in_base(rng: np.random.Generator) -> Array:
    translation = rng.uniform([0.5, -0.3, 0.0], [0.9, 0.3, 0.4])
    angles = rng.uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi])
    return se3.transform(Rotation.from_euler('xyz', angles).as_matrix(), translation)


def perturbed(T: Array, error: Array) -> Array:
    """Return T (n, 4, 4) perturbed by error (n, 6)."""
    R = se3.exp_rotation(error[:, 3:]) @ T[:, :3, :3]
    return se3.transform(R, T[:, :3, 3] + error[:, :3])


def robot_error(robot: RobotModel, T: Array, rng: np.random.Generator) -> Array:
    """Return the errors (n, 6) of the reported poses at T (n, 4, 4): random plus smooth."""
    scale = np.repeat(robot.repeatability, 3)
    return np.asarray(rng.normal(size=(len(T), 6)) * scale + _systematic(robot, T, rng))


def _systematic(robot: RobotModel, T: Array, rng: np.random.Generator) -> Array:
    """Return six sinusoids over position (0.3 m) and orientation (0.5 rad): (n, 6)."""
    mean = se3.mean_pose(T)
    turned = se3.log_rotation(T[:, :3, :3] @ mean[:3, :3].T)
    scaled = np.concatenate([T[:, :3, 3] / 0.3, turned / 0.5], axis=1)
    wave, phase = rng.normal(size=(6, 6)) / np.sqrt(2), rng.uniform(0, 2 * np.pi, 6)
    amplitude = np.repeat(robot.systematic, 3) * np.sqrt(2 / 3)  # RMS of the vector of three
    return np.asarray(amplitude * np.sin(scaled @ wave.T + phase))


def _bumped(T: Array, count: int, rng: np.random.Generator) -> Array:
    """Return poses, count of them with errors of 1-3 mm and 0.1-0.3 degrees."""
    error = np.zeros((len(T), 6))
    size = np.repeat(rng.uniform([1e-3, 2e-3], [3e-3, 5e-3], (count, 2)), 3, axis=1)
    direction = rng.normal(size=(count, 2, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    error[rng.permutation(len(T))[:count]] = size * direction.reshape(-1, 6)
    return perturbed(T, error)


def visit_order(scenario: Scenario, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the order of n stops; all are visited once per run of the programme."""
    programme = rng.permutation(n) if scenario.shuffled else np.arange(n)
    return np.tile(programme, scenario.repeats)


def truth(scenario: Scenario, cell: Cell, stops: Stops, spans: NDArray[np.int64],
          distortion: Distortion | None = None) -> Truth:
    """
    Return the true values, stop by stop.

    spans (n, 2): stamps of the stops; distortion: of the sensor.
    """
    T_standard_sensor = FRAMES[scenario.layout.frame].T_standard_sensor
    stations = tuple(
        Station(int(span[0]), int(span[1]), label, point, T, T_reported)
        for span, label, point, T, T_reported in zip(
            spans, stops.labels, stops.points, cell.T_base_flange, cell.T_base_flange_reported,
            strict=True))
    T_mount_sensor = cell.T_mount_best @ (distortion.T_true_reported if distortion else np.eye(4))
    return Truth(T_mount_sensor @ T_standard_sensor, cell.T_world_target, stations)
