# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The plate, and a plane without a visible edge: stops, features, solids."""
from __future__ import annotations

import math

from handeye_ros import se3
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.simulate.scenario import PlateTarget, Scenario, SensorModel
from handeye_ros.simulate.solids import Box, slab, Solid, table
from handeye_ros.simulate.stations import fan, lift, MOTIONS, Stops, strata, tilts
import numpy as np
from scipy.spatial.transform import Rotation

FACING = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # of the sensor; line along the edge's y


def edge_frames(target: PlateTarget) -> dict[str, Array]:
    """Return T_target_edge of each edge: x along it, y into the face, z out of the face."""
    (length, width), angle = target.size, target.edge_angle
    end_of_q = (width * math.cos(angle), width * math.sin(angle))
    starts = {'p': (0.0, (0.0, 0.0)), 'q': (angle + math.pi, end_of_q),
              'p2': (math.pi, (length, width)), 'q2': (math.pi / 2, (length, 0.0))}
    return {label: se3.transform(Rotation.from_rotvec([0, 0, turn]).as_matrix(),
                                 np.array([*start, 0.0]))
            for label, (turn, start) in starts.items()}


def edge_lengths(target: PlateTarget) -> dict[str, float]:
    """Return the length of each edge."""
    length, width = target.size
    return {'p': length, 'q': width, 'p2': length, 'q2': width}


def stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops whose laser line crosses an edge inside the field of view."""
    target, counts = scenario.target, scenario.stations
    assert isinstance(target, PlateTarget)
    labels = ['p'] * counts[0] + ['q'] * counts[1]
    for k in rng.permutation(len(labels))[:scenario.wrong_edges]:
        labels[k] += '2'
    near, far = scenario.sensor.range
    depth, width = far - near, 0.5 * scenario.sensor.half_width * near
    low, high = [0.0, -width, near + 0.22 * depth], [1.0, width, far - 0.22 * depth]
    drawn = np.concatenate([strata(rng, n, np.array(low), np.array(high)) for n in counts])
    R_nominal = _plate_orientations(scenario, labels)
    R = R_nominal @ tilts(scenario, rng, counts)
    crossing = _crossings(target, labels, drawn[:, 0])
    points = drawn[:, 1:]
    T = se3.transform(R, crossing - (R @ lift(points)[:, :, None])[:, :, 0])
    return Stops(T, tuple(labels), points)


def _plate_orientations(scenario: Scenario, labels: list[str]) -> Array:
    """Return (n, 3, 3) R_target_sensor: facing the plate, the line across the label's edge."""
    if MOTIONS[scenario.motion].shared:
        diagonal = Rotation.from_rotvec([0, 0, -math.pi / 4]).as_matrix() @ FACING
        return np.repeat(diagonal[None], len(labels), axis=0)
    frames = edge_frames(PlateTarget())
    across = {label: frame[:3, :3] @ FACING for label, frame in frames.items()}
    # the opposite edge is crossed outwards, so that the robot need not turn around
    across |= {'p2': across['p'], 'q2': across['q']}
    return np.array([across[label] for label in labels])


def _crossings(target: PlateTarget, labels: list[str], fraction: Array) -> Array:
    """Return (n, 3) points on the labels' edges, far enough from their corners."""
    frames, lengths, margin = edge_frames(target), edge_lengths(target), 0.03
    along = margin + fraction * (np.array([lengths[k] for k in labels]) - 2 * margin)
    T = np.array([frames[k] for k in labels])
    return np.asarray(T[:, :3, 3] + T[:, :3, 0] * along[:, None])


def features(
        scenario: Scenario, drawn: Stops,
        rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return (FaceLine, EdgePoint) of each stop, with the noise of all its profiles."""
    sensor, count = scenario.sensor, scenario.profiles_per_stop
    assert isinstance(scenario.target, PlateTarget)
    inwards = face_directions(drawn.T_target_sensor, drawn.labels)
    length = visible_lengths(sensor, scenario.target, drawn, inwards)
    ends = drawn.points + length[:, None] * inwards
    columns = np.abs(fan(ends) - fan(drawn.points)) / (2 * sensor.half_width) * sensor.columns
    spread = length / np.sqrt(12)
    std = sensor.noise * np.abs(inwards[:, 0]) / np.sqrt(columns * count)
    std_along = length / columns / np.sqrt(12)
    e = rng.normal(size=(3, len(length))) * np.stack([std, std, std_along])
    normals = inwards[:, ::-1] * [-1, 1]
    centre = drawn.points + (length / 2)[:, None] * inwards + e[0][:, None] * normals
    directions = inwards + (e[1] / spread)[:, None] * normals
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    edge = centre - (length / 2 + e[2])[:, None] * directions
    std_across = std * np.sqrt(1 + (length / 2 / spread)**2)
    return [(FaceLine(centre[k], directions[k], float(spread[k]), float(std[k])),
             EdgePoint(edge[k], -directions[k], float(std_along[k]), float(std_across[k])))
            for k in range(len(length))]


def face_directions(T_target_sensor: Array, labels: tuple[str, ...]) -> Array:
    """Return (n, 2) unit vectors along the profile's face, from the edge into the face."""
    normal = T_target_sensor[:, 2, :3]  # the face's normal, in the sensor frame
    along = np.stack([normal[:, 2], -normal[:, 0]], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    in_target = (T_target_sensor[:, :3, :3] @ lift(along)[:, :, None])[:, :, 0]
    inward = {'p': (1, 1), 'q': (0, 1), 'p2': (1, -1), 'q2': (0, -1)}
    axis, sign = np.array([inward[label] for label in labels]).T
    sign = np.sign(in_target[np.arange(len(along)), axis]) * sign
    return np.asarray(along * sign[:, None])


def visible_lengths(
        sensor: SensorModel, target: PlateTarget, drawn: Stops, inwards: Array) -> Array:
    """Return (n,) lengths of the face in the field of view, from the edge on."""
    w, (near, far) = sensor.half_width, sensor.range
    view = np.array([[1, -w, 0], [-1, -w, 0], [0, -1, -near], [0, 1, far]])
    rise, room = inwards @ view[:, :2].T, view[:, 2] - drawn.points @ view[:, :2].T
    start = se3.apply(drawn.T_target_sensor, lift(drawn.points)[:, None])[:, 0, :2]
    in_face = (drawn.T_target_sensor[:, :3, :3] @ lift(inwards)[:, :, None])[:, :2, 0]
    rise = np.concatenate([rise, in_face, -in_face], axis=1)
    room = np.concatenate([room, np.array(target.size) - start, start], axis=1)
    outwards = rise > 1e-6
    return np.asarray((np.where(outwards, room, np.inf) / np.where(outwards, rise, 1)).min(axis=1))


def solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return table, plate and, with clutter, a block at each of the edges p and q."""
    target = scenario.target
    assert isinstance(target, PlateTarget)
    if scenario.empty:
        return table(target.table)
    bottom, (length, width) = -target.thickness, target.size
    if target.clutter is None:
        return (*table(target.table), *slab(target))
    near = target.clutter_gap
    far = near + target.clutter_width
    return (*table(target.table), *slab(target),
            Box((-0.02, -far, bottom), (length, -near, target.clutter)),
            Box((-far, -0.005, bottom), (-near, width, target.clutter)))


def plane_stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops with the sensor aimed at the middle third of the plate."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, PlateTarget)
    near, far = scenario.sensor.range
    depth, width = far - near, 0.3 * scenario.sensor.half_width * near
    low = np.array([1 / 3, 1 / 3, -width, near + 0.3 * depth])
    high = np.array([2 / 3, 2 / 3, width, far - 0.3 * depth])
    drawn = strata(rng, n, low, high)
    R = FACING @ tilts(scenario, rng, (n,))
    spots = np.column_stack([drawn[:, :2] * target.size, np.zeros(n)])
    points = drawn[:, 2:]
    T = se3.transform(R, spots - (R @ lift(points)[:, :, None])[:, :, 0])
    return Stops(T, ('plane',) * n, points)


def plane_features(scenario: Scenario, drawn: Stops,
                   rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the FaceLine of each stop, with the noise of all its profiles."""
    return [(_face_line(scenario, T, point, rng),)
            for T, point in zip(drawn.T_target_sensor, drawn.points, strict=True)]


def _face_line(scenario: Scenario, T: Array, point: Array, rng: np.random.Generator) -> FaceLine:
    """Return the line through the visible part of a face, sampled evenly."""
    sensor = scenario.sensor
    normal = T[2, [0, 2]] * np.sign(T[2, 2]) / np.linalg.norm(T[2, [0, 2]])
    along, distance = np.array([normal[1], -normal[0]]), normal @ point
    limits = np.array([-sensor.half_width, sensor.half_width])
    if abs(normal[0]) > 1e-9:  # the fan's angles at which the range ends
        by_range = (distance / np.array(sensor.range) - normal[1]) / normal[0]
        limits = np.clip(np.sort(by_range), *limits)
    z = distance / (limits * normal[0] + normal[1])
    first, last = np.column_stack([limits * z, z])
    spread = float((last - first) @ along) / np.sqrt(12)
    columns = (limits[1] - limits[0]) / (2 * sensor.half_width) * sensor.columns
    std = sensor.noise * along[0] / np.sqrt(columns * scenario.profiles_per_stop)
    shift, turn = rng.normal(size=2) * std
    direction = along + turn / spread * normal
    return FaceLine((first + last) / 2 + shift * normal, direction / np.linalg.norm(direction),
                    spread, float(std))
