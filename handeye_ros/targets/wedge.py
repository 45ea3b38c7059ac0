# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The edge of a block, or a groove: two faces, both visible in every profile.

Frame of the target: x along the edge, the origin on it. Each face contains the edge and is turned
about it by an angle, which the state holds. Unknown beside X: the edge as a line (four
parameters), a common turn of both faces about it, and the angle between them. A profile gives two
face lines, each in its face, so they cross on the edge. The sides tell which face is which, so it
need not be stated.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, FaceLine
from handeye_ros.estimation.problem import Estimate, Observations, Problem
from handeye_ros.estimation.target import target_pose
from handeye_ros.profiles.faces import face_pair_features
from handeye_ros.targets.line import EDGE_Y, EDGE_Z, LINE, line_starts
from handeye_ros.targets.profile_target import observations_at, ProfileTarget, xyz
from handeye_ros.targets.starts import (
    best_fitting_first,
    lines_of_parts,
    with_few_stations,
    with_one_candidate,
)
import numpy as np
from numpy.typing import NDArray

# turn of each face for a change of the angle between them by 1
ANGLE_SHARES = np.array([-0.5, 0.5])
CORNER_STD = 1e-5  # 1 sigma of where two lines cross, for a start (m)


def problems_with_one_corner(problem: Problem) -> list[Problem]:
    """
    Return problems with one pair of lines per station, chosen in several ways.

    A convex one: that of the longest faces, the nearest, or the farthest, as a block may have a
    step or stand beside another; a concave one, as a block and the table that it stands on make a
    groove, where the faces meet on the other side; or any, that of the longest faces.
    """
    obs, pair = problem.observations, WEDGE.candidates(problem.observations)
    if not WEDGE.shows_several(obs):
        return [problem]
    corner, mean_range = corners(obs, pair)
    sign = problem.config.profile.range_sign
    depth, is_convex = sign * corner[..., 1], sign * mean_range > sign * corner[..., 1]
    by_length = np.where(np.isnan(depth), np.nan, np.arange(depth.shape[1]))
    return with_one_candidate(problem, pair, [
        *(np.where(is_convex, rank, np.nan) for rank in (by_length, depth, -depth)),
        np.where(is_convex, np.nan, by_length), by_length])


def corners(observations: Observations, pair: NDArray[np.intp]) -> tuple[Array, Array]:
    """
    Return where the lines of each pair cross (stations, pairs, 2), and their mean range.

    pair: (m,) the pair of each observation. Both are NaN where a station has no such pair.
    """
    (x_1, x_2), (z_1, z_2), (slope_1, slope_2) = (
        (values[:, ::2], values[:, 1::2])
        for values in lines_of_parts(observations, 2 * pair + observations.kind))
    # two lines that are parallel cross nowhere: any point of one of them then
    difference = np.where(slope_1 == slope_2, np.inf, slope_1 - slope_2)
    along_x = (z_2 - z_1 - slope_2 * (x_2 - x_1)) / difference
    return np.stack([x_1 + along_x, z_1 + slope_1 * along_x], axis=-1), (z_1 + z_2) / 2


def _starts(problem: Problem) -> list[Estimate]:
    """Return starts by the crossing of the two lines of each station: these lie on one edge."""
    obs, root = problem.observations, CORNER_STD * np.eye(2)[None]
    crossings = Observations.concatenated([
        observations_at(station, corner, kind, root)
        for station, corner in enumerate(corners(obs, np.zeros_like(obs.kind))[0])
        for kind in (EDGE_Y, EDGE_Z)])
    edges = replace(problem, target=LINE, observations=crossings)
    return [_with_faces(problem, edge) for edge in line_starts(edges)]


def _with_faces(problem: Problem, edge: Estimate) -> Estimate:
    """Return the estimate with the turns of both faces fitted to the points."""
    T = edge.T_base_target.copy()
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])
    _, y, z = ((problem.points_in_base(edge.X) - T[:3, 3]) @ T[:3, :3]).T
    across = y + 1j * z  # the mean of all lies between the faces
    is_first = (across * across.sum().conjugate()).imag > 0
    turns = [np.angle(across[face].sum()) + np.pi / 2 for face in (is_first, ~is_first)]
    return Estimate(edge.X, np.append(T.ravel(), turns))


class Wedge(ProfileTarget):
    """The edge of a block, or a groove: two faces, both visible in every profile."""

    name = 'wedge'
    kinds = ('face_1', 'face_2')
    parameter_names, pose_axes = ('y', 'z', 'ry', 'rz', 'turn', 'angle'), (1, 2, 4, 5)
    extract = staticmethod(face_pair_features)
    required_features = (FaceLine, FaceLine)
    face_count, several_in_view = 2, True

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts; where several edges are visible, from each choice of one."""
        few = with_few_stations(problem, rng)
        return best_fitting_first(few, [[start for choice in problems_with_one_corner(few)
                                         for start in _starts(choice)]])

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """Return heights over the faces (m); measures: (..., 2) turns of both faces (rad)."""
        turn = measures[..., kind]
        c, s = np.cos(turn), np.sin(turn)
        y, z = local[..., 1], local[..., 2]
        wrt_turn = c * z - s * y
        return (c * y + s * z, np.stack([np.zeros_like(c), c, s], axis=-1),
                np.stack([wrt_turn, ANGLE_SHARES[kind] * wrt_turn], axis=-1))

    def retract(self, state: Array, delta: Array) -> Array:
        """Return targets (..., 18) after a step: moves, and the turn and angle of both faces."""
        turns = delta[..., 4:5] + ANGLE_SHARES * delta[..., 5:]
        return super().retract(state, np.concatenate([delta[..., :4], turns], axis=-1))

    def measures(self, state: Array) -> dict[str, float]:
        """Return the mean turn of both faces about the edge, and the angle between them (rad)."""
        first, second = state[16:].tolist()
        return {'turn': (first + second) / 2, 'angle': second - first}

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """Return the observations with the best pair of lines per station, each on its face."""
        kind, pair = observations.kind, self.candidates(observations)
        group = observations.station * (int(pair.max()) + 1) + pair
        unswapped, swapped = (self.conditions(p, k, state, config).g ** 2
                              for k in (kind, 1 - kind))
        better = (np.bincount(group, swapped) < np.bincount(group, unswapped))[group]
        assigned = replace(observations, kind=np.where(better, 1 - kind, kind))
        return super().reassign(assigned, p, state, config)

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the edge's point and direction, the faces' normals and their angle (rad)."""
        T, turns = target_pose(state), state[16:]
        normals = np.outer(np.cos(turns), T[:3, 1]) + np.outer(np.sin(turns), T[:3, 2])
        between = float(np.arccos(np.clip(normals[0] @ normals[1], -1.0, 1.0)))
        return {'point': xyz(T[:3, 3]), 'direction': T[:3, 0].tolist(),
                'normal_1': normals[0].tolist(), 'normal_2': normals[1].tolist(),
                'face_angle': between, 'face_angle_std': float(std[-1])}


WEDGE = Wedge()
