# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sphere: all points of all arcs are at the radius from one centre.

Unknown beside X: the centre in the base frame and, on demand, the radius. The side of the sensor
plane on which the centre lies need not be given.
"""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Feature, Sample
from handeye_ros.estimation.problem import (
    Estimate,
    Linear,
    Problem,
)
from handeye_ros.estimation.search import shortlisted
from handeye_ros.estimation.target import Conditions
from handeye_ros.profiles.arcs import arc_features, fit_circle
from handeye_ros.targets.starts import (
    frames_along,
    hemisphere,
    linear_solutions,
    with_few_stations,
)
from handeye_ros.targets.target import ObservationRows, ProfileTarget, xyz
import numpy as np
from numpy.typing import NDArray

DIRECTION_COUNT = 200  # of the normal of the sensor plane
CANDIDATE_COUNT = 16
LARGER = 1.05  # an unknown radius over that of the largest circle


def _candidates(problem: Problem, radius: float) -> list[Estimate]:
    """
    Return the best linear solutions over a sweep of the normal of the sensor plane.

    The centre of the sphere is at one place across it from the centres of all circles.
    """
    obs, poses = problem.observations, problem.poses
    bounds = np.searchsorted(obs.station, np.arange(1, len(poses)))
    circles = np.array([fit_circle(p, steps=1) for p in np.split(obs.points, bounds)])
    radius = radius or LARGER * float(circles[:, 2].max())
    height = np.sqrt(np.maximum(radius ** 2 - circles[:, 2] ** 2, 0.0))
    in_plane = frames_along(hemisphere(DIRECTION_COUNT))[:, None, :, 1:]
    X, centre, _ = linear_solutions(poses, circles[:, :2], poses[:, :3, :3] @ in_plane,
                                    CANDIDATE_COUNT)
    # along the normal it is at the height of each circle, on either side
    T = poses @ X[:, None]
    y = ((centre[:, None] - T[..., :3, 3]) * T[..., :3, 1]).sum(axis=-1)
    offsets = np.concatenate([y - height, y + height], axis=1)
    misfit = np.abs(np.abs(y[:, None] - offsets[:, :, None]) - height)
    best = (misfit ** 2).sum(axis=2).argmin(axis=1)
    X[:, :3, 3] += offsets[np.arange(len(X)), best, None] * X[:, :3, 1]
    return [Estimate(*both) for both in zip(X, np.insert(centre, 3, radius, axis=1), strict=True)]


class Sphere(ProfileTarget):
    """A sphere: all points of all arcs are at the radius from one centre."""

    name = 'sphere'
    kinds = ('arc',)
    labels = ('x', 'y', 'z', 'radius')
    free_shape = {'radius': 0.0}
    extract = staticmethod(arc_features)

    def add(self, rows: ObservationRows, station: int, feature: Feature, number: int) -> None:
        """Append the conditions of the normal points of an arc."""
        if isinstance(feature, Arc):
            outward = feature.points - feature.centre
            outward /= np.linalg.norm(outward, axis=1)[:, None]
            noise = np.zeros((len(outward), 2, 2))
            noise[:, :, 0] = outward * feature.std[:, None]
            rows.add(station, feature.points, 0, noise)

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return the radius if it is given."""
        target = config.target
        return {'radius': (target.radius, target.radius_std)} if target.radius > 0 else {}

    def measured(self, sample: Sample, points: Array, kind: NDArray[np.intp]
                 ) -> tuple[Array, NDArray[np.intp]]:
        """Return all raw points of the arcs of a sample."""
        arcs = [f.raw for f in sample.features if isinstance(f, Arc)]
        points = np.concatenate(arcs) if len(arcs) > 1 else arcs[0]
        return points, np.zeros(len(points), dtype=np.intp)

    def starts(self, whole: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first, from a sweep of the normal of the sensor plane."""
        problem = with_few_stations(whole, rng)
        yield from shortlisted(problem, _candidates(problem, problem.config.target.radius))

    def half_turn_misfit(self, linear: Linear) -> tuple[str, float]:
        """
        Return the line of the view about which half a turn changes least, and m RMS off it.

        An arc does not tell on which side of the sensor plane its centre lies.
        """
        poses = linear.problem.poses @ linear.estimate.X
        centres = (linear.estimate.state[:3] - poses[:, :3, 3])[:, None] @ poses[:, :3, [0, 2]]
        across = np.linalg.svd(centres[:, 0] - centres[:, 0].mean(axis=0))[1][-1]
        return 'on one line', float(across) / len(poses) ** 0.5

    def conditions(self, p: Array, kind: NDArray[np.intp], state: Array, config: Config
                   ) -> Conditions:
        """Return the distances from the sphere of points p (..., m, 3) in base."""
        outward = p - state[..., None, :3]
        x, y, z = outward[..., 0], outward[..., 1], outward[..., 2]
        distance = np.sqrt(x * x + y * y + z * z)
        outward /= distance[..., None]
        wrt_target = np.full((*p.shape[:-1], 4), -1.0)
        np.negative(outward, out=wrt_target[..., :3])
        return Conditions(distance - state[..., 3:], outward, wrt_target)

    def retract(self, state: Array, delta: Array) -> Array:
        """Return centres and radii (..., 4) after a step delta."""
        return state + delta

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the sphere's centre and radius as plain values."""
        return {'centre': xyz(state[:3]), 'radius': float(state[3]), 'radius_std': float(std[3])}


SPHERE = Sphere()
