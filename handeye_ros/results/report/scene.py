"""The scene of the report: polylines and points in space, for a small script that turns them."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration
from handeye_ros.frames import sensor_axes
from handeye_ros.results.report.evidence import in_plane, StopSnapshot
from handeye_ros.results.target_shape import enlargement, half_axes, rings, shape
import numpy as np

FLANGE, SENSOR, LASER, UNUSED = '#555555', '#6a1b9a', '#e53935', '#bdbdbd'
TARGET, EDGES, BALL, SEEN = '#2e7d32', '#00695c', '#f9a825', '#e07b00'
AXIS = 0.03  # m, of a frame at a stop
ELLIPSOID = 0.02  # m, the half axis as it is drawn
MOST_POINTS = 60  # of a laser line


def scene(calibration: Calibration, stops: Sequence[StopSnapshot], config: Config
          ) -> dict[str, Any]:
    """Return what is drawn: parts with a name, a colour and points; and what the factor is."""
    T_mounts = [stop.T_mount for stop in stops if stop.used] or [np.eye(4)]
    T_sensors = [T @ calibration.T_flange_sensor for T in T_mounts]
    target, near = _target(calibration, stops, config)
    factor = enlargement(_largest(calibration), ELLIPSOID)
    parts = [
        *(part for T in T_mounts for part in _axes(T, AXIS, 'flange at each stop', [FLANGE] * 3)),
        *(_line('sensor at each stop', SENSOR, np.array([M[:3, 3], T[:3, 3]]))
          for M, T in zip(T_mounts, T_sensors, strict=True)),
        *_lasers(stops, calibration, config),
        *(_line('target', TARGET, line) for line in target.outline),
        *(_line('edges of the target', EDGES, line, 2.5) for line in target.edges),
        {'name': 'what the answer comes from', 'color': SEEN, 'width': 4.0,
         'points': _plain(near)},
        *(_line(f'1 sigma of the sensor position, enlarged {factor:g} times', BALL, ring)
          for ring in _ellipsoid(calibration, T_mounts[0], factor))]
    return {'parts': [part for part in parts if len(part.get('line') or part['points'])],
            'factor': factor, 'frame': _frame_name(config)}


def _frame_name(config: Config) -> str:
    in_hand = config.calibration_type == 'eye_in_hand'
    return config.base_frame if in_hand else config.robot_effector_frame


def _target(calibration: Calibration, stops: Sequence[StopSnapshot], config: Config
            ) -> tuple[Any, Array]:
    near = [se3.apply(stop.T_mount @ calibration.T_flange_sensor,
                      in_sensor(in_plane(stop.features), config)) for stop in stops if stop.used]
    points = np.concatenate(near) if near else np.empty((0, 3))
    return shape(calibration.target, config.target.size, points), points


def in_sensor(plane: Array, config: Config) -> Array:
    """Return points (n, 2) of the sensor plane as (n, 3) of the sensor frame."""
    return np.asarray(plane @ sensor_axes(config)[:3, [0, 2]].T)


def _largest(calibration: Calibration) -> float:
    return float(np.linalg.norm(half_axes(calibration.covariance[:3, :3]), axis=0).max())


def _ellipsoid(calibration: Calibration, T_mount: Array, factor: float) -> list[Array]:
    axes = T_mount[:3, :3] @ half_axes(calibration.covariance[:3, :3]) * factor
    centre = (T_mount @ calibration.T_flange_sensor)[:3, 3]
    return [centre + ring for ring in rings(axes)]


def _lasers(stops: Sequence[StopSnapshot], calibration: Calibration, config: Config
            ) -> list[dict[str, Any]]:
    parts = []
    for stop in stops:
        plane = stop.points[np.isfinite(stop.points).all(axis=1)]
        plane = plane[::max(1, len(plane) // MOST_POINTS)]
        points = se3.apply(stop.T_mount @ calibration.T_flange_sensor, in_sensor(plane, config))
        parts.append({'name': 'laser line' if stop.used else 'laser line, not used',
                      'color': LASER if stop.used else UNUSED, 'width': 2.0,
                      'points': _plain(points)})
    return parts


def _axes(T: Array, length: float, name: str, colors: Sequence[str]) -> list[dict[str, Any]]:
    return [_line(name, color, np.array([T[:3, 3], T[:3, 3] + length * T[:3, i]]))
            for i, color in enumerate(colors)]


def _line(name: str, color: str, points: Array, width: float = 1.2) -> dict[str, Any]:
    return {'name': name, 'color': color, 'line': _plain(points), 'width': width}


def _plain(points: Array) -> list[list[float]]:
    return [[round(float(v), 6) for v in point] for point in points]


def legend(parts: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return the names of parts of one colour, each once, with it."""
    colors: dict[str, set[str]] = {}
    for part in parts:
        colors.setdefault(part['name'], set()).add(part['color'])
    return [(name, min(found)) for name, found in colors.items() if len(found) == 1]
