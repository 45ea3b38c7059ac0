"""The edge of a block, or the groove of an angle: stops at it, its features, its solids."""
from __future__ import annotations

import math

from handeye_ros import se3
from handeye_ros.data import Array, FaceLine, Feature
from handeye_ros.simulate.scenario import Scenario, WedgeTarget
from handeye_ros.simulate.solids import Box, Solid
from handeye_ros.simulate.stations import fan, lift, Stops, strata, tilts
import numpy as np

MARGIN = 0.02  # from the ends of the edge (m)
WALL = 0.02  # thickness of the legs of an angle (m)


def facing(target: WedgeTarget) -> Array:
    """Return R_target_sensor (3, 3) of a sensor that sees both faces alike, its line across."""
    half, side = math.sqrt(0.5), -1.0 if target.concave else 1.0
    line, light = np.array([0, half, side * half]), np.array([0, side * half, -half])
    return np.column_stack([line, np.cross(light, line), light])


def stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops whose laser line crosses the edge in the middle half of the field of view."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, WedgeTarget)
    near, far = scenario.sensor.range
    depth, width = far - near, 0.35 * scenario.sensor.half_width * near
    low = np.array([MARGIN, -width, near + 0.3 * depth])
    high = np.array([target.length - MARGIN, width, far - 0.3 * depth])
    place = strata(rng, n, low, high)
    R = facing(target) @ tilts(scenario, rng, (n,))
    spots = np.column_stack([place[:, 0], np.zeros((n, 2))])
    points = place[:, 1:]
    T = se3.transform(R, spots - (R @ lift(points)[:, :, None])[:, :, 0])
    return Stops(T, ('wedge',) * n, points)


def features(scenario: Scenario, at: Stops,
             rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the two FaceLines of each stop, left one first, with the noise of all profiles."""
    target = scenario.target
    assert isinstance(target, WedgeTarget)
    lines = [[_line(scenario, point, along, rng) for along in _directions(target, T)]
             for T, point in zip(at.T_target_sensor, at.points, strict=True)]
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


def solids(scenario: Scenario) -> tuple[Solid, ...]:
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
