# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sphere: all points of all arcs are at the radius from one centre.

Unknown beside X: the centre in the base frame and, on demand, the radius. The side of the sensor
plane on which the centre lies need not be given.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

from handeye_ros import se3
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
from handeye_ros.targets.starts import with_few_stations
from handeye_ros.targets.target import ObservationRows, ProfileTarget, xyz
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ROTATION_COUNT = 600
CANDIDATE_COUNT = 16
MIDDLE_WEIGHT = 1e-9  # weight of a centre at the middle of the poses (regularisation)


def _candidates(problem: Problem, radius: float) -> list[Estimate]:
    """Return the best linear solutions over a sweep of rotations of the sensor."""
    obs = problem.observations
    bounds = np.searchsorted(obs.station, np.arange(1, len(problem.poses)))
    circles = np.array([fit_circle(p, steps=1) for p in np.split(obs.points, bounds)])
    radius = radius or 1.05 * float(circles[:, 2].max())
    height = np.sqrt(np.maximum(radius ** 2 - circles[:, 2] ** 2, 0.0))
    a_mean = problem.poses[:, :3, 3].mean(axis=0)
    R_sensor = rotations(ROTATION_COUNT)
    centre, t, rms, y = _centres(R_sensor, problem.poses[:, :3, :3],
                                 problem.poses[:, :3, 3] - a_mean, circles)
    t[:, 1], rms_y = _side(y, height)
    best = np.argsort(np.hypot(rms, rms_y))[:CANDIDATE_COUNT]
    X = se3.transform(R_sensor[best], (R_sensor[best] @ t[best, :, None])[..., 0])
    return [Estimate(*both) for both in zip(X, np.column_stack(
        [a_mean + centre[best], np.full(CANDIDATE_COUNT, radius)]), strict=True)]


def _centres(R_sensor: Array, R: Array, a: Array, circles: Array
             ) -> tuple[Array, Array, Array, Array]:
    """
    Return the linear solutions from circles (n, 3) for k rotations of the sensor.

    R (n, 3, 3), a (n, 3): of the poses, about their mean position. Returned: centre in the base
    (k, 3); sensor position (k, 3), 0 across its plane; RMS (k,) of the residuals in the plane;
    coordinates (k, n) of the centre across it (m).
    """
    axes = np.einsum('nij,kja->kani', R, R_sensor)  # of the sensor in the base
    flange = np.einsum('kani,ni->kan', axes, a)
    # axis . (centre - flange) - offset is the centre of the circle, in x and in z
    A, b = axes[:, ::2], flange[:, ::2] + circles[:, :2].T
    A_free, b_free = A - A.mean(axis=2, keepdims=True), b - b.mean(axis=2, keepdims=True)
    normal = np.einsum('kani,kanj->kij', A_free, A_free) + MIDDLE_WEIGHT * len(R) * np.eye(3)
    centre = np.linalg.solve(normal, np.einsum('kani,kan->ki', A_free, b_free)[..., None])[..., 0]
    left = (A @ centre[:, None, :, None])[..., 0] - b
    t = np.zeros((len(centre), 3))
    t[:, ::2] = left.mean(axis=2)
    rms = np.sqrt(left.var(axis=2).mean(axis=1))
    return centre, t, rms, (axes[:, 1] @ centre[..., None])[..., 0] - flange[:, 1]


def _side(y: Array, height: Array) -> tuple[Array, Array]:
    """Return offsets (k,) with |y - offset| nearest to height (n,), and RMS; y: (k, n)."""
    offsets = np.concatenate([y - height, y + height], axis=1)
    misfit = np.abs(np.abs(y[:, None, :] - offsets[:, :, None]) - height)
    total = (misfit ** 2).mean(axis=2)
    best = np.argmin(total, axis=1)
    rows = np.arange(len(y))
    return offsets[rows, best], np.sqrt(total[rows, best])


@cache
def rotations(count: int) -> Array:
    """Return (count, 3, 3) rotations, evenly distributed (super-Fibonacci spiral)."""
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / 2 ** 0.5, 2 * np.pi * s / 1.533751168755204288118041
    q = np.column_stack([r * np.sin(alpha), r * np.cos(alpha),
                         big_r * np.sin(beta), big_r * np.cos(beta)])
    return np.asarray(Rotation.from_quat(q).as_matrix())


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
        """
        Yield starts, best first, from a sweep of rotations of the sensor.

        For a given rotation, the centre's coordinates in the sensor plane are linear in the other
        unknowns, on whichever side of the plane the centre lies.
        """
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
