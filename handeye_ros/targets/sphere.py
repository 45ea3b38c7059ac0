# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sphere: all points of all arcs are at the radius from one centre.

Unknown beside X: the centre in the base frame and, on demand, the radius. The side of the sensor
plane on which the centre lies need not be given.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Feature, Sample
from handeye_ros.estimation.problem import (
    Conditions,
    Estimate,
    Observations,
    Problem,
)
from handeye_ros.estimation.search import best_of
from handeye_ros.profiles.arcs import arc_features, fit_circle
from handeye_ros.targets.common import ObservationRows, some_of
from handeye_ros.targets.target import ProfileTarget
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ROTATIONS = 600
CANDIDATES = 16
LONG = 9  # points: of longer arcs every third is used for a start
REGULAR = 1e-9  # weight of a centre at the middle of the poses (regularisation)
AT_ONCE = 50  # rotations for which the offset across the plane is searched together


def _fewer(observations: Observations) -> Observations:
    """Return the observations with every third point of long arcs, enough for a start."""
    station = observations.station
    place = np.arange(len(station)) - np.searchsorted(station, station)
    short = np.bincount(station)[station] < LONG
    return observations.select(short | (place % 3 == 1))


def _candidates(problem: Problem, radius: float) -> list[Estimate]:
    """Return the best linear solutions over a sweep of rotations of the sensor."""
    obs = problem.observations
    bounds = np.searchsorted(obs.station, np.arange(1, len(problem.poses)))
    circles = np.array([fit_circle(p, steps=1) for p in np.split(obs.points, bounds)])
    radius = radius or 1.05 * float(circles[:, 2].max())
    height = np.sqrt(np.maximum(radius ** 2 - circles[:, 2] ** 2, 0.0))
    a_mean = problem.poses[:, :3, 3].mean(axis=0)
    R_sensor = rotations(ROTATIONS)
    centre, t, rms, y = _centres(R_sensor, problem.poses[:, :3, :3],
                                 problem.poses[:, :3, 3] - a_mean, circles)
    k = len(R_sensor)
    rms_y = np.full(k, np.inf)
    order = np.argsort(rms)
    for first in range(0, k, AT_ONCE):  # poor fits for any side are skipped
        some = order[first:first + AT_ONCE]
        if np.partition(np.hypot(rms, rms_y), CANDIDATES)[CANDIDATES] < rms[some[0]]:
            break
        t[some, 1], rms_y[some] = _side(y[some], height)
    best = np.argsort(np.hypot(rms, rms_y))[:CANDIDATES]
    X = se3.transform(R_sensor[best], (R_sensor[best] @ t[best, :, None])[..., 0])
    return [Estimate(*both) for both in zip(X, np.column_stack(
        [a_mean + centre[best], np.full(CANDIDATES, radius)]), strict=True)]


def _centres(R_sensor: Array, R: Array, a: Array, circles: Array
             ) -> tuple[Array, Array, Array, Array]:
    """
    Return the linear solutions from circles (n, 3) for k rotations of the sensor.

    R (n, 3, 3), a (n, 3): of the poses, about their mean position. Returned: centre in the base
    (k, 3); sensor position (k, 3), 0 across its plane; RMS (k,) of the residuals in the plane;
    coordinates (k, n) of the centre across it (m). Sums over the stations are formed first, and
    then multiplied by the axes of each rotation.
    """
    n, turns, own = len(R), R.transpose(2, 1, 0).reshape(9, -1), np.einsum('nlj,nl->jn', R, a)
    x, y, z = np.moveaxis(R_sensor, 2, 0)

    def coordinate(axis: Array, centre: Array) -> Array:
        return np.asarray(_outer(axis, centre) @ turns - axis @ own)
    normal = (n + REGULAR) * np.eye(3) - (_outer(y, y) @ np.einsum(
        'nlj,nqm->jmlq', R, R).reshape(9, 9)).reshape(-1, 3, 3)
    right = -_outer(y, y) @ np.einsum('nlj,mn->jml', R, own).reshape(9, 3)
    for axis, predicted_covariance in ((x, circles[:, 0]), (z, circles[:, 1])):
        mean = axis @ R.mean(axis=0).T
        normal -= n * mean[:, :, None] * mean[:, None]
        right += axis @ np.einsum('nlj,n->jl', R, predicted_covariance) - mean * (
            predicted_covariance.sum() + axis @ own.sum(axis=1))[:, None]
    centre = np.linalg.solve(normal, right[..., None])[..., 0]
    left = [coordinate(x, centre) - circles[:, 0], coordinate(z, centre) - circles[:, 1]]
    t = np.zeros((len(centre), 3))
    t[:, 0], t[:, 2] = left[0].mean(axis=1), left[1].mean(axis=1)
    rms = np.sqrt((left[0].var(axis=1) + left[1].var(axis=1)) / 2)
    return centre, t, rms, coordinate(y, centre)


def _outer(a: Array, b: Array) -> Array:
    """Return the products (k, 9) of all pairs of components of vectors (k, 3)."""
    return np.asarray((a[:, :, None] * b[:, None]).reshape(-1, 9))


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
    features = staticmethod(arc_features)

    def add(self, rows: ObservationRows, station: int, feature: Feature, number: int) -> None:
        """Append the conditions of the normal points of an arc."""
        if isinstance(feature, Arc):
            outward = feature.points - feature.centre
            outward /= np.linalg.norm(outward, axis=1)[:, None]
            noise = np.zeros((len(outward), 2, 2))
            noise[:, :, 0] = outward * feature.std[:, None]
            rows.add_points(station, feature.points, 0, noise)

    def stated(self, config: Config) -> dict[str, tuple[float, float]]:
        """Return the radius if it is given."""
        target = config.target
        return {'radius': (target.radius, target.radius_std)} if target.radius > 0 else {}

    def measured(self, sample: Sample, points: Array, kind: NDArray[np.intp]
                   ) -> tuple[Array, NDArray[np.intp]]:
        """Return all raw points of the arcs of a sample."""
        arcs = [f.raw for f in sample.features if isinstance(f, Arc)]
        points = np.concatenate(arcs) if len(arcs) > 1 else arcs[0]
        return points, np.zeros(len(points), dtype=np.intp)

    def guess(self, whole: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """
        Yield starts, best first, from a sweep of rotations of the sensor.

        For a given rotation, the centre's coordinates in the sensor plane are linear in the other
        unknowns, on whichever side of the plane the centre lies.
        """
        problem = some_of(whole, rng)
        some = replace(problem, observations=_fewer(problem.observations))
        yield from best_of(some, _candidates(problem, problem.config.target.radius))

    def conditions(self, p: Array, kind: NDArray[np.intp], target: Array, config: Config
                   ) -> Conditions:
        """Return the distances from the sphere of points p (..., m, 3) in base."""
        outward = p - target[..., None, :3]
        x, y, z = outward[..., 0], outward[..., 1], outward[..., 2]
        distance = np.sqrt(x * x + y * y + z * z)
        outward /= distance[..., None]
        by_target = np.full((*p.shape[:-1], 4), -1.0)
        np.negative(outward, out=by_target[..., :3])
        return Conditions(distance - target[..., 3:], outward, by_target)

    def retract(self, target: Array, delta: Array) -> Array:
        """Return centres and radii (..., 4) after a step delta."""
        return target + delta

    def describe(self, target: Array, std: Array) -> dict[str, Any]:
        """Return the sphere's centre and radius as plain values."""
        return {'centre': dict(zip('xyz', map(float, target[:3]), strict=True)),
                'radius': float(target[3]), 'radius_std': float(std[3])}

    def relax(self, config: Config) -> Config | None:
        """Return the configuration with a free radius, None if it is free already."""
        if config.target.radius <= 0:
            return None
        return replace(config, target=replace(config.target, radius=0.0))


SPHERE = Sphere()
