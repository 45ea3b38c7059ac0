# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From a scenario to its recording: the cell is drawn, then its profiles and poses, with the truth.

`simulate` renders profiles, of stops or of a sweep; `simulate_samples` makes the features of the
stops directly.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, Profile, Sample, TimedPose
from handeye_ros.simulate import robot as robots
from handeye_ros.simulate import sensor as sensors
from handeye_ros.simulate.scenario import Scenario, SphereTarget, Sweep
from handeye_ros.simulate.scenes import many_placements, Placements, SCENES
from handeye_ros.simulate.sensor import FRAMES
from handeye_ros.simulate.solids import relief, table_top
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

START_STAMP = 1_700_000_000_000_000_000  # ns
EXPOSURE_INSTANTS = 5  # rendered per exposure
GAP = 0.3  # s: duration of a gap in the poses of a sweep
DRIFT_TIME = 1.0  # s between the knots of their drift


@dataclass(frozen=True, eq=False)
class TrueStop:
    """
    A stop of the robot with its true values.

    start, end: stamps of the stop (0, 0 of a sweep)
    label: the edge that the line crosses (p, q, p_far, q_far), or sphere, plane or wedge
    point: (2,) true point of the edge or plane, or centre of the arc, along the line and range in
        the standard sensor frame
    T_base_flange, T_base_flange_reported: (4, 4)
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
    The true values of a calibration; (4, 4) transforms. The sensor frame is the published one.

    T_flange_sensor: with errors of joints and links (geometry), and with a distortion or scale of
        the sensor, the best-fit transform over the volume of the stops and the field of view; with
        other errors as mounted; with eye_on_base the sensor's pose in the base
    T_base_target: with eye_on_base the target's pose in the flange
    time_offset: of a sweep, to be added to the stamps of the profiles (s)
    T_corrected_sensor: the pose of a sensor on an arm with errors in the flange of the corrected
        arm, which is not the flange of the reported poses
    """

    T_flange_sensor: Array
    T_base_target: Array
    stops: tuple[TrueStop, ...]
    time_offset: float | None = None
    T_corrected_sensor: Array | None = None


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated recording with its truth; profiles and poses in the order of their stamps."""

    scenario: Scenario
    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]
    truth: Truth

    @property
    def tables(self) -> dict[str, str]:
        """Return the texts of the files beside the bag, by name: the URDF of an arm."""
        return {'robot.urdf': robots.URDF} if self.scenario.robot.geometry else {}

    @property
    def joints(self) -> list[tuple[int, Array]]:
        """Return stamps and joint values of the arm at the poses, empty without an arm."""
        if not self.scenario.robot.geometry:
            return []
        T = np.array([se3.of_pose(pose) for pose in self.poses])
        values = np.unwrap(robots.inverse(T), axis=0)
        return [(pose.stamp, row) for pose, row in zip(self.poses, values, strict=True)]

    @property
    def true_values(self) -> dict[str, Any]:
        """Return the content of truth.yaml by key."""
        sensor, robot, truth = self.scenario.sensor, self.scenario.robot, self.truth
        true_values = {key: getattr(truth, key) for key in (
            'T_flange_sensor', 'T_base_target', 'time_offset', 'T_corrected_sensor')}
        return {key: se3.transform_values(value) if np.ndim(value) else value
                for key, value in true_values.items() if value is not None} | {
            'noise': {'sensor': sensor.noise, 'robot_translation': robot.repeatability[0],
                      'robot_rotation': robot.repeatability[1]},
            'parameters': asdict(self.scenario)}


def settings(scenario: Scenario) -> dict[str, Any]:
    """Return the configuration by dotted key for the recordings of a scenario."""
    frame, target = FRAMES[scenario.frame], scenario.target
    values: dict[str, Any] = {
        'calibration_type': scenario.calibration_type, 'target.type': scenario.scene,
        'profile.axes': list(frame.axes), 'profile.range_sign': frame.range_sign,
        'noise.sensor': scenario.sensor.noise,
        'noise.robot_translation': scenario.robot.repeatability[0],
        'noise.robot_rotation': scenario.robot.repeatability[1]}
    if isinstance(target, SphereTarget):
        values['target.radius'] = target.radius
    return values | dict(scenario.stated)


# -- the cell


@dataclass(frozen=True, eq=False)
class Cell:
    """
    The fixed poses of a cell, and the robot's at n stops; the sensor frame is the standard one.

    placements: the sensor's poses in the target
    T_mount_sensor: the sensor in the flange (eye_in_hand) or in the base (eye_on_base)
    T_fixed_target: the target in the base (eye_in_hand) or in the flange (eye_on_base)
    T_base_flange, T_base_flange_reported: (n, 4, 4), true and with the robot's errors
    T_mount_best: T_mount_sensor; with errors of joints and links as it fits the poses best
    arm_errors, distortion: those of arm and sensor, if there are any
    """

    scenario: Scenario
    placements: Placements
    T_mount_sensor: Array
    T_fixed_target: Array
    T_base_flange: Array
    T_base_flange_reported: Array
    T_mount_best: Array
    arm_errors: robots.ArmErrors | None = None
    distortion: sensors.Distortion | None = None

    def T_target_sensor(self, T_base_flange: Array) -> Array:
        """Return the sensor's poses (n, 4, 4) in the target at flange poses (n, 4, 4)."""
        on_base = self.scenario.calibration_type == 'eye_on_base'
        T = se3.inverse(T_base_flange) if on_base else T_base_flange
        return np.asarray(se3.inverse(self.T_fixed_target) @ T @ self.T_mount_sensor)

    def truth(self, spans: NDArray[np.int64]) -> Truth:
        """Return the true values; spans (n, 2): stamps of the stops."""
        T_true_sensor = FRAMES[self.scenario.frame].T_standard_sensor
        if self.distortion:
            T_true_sensor = self.distortion.T_true_reported @ T_true_sensor
        corrected = None
        if self.arm_errors and self.scenario.calibration_type == 'eye_in_hand':
            corrected = self.arm_errors.flange @ self.T_mount_sensor @ T_true_sensor
        stops = tuple(TrueStop(*span, *of_stop) for span, *of_stop in zip(
            spans.tolist(), self.placements.labels, self.placements.points, self.T_base_flange,
            self.T_base_flange_reported, strict=True))
        return Truth(self.T_mount_best @ T_true_sensor, self.T_fixed_target, stops,
                     T_corrected_sensor=corrected)


def draw(scenario: Scenario, rng: Generator) -> Cell:
    """Draw a cell in which the sensor reaches the stops of its scene, and the robot's errors."""
    placed = SCENES[scenario.scene].placements(scenario, rng)
    number = len(placed.labels)
    programme = rng.permutation(number) if scenario.shuffled else np.arange(number)
    return cell_of(scenario, placed.ordered(np.tile(programme, scenario.repeats)), rng)


def cell_of(scenario: Scenario, placed: Placements, rng: Generator) -> Cell:
    """Draw a cell in which the sensor reaches the given stops, and the robot's errors."""
    in_flange, in_base = _draw_in_flange(scenario, rng), _draw_in_base(rng)
    X, Z = ((in_base, in_flange) if scenario.calibration_type == 'eye_on_base' else
            (in_flange, in_base))
    T = flange_poses(scenario, placed.T_target_sensor, X, Z)
    reported = se3.perturb(T, robots.pose_error(scenario.robot, T, rng))
    best, errors = X, None
    if scenario.robot.geometry:
        errors = robots.draw_arm(scenario.robot.geometry, rng)
        reported = se3.perturb(reported, robots.arm_pose_error(T, errors))
        many_poses = flange_poses(scenario, many_placements(scenario).T_target_sensor, X, Z)
        best = _best_mount(many_poses, robots.arm_pose_error(many_poses, errors), X, scenario)
    reported[:, :3, 3] *= 1 + scenario.robot.scale
    reported = robots.bumped(reported, scenario.bumped, rng)
    return Cell(scenario, placed, X, Z, T, reported, best, errors)


def flange_poses(scenario: Scenario, T_target_sensor: Array, T_mount_sensor: Array,
                 T_fixed_target: Array) -> Array:
    """Return T_base_flange (n, 4, 4) at poses of the sensor in the target."""
    if scenario.calibration_type == 'eye_on_base':
        return np.asarray(T_mount_sensor @ se3.inverse(T_target_sensor)
                          @ se3.inverse(T_fixed_target))
    return np.asarray(T_fixed_target @ T_target_sensor @ se3.inverse(T_mount_sensor))


def _draw_in_flange(scenario: Scenario, rng: Generator) -> Array:
    """Draw the pose in the flange (4, 4) of what is mounted there."""
    translation = se3.unit(rng.normal(size=3)) * rng.uniform(*scenario.lever)
    if scenario.robot.geometry:  # an arm whose flange must look down
        turn = Rotation.from_euler('ZY', rng.uniform([-np.pi, -0.4], [np.pi, 0.4]))
    else:
        turn = Rotation.from_quat(rng.normal(size=4))
    return se3.transform(turn.as_matrix(), translation)


def _draw_in_base(rng: Generator) -> Array:
    """Draw the pose in the base (4, 4) of what stands in front of the robot."""
    translation = rng.uniform([0.5, -0.3, 0.0], [0.9, 0.3, 0.4])
    angles = rng.uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi])
    return se3.transform(Rotation.from_euler('xyz', angles).as_matrix(), translation)


def _best_mount(T: Array, error: Array, X: Array, scenario: Scenario) -> Array:
    """
    Return the best-fit mount (4, 4) for poses T (n, 4, 4) reported with errors (n, 6).

    It minimises the errors of points mapped from the field of view, up to a common motion of all
    points, which the pose of the target absorbs.
    """
    (near, far), w = scenario.sensor.range, scenario.sensor.half_width
    field = np.array([[x * z, 0.0, z] for z in (near, far) for x in (-w, 0.0, w)])
    lever = field @ X[:3, :3].T
    points = se3.apply(T, lever + X[:3, 3])
    shift = error[:, None, :3] + np.cross(error[:, None, 3:], points - T[:, None, :3, 3])
    wrt_mount = np.einsum('nij,kjl->nkil', T[:, :3, :3], se3.perturbation_jacobian(lever))
    A = np.concatenate([wrt_mount, -se3.perturbation_jacobian(points)], axis=3).reshape(-1, 12)
    step = np.linalg.lstsq(A, -shift.reshape(-1), rcond=1e-9)[0]
    return se3.perturb(X, step[:6])


# -- streams


def stamps(times: Array) -> NDArray[np.int64]:
    """Return the stamps (n,) (ns) of times (n,) (s) since the start."""
    return START_STAMP + np.round(times * 1e9).astype(np.int64)


def timed_poses(times: Array, position: Array, quaternion: Array) -> tuple[TimedPose, ...]:
    """Return the streamed poses of positions (n, 3) and quaternions (n, 4)."""
    return tuple(TimedPose(int(stamp), t, q) for stamp, t, q in zip(
        stamps(times), position, quaternion, strict=True))


def timed_profiles(times: Array, points: Iterable[Array], axes: tuple[str, str] = ('x', 'z')
                   ) -> tuple[Profile, ...]:
    """Return the streamed profiles of points, (columns, 2) for each of the times (n,)."""
    return tuple(Profile(int(stamp), 'laser', p, axes)
                 for stamp, p in zip(stamps(times), points, strict=True))


def simulate(scenario: Scenario, rng: Generator) -> Simulated:
    """Return a recording of a robot that moves from stop to stop, or sweeps past them."""
    cell = replace(draw(scenario, rng), distortion=sensors.draw_distortion(scenario.sensor, rng))
    return _sweeping(cell, scenario.sweep, rng) if scenario.sweep else _stopping(cell, rng)


def _stopping(cell: Cell, rng: Generator) -> Simulated:
    """Return the recording of a robot that stops for dwell, and moves on for move seconds."""
    sensor, robot, count = cell.scenario.sensor, cell.scenario.robot, len(cell.placements.labels)
    period, arrivals = robot.dwell + robot.move, np.arange(count) * (robot.dwell + robot.move)
    duration = count * robot.dwell + (count - 1) * robot.move

    def progress(times: Array) -> tuple[NDArray[np.int64], Array]:
        """Return the last stop (k,), and the fraction (k,) of the path to the next."""
        stop = np.minimum((times / period).astype(np.int64), count - 1)
        s = np.clip((times - stop * period - robot.dwell) / robot.move, 0.0, 1.0)
        s = np.where(stop == count - 1, 0.0, s)
        return stop, s**3 * (10 - 15 * s + 6 * s**2)  # smooth at start and end

    times = np.arange(0.5 / sensor.rate, duration, 1 / sensor.rate)
    still = progress(times)[1] == 0
    times = times[still | (np.arange(len(times)) % sensor.thinning == 0)]
    # each stop is rendered once: the errors of the exact ranges are constant during a stop
    places, row = np.unique(np.stack(progress(times), axis=1), axis=0, return_inverse=True)
    row = row.reshape(-1)  # numpy 2.0 alone returns it as a column
    T = _between(cell.T_base_flange, places[:, 0].astype(np.int64), np.asarray(places[:, 1]))
    z, angle = _exact_ranges(cell, cell.T_target_sensor(T), rng)
    profiles = _profiles(cell, z[row], angle[row], times + sensor.delay, rng)

    times = np.arange(0, duration, 1 / robot.rate)
    T = _between(cell.T_base_flange_reported, *progress(times))
    T = se3.perturb(T, rng.normal(size=(len(T), 6)) * robot.jitter)
    translation, quaternion = T[:, :3, 3], se3.quaternion(T)
    for name in cell.scenario.wrong_conventions:
        translation, quaternion = robots.WRONG_CONVENTIONS[name](translation, quaternion)
    spans = stamps(np.stack([arrivals, arrivals + robot.dwell], axis=1))
    return Simulated(cell.scenario, profiles, timed_poses(times, translation, quaternion),
                     cell.truth(spans))


def _between(T: Array, stop: NDArray[np.int64], fraction: Array) -> Array:
    """Return poses (k, 4, 4) at a fraction of the path from a stop (of n) to the next."""
    start, end = T[stop], T[np.minimum(stop + 1, len(T) - 1)]
    R = start[:, :3, :3]
    turn = se3.log_rotation(np.swapaxes(R, 1, 2) @ end[:, :3, :3])
    t = start[:, :3, 3] + fraction[:, None] * (end[:, :3, 3] - start[:, :3, 3])
    return se3.transform(R @ se3.exp_rotation(fraction[:, None] * turn), t)


def _sweeping(cell: Cell, sweep: Sweep, rng: Generator) -> Simulated:
    """Return the recording of a robot on a smooth path through all stops."""
    scenario, T_target_sensor = cell.scenario, cell.placements.T_target_sensor
    sensor, knots = scenario.sensor, np.arange(len(T_target_sensor)) * sweep.knot
    position = CubicSpline(knots, T_target_sensor[:, :3, 3], bc_type='natural')
    rotation = RotationSpline(knots, Rotation.from_matrix(T_target_sensor[:, :3, :3].copy()))

    def path(times: Array) -> Array:
        """Return T_target_sensor (n, 4, 4) at times (n,)."""
        times = np.clip(times, knots[0], knots[-1])
        return se3.transform(rotation(times).as_matrix(), position(times))

    times = np.arange(0.5 / sensor.rate, knots[-1], 1 / sensor.rate)
    instants = times[:, None] + (np.linspace(-0.5, 0.5, EXPOSURE_INSTANTS) * sweep.exposure
                                 if sweep.exposure else np.zeros(1))
    z, angle = (values.reshape(*instants.shape, -1).mean(axis=1)
                for values in _exact_ranges(cell, path(instants.ravel()), rng))
    stamped = times + sensor.delay + rng.normal(size=len(times)) * sweep.stamp_jitter
    profiles = _profiles(cell, z, angle, np.maximum.accumulate(stamped), rng)

    times = np.arange(0.0, knots[-1], 1 / scenario.robot.rate)
    begins = (np.arange(sweep.gaps) + 0.5) * (times[-1] / max(sweep.gaps, 1))
    missing = (times >= begins[:, None]) & (times < begins[:, None] + GAP)
    times = times[~missing.any(axis=0)]
    T, T_lagging = (flange_poses(scenario, path(t), cell.T_mount_sensor, cell.T_fixed_target)
                    for t in (times, times - sweep.rotation_lag))
    T = se3.transform(T_lagging[:, :3, :3], T[:, :3, 3])
    error = robots.pose_error(scenario.robot, T, rng)
    drift_times = np.arange(0.0, times[-1] + 2 * DRIFT_TIME, DRIFT_TIME)
    drift = rng.normal(size=(len(drift_times), 6)) * np.repeat(sweep.drift, 3) / np.sqrt(3)
    T = se3.perturb(T, error + CubicSpline(drift_times, drift)(times))
    stamped = np.maximum.accumulate(times + rng.normal(size=len(times)) * sweep.pose_jitter)
    if cell.arm_errors:
        T = se3.perturb(T, robots.arm_pose_error(T, cell.arm_errors))
    step = sweep.resolution
    poses = timed_poses(stamped, np.round(T[:, :3, 3] / step) * step if step else T[:, :3, 3],
                        se3.quaternion(T))
    truth = cell.truth(np.zeros((len(knots), 2), dtype=np.int64))
    return Simulated(scenario, profiles, poses, replace(truth, time_offset=-sensor.delay))


def _exact_ranges(cell: Cell, T_target_sensor: Array, rng: Generator) -> tuple[Array, Array]:
    """
    Return ranges and angles of incidence (m, n) of n columns at poses (m, 4, 4) (m, rad).

    With the errors that are the same for all profiles of a stop.
    """
    scenario, sensor = cell.scenario, cell.scenario.sensor
    solids = (table_top(getattr(scenario.target, 'table', None)) if scenario.empty else
              SCENES[scenario.scene].solids(scenario))
    z, angle = sensors.render(sensor, solids, T_target_sensor, relief(scenario.target, rng))
    if sensor.spot:
        z = sensors.blurred(sensor, z, T_target_sensor)
    if sensor.speckle:
        z = z + sensors.speckle(sensor, z.shape, rng)
    return z, angle


def _profiles(cell: Cell, z: Array, angle: Array, times: Array, rng: Generator
              ) -> tuple[Profile, ...]:
    """Return the profiles measured of ranges and angles of incidence (m, n); times: (m,) (s)."""
    sensor, frame = cell.scenario.sensor, FRAMES[cell.scenario.frame]
    mark = cell.scenario.no_return
    ranges = sensors.measure(sensor, z, angle, rng, cell.distortion)
    points = frame.published(sensors.plane_points(sensor, ranges, cell.distortion))
    missing = np.asarray(np.isnan(points).any(axis=2))
    points[missing] = np.inf if mark == 'inf' else np.nan
    return timed_profiles(times, (p[~gone] if mark == 'omit' else p for p, gone in zip(
        points, missing, strict=True)), frame.axes)


def simulate_samples(scenario: Scenario, rng: Generator) -> tuple[tuple[Sample, ...], Truth]:
    """
    Return the samples of a recording, and their truth.

    Each feature has exactly its stated noise, each pose the robot's error. Of the sensor's errors
    there is the white noise alone, averaged over the profiles of a stop, of the target none but
    its edge_angle; a sweep gives its stops. Standard sensor frame; without wrong conventions. For
    all other faults use `simulate`.
    """
    scenario = replace(scenario, frame='standard')
    cell, dwell = draw(scenario, rng), scenario.robot.dwell
    starts = np.arange(len(cell.placements.labels)) * int((dwell + scenario.robot.move) * 1e9)
    truth = cell.truth(np.stack([starts, starts + int(dwell * 1e9)], axis=1))
    features = SCENES[scenario.scene].features(scenario, cell.placements, rng)
    samples = tuple(Sample(s.start, s.T_base_flange_reported, f, scenario.profiles_per_stop)
                    for s, f in zip(truth.stops, features, strict=True))
    return samples, truth
