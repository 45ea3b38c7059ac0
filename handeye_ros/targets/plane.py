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
    some_of,
    sums_by_piece,
    with_one_piece,
)
from handeye_ros.targets.target import FaceTarget
import numpy as np
from numpy.typing import NDArray

NORMAL_COUNT = 400
CANDIDATE_COUNT = 10
TINY = 1e-30  # m^2


def nearest_surface(problem: Problem) -> Problem:
    """Return the problem with one surface per station, the nearest."""
    obs = problem.observations
    surface, (x, z) = PLANE.pieces(obs), obs.points.T
    n, x, z, xx, xz = (sums_by_piece(obs, surface, values)
                       for values in (np.ones_like(x), x, z, x * x, x * z))
    some = np.maximum(n, 1.0)
    slope = ((xz - x * z / some) / np.maximum(xx - x * x / some, TINY))[:, :1]
    # of tilted surfaces, the nearer one lies above the extended line of the longest
    depth = problem.config.profile.range_sign * (z / some - slope * x / some)
    return with_one_piece(problem, surface, [(depth, n > 0)])[0]


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
        """
        Yield starts, best first; of few stations, which fit in many wrong ways, then all.

        Of several surfaces of a station the nearest is used.
        """
        problem = some_of(replace(whole, target=PLANE), rng)
        if self.ambiguous(problem.observations):
            problem = nearest_surface(problem)
        candidates: list[Estimate] = []
        for more in (1, NORMAL_COUNT // CANDIDATE_COUNT) if whole.needs_more_starts else (1,):
            known = len(candidates)
            candidates += shortlisted(problem, plane_candidates(problem, more), more)
            yield from (candidates[i] for i in distinct(np.array([e.X for e in candidates]))
                        if i >= known)

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
