# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The edge of a block, or a groove: two faces, both visible in every profile.

Frame of the target: x along the edge, the origin on it. Each face contains the edge and is turned
about it by an angle. Unknown beside X: the edge as a line (4) and the angles of the two faces (2).
A profile gives two face lines, each in its face, so they cross on the edge. The sides tell which
face is which, so it need not be stated.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.problem import (
    Estimate,
    linearise,
    Observations,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.search import shortlisted
from handeye_ros.profiles.faces import corner_features
from handeye_ros.targets import line as edge_line
from handeye_ros.targets.starts import (
    nearest_piece,
    sums_by_piece,
    with_few_stations,
    with_one_piece,
)
from handeye_ros.targets.target import FaceTarget, ObservationRows, xyz
import numpy as np
from numpy.typing import NDArray

KINDS = ('face_1', 'face_2')
# turn of each face for a change of the angle between them by 1
ANGLE_SHARES = np.array([-0.5, 0.5])
ANGLES_TRIED = 24  # angles tried for the pair of faces about a known edge


def one_corner(problem: Problem) -> list[Problem]:
    """
    Return problems with one pair of lines per station, chosen in several ways.

    A convex one: that of the longest faces, the nearest, or the farthest, as a block may have a
    step or stand beside another; a concave one, as a block and the table that it stands on make a
    groove, where the faces meet on the other side; or any, that of the longest faces.
    """
    obs, pair = problem.observations, WEDGE.pieces(problem.observations)
    if not WEDGE.ambiguous(obs):
        return [problem]
    n, z = (sums_by_piece(obs, pair, values) for values in (np.ones(len(pair)), obs.points[:, 1]))
    middle, depth = z / np.maximum(n, 1), np.full(n.shape, np.nan)  # of pairs and their corners
    for k in range(n.shape[1]):
        corner = crossings(obs.select(pair == k))
        depth[corner.station[::2], k] = corner.points[::2, 1]
    depth, middle = (problem.config.profile.range_sign * each for each in (depth, middle))
    order = np.broadcast_to(np.arange(float(n.shape[1])), n.shape)
    convex = middle > depth
    choices = [(order, convex), (depth, convex), (-depth, convex), (order, middle <= depth),
               (order, ~np.isnan(depth))]
    parts = with_one_piece(problem, pair, choices)
    return [part for part in parts if len(part.poses) >= WEDGE.min_samples]


def _guess(problem: Problem) -> list[Estimate]:
    """Return starts: the crossings of two lines per station lie on one edge, for any labels."""
    corners = crossings(problem.observations)
    edges = replace(problem, target=edge_line.LINE, observations=corners)
    return _refined(problem, [_with_faces(problem, e) for e in shortlisted(
        edges, edge_line.line_candidates(edges))])


def _refined(problem: Problem, starts: Sequence[Estimate]) -> list[Estimate]:
    """Return the estimates reached from the starts, with their labels, best first."""
    alike: dict[bytes, tuple[Problem, list[Estimate]]] = {}  # by their labels
    for start in starts:
        p = problem.points_in_base(start.X)
        labelled = WEDGE.reassign(problem.observations, p, start.state, problem.config)
        part = replace(problem, observations=labelled)
        alike.setdefault(labelled.kind.tobytes(), (part, []))[1].append(start)
    refined = [(float((linearise(labelled, end).residuals ** 2).sum()), end)
               for labelled, some in alike.values()
               for end in shortlisted(labelled, some, len(some))]
    return [end for _, end in sorted(refined, key=lambda pair: pair[0])]


def crossings(observations: Observations) -> Observations:
    """Return the conditions that the crossing of each station's two lines lies on an edge."""
    rows = ObservationRows()
    for station in np.unique(observations.station):
        of_station = observations.select(observations.station == station)
        (a, u), (b, v) = (_line_through(of_station.points[of_station.kind == side])
                          for side in range(2))
        # two lines that are parallel cross nowhere: any point of one of them then
        along = np.linalg.lstsq(np.column_stack([u, -v]), b - a, rcond=None)[0][0]
        for kind in (edge_line.EDGE_Y, edge_line.EDGE_Z):
            rows.add(int(station), (a + along * u)[None], kind, 1e-5 * np.eye(2)[None])
    return rows.observations()


def _line_through(points: Array) -> tuple[Array, Array]:
    """Return a point and the direction of the line fitted to points (k, 2)."""
    centre = points.mean(axis=0)
    return centre, np.linalg.svd(points - centre)[2][0]


def _with_faces(problem: Problem, edge: Estimate) -> Estimate:
    """Return the estimate with the turns of both faces fitted to the points."""
    T = edge.state.reshape(4, 4).copy()
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])
    local = (problem.points_in_base(edge.X) - T[:3, 3]) @ T[:3, :3]
    angle = np.arctan2(local[:, 2], local[:, 1])
    first, second = _two_directions(angle, np.hypot(local[:, 1], local[:, 2]))
    return Estimate(edge.X, np.append(T.ravel(), [first + np.pi / 2, second + np.pi / 2]))


def _two_directions(angle: Array, weight: Array) -> tuple[float, float]:
    """Return the two most frequent directions (rad) of angles (m,)."""
    best, least = (0.0, np.pi / 2), np.inf
    for parting in np.linspace(0.0, np.pi, ANGLES_TRIED, endpoint=False):
        side = np.sin(angle - parting) > 0
        sums = [(weight[part] * np.exp(1j * angle[part])).sum() for part in (side, ~side)]
        spread = weight.sum() - sum(abs(total) for total in sums)
        if spread < least:
            least = spread
            best = (float(np.angle(sums[0])), float(np.angle(sums[1])))
    return best


class Wedge(FaceTarget):
    """The edge of a block, or a groove: two faces, both visible in every profile."""

    name = 'wedge'
    kinds = KINDS
    labels, moves = ('y', 'z', 'ry', 'rz', 'turn', 'angle'), (1, 2, 4, 5)
    extract = staticmethod(corner_features)
    face_count, several_in_view = 2, True

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts; where several edges are visible, from each choice in turn."""
        choices = map(_guess, one_corner(with_few_stations(problem, rng)))
        for of_each in zip_longest(*choices):
            yield from filter(None, of_each)

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """Return the height over the face of each point."""
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

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """Return two lines per station, the best fitting ones, assigned to the two faces."""
        kind, pair = observations.kind, self.pieces(observations)
        group = observations.station * (int(pair.max()) + 1) + pair
        as_is, swapped = (self.conditions(p, k, state, config).g ** 2 for k in (kind, 1 - kind))
        better = (np.bincount(group, swapped) < np.bincount(group, as_is))[group]
        kind = np.where(better, 1 - kind, kind)
        chosen = nearest_piece(observations, pair, np.where(better, swapped, as_is))
        return replace(observations, kind=np.where(chosen, kind, UNUSED))

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the edge's point and direction, the faces' normals and their angle (rad)."""
        T, (first, second) = state[:16].reshape(4, 4), state[16:]
        between = float(np.arccos(np.clip(np.cos(second - first), -1.0, 1.0)))
        return {'point': xyz(T[:3, 3]),
                'direction': T[:3, 0].tolist(),
                **{f'normal_{k}': (np.cos(turn) * T[:3, 1] + np.sin(turn) * T[:3, 2]).tolist()
                   for k, turn in enumerate((first, second), 1)}, 'face_angle': between,
                'face_angle_std': float(std[5])}


WEDGE = Wedge()
