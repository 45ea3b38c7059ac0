# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Drawings: the scene of the report, the shape of a target, a profile.

The scene is polylines and points, which a small script turns; every target is lines and balls.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from handeye_ros import se3
from handeye_ros.arithmetic import even_indices
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Feature, has_return, StopSnapshot
from handeye_ros.frames import mount_frame, T_sensor_plane, target_frame
import numpy as np

FLANGE_COLOUR, SENSOR_COLOUR = '#555555', '#6a1b9a'
LASER_COLOUR, UNUSED_COLOUR = '#e53935', '#bdbdbd'
TARGET_COLOUR, EDGE_COLOUR, SEEN_COLOUR = '#2e7d32', '#00695c', '#e07b00'
AXIS_LENGTH = 0.03  # m, of a frame at a stop
MAX_POINTS = 60  # of a laser line in the scene
MAX_OF_PROFILE = 400  # points: about the pixels of a tablet
DRAWN_EDGE_LENGTH = 0.1  # m of an edge that is drawn when its length is unknown
CIRCLE_ANGLES = np.linspace(0, 2 * np.pi, 49)


def scene(calibration: Calibration, stops: Sequence[StopSnapshot], config: Config
          ) -> dict[str, Any]:
    """
    Return the name of the frame of the scene, and its parts.

    Each part has a name, a colour, a width (pixels), and a 'line' or 'points' (k, 3) in metres.
    """
    T_flange_sensor, used = calibration.T_flange_sensor, [stop for stop in stops if stop.used]
    parts = list[dict[str, Any]]()

    def draw(kind: str, name: str, color: str, width: float, points: Array) -> None:
        if len(points):
            parts.append({'name': name, 'color': color, 'width': width, kind: rounded(points)})

    for T in [stop.T_fixed_mount for stop in used] or [np.eye(4)]:
        for axis in T[:3, :3].T:
            draw('line', f'{mount_frame(config)} at each stop', FLANGE_COLOUR, 1.2,
                 np.array([T[:3, 3], T[:3, 3] + AXIS_LENGTH * axis]))
        draw('line', 'sensor at each stop', SENSOR_COLOUR, 1.2,
             np.array([T[:3, 3], (T @ T_flange_sensor)[:3, 3]]))
    for stop in stops:
        plane = stop.points[has_return(stop.points)]
        plane = plane[even_indices(len(plane), MAX_POINTS)]
        name, color = (('laser line', LASER_COLOUR) if stop.used else
                       ('laser line, not used', UNUSED_COLOUR))
        draw('points', name, color, 2.0,
             se3.apply(stop.T_fixed_mount @ T_flange_sensor, sensor_points(plane, config)))
    seen = np.concatenate([np.empty((0, 3)), *(
        se3.apply(stop.T_fixed_mount @ T_flange_sensor,
                  sensor_points(feature_points(stop.features), config)) for stop in used)])
    target = outline_of(calibration.target, config.target.size, seen)
    for outline in target.outline:
        draw('line', 'target', TARGET_COLOUR, 1.2, outline)
    for edge in target.edges:
        draw('line', 'edges of the target', EDGE_COLOUR, 2.5, edge)
    draw('points', 'what the answer comes from', SEEN_COLOUR, 4.0, seen)
    return {'parts': parts, 'frame': target_frame(config)}


def sensor_points(plane: Array, config: Config) -> Array:
    """Return points (n, 2) of the sensor plane as points (n, 3) of the sensor frame (m)."""
    return np.asarray(plane @ T_sensor_plane(config)[:3, [0, 2]].T)


def rounded(values: Array | Sequence[float]) -> Any:
    """Return lengths (m) or directions as lists, with six decimals."""
    return np.round(values, 6).tolist()


def feature_points(features: Iterable[Feature]) -> Array:
    """Return points (k, 2) of the sensor plane that represent features: ends, edges, arcs."""
    return np.concatenate([np.empty((0, 2)), *(feature.polyline for feature in features)])


def profile_picture(points: Array, features: Iterable[Feature]) -> dict[str, Any]:
    """
    Return what profile.js draws of a profile: points, lines and single points, (x, range) each.

    points: (n, 2) metres, as many as there are pixels at most; features: found in it.
    """
    points = points[has_return(points)]
    polylines = [feature.polyline for feature in features]
    return {'points': rounded(points[even_indices(len(points), MAX_OF_PROFILE)]),
            'lines': [rounded(line) for line in polylines if len(line) > 1],
            'spots': [rounded(line[0]) for line in polylines if len(line) == 1]}


@dataclass(frozen=True, eq=False)
class TargetDrawing:
    """
    A target in its fixed frame (metres).

    edges: polylines (n, 3), each a straight edge
    outline: polylines (n, 3) of the rest
    ball: the centre (3,) and radius of a sphere, where there is one
    """

    edges: tuple[Array, ...] = ()
    outline: tuple[Array, ...] = ()
    ball: tuple[Array, float] | None = None


def outline_of(target: Mapping[str, Any], size: tuple[float, ...], seen: Array) -> TargetDrawing:
    """
    Return the shape of a target as stored in calibration.yaml.

    size: of a plate (metres), empty if unknown; seen: points (k, 3) of it, which limit the
    drawn part of an infinite line or plane.
    """
    if 'centre' in target:
        centre, radius = _xyz(target['centre']), target['radius']
        return TargetDrawing(outline=tuple(centre + ring for ring in circles(radius)),
                             ball=(centre, radius))
    if 'pose' in target:
        return _plate(target, size, seen)
    if 'direction' in target and 'point' in target:
        point, axes = _xyz(target['point']), np.array([target['direction']])
        return TargetDrawing(edges=(point + _extent(seen - point, axes) @ axes,))
    if 'normal' in target:
        rectangle = _plane_rectangle(np.array(target['normal']), target['distance'], seen)
        return TargetDrawing(outline=(rectangle,))
    return TargetDrawing()


def _xyz(values: Mapping[str, float]) -> Array:
    """Return the point or vector (3,) that calibration.yaml holds as x, y and z."""
    return np.array([values[axis] for axis in 'xyz'], dtype=float)


def _plate(target: Mapping[str, Any], size: tuple[float, ...], seen: Array) -> TargetDrawing:
    """Return both edges of a plate and the rest of its outline; arguments as in `outline_of`."""
    T = se3.transform_from_values(target['pose'])
    angle = target.get('edge_angle', np.pi / 2)
    flat = se3.apply(se3.inverse(T), seen)
    length, width = size or flat[:, :2].max(axis=0, initial=DRAWN_EDGE_LENGTH / 2)
    p = np.array([length, 0.0, 0.0])
    q = width * np.array([np.cos(angle), np.sin(angle), 0.0])
    ends = se3.apply(T, np.array([np.zeros(3), p, q, p + q]))
    return TargetDrawing(edges=(ends[[0, 1]], ends[[0, 2]]), outline=(ends[[1, 3, 2]],))


def _extent(seen: Array, axes: Array) -> Array:
    """Return the least and the largest coordinates (2, k) of seen points along axes (k, 3)."""
    half = DRAWN_EDGE_LENGTH / 2 * np.ones(len(axes))
    flat = seen @ axes.T if len(seen) else np.array([-half, half])
    return np.array([flat.min(axis=0), flat.max(axis=0)])


def _plane_rectangle(normal: Array, distance: float, seen: Array) -> Array:
    """Return the outline (5, 3) of the visible part of a plane."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.array([first, np.cross(normal, first)]) / np.linalg.norm(first)
    corners = _extent(seen, axes)[[[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], [0, 1]]
    return np.asarray(corners @ axes + normal * distance)


def circles(radius: float) -> tuple[Array, ...]:
    """Return three circles (49, 3) about the origin, in the planes of the axes."""
    circle = radius * np.column_stack([
        np.cos(CIRCLE_ANGLES), np.sin(CIRCLE_ANGLES), 0 * CIRCLE_ANGLES])
    return tuple(np.roll(circle, k, axis=1) for k in range(3))
