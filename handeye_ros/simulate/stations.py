# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The published sensor frame, and the stops of the robot: poses, stamps, motions between."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate.scenario import Scenario, SphereTarget
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

START = 1_700_000_000_000_000_000
STAMP = np.int64


@dataclass(frozen=True)
class Motion:
    """
    The variation of orientations between stations.

    shared: both edges are crossed with one nominal orientation, at 45 degrees to each. axes: which
    tilts (about the sensor's x, y, z) vary; the others are drawn once, or are zero when level.
    per_edge: drawn once for each edge.
    """

    shared: bool = False
    axes: tuple[bool, bool, bool] = (True, True, True)
    level: bool = False
    per_edge: bool = False


MOTIONS = {
    'general': Motion(),
    'one_orientation': Motion(shared=True, axes=(False, False, False)),
    'one_orientation_per_edge': Motion(axes=(False, False, False), per_edge=True),
    'tilt_only': Motion(shared=True, axes=(True, False, False), level=True),
    'yaw_only': Motion(axes=(False, False, True), level=True),
}


@dataclass(frozen=True, eq=False)
class Stops:
    """
    Poses of the sensor at n stations.

    T_target_sensor: (n, 4, 4), standard sensor frame; labels: n; points: (n, 2) true edge point
    or centre of the arc in the sensor plane.
    """

    T_target_sensor: Array
    labels: tuple[str, ...]
    points: Array

    def ordered(self, order: NDArray[np.int64]) -> Stops:
        """Return the same stops in another order."""
        labels = tuple(self.labels[k] for k in order)
        return Stops(self.T_target_sensor[order], labels, self.points[order])


def strata(rng: np.random.Generator, n: int, low: Array, high: Array) -> Array:
    """Return (n, k) stratified values from low to high (k,), each column shuffled."""
    order = rng.permuted(np.tile(np.arange(n), (len(low), 1)), axis=1).T
    return np.asarray(low + (order + rng.random(order.shape)) / n * (high - low))


def tilts(scenario: Scenario, rng: np.random.Generator, counts: tuple[int, ...]) -> Array:
    """Return (n, 3, 3) rotations of the sensor about its own axes, group by group."""
    motion = MOTIONS[scenario.motion]
    limit = np.full(3, scenario.tilt)
    constant = rng.uniform(-limit, limit, (len(counts), 3)) * (not motion.level)
    if not motion.per_edge:
        constant[:] = constant[0]
    groups = [np.where(motion.axes, strata(rng, n, -limit, limit), constant[k])
              for k, n in enumerate(counts)]
    angles = np.concatenate(groups)
    return np.asarray(Rotation.from_euler('xyz', angles).as_matrix())


def fan(points: Array) -> Array:
    """Return the tangent of the fan's angle of points (..., 2)."""
    return np.asarray(points[..., 0] / points[..., 1])


def lift(points: Array) -> Array:
    """Return points (..., 2) of the standard sensor plane as 3D points."""
    return np.stack([points[..., 0], np.zeros(points.shape[:-1]), points[..., 1]], axis=-1)


@dataclass(frozen=True)
class Timeline:
    """A stop of duration dwell at each of n stations, and a motion between each two; seconds."""

    stations: int
    dwell: float
    move: float

    @property
    def duration(self) -> float:
        """Return the time from arrival at the first to departure from the last station."""
        return self.stations * self.dwell + (self.stations - 1) * self.move

    def spans(self) -> NDArray[STAMP]:
        """Return the (n, 2) stamps of the stops."""
        starts = np.arange(self.stations) * (self.dwell + self.move)
        return stamps(np.stack([starts, starts + self.dwell], axis=1))

    def progress(self, times: Array) -> tuple[NDArray[STAMP], Array]:
        """Return the last station (k,), and the fraction (k,) of the path to the next."""
        period = self.dwell + self.move
        station = np.minimum((times / period).astype(np.int64), self.stations - 1)
        s = np.clip((times - station * period - self.dwell) / self.move, 0.0, 1.0)
        s = np.where(station == self.stations - 1, 0.0, s)
        return station, s**3 * (10 - 15 * s + 6 * s**2)  # smooth at start and end


def stamps(times: Array) -> NDArray[STAMP]:
    """Return integer nanoseconds of seconds since the start."""
    return START + np.round(times * 1e9).astype(np.int64)


def stamped_poses(stamps: NDArray[STAMP], position: Array, quaternion: Array
                  ) -> tuple[TimedPose, ...]:
    """Return the streamed poses of positions (n, 3) and quaternions (n, 4)."""
    return tuple(TimedPose(int(stamp), t, q) for stamp, t, q in zip(
        stamps, position, quaternion, strict=True))


def stamped_profiles(stamps: NDArray[STAMP], points: Array) -> tuple[Profile, ...]:
    """Return the streamed profiles of points (n, columns, 2)."""
    return tuple(Profile(int(stamp), 'laser', p) for stamp, p in zip(stamps, points, strict=True))


def interpolated(T: Array, station: NDArray[STAMP], fraction: Array) -> Array:
    """Return poses (k, 4, 4) at a fraction of the path from a station (of n) to the next."""
    start, end = T[station], T[np.minimum(station + 1, len(T) - 1)]
    R = start[:, :3, :3]
    turn = se3.log_rotation(np.swapaxes(R, 1, 2) @ end[:, :3, :3])
    t = start[:, :3, 3] + fraction[:, None] * (end[:, :3, 3] - start[:, :3, 3])
    return se3.transform(R @ se3.exp_rotation(fraction[:, None] * turn), t)


@dataclass(frozen=True, eq=False)
class Frame:
    """
    A published frame.

    T_standard_sensor: (4, 4) pose of the published frame in the standard one (x along the laser
    line, z the range, y = 0). axes: of the published frame, along the line and range. range_sign:
    -1 if the published range decreases with the distance.
    """

    T_standard_sensor: Array
    axes: tuple[str, str] = ('x', 'z')
    range_sign: int = 1


def _rotation(*columns: tuple[float, float, float], x: float = 0.0, z: float = 0.0) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(columns).T, [x, 0.0, z]
    return T


FRAMES = {
    'standard': Frame(np.eye(4)),
    'z_up': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), z=0.2), range_sign=-1),
    # zero in the middle of the range, which is counted upwards, and at the left of a wide field
    'off_centre': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), x=-0.07, z=0.275),
                        range_sign=-1),
    'x_reversed': Frame(_rotation((-1, 0, 0), (0, -1, 0), (0, 0, 1))),
    'y_along_line': Frame(_rotation((0, -1, 0), (1, 0, 0), (0, 0, 1)), axes=('y', 'z')),
}


def published(frame: Frame, points: Array) -> Array:
    """Return points (..., 2) of the standard sensor plane along the axes of the published one."""
    R, t = frame.T_standard_sensor[:3, :3], frame.T_standard_sensor[:3, 3]
    in_frame = (lift(points) - t) @ R
    return np.asarray(in_frame[..., ['xyz'.index(axis) for axis in frame.axes]])


def settings(scenario: Scenario) -> dict[str, Any]:
    """Return the configuration by dotted key for the recordings of a scenario."""
    frame, target = FRAMES[scenario.layout.frame], scenario.target
    values: dict[str, Any] = {
        'calibration_type': scenario.calibration_type, 'target.type': scenario.scene,
        'profile.axes': list(frame.axes), 'profile.range_sign': frame.range_sign,
        'noise.sensor': scenario.sensor.noise,
        'noise.robot_translation': scenario.robot.repeatability[0],
        'noise.robot_rotation': scenario.robot.repeatability[1]}
    if isinstance(target, SphereTarget):
        values['target.radius'] = target.radius
    return values | dict(scenario.stated)
