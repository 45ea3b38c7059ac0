# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One straight edge: every edge point lies on one line of the base frame.

Frame of the target: x along the line, the origin its point nearest to the mean position of the
mount in the start. An edge point gives two conditions, its distances from the line along y and z,
which share the point's error. With target.use_face, the face beside the edge takes part: then z is
its normal, and the points of each face line replace the z condition of the edge point, which is
measured on that line.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, ENDINGS
from handeye_ros.estimation.problem import (
    Estimate,
    Observations,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.search import shortlisted
from handeye_ros.estimation.target import target_pose
from handeye_ros.profiles.faces import face_features
from handeye_ros.targets.profile_target import FACE, ProfileTarget, xyz
from handeye_ros.targets.starts import (
    best_fitting_first,
    linear_solutions,
    with_few_stations,
    with_one_candidate,
)
import numpy as np

EDGE_Y, EDGE_Z = 1, 2
LINE_SOLUTIONS = 24  # that are tried, of those over a grid of directions
SAME_FACE = 0.25  # rad: largest angle between the faces of two stations about the edge
# of ends, by Observations.ending: 0 no end, 1 roof, 2 step or shadow, 3 gap or open
END_GROUPS = np.array([0, *({'roof': 1, 'step': 2, 'shadow': 2}.get(end, 3) for end in ENDINGS)])


def _face_angles(observations: Observations, p: Array, state: Array) -> Array:
    """Return the angle (n,) of the face of each station about the line, from y (rad)."""
    T, face = target_pose(state), observations.kind == FACE
    local = ((p[face] - T[:3, 3]) @ T[:3, :3])[:, 1:]
    y, z = (np.bincount(observations.station[face], values, observations.station.max() + 1)
            for values in local.T)
    without_face = (y == 0) & (z == 0)
    return np.asarray(np.where(without_face, np.pi / 2, np.arctan2(z, y)))


def line_starts(problem: Problem) -> list[Estimate]:
    """Return starts of a problem whose edge points are all on the line."""
    obs = problem.observations
    each_point_once = replace(problem, observations=obs.select(obs.kind == EDGE_Y))
    return shortlisted(problem, linear_solutions(
        each_point_once, [0, 1, 2], slice(1, 3), LINE_SOLUTIONS))


def _with_face(problem: Problem, estimate: Estimate) -> Estimate:
    """Return the estimate with the target's z along the normal of the most frequent face."""
    p = problem.points_in_base(estimate.X)
    # twice the angle, as a number of the unit circle: a face is the same after half a turn
    faces = np.exp(2j * _face_angles(problem.observations, p, estimate.state))
    same_face = (faces[:, None] * faces.conj()).real > np.cos(2 * SAME_FACE)
    most_frequent = same_face[same_face.sum(axis=1).argmax()]
    turn = np.angle(faces[most_frequent].sum()) / 2
    T_turn = se3.transform(se3.exp_rotation(np.array([turn, 0.0, 0.0])), np.zeros(3))
    return replace(estimate, state=(estimate.T_base_target @ T_turn).ravel())


def problems_with_one_end(problem: Problem) -> Iterator[list[Problem]]:
    """
    Yield problems with one end of a face per station, chosen in several ways.

    If a face has several visible ends, it is unknown which one is the edge. Nearly all stations
    see a roof as a roof, whatever else ends a face (the sensor's reach, a step): the first
    problems have ends of one group each, that of most stations first, the last ones those of all
    groups. Where a station has several on both sides of the face, there is a problem for each.
    """
    edges = replace(problem, observations=problem.observations.select(
        problem.observations.kind != FACE))
    obs, end = edges.observations, LINE.candidates(edges.observations)
    group, side = np.zeros((2, len(edges.poses), int(end.max()) + 1))
    group[obs.station, end], side[obs.station, end] = END_GROUPS[obs.ending], obs.outward[:, 0]
    station_counts = {k: (group == k).any(axis=1).sum() for k in np.unique(group[group > 0])}
    present = sorted(station_counts, key=lambda k: (station_counts[k], k), reverse=True)
    for allowed in ([group == k for k in present] if len(present) > 1 else [], [group > 0]):
        yield with_one_candidate(edges, end, [np.where(is_allowed, rank, np.nan)
                                              for is_allowed in allowed for rank in (side, -side)])


class Line(ProfileTarget):
    """One straight edge: every edge point lies on one line of the base frame."""

    name = 'line'
    kinds = ('face', 'edge', 'edge_z')
    parameter_names, pose_axes = ('y', 'z', 'rx', 'ry', 'rz'), (1, 2, 3, 4, 5)
    normals = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, 0, 1.0]])
    extract = staticmethod(face_features)
    required_features = (EdgePoint,)
    edge_kinds = {EDGE_Y: 'edge'}
    min_samples = 7
    unassigned_edge_kinds = (EDGE_Y, EDGE_Z)

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first, from a grid of directions of the line."""
        target = problem.config.target
        without_face = replace(problem.config, target=replace(target, use_face=False))
        few = with_few_stations(replace(problem, config=without_face), rng)
        rounds = ([start for choice in choices for start in line_starts(choice)]
                  for choices in problems_with_one_end(few))
        for start in best_fitting_first(few, rounds):
            yield _with_face(problem, start) if target.use_face else start

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return that the turn about the line is none, without a face."""
        return {} if config.target.use_face else {'rx': (0.0, 0.0)}

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """
        Return the observations with their kinds assigned, unused ones marked.

        Of several edge points of a station, only the nearest to the line is used. With its face,
        the points of the face replace the z condition of the edge point. A station that shows
        another face (the edge of a block has two) takes part with its edge point alone.
        """
        is_edge, T = observations.kind != FACE, target_pose(state)
        distance = np.linalg.norm(((p - T[:3, 3]) @ T[:3, :3])[:, 1:], axis=1)
        nearest = np.full(observations.station.max() + 1, np.inf)
        np.minimum.at(nearest, observations.station[is_edge], distance[is_edge])
        with_face = np.zeros(len(nearest), dtype=bool)
        if config.target.use_face:
            turn = np.abs(_face_angles(observations, p, state))
            with_face = np.minimum(turn, np.pi - turn) < SAME_FACE
        replaced = np.where(with_face[observations.station], EDGE_Z, FACE)
        unused = (observations.kind == replaced) | (
            is_edge & (distance > nearest[observations.station]))
        return replace(observations, kind=np.where(unused, UNUSED, observations.kind))

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return a point of the line and its direction."""
        T = target_pose(state)
        return {'point': xyz(T[:3, 3]), 'direction': T[:3, 0].tolist()}


LINE = Line()
