# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Profiles and poses of a whole recording, or its samples directly."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array, Profile, Sample, TimedPose
from handeye_ros.simulate import arm
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.arm import CONVENTION_ERRORS
from handeye_ros.simulate.cell import Truth
from handeye_ros.simulate.scenario import Scenario, Sweep
from handeye_ros.simulate.scenes import anywhere, SCENES
from handeye_ros.simulate.solids import relief
from handeye_ros.simulate.stations import (
    FRAMES,
    interpolated,
    published,
    stamped_poses,
    stamps,
    Stops,
    Timeline,
)
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

CHILD_FRAME = 'laser'
INSTANTS = 5  # rendered per exposure

Way = Callable[[Array], Array]
"""The poses (n, 4, 4) of the sensor in the target at times (n,)."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated recording with its truth; profiles and poses in the order of their stamps."""

    scenario: Scenario
    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]
    truth: Truth

    def joints(self) -> list[tuple[int, Array]]:
        """Return stamps and joint values of the arm at the poses, empty without an arm."""
        if not self.scenario.robot.geometry:
            return []
        T = se3.from_quaternion(np.array([pose.translation for pose in self.poses]),
                                np.array([pose.quaternion for pose in self.poses]))
        values = np.unwrap(arm.inverse(T), axis=0)
        return [(pose.stamp, row) for pose, row in zip(self.poses, values, strict=True)]


def simulate(scenario: Scenario, rng: np.random.Generator) -> Simulated:
    """Return a recording of a robot that moves from stop to stop."""
    scene = SCENES[scenario.scene]
    stops = scene.stops(scenario, rng)
    stops = stops.ordered(cells.visit_order(scenario, len(stops.labels), rng))
    cell = cells.draw(scenario, stops, anywhere(scenario), rng)
    distortion = sensors.draw_distortion(scenario.sensor, rng)
    if scenario.sweep:
        return _swept(scenario, cell, stops, distortion, rng)
    line = Timeline(len(stops.labels), scenario.robot.dwell, scenario.robot.move)
    truth = cells.truth(scenario, cell, stops, line.spans(), distortion)
    profiles = _profiles(scenario, cell, line, distortion, rng)
    return Simulated(scenario, profiles, _poses(scenario, cell, line, rng), truth)


def _swept(scenario: Scenario, cell: cells.Cell, stops: Stops,
           distortion: sensors.Distortion | None, rng: np.random.Generator) -> Simulated:
    """Return the recording of a sweep."""
    assert scenario.sweep is not None
    sensor, unstamped = scenario.sensor, np.zeros((len(stops.labels), 2), dtype=np.int64)
    along = _path(scenario, stops.T_target_sensor)
    times = np.arange(0.5 / sensor.rate, _sweep_duration(scenario), 1 / sensor.rate)
    instants = _exposed(scenario, times)
    z, angle = _cast(scenario, along(instants.ravel()), rng)
    z, angle = (values.reshape(*instants.shape, -1).mean(axis=1) for values in (z, angle))
    stamped = times + sensor.delay + rng.normal(size=len(times)) * scenario.sweep.stamp_jitter
    profiles = _measured(scenario, z, angle, np.maximum.accumulate(stamped), distortion, rng)
    poses = _swept_poses(scenario, cell, along, rng)
    truth = cells.truth(scenario, cell, stops, unstamped, distortion)
    return Simulated(scenario, profiles, poses, replace(truth, time_offset=-sensor.delay))


def _path(scenario: Scenario, T_target_sensor: Array) -> Way:
    """Return the path through sensor poses (k, 4, 4), a knot each."""
    sweep = _sweep(scenario)
    knots = np.arange(len(T_target_sensor)) * sweep.knot
    position = CubicSpline(knots, T_target_sensor[:, :3, 3], bc_type='natural')
    rotation = RotationSpline(knots, Rotation.from_matrix(T_target_sensor[:, :3, :3].copy()))

    def poses(times: Array) -> Array:
        clipped = np.clip(times, knots[0], knots[-1])
        return se3.transform(rotation(clipped).as_matrix(), position(clipped))
    return poses


def _sweep_duration(scenario: Scenario) -> float:
    """Return the duration of a sweep (s)."""
    return (sum(scenario.stations) - 1) * _sweep(scenario).knot


def _flange(cell: cells.Cell, T_target_sensor: Array, calibration_type: str) -> Array:
    """Return the poses (n, 4, 4) of the flange at poses of the sensor in the target."""
    T = cell.T_world_target @ T_target_sensor @ se3.inverse(cell.T_mount_sensor)
    return se3.inverse(T) if calibration_type == 'eye_on_base' else T


def _swept_poses(scenario: Scenario, cell: cells.Cell, along: Way, rng: np.random.Generator
                 ) -> tuple[TimedPose, ...]:
    """Return the poses that the robot publishes along its path."""
    robot, sweep = scenario.robot, _sweep(scenario)
    times = np.arange(0.0, _sweep_duration(scenario), 1 / robot.rate)
    times = times[~_missing(times, sweep)]
    T, late = (_flange(cell, along(t), scenario.calibration_type)
               for t in (times, times - sweep.rotation_lag))
    T = se3.transform(late[:, :3, :3], T[:, :3, 3])
    T = cells.perturbed(T, cells.robot_error(robot, T, rng) + _drift(times, sweep, rng))
    stamped = np.maximum.accumulate(times + rng.normal(size=len(times)) * sweep.pose_jitter)
    if cell.arm:
        T = cells.perturbed(T, arm.reported_error(T, cell.arm))
    step = sweep.resolution
    position = np.round(T[:, :3, 3] / step) * step if step else T[:, :3, 3]
    return stamped_poses(stamps(stamped), position, se3.quaternion(T))


def _missing(times: Array, sweep: Sweep) -> NDArray[np.bool_]:
    """Return at which times (n,) poses are missing: in each of the gaps, evenly spaced."""
    begins = (np.arange(sweep.gaps) + 0.5) * (times[-1] / max(sweep.gaps, 1))
    return np.asarray(((times >= begins[:, None]) & (times < begins[:, None] + sweep.gap)
                       ).any(axis=0))


def _drift(times: Array, sweep: Sweep, rng: np.random.Generator) -> Array:
    """Return an error (n, 6) of the poses that varies smoothly over time."""
    knots = np.arange(0.0, times[-1] + 2 * sweep.drift_time, sweep.drift_time)
    values = rng.normal(size=(len(knots), 6)) * np.repeat(sweep.drift, 3) / np.sqrt(3)
    return np.asarray(CubicSpline(knots, values)(times)) if any(sweep.drift) else np.zeros(
        (len(times), 6))


def _exposed(scenario: Scenario, times: Array) -> Array:
    """Return the instants (n, k) that profiles at times (n,) average over."""
    exposure = _sweep(scenario).exposure
    offsets = np.linspace(-0.5, 0.5, INSTANTS) * exposure if exposure else np.zeros(1)
    return np.asarray(times[:, None] + offsets)


def _sweep(scenario: Scenario) -> Sweep:
    assert scenario.sweep is not None
    return scenario.sweep


def _poses(scenario: Scenario, cell: cells.Cell, line: Timeline,
           rng: np.random.Generator) -> tuple[TimedPose, ...]:
    robot = scenario.robot
    times = np.arange(0, line.duration, 1 / robot.rate)
    T = interpolated(cell.T_base_flange_reported, *line.progress(times))
    T = cells.perturbed(T, rng.normal(size=(len(T), 6)) * robot.jitter)
    translation, quaternion = T[:, :3, 3], se3.quaternion(T)
    for name in scenario.convention_errors:
        translation, quaternion = CONVENTION_ERRORS[name](translation, quaternion)
    return stamped_poses(stamps(times), translation, quaternion)


def _profiles(scenario: Scenario, cell: cells.Cell, line: Timeline,
              distortion: sensors.Distortion | None, rng: np.random.Generator
              ) -> tuple[Profile, ...]:
    sensor = scenario.sensor
    times = np.arange(0.5 / sensor.rate, line.duration, 1 / sensor.rate)
    times = times[_recorded(scenario, line, times)]
    z, angle = _exact(scenario, cell, line, times, rng)
    return _measured(scenario, z, angle, times + sensor.delay, distortion, rng)


def _measured(scenario: Scenario, z: Array, angle: Array, times: Array,
              distortion: sensors.Distortion | None, rng: np.random.Generator
              ) -> tuple[Profile, ...]:
    """Return profiles of exact ranges and incidences (m, n), stamped with times (m,)."""
    sensor, frame = scenario.sensor, FRAMES[scenario.layout.frame]
    ranges = sensors.measure(sensor, z, angle, rng, distortion)
    points = published(frame, sensors.plane_points(sensor, ranges, distortion))
    mark = scenario.layout.no_return
    return tuple(Profile(int(stamp), CHILD_FRAME, _marked(p, mark), frame.axes)
                 for stamp, p in zip(stamps(times), points, strict=True))


def _recorded(scenario: Scenario, line: Timeline, times: Array) -> Array:
    """Return which profiles are recorded: during motion only every nth."""
    _, fraction = line.progress(times)
    return np.asarray((fraction == 0) | (np.arange(len(times)) % scenario.sensor.thinning == 0))


def _exact(scenario: Scenario, cell: cells.Cell, line: Timeline,
           times: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """
    Return exact ranges and incidences (m, n) at the times; each stop is rendered once.

    The ranges include errors that are constant during a stop.
    """
    station, fraction = line.progress(times)
    pose = np.stack([station, fraction], axis=1)
    different, row = np.unique(pose, axis=0, return_inverse=True)
    T = interpolated(cell.T_base_flange, different[:, 0].astype(np.int64), different[:, 1])
    z, angle = _cast(scenario, cell.T_target_sensor(T, scenario.calibration_type), rng)
    row = row.reshape(-1)  # numpy 2.0 alone returns it as a column
    return z[row], angle[row]


def _cast(scenario: Scenario, T_target_sensor: Array, rng: np.random.Generator
          ) -> tuple[Array, Array]:
    """Return ranges and incidences (m, n) at poses of the sensor in the target (m, 4, 4)."""
    sensor, solids = scenario.sensor, SCENES[scenario.scene].solids(scenario)
    z, angle = sensors.render(sensor, solids, T_target_sensor, relief(scenario.target, rng))
    z = sensors.blurred(sensor, z, T_target_sensor)
    if sensor.speckle:
        z = z + sensors.speckle(sensor, z.shape, rng)
    return z, angle


def _marked(points: Array, no_return: str) -> Array:
    """Return points (n, 2) with missing returns in the form of the driver."""
    missing = np.isnan(points).any(axis=1)
    if no_return == 'omit':
        return points[~missing]
    points = points.copy()
    points[missing] = np.inf if no_return == 'inf' else np.nan
    return points


def simulate_samples(
        scenario: Scenario, rng: np.random.Generator) -> tuple[tuple[Sample, ...], Truth]:
    """
    Return the samples of a recording, and their truth.

    Each feature has exactly its stated noise (white sensor noise, averaged over the profiles of a
    stop), each pose the robot's error. Standard sensor frame; without convention errors.
    """
    scenario = replace(scenario, layout=replace(scenario.layout, frame='standard'))
    scene = SCENES[scenario.scene]
    stops = scene.stops(scenario, rng)
    stops = stops.ordered(cells.visit_order(scenario, len(stops.labels), rng))
    cell = cells.draw(scenario, stops, anywhere(scenario), rng)
    spacing = int((scenario.robot.dwell + scenario.robot.move) * 1e9)
    starts = np.arange(len(stops.labels)) * spacing
    spans = np.stack([starts, starts + int(scenario.robot.dwell * 1e9)], axis=1)
    truth = cells.truth(scenario, cell, stops, spans)
    features = scene.features(scenario, stops, rng)
    samples = tuple(Sample(s.start, s.T_base_flange_reported, f, scenario.profiles_per_stop)
                    for s, f in zip(truth.stations, features, strict=True))
    return samples, truth
