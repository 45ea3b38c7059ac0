# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A plate: its face, and two straight edges with a common corner; with target.size all four.

Frame of the target: corner at the origin, edge p along x, edge q along y (turned by the edge
angle when that is free), face z = 0. Unknown beside X: the target's pose and, on demand, the
angle between the edges. An edge point and a face line, both from the same profile, give
conditions: the mean points of the line lie in z = 0, the edge point on its edge.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine
from handeye_ros.estimation.problem import (
    Estimate,
    Observations,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.target import target_pose
from handeye_ros.profiles.faces import face_features
from handeye_ros.targets.plane import PLANE
from handeye_ros.targets.profile_target import FACE, ProfileTarget
from handeye_ros.targets.starts import random_indices
import numpy as np
from numpy.typing import NDArray


class Edge(NamedTuple):
    """
    One of the edges of a plate.

    axis: of the target's frame, across the edge: x (0) or y (1)
    side: the sign of this axis out of the plate, -1 through the corner, or 1 at target.size[axis]
    opposite: the kind of the edge that it is parallel to
    """

    name: str
    axis: int
    side: int
    opposite: int


P, Q, P_FAR, Q_FAR = range(1, 5)  # kinds of conditions, after FACE
EDGES = {P: Edge('p', 1, -1, P_FAR), Q: Edge('q', 0, -1, Q_FAR),
         P_FAR: Edge('p_far', 1, 1, P), Q_FAR: Edge('q_far', 0, 1, Q)}
SIZE, ANGLE = slice(16, 18), 18  # of the target's state, after its pose
GATE_RATIO = 10.0  # an edge point this many times further from its edge than most is not used
MIN_GATE = 1e-3
MIN_SIZE = 0.02  # of a plate: an end nearer to one of its edges is another object
SURE_SHARE = 0.3  # of the edge points are surely on an edge of the plate

TRIED_TURNS = 240  # of the two edges in their plane, over a whole turn
TURN_VOTERS = 24  # points that this search uses


def _edge_points(observations: Observations, p: Array, state: Array
                 ) -> tuple[NDArray[np.intp], Array, Array]:
    """
    Return the rows (k,) of edge points, their places (k, 2), m, and unit vectors outwards (k, 2).

    Both along x and y of the target's frame.
    """
    T, face = target_pose(state), observations.kind == FACE
    flat = ((p - T[:3, 3]) @ T[:3, :3])[:, :2]
    rows, n = np.flatnonzero(~face), observations.station[-1] + 1
    total = np.zeros((n, 2))
    np.add.at(total, observations.station[face], flat[face])
    centre = total / np.maximum(np.bincount(observations.station[face], minlength=n), 1)[:, None]
    outward = flat[rows] - centre[observations.station[rows]]
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-12)[:, None]
    return rows, flat[rows], outward


def _is_steep(edge: Edge, outward: Array, config: Config) -> NDArray[np.bool_]:
    """Return whether unit vectors outwards (k, 2) leave the plate across an edge, and steeply."""
    steepness = edge.side * outward[:, edge.axis]
    return np.asarray(steepness >= np.sin(config.sampling.min_crossing_angle))


def _with_edges(problem: Problem, plane: Estimate, rng: np.random.Generator) -> Estimate:
    """Return an estimate of the plate in an estimated plane."""
    T = plane.T_base_target
    looking = (problem.poses[:, :3, :3] @ plane.X[:3, 2]).mean(axis=0)
    if T[:3, 2] @ looking * problem.config.profile.range_sign > 0:  # z towards the sensor
        T = T @ np.diag([1.0, -1.0, -1.0, 1.0])
    _, points, outward = _edge_points(
        problem.observations, problem.points_in_base(plane.X), T.ravel())
    corner, turn = _two_lines(points, outward, rng)
    T_base_target = T @ se3.transform(
        se3.exp_rotation(np.array([0.0, 0.0, turn])), np.append(corner, 0.0))
    return Estimate(plane.X, np.concatenate([
        T_base_target.ravel(), problem.config.target.size or (0.0, 0.0), [np.pi / 2]]))


def _turned_around_corner(estimate: Estimate) -> Estimate:
    """Return the estimate with its corner taken for that at the other end of edge p."""
    T, length = estimate.T_base_target, estimate.state[SIZE][0]
    turned = se3.transform(np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]]),
                           np.array([0.0, length, 0.0]))
    return Estimate(estimate.X, np.append((T @ turned).ravel(), estimate.state[16:]))


def _two_lines(points: Array, outward: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """
    Return corner (2,) and direction (rad) of the best two perpendicular lines through points.

    The face is at x, y > 0. points, outward: (m, 2). All directions, and all pairs of points for
    the lines, are tried. The cost of a point is its distance to the nearer line that the face is
    inside of, limited.
    """
    voters = random_indices(len(points), TURN_VOTERS, rng)
    limit = 0.03 * float(np.ptp(points[voters], axis=0).max() + 1e-9)
    turns = np.linspace(0.0, 2 * np.pi, TRIED_TURNS, endpoint=False)
    cosine, sine = np.cos(turns), np.sin(turns)
    R = np.stack([cosine, -sine, sine, cosine], axis=-1).reshape(-1, 2, 2)
    local, inside = points[voters] @ R, outward[voters] @ R < 0
    off = np.where(inside[:, None], np.abs(local[:, None] - local[:, :, None]), limit)
    off = np.minimum(off, limit).astype(np.float32)  # (direction, line through, point, axis)
    total = np.zeros(off.shape[:3], dtype=np.float32)
    for point in range(len(voters)):
        total += np.minimum(off[:, :, None, point, 0], off[:, None, :, point, 1])
    k, i, j = np.unravel_index(int(np.argmin(total)), total.shape)
    return R[k] @ np.array([local[k, i, 0], local[k, j, 1]]), float(turns[k])


class Plate(ProfileTarget):
    """A plate: its face, and two straight edges with a common corner; with a size all four."""

    name = 'plate'
    kinds = ('face', *(edge.name for edge in EDGES.values()))
    parameter_names = ('x', 'y', 'z', 'rx', 'ry', 'rz', 'size_p', 'size_q', 'edge_angle')
    pose_axes = range(6)
    extract = staticmethod(face_features)
    required_features = (FaceLine, EdgePoint)
    edge_kinds = {P: 'p', Q: 'q', P_FAR: 'p', Q_FAR: 'q'}
    unstated_measure = {'edge_angle_free': True}
    loosened_lengths = {'size_std': 3e-3}
    unassigned_edge_kinds = (P,)  # until an edge is found for it

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts: first the plane, then the two edges in it."""
        faces = problem.observations.select(problem.observations.kind == FACE)
        for plane in PLANE.starts(replace(problem, observations=faces), rng):
            estimate = _with_edges(problem, plane, rng)
            yield estimate
            if problem.config.target.size:  # edge p may run along either of the two
                yield _turned_around_corner(estimate)

    def edge_place(self, edge: EdgePoint) -> Array:
        """Return the lowest point of the end: the wall is there, for any crossing angle."""
        return edge.point + edge.to_lowest

    def axes(self, R: Array) -> Array:
        """Return the axes of the base: along them are the covariances of stored answers."""
        return np.broadcast_to(np.eye(3), R.shape)

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """
        Return height over the face, or distance from the edge (m), of points (m, 3).

        Of one plate at a time, with the measures (3,): both lengths (m), and the angle (rad).
        """
        *size, angle = measures
        sine, cosine = np.sin(angle), np.cos(angle)
        across = [sine, -cosine, 0.0], [0.0, 1.0, 0.0]
        edges = EDGES.values()
        normals = np.array([[0.0, 0.0, 1.0], *(across[edge.axis] for edge in edges)])[kind]
        length = np.array([0.0, *(size[edge.axis] * (edge.side > 0) for edge in edges)])[kind]
        along_q = local @ [cosine, sine, 0.0]
        by_angle = np.where((kind == Q) | (kind == Q_FAR), along_q, 0.0) - length * cosine
        dg_dmeasures = [*(np.where(kind == k, -sine, 0.0) for k in (Q_FAR, P_FAR)), by_angle]
        return ((local * normals).sum(axis=1) - length * sine, normals,
                np.column_stack(dg_dmeasures))

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return the lengths, and the angle between the edges if it is not free."""
        target = config.target
        std = target.size_std if target.size else 0.0
        size_p, size_q = target.size or (0.0, 0.0)
        angle = {} if target.edge_angle_free else {
            'edge_angle': (np.pi / 2, target.edge_angle_std)}
        return {'size_p': (size_p, std), 'size_q': (size_q, std), **angle}

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """
        Return the observations with each edge point assigned to the nearest edge.

        An edge is possible if the face is on its right side and the laser crosses it steeply
        enough. Points far from all edges are not used, such as ends at the limit of the range.
        """
        rows, _, outward = _edge_points(observations, p, state)
        edges = {k: edge for k, edge in EDGES.items() if config.target.size or edge.side < 0}
        kinds = np.array(list(edges))
        distance = np.array([np.where(_is_steep(edge, outward, config), np.abs(self.conditions(
            p[rows], np.full(len(rows), k), state, config).g), np.inf)
            for k, edge in edges.items()])
        nearest, smallest = kinds[np.argmin(distance, axis=0)], np.min(distance, axis=0)
        typical = np.quantile(smallest, SURE_SHARE, method='lower') if len(smallest) else 0.0
        is_near = np.isfinite(smallest) & (smallest <= max(MIN_GATE, GATE_RATIO * typical))
        kind = observations.kind.copy()
        kind[rows] = np.where(is_near, nearest, UNUSED)
        return replace(observations, kind=kind)

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the target's pose and edge angle as plain values."""
        return {'pose': se3.transform_values(target_pose(state)),
                'edge_angle': float(state[ANGLE]), 'edge_angle_std': float(std[-1])}

    def describe_strays(self, observations: Observations, p: Array, state: Array, config: Config
                        ) -> str:
        """
        Return in words where edge points lie that are on no edge of the plate, '' if unknown.

        observations, p: all of these stations; where several points agree, it is another edge.
        """
        # points at the far sides first: how far they are from the near edges is what target.size
        # should say. Without it those at the near sides have no far edges to be measured from
        rows, _, outward = _edge_points(observations, p, state)
        size, texts = config.target.size, []
        for edge in reversed(EDGES.values()):
            if not size and edge.side < 0:
                continue
            ends = p[rows[_is_steep(edge, outward, config)]]
            opposite = np.full(len(ends), edge.opposite)
            away = np.abs(self.conditions(ends, opposite, state, config).g)
            middle = float(np.median(away)) if len(away) else 0.0
            count = int((np.abs(away - middle) < MIN_GATE).sum())
            if count > 1:
                hint = (f', and not {size[edge.axis] * 1e3:.1f} mm as target.size has it' if size
                        else ' (with target.size they could be used)' if middle > MIN_SIZE
                        else '')
                texts.append(f'{count} of them {middle * 1e3:.1f} mm from '
                             f'{EDGES[edge.opposite].name}{hint}')
        return '; '.join(texts)


PLATE = Plate()
