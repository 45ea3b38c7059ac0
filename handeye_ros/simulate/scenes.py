# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The targets of the simulator: stops, features, solids."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

from handeye_ros import se3
from handeye_ros.data import Arc, Array, FaceLine, Feature
from handeye_ros.simulate import plate
from handeye_ros.simulate.scenario import Scenario, SensorModel, SphereTarget, WedgeTarget
from handeye_ros.simulate.solids import Ball, Box, Solid, table
from handeye_ros.simulate.stations import fan, lift, Stops, strata, tilts
import numpy as np

ARC_POINTS = 12  # mean points that represent an arc


def sphere_stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops whose laser plane cuts the ball within 0.6 radii of its centre."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, SphereTarget)
    radius, (near, far) = target.radius, scenario.sensor.range
    margin = 0.45 * scenario.sensor.half_width * near
    low = np.array([-margin, -0.6 * radius, near + 0.12 * (far - near)])
    high = np.array([margin, 0.6 * radius, near + 0.45 * (far - near)])
    centre = strata(rng, n, low, high)  # of the ball in the sensor frame; z: top of the arc
    centre[:, 2] += np.sqrt(radius**2 - centre[:, 1]**2)
    R = np.diag([1.0, -1.0, -1.0]) @ tilts(scenario, rng, (n,))
    T = se3.transform(R, -(R @ centre[:, :, None])[:, :, 0])
    return Stops(T, ('sphere',) * n, centre[:, [0, 2]])


def sphere_features(
        scenario: Scenario, drawn: Stops,
        rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the Arc of each stop: points between the rims and within the field of view."""
    assert isinstance(scenario.target, SphereTarget)
    y = (drawn.T_target_sensor[:, :3, 1] * drawn.T_target_sensor[:, :3, 3]).sum(axis=1)
    radii = np.sqrt(scenario.target.radius**2 - y**2)
    return [(_arc(scenario, centre, float(radius), rng),)
            for centre, radius in zip(drawn.points, radii, strict=True)]


def _arc(scenario: Scenario, centre: Array, radius: float, rng: np.random.Generator) -> Arc:
    """Return an arc; its mean points are on the circle except for their stated noise."""
    sensor = scenario.sensor
    sine = _visible(sensor, centre, radius)
    width = len(sine) // ARC_POINTS
    bins = [sine[k:k + width] for k in range(0, len(sine) - width + 1, width)]
    middle = np.array([group.mean() for group in bins])
    size = np.array([len(group) for group in bins])
    std = sensor.noise * np.sqrt((1 - middle**2) / (size * scenario.profiles_per_stop))
    points = _on_circle(centre, radius, middle, rng.normal(size=len(std)) * std)
    noise = rng.normal(size=len(sine)) * sensor.noise * np.sqrt(1 - sine**2)
    return Arc(points, std, centre, radius, _on_circle(centre, radius, sine, noise))


def _on_circle(centre: Array, radius: float, sine: Array, outwards: Array) -> Array:
    normals = np.stack([sine, -np.sqrt(1 - sine**2)], axis=1)
    return np.asarray(centre + (radius + outwards)[:, None] * normals)


def _visible(sensor: SensorModel, centre: Array, radius: float) -> Array:
    """Return the sines of the angles between normals and range axis, for columns on the ball."""
    rim = np.sin(sensor.max_incidence)
    pitch = 2 * sensor.half_width * (centre[1] - radius) / sensor.columns
    sine = np.arange(-rim, rim, pitch / radius)
    points = _on_circle(centre, radius, sine, np.zeros(len(sine)))
    return sine[(np.abs(fan(points)) < sensor.half_width) & (points[:, 1] < sensor.range[1])]


def sphere_solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return ball, stem, table and, with clutter, a block beside the ball."""
    target = scenario.target
    assert isinstance(target, SphereTarget)
    half, bottom = target.stem / 2, -(target.table or 0.2)
    beside = 1.2 * target.radius
    ball = (Ball(target.radius), Box((-half, -half, bottom), (half, half, 0)))
    block = Box((beside, -target.radius, bottom), (beside + 0.03, target.radius, -0.015))
    return (table(target.table) + ball * (not scenario.empty)
            + (block,) * (target.clutter and not scenario.empty))


MARGIN = 0.02  # from the ends of the edge (m)
WALL = 0.02  # thickness of the legs of an angle (m)


def facing(target: WedgeTarget) -> Array:
    """Return R_target_sensor (3, 3) of a sensor facing both faces equally, its line across."""
    half, side = math.sqrt(0.5), -1.0 if target.concave else 1.0
    line, light = np.array([0, half, side * half]), np.array([0, side * half, -half])
    return np.column_stack([line, np.cross(light, line), light])


def wedge_stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops whose laser line crosses the edge in the middle half of the field of view."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, WedgeTarget)
    near, far = scenario.sensor.range
    depth, width = far - near, 0.35 * scenario.sensor.half_width * near
    low = np.array([MARGIN, -width, near + 0.3 * depth])
    high = np.array([target.length - MARGIN, width, far - 0.3 * depth])
    drawn = strata(rng, n, low, high)
    R = facing(target) @ tilts(scenario, rng, (n,))
    spots = np.column_stack([drawn[:, 0], np.zeros((n, 2))])
    points = drawn[:, 1:]
    T = se3.transform(R, spots - (R @ lift(points)[:, :, None])[:, :, 0])
    return Stops(T, ('wedge',) * n, points)


def wedge_features(
        scenario: Scenario, drawn: Stops,
        rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the two FaceLines of each stop, left one first, with the noise of its profiles."""
    target = scenario.target
    assert isinstance(target, WedgeTarget)
    lines = [[_line(scenario, point, along, rng) for along in _directions(target, T)]
             for T, point in zip(drawn.T_target_sensor, drawn.points, strict=True)]
    return [(a, b) if a.centre[0] < b.centre[0] else (b, a) for a, b in lines]


def _directions(target: WedgeTarget, T_target_sensor: Array) -> list[Array]:
    """Return unit vectors (2,) along the two faces in the sensor plane, away from the edge."""
    directions = []
    for normal, inward in ((2, (1, 1.0)), (1, (2, 1.0 if target.concave else -1.0))):
        n = T_target_sensor[normal, [0, 2]]
        along = np.array([n[1], -n[0]]) / np.linalg.norm(n)
        in_target = T_target_sensor[inward[0], [0, 2]] @ along
        directions.append(along * np.sign(in_target) * inward[1])
    return directions


def _line(scenario: Scenario, point: Array, along: Array, rng: np.random.Generator) -> FaceLine:
    """Return the line of a face from the edge to the border of the field of view."""
    sensor = scenario.sensor
    w, (near, far) = sensor.half_width, sensor.range
    view = np.array([[1, -w, 0], [-1, -w, 0], [0, -1, -near], [0, 1, far]])
    rise, room = view[:, :2] @ along, view[:, 2] - view[:, :2] @ point
    length = float(np.min(room[rise > 1e-6] / rise[rise > 1e-6]))
    end = point + length * along
    columns = abs(fan(end) - fan(point)) / (2 * w) * sensor.columns
    std = float(sensor.noise * abs(along[0]) / np.sqrt(columns * scenario.profiles_per_stop))
    spread = length / math.sqrt(12)
    normal = np.array([-along[1], along[0]])
    shift, turn = rng.normal(size=2) * std
    direction = along * np.sign(along[0]) + turn / spread * normal
    return FaceLine((point + end) / 2 + shift * normal, direction / np.linalg.norm(direction),
                    spread, std)


def wedge_solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return the block whose edge is the x axis, or the two legs of an angle."""
    target = scenario.target
    assert isinstance(target, WedgeTarget)
    if scenario.empty:
        return ()
    length, width = target.length, target.width
    if not target.concave:
        return (Box((0.0, 0.0, -width), (length, width, 0.0)),)
    return (Box((0.0, 0.0, -WALL), (length, width, 0.0)),
            Box((0.0, -WALL, -WALL), (length, 0.0, width)))


MANY = 100  # stops at each edge


@dataclass(frozen=True)
class Scene:
    """
    A target of the simulator.

    stops: draws the sensor poses; solids: target and surroundings, in the target frame; features:
    of each stop, with noise.
    """

    stops: Callable[[Scenario, np.random.Generator], Stops]
    solids: Callable[[Scenario], tuple[Solid, ...]]
    features: Callable[[Scenario, Stops, np.random.Generator], list[tuple[Feature, ...]]]


SCENES = {
    'plate': Scene(plate.stops, plate.solids, plate.features),
    'line': Scene(plate.stops, plate.solids, plate.features),
    'plane': Scene(plate.plane_stops, plate.solids, plate.plane_features),
    'sphere': Scene(sphere_stops, sphere_solids, sphere_features),
    'wedge': Scene(wedge_stops, wedge_solids, wedge_features),
}


def anywhere(scenario: Scenario) -> Stops:
    """Return many stops drawn like the scenario's own."""
    first, second = scenario.stations
    enlarged = replace(scenario, stations=(MANY * (first > 0), MANY * (second > 0)), wrong_edges=0)
    return SCENES[scenario.scene].stops(enlarged, np.random.default_rng(0))
