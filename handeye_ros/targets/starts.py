# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Starts from nothing: the ends of faces that belong to the line; the two edges of a plate."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Array
from handeye_ros.estimation.problem import Problem
from handeye_ros.targets.common import edges_of, ENDS, FACE, some_stations
import numpy as np
from numpy.typing import NDArray

CONDITIONS = 2  # of one edge point
GROUPS = np.array([0, *({'roof': 1, 'step': 2, 'shadow': 2}.get(end, 3) for end in ENDS)])
# of ends, by their number in observations: 1 corner, 2 step, 3 nothing behind


def same_kind(problem: Problem, fewest: int) -> list[Problem]:
    """
    Return problems with edge points of one group of kinds each, the most frequent first.

    Nearly all stations see a corner as a corner, whatever else ends a face (the sensor's reach, a
    step). If a station shows several of a kind, those of either side follow.
    """
    obs = problem.observations
    group = np.where(obs.kind == FACE, 0, GROUPS[edges_of(obs).end])
    stations = [len(np.unique(obs.station[group == k])) for k in range(GROUPS.max() + 1)]
    present = [k for k in np.argsort(stations)[::-1].tolist() if k and stations[k]]
    if len(present) < 2:
        return []
    left = _left(problem)
    choices = [(group == k) & side for k in present for side in (True, left, ~left)]
    parts = [_part(problem, chosen, fewest) for chosen in choices]
    return [part for i, part in enumerate(parts) if part is not None and (
        i % 3 == 0 or np.bincount(obs.station[choices[i - i % 3]]).max() > CONDITIONS)]


def same_side(problem: Problem, fewest: int) -> list[Problem]:
    """Return problems with all edge points, or the left or right ones where there are several."""
    edge = problem.observations.kind != FACE
    choices = [edge]
    if _several(problem):
        left = _left(problem)
        choices += [edge & left, edge & ~left]
    return [part for chosen in choices if (part := _part(problem, chosen, fewest)) is not None]


def _several(problem: Problem) -> bool:
    """Return whether any station shows several ends of a face."""
    obs = problem.observations
    return bool((obs.kind == FACE).any()
                and np.bincount(obs.station[obs.kind != FACE]).max(initial=0) > CONDITIONS)


def _left(problem: Problem) -> NDArray[np.bool_]:
    """Return which observations (m,) are left of the centre of their station's face."""
    obs, n = problem.observations, len(problem.poses)
    face = obs.kind == FACE
    total = np.bincount(obs.station[face], obs.points[face, 0], minlength=n)
    middle = total / np.maximum(np.bincount(obs.station[face], minlength=n), 1)
    return np.asarray(obs.points[:, 0] < middle[obs.station])


def _part(problem: Problem, chosen: NDArray[np.bool_], fewest: int) -> Problem | None:
    """Return the problem of chosen observations (m,), None if too few stations have any."""
    part = replace(problem, observations=problem.observations.select(chosen))
    stations = np.unique(part.observations.station)
    everything = chosen[problem.observations.kind != FACE].all()
    return part.subset(stations) if len(stations) >= fewest or everything else None


DIRECTIONS = 120  # tried, over a quarter turn
VOTERS = 24  # points that this search uses


def two_lines(points: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """
    Return corner (2,) and direction (rad) of the best two perpendicular lines through points.

    points: (m, 2). All directions, and all pairs of points for the lines, are tried. The cost of a
    point is its distance to the nearer line, limited.
    """
    voters = points[some_stations(len(points), VOTERS, rng)]
    angles = np.linspace(0.0, np.pi / 2, DIRECTIONS, endpoint=False)
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = c * voters[:, 0] + s * voters[:, 1], c * voters[:, 1] - s * voters[:, 0]
    limit = 0.03 * float(np.ptp(voters, axis=0).max() + 1e-9)
    to_q, to_p = (np.minimum(np.abs(w.T[:, :, None] - w), limit).astype(np.float32)
                  for w in (u, v))  # (point, angle, line through)
    total = np.zeros((*u.shape, len(voters)), dtype=np.float32)
    for of_q, of_p in zip(to_q, to_p, strict=True):
        total += np.minimum(of_q[:, :, None], of_p[:, None])
    k, i, j = np.unravel_index(int(np.argmin(total)), total.shape)
    turn = float(angles[k])
    return _fitted(points, turned(turn) @ np.array([u[k, i], v[k, j]]), turn, limit)


def _fitted(points: Array, corner: Array, turn: float, limit: float) -> tuple[Array, float]:
    """Return corner and direction fitted to the points (m, 2) near either line."""
    for reach in (limit, limit / 2, limit / 4):
        x, y = ((points - corner) @ turned(turn)).T
        on_p, on_q = np.abs(y) < np.minimum(np.abs(x), reach), np.abs(x) < np.minimum(
            np.abs(y), reach)
        A = np.concatenate([
            np.column_stack([np.zeros(on_p.sum()), np.ones(on_p.sum()), x[on_p]]),
            np.column_stack([np.ones(on_q.sum()), np.zeros(on_q.sum()), -y[on_q]])])
        step = np.linalg.lstsq(A, np.concatenate([y[on_p], x[on_q]]), rcond=None)[0]
        corner, turn = corner + turned(turn) @ step[:2], turn + float(step[2])
    return corner, turn


def turned(turn: float) -> Array:
    """Return the (2, 2) rotation by an angle."""
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
