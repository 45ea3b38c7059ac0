"""Files of measured values, as instruments other than a profiler at its stops write them."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.simulate import tracker
from handeye_ros.simulate.scenario import SensorModel
import numpy as np
from scipy.spatial.transform import Rotation

QUATERNION = ('qx', 'qy', 'qz', 'qw')
SMALL = replace(tracker.SENSOR, columns=320, resolution=2.0**-20)  # compresses well


@dataclass(frozen=True, eq=False)
class Measured:
    """
    Files, and what is true of them.

    tables: their texts by name; T_flange_sensor: (4, 4), of the camera in the base where it
    stands there; noise: 1 sigma each, in SI units; settings: the configuration, by dotted key,
    that reads them; profiles, poses: of the bag beside the tables, if there is one.
    """

    tables: Mapping[str, str]
    T_flange_sensor: Array
    noise: Mapping[str, float]
    settings: Mapping[str, Any]
    profiles: tuple[Profile, ...] = field(default=())
    poses: tuple[TimedPose, ...] = field(default=())


def points(rng: np.random.Generator, noise: float = 3e-5, count: int = 10) -> Measured:
    """Return the tip of a tool at some places, seen from beside the robot, half a metre away."""
    R = Rotation.random(random_state=rng).as_matrix()
    middle, reach = np.array([0.6, 0.1, 0.3]), np.array([0.0, 0.0, 0.5])
    X = se3.transform(R, middle - R @ reach)
    base = rng.uniform(-0.15, 0.15, (count, 3)) + middle
    camera = se3.apply(se3.inverse(X), base) + noise * rng.normal(size=base.shape)
    header = [f'{frame}_{axis} [mm]' for frame in ('camera', 'base') for axis in 'xyz']
    text = csv_text(header, 1e3 * np.hstack([camera, base]))
    return Measured({'points.csv': text}, X, {'point': noise},
                    {'target.type': 'points', 'calibration_type': 'eye_on_base'})


def hand_eye(rng: np.random.Generator, eye_on_base: bool = False, noise: float = 1.0,
             count: int = 12, tilts: Sequence[float] = (30.0, 30.0, 60.0)) -> Measured:
    """
    Return poses of the robot, and of a target that a camera sees.

    noise: a factor; tilts: the largest about each axis of the camera (degrees).
    """
    near, far = (Rotation.random(random_state=rng).as_matrix() for _ in range(2))
    T_near = se3.transform(near, rng.normal(scale=0.1, size=3))
    T_far = se3.transform(far, np.array([0.7, 0.1, 0.2]))
    X, Z = (T_far, T_near) if eye_on_base else (T_near, T_far)
    views = _views(rng, count, tilts)
    T_fixed_mount = Z @ se3.inverse(views) @ se3.inverse(X)
    poses = se3.inverse(T_fixed_mount) if eye_on_base else T_fixed_mount
    robot, target = (3e-5 * noise, 1e-4 * noise), (1e-4 * noise, 1e-3 * noise)
    both = [_columns(_disturbed(T, sigma, rng))
            for T, sigma in ((poses, robot), (views, target))]
    header = [f'{name}_{column}' for name in ('flange', 'target')
              for column in ('x [mm]', 'y [mm]', 'z [mm]', *QUATERNION)]
    names = ('robot_translation', 'robot_rotation', 'target_translation', 'target_rotation')
    return Measured({'poses.csv': csv_text(header, np.hstack(both))}, X,
                    dict(zip(names, (*robot, *target), strict=True)),
                    {'target.type': 'hand_eye', 'calibration_type': (
                        'eye_on_base' if eye_on_base else 'eye_in_hand')})


def _views(rng: np.random.Generator, count: int, tilts: Sequence[float]) -> Array:
    """Return poses (n, 4, 4) of a target that faces the camera, but for tilts (degrees)."""
    turns = Rotation.from_euler('xyz', rng.uniform(-1, 1, (count, 3)) * tilts, degrees=True)
    return se3.transform(turns.as_matrix() @ np.diag([1.0, -1.0, -1.0]),
                         rng.uniform([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3], (count, 3)))


def _columns(T: Array) -> Array:
    return np.hstack([1e3 * T[:, :3, 3], se3.quaternion(T)])


def _disturbed(T: Array, sigma: tuple[float, float], rng: np.random.Generator) -> Array:
    """Return poses (n, 4, 4) with noise, 1 sigma of each axis (m, rad)."""
    shift, turn = rng.normal(size=(2, len(T), 3)) * np.array(sigma)[:, None, None]
    return se3.transform(se3.exp_rotation(turn) @ T[:, :3, :3], T[:, :3, 3] + shift)


def laser_tracker(rng: np.random.Generator, sensor: SensorModel = tracker.SENSOR,
                  noise: float = tracker.TRACKER_NOISE, reported: float = tracker.REPORTED
                  ) -> Measured:
    """Return a bag of the sweep over ball and block, and the reflector's points beside it."""
    cell = tracker.simulate_tracker(rng, sensor, noise, reported)
    rows = [[kind, *_numbers(point)] for kind, points in cell.reflector.items()
            for point in 1e3 * points]
    text = '\n'.join(map(', '.join, [['kind', 'x [mm]', 'y [mm]', 'z [mm]'], *rows])) + '\n'
    settings = {'target.type': 'tracker', 'target.radius': tracker.RADIUS, 'tracker.h0': cell.h0,
                'tracker.h1': cell.h1, 'tracker.first_reading': cell.q3_first,
                'tracker.noise': max(noise, 1e-9), 'noise.sensor': max(sensor.noise, 1e-9)}
    return Measured({'tracker.csv': text}, cell.T_flange_sensor,
                    {'tracker': noise, 'sensor': sensor.noise, 'readings': reported}, settings,
                    cell.profiles, cell.poses)


def csv_text(header: Iterable[str], values: Array) -> str:
    """Return a table of numbers as CSV."""
    lines = [', '.join(header), *(', '.join(_numbers(row)) for row in values)]
    return '\n'.join(lines) + '\n'


def _numbers(row: Iterable[float]) -> list[str]:
    return [f'{value:.9f}' for value in row]


FILE_SCENES: dict[str, Callable[[np.random.Generator], Measured]] = {
    'points': points,
    'hand_eye': hand_eye,
    'hand_eye_on_base': partial(hand_eye, eye_on_base=True),
    'tracker': laser_tracker,
    'small_tracker': partial(laser_tracker, sensor=SMALL),
}
"""What can be simulated for the targets that are solved from files, by name."""
