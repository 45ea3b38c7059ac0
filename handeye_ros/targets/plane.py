# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A plane: one straight piece of each profile lies on it; its border is not used.

If several surfaces are visible, each station uses the one that fits the plane, so that all
stations use the same surface.

Frame of the target: any point of the plane as origin, z its normal, towards the sensor.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.problem import (
    Estimate,
    Observations,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.search import distinct, shortlisted
from handeye_ros.profiles.faces import plane_features
from handeye_ros.targets.starts import (
    frames_along,
    hemisphere,
    linear_candidates,
    nearest_piece,
    sums_by_piece,
    with_few_stations,
    with_one_piece,
)
from handeye_ros.targets.target import FaceTarget
import numpy as np
from numpy.typing import NDArray

NORMAL_COUNT = 400
CANDIDATE_COUNT = 10
NEAR_SHARE = 0.7  # of the stations
AS_NEAR = 2.0  # ratio to the smallest distance of a start, up to which the surfaces' order decides
ONE_ANGLE = 0.05  # rad: angles to the plane that differ by less count as one
TINY = 1e-30  # m^2


def one_surface(problem: Problem) -> list[Problem]:
    """
    Return problems with one surface per station: the nearest, longest, or farthest.

    Only the problem itself if no station shows several surfaces.
    """
    obs = problem.observations
    if not PLANE.ambiguous(obs):
        return [problem]
    surface, (x, z) = PLANE.pieces(obs), obs.points.T
    n, x, z, xx, xz = (sums_by_piece(obs, surface, values)
                       for values in (np.ones_like(x), x, z, x * x, x * z))
    some = np.maximum(n, 1.0)
    slope = ((xz - x * z / some) / np.maximum(xx - x * x / some, TINY))[:, :1]
    # of tilted surfaces, the nearer one lies above the extended line of the longest
    depth = problem.config.profile.range_sign * (z / some - slope * x / some)
    order = np.broadcast_to(np.arange(n.shape[1], dtype=float), n.shape)
    return with_one_piece(problem, surface, [(rank, n > 0) for rank in (depth, order, -depth)])


def _typical_distance(problem: Problem, estimate: Estimate) -> float:
    """Return the distance (m) from the plane within which most stations have a surface."""
    p = problem.points_in_base(estimate.X)
    labelled = PLANE.reassign(problem.observations, p, estimate.state, problem.config)
    used = labelled.kind != UNUSED
    station, n = labelled.station[used], len(problem.poses)
    away = PLANE.conditions(p[used], labelled.kind[used], estimate.state, problem.config).g
    count = np.maximum(np.bincount(station, minlength=n), 1)
    return float(np.quantile(np.bincount(station, away ** 2, n) / count, NEAR_SHARE) ** 0.5)


def plane_candidates(problem: Problem, more: int = 1) -> list[Estimate]:
    """Return the best linear solutions, many times `more`, over a sweep of plane normals."""
    frames = frames_along(hemisphere(NORMAL_COUNT))[:, :, [1, 2, 0]]
    return linear_candidates(problem, frames, slice(2, 3), CANDIDATE_COUNT * more)


class Plane(FaceTarget):
    """A plane: one straight piece of each profile lies on it; its border is not used."""

    name = 'plane'
    kinds = ('face',)
    several_in_view = True
    labels, moves = ('z', 'rx', 'ry'), (2, 3, 4)
    extract = staticmethod(plane_features)
    one_axis = ('the position along it is free, and if it is the normal of the plane (yaw only) '
                'all of the position and part of the rotation')

    def starts(self, whole: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first; of few stations, which fit in many wrong ways, then all."""
        problem = with_few_stations(replace(whole, target=PLANE), rng)
        candidates: list[Estimate] = []
        for more in (1, NORMAL_COUNT // CANDIDATE_COUNT) if whole.needs_more_starts else (1,):
            known = len(candidates)
            for of_surface in one_surface(problem):
                candidates += shortlisted(of_surface, plane_candidates(of_surface, more), more)
            fresh = [i for i in distinct(np.array([e.X for e in candidates])) if i >= known]
            if self.ambiguous(problem.observations):
                away = {i: _typical_distance(problem, candidates[i]) for i in fresh}
                fresh.sort(key=lambda i: away[i] > AS_NEAR * min(away.values()))
            yield from (candidates[i] for i in fresh)

    def views_alike(self, problem: Problem, estimate: Estimate) -> str:
        """Return in words that all samples see the plane at one angle, '' if they do not."""
        range_axes = problem.poses[:, :3, :3] @ estimate.X[:3, 2]
        normal = estimate.state.reshape(4, 4)[:3, 2]
        angles = np.arccos(np.clip(np.abs(range_axes @ normal), 0.0, 1.0))
        if np.ptp(angles) > ONE_ANGLE:
            return ''
        mean = np.degrees(angles.mean())
        return (f'all samples see the plane at one angle ({mean:.0f} degrees between its normal '
                'and the range axis), so that a shift of the sensor along the range cannot be '
                'told from one of the plane: take samples square to the plane too, and at other '
                'angles')

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """Return the height over the plane, and its derivatives."""
        return local[..., 2], np.broadcast_to([0.0, 0.0, 1.0], local.shape), np.empty(
            (*local.shape[:-1], 0))

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """Return the observations with one surface per station: the longest of the near ones."""
        if not self.ambiguous(observations):
            return observations
        squares = self.conditions(p, observations.kind, state, config).g ** 2
        chosen = nearest_piece(observations, self.pieces(observations), squares)
        return replace(observations, kind=np.where(chosen, observations.kind, UNUSED))

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the plane's normal and distance from the base."""
        T = state.reshape(4, 4)
        return {'normal': T[:3, 2].tolist(), 'distance': float(T[:3, 2] @ T[:3, 3])}


PLANE = Plane()
