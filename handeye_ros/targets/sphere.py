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

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Sample
from handeye_ros.estimation.problem import (
    Estimate,
    Linearisation,
    Problem,
)
from handeye_ros.estimation.search import shortlisted
from handeye_ros.estimation.target import target_pose
from handeye_ros.profiles.arcs import arc_features, fit_circle
from handeye_ros.targets.profile_target import ProfileTarget, xyz
from handeye_ros.targets.starts import with_few_stations
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ROTATION_COUNT = 1200
SPHERE_SOLUTIONS = 16  # that are tried, of those with random rotations of the sensor
START_RADIUS_RATIO = 1.05  # an unknown radius over that of the largest circle
# regularisation: weight of a centre at the middle of the poses, and of no shift of the sensor in
# its plane
MIDDLE_WEIGHT = 1e-9


def _linear_solutions(problem: Problem, rng: np.random.Generator) -> list[Estimate]:
    """
    Return the best linear solutions over random rotations of the sensor.

    For a given one the places of the sphere's centre c and of the sensor t are linear in the
    centres of the circles: axis . (c - a) - t, along the line and in range. Across the sensor
    plane c is at the height of each circle above it, on either side.
    """
    obs, a = problem.observations, problem.poses[:, :3, 3]
    bounds = np.searchsorted(obs.station, np.arange(1, len(a)))
    circles = np.array([fit_circle(p, steps=1) for p in np.split(obs.points, bounds)])
    radius = problem.config.target.radius or START_RADIUS_RATIO * float(circles[:, 2].max())
    height = np.sqrt(np.maximum(radius ** 2 - circles[:, 2] ** 2, 0.0))
    R_sensor = Rotation.from_quat(rng.normal(size=(ROTATION_COUNT, 4))).as_matrix()
    axes = np.swapaxes(problem.poses[:, :3, :3] @ R_sensor[:, None], -1, -2)  # in the base
    mount = axes @ (a - a.mean(axis=0))[:, :, None]
    A = np.concatenate([axes[:, :, ::2], np.broadcast_to(-np.eye(2), (*axes.shape[:2], 2, 2))],
                       axis=-1).reshape(ROTATION_COUNT, -1, 5)
    b = (mount[:, :, ::2, 0] + circles[:, :2]).reshape(ROTATION_COUNT, -1, 1)
    transposed = np.swapaxes(A, 1, 2)
    normal = transposed @ A + MIDDLE_WEIGHT * len(a) * np.eye(5)
    solved = np.linalg.solve(normal, transposed @ b)
    y = (axes[:, :, 1] @ solved[:, :3] - mount[:, :, 1])[..., 0]
    offsets = np.concatenate([y - height, y + height], axis=1)
    misfit = ((np.abs(y[:, None] - offsets[:, :, None]) - height) ** 2).mean(axis=2)
    total = misfit.min(axis=1) + ((A @ solved - b) ** 2).mean(axis=(1, 2))
    best = np.argsort(total)[:SPHERE_SOLUTIONS]
    t = np.insert(solved[best, 3:, 0], 1, offsets[best, misfit[best].argmin(axis=1)], axis=1)
    X = se3.transform(R_sensor[best], (R_sensor[best] @ t[:, :, None])[..., 0])
    T = se3.transform(np.eye(3), a.mean(axis=0) + solved[best, :3, 0]).reshape(-1, 16)
    return [Estimate(*each) for each in zip(X, np.insert(T, 16, radius, axis=1), strict=True)]


class Sphere(ProfileTarget):
    """A sphere: all points of all arcs are at the radius from one centre."""

    name = 'sphere'
    kinds = ('arc',)
    parameter_names, pose_axes = ('x', 'y', 'z', 'radius'), (0, 1, 2)
    unstated_measure = {'radius': 0.0}
    extract = staticmethod(arc_features)
    required_features = (Arc,)

    def stated_values(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return the radius if it is given."""
        target = config.target
        return {'radius': (target.radius, target.radius_std)} if target.radius > 0 else {}

    def raw_points(self, sample: Sample, points: Array, kind: NDArray[np.intp]
                   ) -> tuple[Array, NDArray[np.intp]]:
        """Return all raw points of the arcs of a sample."""
        points = np.concatenate([f.measured for f in sample.features if isinstance(f, Arc)])
        return points, np.zeros(len(points), dtype=np.intp)

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first, from random rotations of the sensor."""
        few = with_few_stations(problem, rng)
        yield from shortlisted(few, _linear_solutions(few, rng))

    def half_turn_misfit(self, linear: Linearisation) -> tuple[str, float]:
        """
        Return in words the line of the view on which all centres lie best, and m RMS off it.

        An arc does not tell on which side of the sensor plane its centre lies.
        """
        poses = linear.problem.poses @ linear.estimate.X
        from_sensor = linear.estimate.T_base_target[:3, 3] - poses[:, :3, 3]
        centres = from_sensor[:, None] @ poses[:, :3, [0, 2]]  # in the sensor plane
        across = np.linalg.svd(centres[:, 0] - centres[:, 0].mean(axis=0))[1][-1]
        return 'on one line', float(across) / len(poses) ** 0.5

    def local_conditions(self, local: Array, kind: NDArray[np.intp], measures: Array
                         ) -> tuple[Array, Array, Array]:
        """Return the distances of points from the sphere (m); measures: (..., 1) radius (m)."""
        distance = np.sqrt((local * local).sum(axis=-1))
        return (distance - measures, local / distance[..., None],
                np.full((*distance.shape, 1), -1.0))

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the sphere's centre and radius as plain values."""
        return {'centre': xyz(target_pose(state)[:3, 3]), 'radius': float(state[16]),
                'radius_std': float(std[-1])}


SPHERE = Sphere()
