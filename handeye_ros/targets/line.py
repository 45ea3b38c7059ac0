# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One straight edge: every edge point lies on one line of the base frame.

Frame of the target: x along the line, the origin its point nearest to the mean position of the
mount in the guess. An edge point gives two conditions, its distances from the line along y and z,
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
from handeye_ros.data import Array, ENDINGS
from handeye_ros.estimation.problem import (
    Estimate,
    Observations,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.search import shortlisted
from handeye_ros.profiles.faces import face_features
from handeye_ros.targets.profile_target import FACE, ProfileTarget, xyz
from handeye_ros.targets.starts import (
    fitting_first,
    over_directions,
    with_few_stations,
    with_one_piece,
)
import numpy as np

EDGE_Y, EDGE_Z = 1, 2
CANDIDATE_COUNT = 24
SAME_FACE = 0.25  # rad: largest angle between the faces of two stations about the edge
# of ends, by their number in observations: 1 corner, 2 step, 3 nothing beyond
END_GROUPS = np.array([0, *({'roof': 1, 'step': 2, 'shadow': 2}.get(end, 3) for end in ENDINGS)])


def _face_angles(observations: Observations, p: Array, state: Array) -> Array:
    """Return the angle (n,) of the face of each station about the line, from y (rad)."""
    T, face = state.reshape(4, 4), observations.kind == FACE
    local = ((p[face] - T[:3, 3]) @ T[:3, :3])[:, 1:]
    y, z = (np.bincount(observations.station[face], values, observations.station.max() + 1)
            for values in local.T)
    return np.asarray(np.where((y == 0) & (z == 0), np.pi / 2, np.arctan2(z, y)))


def line_starts(problem: Problem) -> list[Estimate]:
    """Return starts of a problem whose edge points are all on the line."""
    obs = problem.observations
    part = replace(problem, observations=obs.select(obs.kind == EDGE_Y))
    return shortlisted(problem, over_directions(part, [0, 1, 2], slice(1, 3), CANDIDATE_COUNT))


def _with_face(problem: Problem, estimate: Estimate) -> Estimate:
    """Return the estimate with the target's z along the normal of the most frequent face."""
    p = problem.points_in_base(estimate.X)
    # a face is the same after half a turn
    faces = np.exp(2j * _face_angles(problem.observations, p, estimate.state))
    near = (faces[:, None] * faces.conj()).real > np.cos(2 * SAME_FACE)
    turn = np.angle(faces[near[near.sum(axis=1).argmax()]].sum()) / 2
    T_turn = se3.transform(se3.exp_rotation(np.array([turn, 0.0, 0.0])), np.zeros(3))
    return replace(estimate, state=(estimate.state.reshape(4, 4) @ T_turn).ravel())


def one_end(problem: Problem) -> Iterator[list[Problem]]:
    """
    Yield problems with one end of a face per station, chosen in several ways.

    If a face has several visible ends, it is unknown which one is the edge. Nearly all stations
    see a corner as a corner, whatever else ends a face (the sensor's reach, a step): first there
    are problems with one kind of end each, the most frequent first, then those with all; of either
    side of the face where a station shows several.
    """
    edges = replace(problem, observations=problem.observations.select(
        problem.observations.kind != FACE))
    obs, end = edges.observations, LINE.pieces(edges.observations)
    group, side = np.zeros((2, len(edges.poses), int(end.max()) + 1))
    group[obs.station, end], side[obs.station, end] = END_GROUPS[obs.ending], obs.outward[:, 0]
    stations = [int((group == k).any(axis=1).sum()) for k in range(1, END_GROUPS.max() + 1)]
    present = [group == k + 1 for k in np.argsort(stations)[::-1] if stations[k]]
    for choices in (present[:len(present) * (len(present) > 1)], [group > 0]):
        yield with_one_piece(edges, end, [np.where(chosen, rank, np.nan)
                                          for chosen in choices for rank in (side, -side)])


class Line(ProfileTarget):
    """One straight edge: every edge point lies on one line of the base frame."""

    name = 'line'
    kinds = ('face', 'edge', 'edge_z')
    parameter_names, pose_axes = ('y', 'z', 'rx', 'ry', 'rz'), (1, 2, 3, 4, 5)
    normals = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, 0, 1.0]])
    extract = staticmethod(face_features)
    essential = ('edge',)
    min_samples = 7
    edge_kinds = (EDGE_Y, EDGE_Z)

    def starts(self, whole: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first, from a sweep of the direction of the line."""
        target = whole.config.target
        alone = replace(whole.config, target=replace(target, use_face=False))
        problem = with_few_stations(replace(whole, config=alone), rng)
        for e in fitting_first(problem, (
                [e for part in parts for e in line_starts(part)] for parts in one_end(problem))):
            yield _with_face(whole, e) if target.use_face else e

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return that the turn about the line is none, without a face."""
        return {} if config.target.use_face else {'rx': (0.0, 0.0)}

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """
        Return the observations labelled, unused ones marked.

        Of several edge points of a station, only the nearest to the line is used. A station that
        shows another face (the edge of a block has two) takes part with its edge point alone.
        """
        edge, T = observations.kind != FACE, state.reshape(4, 4)
        away = np.linalg.norm(((p - T[:3, 3]) @ T[:3, :3])[:, 1:], axis=1)
        nearest = np.full(observations.station.max() + 1, np.inf)
        np.minimum.at(nearest, observations.station[edge], away[edge])
        with_face = np.zeros(len(nearest), dtype=bool)
        if config.target.use_face:
            turn = np.abs(_face_angles(observations, p, state))
            with_face = np.minimum(turn, np.pi - turn) < SAME_FACE
        idle = np.where(with_face[observations.station], EDGE_Z, FACE)
        unused = (observations.kind == idle) | (edge & (away > nearest[observations.station]))
        return replace(observations, kind=np.where(unused, UNUSED, observations.kind))

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return a point of the line and its direction."""
        T = state.reshape(4, 4)
        return {'point': xyz(T[:3, 3]), 'direction': T[:3, 0].tolist()}


LINE = Line()
