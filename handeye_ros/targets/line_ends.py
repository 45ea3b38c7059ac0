"""
Which of the ends of a face in sight is the straight edge: ways to choose, for a start.

Each function returns problems of edge points alone; fewest: stations that one must have.
"""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Array
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.model import Observations
from handeye_ros.targets.common import edges_of, ENDS, FACE
import numpy as np
from numpy.typing import NDArray

CONDITIONS = 2  # of one edge point
GROUPS = np.array([0, *({'roof': 1, 'step': 2, 'shadow': 2}.get(end, 3) for end in ENDS)])
# of ends, by their number in observations: corners, steps, and ends with nothing behind them


def same_kind(problem: Problem, fewest: int) -> list[Problem]:
    """
    Return problems of the edge points of one group of kinds each, that of most stations first.

    A corner is seen as one in nearly all stations, whatever else ends a face in sight: the reach
    of the sensor, a step. Where several of a kind are in sight, those of either side follow.
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
    """Return the problem of the edge points, and where two are in sight that of either side."""
    edge = problem.observations.kind != FACE
    choices = [edge]
    if _several(problem):
        left = _left(problem)
        choices += [edge & left, edge & ~left]
    return [part for chosen in choices if (part := _part(problem, chosen, fewest)) is not None]


def other_choices(problem: Problem, fewest: int) -> list[Problem]:
    """
    Return problems with one of the ends in sight of each station.

    The best known one, as that where two faces meet; the most central, nearest, and farthest one;
    or the side that changes where the sensor is turned around.
    """
    if not _several(problem):
        return []
    obs, edge = problem.observations, problem.observations.kind != FACE
    x, z = obs.points.T
    sizes = np.linalg.norm(obs.noise, axis=(1, 2))
    ranks = [sizes, np.abs(x - np.median(x[edge])), z, -z]
    choices = [edge & _least(obs, rank, edge) for rank in ranks]
    around = _turned_around(problem.poses)[obs.station]
    if around.any():
        side = _left(problem) ^ around
        choices += [edge & side, edge & ~side]
    return [part for chosen in choices if (part := _part(problem, chosen, fewest)) is not None]


def _several(problem: Problem) -> bool:
    """Return whether some station shows several ends of a face."""
    obs = problem.observations
    return bool((obs.kind == FACE).any()
                and np.bincount(obs.station[obs.kind != FACE]).max(initial=0) > CONDITIONS)


def _left(problem: Problem) -> NDArray[np.bool_]:
    """Return which observations (m,) lie left of the middle of their station's face."""
    obs, n = problem.observations, len(problem.poses)
    face = obs.kind == FACE
    total = np.bincount(obs.station[face], obs.points[face, 0], minlength=n)
    middle = total / np.maximum(np.bincount(obs.station[face], minlength=n), 1)
    return np.asarray(obs.points[:, 0] < middle[obs.station])


def _least(obs: Observations, rank: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which observations (m,) have the least rank among those of their station."""
    least = np.full(obs.station.max() + 1, np.inf)
    np.minimum.at(least, obs.station[among], rank[among])
    return np.asarray(rank <= least[obs.station])


def _turned_around(poses: Array) -> NDArray[np.bool_]:
    """Return which of poses (n, 4, 4) are turned by more than a right angle from the first."""
    trace = np.einsum('ij,nij->n', poses[0, :3, :3], poses[:, :3, :3])
    return np.asarray(trace < 1.0)


def _part(problem: Problem, chosen: NDArray[np.bool_], fewest: int) -> Problem | None:
    """Return the problem of the chosen observations (m,), None where too few stations have any."""
    part = replace(problem, observations=problem.observations.select(chosen))
    stations = np.unique(part.observations.station)
    everything = chosen[problem.observations.kind != FACE].all()
    return part.subset(stations) if len(stations) >= fewest or everything else None
