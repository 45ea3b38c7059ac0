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
from handeye_ros.targets.starts import (
    frames_along,
    hemisphere,
    linear_candidates,
    with_few_stations,
)
from handeye_ros.targets.target import FACE, FaceTarget, xyz
import numpy as np
from numpy.typing import NDArray

EDGE_Y, EDGE_Z = 1, 2
KINDS = ('face', 'edge', 'edge_z')
NORMALS = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, 0, 1.0]])
DIRECTION_COUNT = 400
CANDIDATE_COUNT = 24
MIN_SAMPLES = 7
NEAR_SHARE = 0.7
SAME_FACE = 0.25  # rad: largest angle between the faces of two stations about the edge
CONDITIONS_OF_EDGE = 2  # of one edge point
# of ends, by their number in observations: 1 corner, 2 step, 3 nothing beyond
END_GROUPS = np.array([0, *({'roof': 1, 'step': 2, 'shadow': 2}.get(end, 3) for end in ENDINGS)])


def _face_angles(observations: Observations, p: Array, state: Array) -> Array:
    """Return the angle (n,) of the face of each station about the line, from y (rad)."""
    T, face = state.reshape(4, 4), observations.kind == FACE
    local = ((p[face] - T[:3, 3]) @ T[:3, :3])[:, 1:]
    y, z = (np.bincount(observations.station[face], values, observations.station.max() + 1)
            for values in local.T)
    return np.asarray(np.where((y == 0) & (z == 0), np.pi / 2, np.arctan2(z, y)))


def _typical_distance(problem: Problem, estimate: Estimate) -> float:
    """Return the distance (m) from the line within which most stations have an edge point."""
    edge = problem.observations.select(problem.observations.kind == EDGE_Y)
    away = _away(edge.in_base(problem.poses, estimate.X), estimate.state)
    nearest = np.full(len(problem.poses), np.inf)
    np.minimum.at(nearest, edge.station, away)
    return float(np.quantile(nearest[np.isfinite(nearest)], NEAR_SHARE))


def _away(p: Array, state: Array) -> Array:
    """Return the distances (m,) from the line of points (m, 3) in base."""
    T = state.reshape(4, 4)
    return np.asarray(np.linalg.norm(((p - T[:3, 3]) @ T[:3, :3])[:, 1:], axis=1))


def line_candidates(problem: Problem) -> list[Estimate]:
    """Return the best linear solutions over a sweep of the direction of the line."""
    obs = problem.observations
    part = replace(problem, observations=obs.select(obs.kind == EDGE_Y))
    return linear_candidates(part, frames_along(hemisphere(DIRECTION_COUNT)), slice(1, 3),
                             CANDIDATE_COUNT)


def _with_face(problem: Problem, estimate: Estimate) -> Estimate:
    """Return the estimate with the target's z along the normal of the most frequent face."""
    T = estimate.state.reshape(4, 4)
    p = problem.points_in_base(estimate.X)
    angle = 2 * _face_angles(problem.observations, p, estimate.state)
    near = np.cos(angle[:, None] - angle) > np.cos(2 * SAME_FACE)
    middle = angle[np.argmax(near.sum(axis=1))]
    chosen = angle[np.cos(angle - middle) > np.cos(2 * SAME_FACE)]
    middle = np.angle(np.exp(1j * chosen).sum()) / 2
    y, z = np.cos(middle), np.sin(middle)
    turn = np.array([[1.0, 0, 0], [0, y, -z], [0, z, y]])
    return replace(estimate, state=se3.transform(T[:3, :3] @ turn, T[:3, 3]).ravel())


def one_end(problem: Problem) -> Iterator[list[Problem]]:
    """
    Yield problems with one end of a face per station, chosen in several ways.

    If a face has several visible ends, it is unknown which one is the edge. Nearly all stations
    see a corner as a corner, whatever else ends a face (the sensor's reach, a step): first there
    are problems with one kind of end each, the most frequent first, then those with all. If a
    station shows several of them, those of either side of the face follow.
    """
    obs, n = problem.observations, len(problem.poses)
    face = obs.kind == FACE
    group = np.where(face, 0, END_GROUPS[obs.ending])
    total, count = (np.bincount(obs.station[face], weights, n)
                    for weights in (obs.points[face, 0], None))
    left = obs.points[:, 0] < (total / np.maximum(count, 1))[obs.station]
    stations = [len(np.unique(obs.station[group == k])) for k in range(END_GROUPS.max() + 1)]
    present = [k for k in np.argsort(stations)[::-1].tolist() if k and stations[k]]
    for choices in ([group == k for k in present] if len(present) > 1 else [], [~face]):
        parts = []
        for chosen in choices:
            several = face.any() and (
                np.bincount(obs.station[chosen]).max(initial=0) > CONDITIONS_OF_EDGE)
            parts += [_part(problem, chosen & side)
                      for side in ((True, left, ~left) if several else (True,))]
        yield [part for part in parts if part is not None]


def _part(problem: Problem, chosen: NDArray[np.bool_]) -> Problem | None:
    """Return the problem of chosen observations (m,), None if too few stations have any."""
    part = replace(problem, observations=problem.observations.select(chosen))
    stations = np.unique(part.observations.station)
    everything = chosen[problem.observations.kind != FACE].all()
    return part.subset(stations) if len(stations) >= MIN_SAMPLES or everything else None


class Line(FaceTarget):
    """One straight edge: every edge point lies on one line of the base frame."""

    name = 'line'
    kinds = KINDS
    labels, moves = ('y', 'z', 'rx', 'ry', 'rz'), (1, 2, 3, 4, 5)
    extract = staticmethod(face_features)
    essential = ('edge',)
    min_samples = MIN_SAMPLES
    edge_kinds = (EDGE_Y, EDGE_Z)

    def starts(self, whole: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first, from a sweep of the direction of the line."""
        target = whole.config.target
        alone = replace(whole.config, target=replace(target, use_face=False))
        problem = with_few_stations(replace(whole, config=alone), rng)
        for parts in one_end(problem):
            starts = (e for half in parts for e in shortlisted(half, line_candidates(half)))
            for e in sorted(starts, key=lambda estimate: _typical_distance(problem, estimate)):
                yield _with_face(whole, e) if target.use_face else e

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """Return the distances from the line in y and z, or from the face."""
        normals = NORMALS[kind]
        g = (local * normals).sum(axis=-1)
        return g, np.broadcast_to(normals, local.shape), np.empty((*g.shape, 0))

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
        edge, away = observations.kind != FACE, _away(p, state)
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
