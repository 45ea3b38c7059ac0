# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The targets: from where the sensor sees them, what stands there, and the features of each stop.

SCENES has the three functions of each target. The features have exactly the noise that they state.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
import math
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Feature
from handeye_ros.simulate.scenario import PlateTarget, Scenario, SphereTarget, WedgeTarget
from handeye_ros.simulate.sensor import lift, tangent
from handeye_ros.simulate.solids import Ball, box, slab, Solid, table_top
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Features: TypeAlias = list[tuple[Feature, ...]]
"""What each stop shows."""

# -- stops


@dataclass(frozen=True)
class Orientations:
    """
    The variation of orientations between stops.

    shared: both edges are crossed with one nominal orientation, at 45 degrees to each
    axes: which tilts (about the sensor's x, y, z) vary; the others are drawn once, or are zero
        when level
    per_edge: drawn once for each edge
    """

    shared: bool = False
    axes: tuple[bool, bool, bool] = (True, True, True)
    level: bool = False
    per_edge: bool = False


MOTIONS = {
    'general': Orientations(),
    'one_orientation': Orientations(shared=True, axes=(False, False, False)),
    'one_orientation_per_edge': Orientations(axes=(False, False, False), per_edge=True),
    'tilt_only': Orientations(shared=True, axes=(True, False, False), level=True),
    'yaw_only': Orientations(axes=(False, False, True), level=True),
}


@dataclass(frozen=True, eq=False)
class Placements:
    """
    Poses of the sensor at n stops.

    T_target_sensor: (n, 4, 4), standard sensor frame
    labels: of each the edge of the plate that is seen (p, q, p_far, q_far), else the scene's name
    points: (n, 2) true point of edge or plane, or centre of the arc, in the sensor plane (m)
    """

    T_target_sensor: Array
    labels: tuple[str, ...]
    points: Array

    def ordered(self, order: NDArray[np.int64]) -> Placements:
        """Return the same stops in another order."""
        labels = tuple(self.labels[k] for k in order)
        return Placements(self.T_target_sensor[order], labels, self.points[order])


def strata(rng: Generator, n: int, low: Array, high: Array) -> Array:
    """Return values (n, k) from low to high (k,), one in each n-th of the range, shuffled."""
    order = rng.permuted(np.tile(np.arange(n), (len(low), 1)), axis=1).T
    return np.asarray(low + (order + rng.random(order.shape)) / n * (high - low))


def tilts(scenario: Scenario, rng: Generator, counts: tuple[int, ...]) -> Array:
    """Return (n, 3, 3) rotations of the sensor about its own axes, for groups of these counts."""
    motion = MOTIONS[scenario.motion]
    limit = np.full(3, scenario.tilt)
    constant = rng.uniform(-limit, limit, (len(counts), 3)) * (not motion.level)
    if not motion.per_edge:
        constant[:] = constant[0]
    groups = [np.where(motion.axes, strata(rng, n, -limit, limit), constant[k])
              for k, n in enumerate(counts)]
    return np.asarray(Rotation.from_euler('xyz', np.concatenate(groups)).as_matrix())


def placements_seeing(scenario: Scenario, rng: Generator, nominal: Array, spots: Array,
                      seen: Array, groups: Sequence[Sequence[str]]) -> Placements:
    """
    Return stops of tilted sensors that see spots of the target at given points of their frame.

    nominal: R_target_sensor (3, 3) or (n, 3, 3) without the tilt; spots: (n, 3) in the target;
    seen: (n, 3) the spots in the sensor frame (m); groups: the labels of each group of stops.
    """
    R = nominal @ tilts(scenario, rng, tuple(map(len, groups)))
    T = se3.transform(R, spots - (R @ seen[:, :, None])[:, :, 0])
    return Placements(T, tuple(chain(*groups)), seen[:, [0, 2]])


def _in_view(scenario: Scenario, rng: Generator, n: int, width: float, depth: float,
             *others: tuple[float, float]) -> Array:
    """
    Return stratified values (n, k + 2): k others (low, high), then points of the field of view.

    width: largest |x|, in half widths of the near end; depth: distance from both ends of the
    range, in its lengths.
    """
    near, far = scenario.sensor.range
    x, margin = width * scenario.sensor.half_width * near, depth * (far - near)
    limits = np.array([*others, (-x, x), (near + margin, far - margin)])
    return strata(rng, n, *limits.T)


# -- lines of faces


def _length_to_limits(rates: Array, room: Array) -> Array:
    """
    Return the length (n,) of a way until it reaches the first of k limits (m).

    rates: (n, k) by which a metre of the way comes nearer to each limit; room: (n, k) from its
    start to each limit (m).
    """
    nearing = rates > 1e-6
    return np.asarray((np.where(nearing, room, np.inf) / np.where(nearing, rates, 1)).min(axis=1))


def _length_in_view(scenario: Scenario, points: Array, along: Array) -> Array:
    """Return the lengths (n,) in the field of view, from points along directions (n, 2) (m)."""
    w, (near, far) = scenario.sensor.half_width, scenario.sensor.range
    view = np.array([[1, -w, 0], [-1, -w, 0], [0, -1, -near], [0, 1, far]])
    return _length_to_limits(along @ view[:, :2].T, view[:, 2] - points @ view[:, :2].T)


def _along(T_target_sensor: Array, axis: int, into: Array) -> tuple[Array, Array]:
    """
    Return unit vectors (n, 2) in the sensor plane along a face, and (n, 3) the same in the target.

    axis: of the target, the normal of the face; into: (3,) or (n, 3) the side that they point to
    """
    normal = T_target_sensor[:, axis, [0, 2]]
    along = se3.unit(np.stack([normal[:, 1], -normal[:, 0]], axis=1))
    in_target = (T_target_sensor[:, :3, :3] @ lift(along)[:, :, None])[:, :, 0]
    sense = np.sign((in_target * into).sum(axis=1))[:, None]
    return sense * along, sense * in_target


def _face_lines(scenario: Scenario, start: Array, along: Array, length: Array, noise: Array,
                sense: Array | float = 1.0) -> tuple[list[FaceLine], Array]:
    """
    Return the lines of n faces from start along (n, 2), and their numbers of columns (n,).

    noise (2, n): of height and slope in sigmas; sense (n,): -1 for lines that point backwards.
    """
    sensor, end = scenario.sensor, start + length[:, None] * along
    columns = np.abs(tangent(end) - tangent(start)) / (2 * sensor.half_width) * sensor.columns
    spread = length / np.sqrt(12)
    std = sensor.noise * np.abs(along[:, 0]) / np.sqrt(columns * scenario.profiles_per_stop)
    shift, turn = noise * std
    normals = along[:, ::-1] * [-1, 1]
    centre = start + (length / 2)[:, None] * along + shift[:, None] * normals
    direction = se3.unit(along * np.reshape(sense, (-1, 1)) + (turn / spread)[:, None] * normals)
    return [FaceLine(centre[k], direction[k], float(spread[k]), float(std[k]))
            for k in range(len(length))], columns


# -- plate, line: a plate with edges


# R_edge_sensor (3, 3): square to the face, the laser line along the edge frame's y, so across the
# edge
SENSOR_FACING = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
PLATE_END_MARGIN = 0.03  # m from the ends of an edge


def edge_frames(target: PlateTarget) -> dict[str, Array]:
    """Return T_target_edge of each edge: x along it, y into the face, z out of the face."""
    (length, width), angle = target.size, target.edge_angle
    end_of_q = (width * math.cos(angle), width * math.sin(angle))
    starts = {'p': (0.0, (0.0, 0.0)), 'q': (angle + math.pi, end_of_q),
              'p_far': (math.pi, (length, width)), 'q_far': (math.pi / 2, (length, 0.0))}
    return {label: se3.transform(Rotation.from_rotvec([0, 0, turn]).as_matrix(),
                                 np.array([*start, 0.0]))
            for label, (turn, start) in starts.items()}


def plate_placements(scenario: Scenario, rng: Generator) -> Placements:
    """Draw stops whose laser line crosses an edge inside the field of view."""
    target: PlateTarget = scenario.target
    counts = scenario.stops
    labels = ['p'] * counts[0] + ['q'] * counts[1]
    for k in rng.permutation(len(labels))[:scenario.wrong_edges]:
        labels[k] += '_far'
    fraction, points = np.split(np.concatenate([
        _in_view(scenario, rng, n, 0.5, 0.22, (0.0, 1.0)) for n in counts]), [1], axis=1)
    if MOTIONS[scenario.motion].shared:
        nominal = Rotation.from_rotvec([0, 0, -math.pi / 4]).as_matrix()
    else:  # the opposite edge is crossed outwards, so that the robot need not turn around
        frames = edge_frames(PlateTarget())
        nominal = np.array([frames[label[0]][:3, :3] for label in labels])
    edges = np.array([edge_frames(target)[label] for label in labels])
    lengths = np.array([target.size['q' in label] for label in labels])
    along = PLATE_END_MARGIN + fraction[:, 0] * (lengths - 2 * PLATE_END_MARGIN)
    spots = edges[:, :3, 3] + edges[:, :3, 0] * along[:, None]
    groups = labels[:counts[0]], labels[counts[0]:]
    return placements_seeing(scenario, rng, nominal @ SENSOR_FACING, spots, lift(points), groups)


def plate_features(scenario: Scenario, placed: Placements, rng: Generator) -> Features:
    """Return (FaceLine, EdgePoint) of each stop, with the noise of all its profiles."""
    T, frames = placed.T_target_sensor, edge_frames(scenario.target)
    inwards, in_target = _along(T, 2, np.array([frames[label][:3, 1] for label in placed.labels]))
    rise = in_target[:, :2]
    start = se3.apply(T, lift(placed.points)[:, None])[:, 0, :2]
    in_face = _length_to_limits(np.hstack([rise, -rise]),
                                np.hstack([np.array(scenario.target.size) - start, start]))
    length = np.minimum(_length_in_view(scenario, placed.points, inwards), in_face)
    noise = rng.normal(size=(3, len(T)))
    faces, columns = _face_lines(scenario, placed.points, inwards, length, noise[:2])
    return [
        (face, EdgePoint(face.centre - (half + e * std) * face.direction, -face.direction,
                         float(std), float(face.std * np.sqrt(1 + (half / face.spread)**2))))
        for face, half, std, e in zip(faces, length / 2, length / columns / np.sqrt(12),
                                      noise[2], strict=True)]


def plate_solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return table, plate and, with clutter, a block at each of the edges p and q."""
    target: PlateTarget = scenario.target
    solids = (*table_top(target.table), *slab(target))
    if target.clutter is None:
        return solids
    bottom, (length, width) = -target.thickness, target.size
    near = target.clutter_gap
    far = near + target.clutter_width
    return (*solids, box((-0.02, -far, bottom), (length, -near, target.clutter)),
            box((-far, -0.005, bottom), (-near, width, target.clutter)))


# -- plane: the middle of a plate


def plane_placements(scenario: Scenario, rng: Generator) -> Placements:
    """Draw stops with the sensor aimed at the middle third of the plate."""
    target: PlateTarget = scenario.target
    n = sum(scenario.stops)
    third = (1 / 3, 2 / 3)
    in_face, points = np.split(_in_view(scenario, rng, n, 0.3, 0.3, third, third), [2], axis=1)
    spots = np.column_stack([in_face * target.size, np.zeros(n)])
    return placements_seeing(scenario, rng, SENSOR_FACING, spots, lift(points), [['plane'] * n])


def plane_features(scenario: Scenario, placed: Placements, rng: Generator) -> Features:
    """Return the FaceLine of each stop, with the noise of all its profiles."""
    T = placed.T_target_sensor
    along, _ = _along(T, 2, T[:, :3, 0])
    before, beyond = (_length_in_view(scenario, placed.points, way) for way in (-along, along))
    noise = rng.normal(size=(len(along), 2)).T
    start = placed.points - before[:, None] * along
    return [(face,) for face in _face_lines(scenario, start, along, before + beyond, noise)[0]]


# -- wedge


WEDGE_END_MARGIN = 0.02  # from the ends of the edge (m)
WALL_THICKNESS = 0.02  # thickness of the legs of an angle (m)


def facing(target: WedgeTarget) -> Array:
    """Return R_target_sensor (3, 3) of a sensor facing both faces equally, its line across."""
    half, side = math.sqrt(0.5), -1.0 if target.concave else 1.0
    line, light = np.array([0, half, side * half]), np.array([0, side * half, -half])
    return np.column_stack([line, np.cross(light, line), light])


def wedge_placements(scenario: Scenario, rng: Generator) -> Placements:
    """Draw stops whose laser line crosses the edge in the middle half of the field of view."""
    target: WedgeTarget = scenario.target
    n = sum(scenario.stops)
    ends = WEDGE_END_MARGIN, target.length - WEDGE_END_MARGIN
    along, points = np.split(_in_view(scenario, rng, n, 0.35, 0.3, ends), [1], axis=1)
    spots = np.column_stack([along, np.zeros((n, 2))])
    return placements_seeing(scenario, rng, facing(target), spots, lift(points), [['wedge'] * n])


def wedge_features(scenario: Scenario, placed: Placements, rng: Generator) -> Features:
    """Return the two FaceLines of each stop, left one first, with the noise of its profiles."""
    target: WedgeTarget = scenario.target
    T = placed.T_target_sensor
    noise = rng.normal(size=(len(T), 2, 2))
    faces = []
    upwards = np.array([0.0, 0.0, 1.0 if target.concave else -1.0])
    for k, (normal, into) in enumerate(((2, np.array([0.0, 1.0, 0.0])), (1, upwards))):
        along, _ = _along(T, normal, into)
        length = _length_in_view(scenario, placed.points, along)
        faces.append(_face_lines(scenario, placed.points, along, length, noise[:, k].T,
                                 np.sign(along[:, 0]))[0])
    return [(a, b) if a.centre[0] < b.centre[0] else (b, a) for a, b in zip(*faces, strict=True)]


def wedge_solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return the block whose edge is the x axis, or the two legs of an angle."""
    target: WedgeTarget = scenario.target
    length, width = target.length, target.width
    if not target.concave:
        return (box((0.0, 0.0, -width), (length, width, 0.0)),)
    return (box((0.0, 0.0, -WALL_THICKNESS), (length, width, 0.0)),
            box((0.0, -WALL_THICKNESS, -WALL_THICKNESS), (length, 0.0, width)))


# -- sphere


ARC_POINTS = 12  # mean points that represent an arc
STEM_WIDTH = 0.012  # m


def sphere_placements(scenario: Scenario, rng: Generator) -> Placements:
    """Draw stops whose laser plane cuts the ball within 0.6 radii of its centre."""
    target: SphereTarget = scenario.target
    n = sum(scenario.stops)
    radius, (near, far) = target.radius, scenario.sensor.range
    margin = 0.45 * scenario.sensor.half_width * near
    low = np.array([-margin, -0.6 * radius, near + 0.12 * (far - near)])
    high = np.array([margin, 0.6 * radius, near + 0.45 * (far - near)])
    centre = strata(rng, n, low, high)  # of the ball in the sensor frame; z: top of the arc
    centre[:, 2] += np.sqrt(radius**2 - centre[:, 1]**2)
    down = np.diag([1.0, -1.0, -1.0])
    return placements_seeing(scenario, rng, down, np.zeros(3), centre, [['sphere'] * n])


def sphere_features(scenario: Scenario, placed: Placements, rng: Generator) -> Features:
    """Return the Arc of each stop: points between the rims and within the field of view."""
    y = (placed.T_target_sensor[:, :3, 1] * placed.T_target_sensor[:, :3, 3]).sum(axis=1)
    radii = np.sqrt(scenario.target.radius**2 - y**2)
    return [(_arc(scenario, centre, float(radius), rng),)
            for centre, radius in zip(placed.points, radii, strict=True)]


def _arc(scenario: Scenario, centre: Array, radius: float, rng: Generator) -> Arc:
    """Return an arc; its mean points are on the circle except for their stated noise."""
    sensor = scenario.sensor
    rim = np.sin(sensor.max_incidence)
    pitch = 2 * sensor.half_width * (centre[1] - radius) / sensor.columns
    sine = np.arange(-rim, rim, pitch / radius)
    points = _points_on_circle(centre, radius, sine, np.zeros(len(sine)))
    sine = sine[(np.abs(tangent(points)) < sensor.half_width) & (points[:, 1] < sensor.range[1])]
    width = len(sine) // ARC_POINTS
    bins = sine[:len(sine) // width * width].reshape(-1, width)
    middle = bins.mean(axis=1)
    std = sensor.noise * np.sqrt((1 - middle**2) / (width * scenario.profiles_per_stop))
    points = _points_on_circle(centre, radius, middle, rng.normal(size=len(std)) * std)
    noise = rng.normal(size=len(sine)) * sensor.noise * np.sqrt(1 - sine**2)
    return Arc(points, std, centre, radius, _points_on_circle(centre, radius, sine, noise))


def _points_on_circle(centre: Array, radius: float, sine: Array, outwards: Array) -> Array:
    """Return points (n, 2) by the sine (n,) of their angle on the circle, moved outwards (n,)."""
    normals = np.stack([sine, -np.sqrt(1 - sine**2)], axis=1)
    return np.asarray(centre + (radius + outwards)[:, None] * normals)


def sphere_solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return ball, stem, table and, with clutter, a block beside the ball."""
    target: SphereTarget = scenario.target
    half, bottom = STEM_WIDTH / 2, -(target.table or 0.2)
    beside = 1.2 * target.radius
    solids = (*table_top(target.table), Ball(target.radius),
              box((-half, -half, bottom), (half, half, 0)))
    if not target.clutter:
        return solids
    return (*solids, box((beside, -target.radius, bottom), (beside + 0.03, target.radius, -0.015)))


@dataclass(frozen=True)
class Scene:
    """
    A target of the simulator.

    placements: draws the stops
    features: of each stop, with noise
    solids: target and surroundings, in the target frame, of a cell that is not empty
    """

    placements: Callable[[Scenario, Generator], Placements]
    features: Callable[[Scenario, Placements, Generator], Features]
    solids: Callable[[Scenario], tuple[Solid, ...]]


SCENES = {
    'plate': Scene(plate_placements, plate_features, plate_solids),
    'line': Scene(plate_placements, plate_features, plate_solids),
    'plane': Scene(plane_placements, plane_features, plate_solids),
    'sphere': Scene(sphere_placements, sphere_features, sphere_solids),
    'wedge': Scene(wedge_placements, wedge_features, wedge_solids),
}
MANY_STOPS = 100  # stops at each edge


def many_placements(scenario: Scenario) -> Placements:
    """Return many stops drawn like the scenario's own."""
    first, second = scenario.stops
    enlarged = replace(scenario, wrong_edges=0,
                       stops=(MANY_STOPS * (first > 0), MANY_STOPS * (second > 0)))
    return SCENES[scenario.scene].placements(enlarged, np.random.default_rng(0))
