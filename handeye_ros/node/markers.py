# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Markers: poses of samples, their features, and the current profile."""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from geometry_msgs.msg import Point
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature, Sample
from handeye_ros.frames import in_mount, target_frame
from handeye_ros.node.arrivals import Current
from handeye_ros.results.evidence import stated_noise
from handeye_ros.results.scene import enlargement, half_axes, in_sensor, shape
import numpy as np
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray


def _color(red: float, green: float, blue: float, alpha: float = 1.0) -> ColorRGBA:
    return ColorRGBA(r=red, g=green, b=blue, a=alpha)


FLANGES, NUMBERS, LINES = _color(0.5, 0.5, 0.5), _color(0.9, 0.9, 0.9), _color(0.2, 0.6, 1.0)
TARGET, EDGES, BALL = _color(0.1, 0.8, 0.3, 0.4), _color(0.0, 0.6, 0.5), _color(1.0, 0.7, 0.1, 0.5)
UNKNOWN, LASER, FOUND = _color(0.7, 0.7, 0.7), _color(0.9, 0.1, 0.1), _color(1.0, 0.6, 0.0)
AXES = (_color(0.9, 0.2, 0.2), _color(0.2, 0.8, 0.2), _color(0.2, 0.4, 0.9))

LISTS = (Marker.SPHERE_LIST, Marker.LINE_LIST)  # markers that RViz refuses without points
AXIS = 0.03  # m, of a drawn frame
ELLIPSOID = 0.02  # m, the largest drawn half axis of the uncertainty
DOT, LINE, TEXT = 0.003, 0.001, 0.012  # m
ARM = 0.2  # m from the flange to the target, for the stated noise at the target
IDENTITY = np.eye(4)
WORST = 3.0  # times the stated noise: residuals drawn red

Drawn = tuple[int, Sample, float | None]


def session_markers(samples: Sequence[Drawn], calibration: Calibration | None, config: Config
                    ) -> MarkerArray:
    """
    Return the poses of samples and, with an answer, their features.

    samples: their numbers, and their residuals (m), None without a review.
    """
    markers = [Marker(action=Marker.DELETEALL)]
    poses = [in_mount(sample.T_base_flange, config) for _, sample, _ in samples]
    if samples:
        markers.append(_points('flanges', FLANGES, np.array(poses)[:, :3, 3], 0.01))
        markers += [_text('numbers', str(number), T[:3, 3], NUMBERS)
                    for (number, _, _), T in zip(samples, poses, strict=True)]
    if calibration:
        markers += _answer_markers(samples, poses, calibration, config)
    return _array(markers, config)


def current_markers(current: Current | None, calibration: Calibration | None, config: Config
                    ) -> MarkerArray:
    """Return the current profile and its features, placed by the answer."""
    markers = [Marker(action=Marker.DELETEALL)]
    if current and calibration:
        T = in_mount(current.T_base_flange, config) @ calibration.T_flange_sensor
        for name, color, size, plane in (('profile', LASER, DOT / 2, current.points),
                                         ('feature', FOUND, 2 * DOT, _spots(current.features))):
            if len(plane):
                markers.append(_points(name, color, se3.apply(T, in_sensor(plane, config)), size))
        lines = ends(current.features)
        if len(lines):
            markers.append(_lines('feature', FOUND, se3.apply(T, in_sensor(lines, config))))
        markers += _sensor(T, calibration)
    return _array(markers, config)


def _answer_markers(samples: Sequence[Drawn], poses: Sequence[Array],
                    calibration: Calibration, config: Config) -> list[Marker]:
    """Return markers of target, samples and sensor for an answer; poses: of the mount, (4, 4)."""
    T_sensors = [T @ calibration.T_flange_sensor for T in poses]
    spots = [se3.apply(T, in_sensor(_spots(sample.features), config))
             for (_, sample, _), T in zip(samples, T_sensors, strict=True)]
    lines = [se3.apply(T, in_sensor(ends(sample.features), config))
             for (_, sample, _), T in zip(samples, T_sensors, strict=True)]
    visible = np.concatenate([*spots, *lines]) if samples else np.empty((0, 3))
    markers = _target(calibration.target, config, visible)
    if len(visible):
        scale = WORST * stated_noise(config.noise, ARM)
        markers.append(_points('samples', UNKNOWN, np.concatenate(spots), DOT, [
            _by_residual(residual, scale)
            for (_, _, residual), points in zip(samples, spots, strict=True) for _ in points]))
        markers.append(_lines('face lines', LINES, np.concatenate(lines)))
        for (number, _, residual), points in zip(samples, spots, strict=True):
            if len(points):
                label = str(number) if residual is None else f'{number}: {residual * 1e3:.3f} mm'
                markers.append(_text('numbers at the target', label, points.mean(axis=0),
                                     _by_residual(residual, scale)))
        markers += _sensor(T_sensors[-1], calibration)
    return [marker for marker in markers if marker.type not in LISTS or marker.points]


def _by_residual(residual: float | None, worst: float) -> ColorRGBA:
    """Return green for 0, yellow, red for the largest; grey for None."""
    if residual is None:
        return UNKNOWN
    ratio = min(residual / worst, 1.0)
    return _color(min(1.0, 2 * ratio), min(1.0, 2 * (1 - ratio)), 0.1)


def _target(target: Mapping[str, Any], config: Config, visible: Array) -> list[Marker]:
    form = shape(target, config.target.size, visible)
    markers = [_lines('target', TARGET, _pairs(line)) for line in form.outline]
    markers += [_lines('edges', EDGES, _pairs(line), 2 * LINE) for line in form.edges]
    if form.ball:
        centre, radius = form.ball
        markers.append(_ellipsoid('target', TARGET, centre, np.eye(3) * radius))
    return markers


def _sensor(T: Array, calibration: Calibration) -> list[Marker]:
    """Return the axes of the sensor and its uncertainty ellipsoid, enlarged to be visible."""
    R_mount = T[:3, :3] @ calibration.T_flange_sensor[:3, :3].T
    axes = R_mount @ half_axes(calibration.covariance[:3, :3])
    factor = enlargement(float(np.linalg.norm(axes, axis=0).max()), ELLIPSOID)
    markers = [_lines('sensor', color, np.array([T[:3, 3], T[:3, 3] + AXIS * T[:3, i]]))
               for i, color in enumerate(AXES)]
    return [*markers, _ellipsoid('uncertainty', BALL, T[:3, 3], axes * factor),
            _text('uncertainty', f'1 sigma x {factor:g}', T[:3, 3] + ELLIPSOID * T[:3, 1], BALL)]


def _spots(features: Iterable[Feature]) -> Array:
    """Return the edge points, centres of faces without one, and points of arcs, (k, 2)."""
    features = tuple(features)
    edges = [f.point for f in features if isinstance(f, EdgePoint)]
    faces = [f.centre for f in features if isinstance(f, FaceLine)]
    arcs = [p for f in features if isinstance(f, Arc) for p in f.points]
    return np.array((edges or faces) + arcs).reshape(-1, 2)


def ends(features: Iterable[Feature]) -> Array:
    """Return two points (2, 2) for each face line, two spreads from its centre."""
    return np.array([f.centre + side * f.spread * f.direction for f in features
                     if isinstance(f, FaceLine) for side in (-2, 2)]).reshape(-1, 2)


def _pairs(line: Array) -> Array:
    """Return the ends (2 (n - 1), 3) of the segments of a polyline (n, 3)."""
    return np.repeat(line, 2, axis=0)[1:-1]


def _points(name: str, color: ColorRGBA, points: Array, size: float,
            colors: Sequence[ColorRGBA] = ()) -> Marker:
    marker = _marker(name, Marker.SPHERE_LIST, color, (size, size, size), points)
    marker.colors = list(colors)
    return marker


def _lines(name: str, color: ColorRGBA, points: Array, width: float = LINE) -> Marker:
    return _marker(name, Marker.LINE_LIST, color, (width, 0.0, 0.0), points)


def _text(name: str, text: str, position: Array, color: ColorRGBA) -> Marker:
    T = se3.transform(np.eye(3), position + [0.0, 0.0, TEXT])
    return _marker(name, Marker.TEXT_VIEW_FACING, color, (0.0, 0.0, TEXT), T=T, text=text)


def _ellipsoid(name: str, color: ColorRGBA, centre: Array, axes: Array) -> Marker:
    """Return an ellipsoid with half axes in columns (3, 3)."""
    lengths = np.linalg.norm(axes, axis=0)
    R = axes / np.maximum(lengths, 1e-12)
    R[:, 2] = np.cross(R[:, 0], R[:, 1])
    return _marker(name, Marker.SPHERE, color, np.maximum(2 * lengths, 1e-6),
                   T=se3.transform(R, centre))


def _marker(name: str, kind: int, color: ColorRGBA, scale: Iterable[float],
            points: Iterable[Array] = (), T: Array = IDENTITY, text: str = '') -> Marker:
    """Return a marker at T (4, 4)."""
    marker = Marker(type=kind, action=Marker.ADD, color=color, ns=name, text=text)
    marker.points = [set_fields(Point(), 'xyz', point) for point in points]
    set_fields(marker.scale, 'xyz', scale)
    set_fields(marker.pose.position, 'xyz', T[:3, 3])
    set_fields(marker.pose.orientation, 'xyzw', se3.quaternion(T))
    return marker


def set_fields(msg: Any, names: str, values: Iterable[float]) -> Any:
    """Set fields with names of one letter each; return the message."""
    for name, value in zip(names, values, strict=True):
        setattr(msg, name, float(value))
    return msg


def _array(markers: list[Marker], config: Config) -> MarkerArray:
    for number, marker in enumerate(markers):
        marker.header.frame_id, marker.id = target_frame(config), number
    return MarkerArray(markers=markers)
