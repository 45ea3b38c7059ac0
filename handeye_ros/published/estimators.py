# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Every estimator by target, ours and the published ones, on the same samples.

A published estimator is given what it cannot find itself, from the answer of the target's own
method: which edge a point is on (Chen 2023), on which side of the laser the centre of the ball is
(fixed point), where to start (Zheng 2018).
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any, TypeAlias

from handeye_ros import pipeline, se3
from handeye_ros.calibration import measured_points
from handeye_ros.checks.refusals import missing_motion, require_certain
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, EdgePoint, Sample
from handeye_ros.errors import SingularError
from handeye_ros.estimation.noise import Noise
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import fit as fit_target
from handeye_ros.frames import sensor_axes
from handeye_ros.published import chen2023, cn105021139a, fixed_point, wu2017, zheng2018
from handeye_ros.results.truth_file import FIELD, field_points
from handeye_ros.tabulated.hand_eye import Views
from handeye_ros.tabulated.values import solve, Values
from handeye_ros.targets import line, plate, TARGETS
import numpy as np
from numpy.typing import NDArray

ZHENG_START_OFF = np.repeat([0.01, math.radians(5)], 3) / 3 ** 0.5
"""Offset of the start of Zheng 2018 from our answer: 10 mm and 5 degrees."""


@dataclass(frozen=True, eq=False)
class Stations:
    """
    The stations for all estimators, with the solution of the target's own method.

    samples: in the order of their stamps; problem: of the same stations, labelled.
    """

    samples: tuple[Sample, ...]
    config: Config
    problem: Problem
    estimate: Estimate
    noise: Noise

    over = FIELD

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.samples)

    @property
    def axes(self) -> Array:
        """Return T_sensor_plane (4, 4), of the sensor plane in which X and field are."""
        return sensor_axes(self.config)

    def field(self) -> Array:
        """Return points (k, 3) in the sensor plane over which errors are reported."""
        return field_points()

    def subset(self, stations: NDArray[np.intp]) -> Stations:
        """Return some of the stations (ascending indices)."""
        return replace(self, samples=tuple(self.samples[i] for i in stations),
                       problem=self.problem.subset(stations))

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]) -> Array:
        """Return distances (m) of `measured` stations for X, the target fitted to `fitted`."""
        part = self.problem.subset(fitted)
        given = _GivenTransform(part.target, part.poses, part.observations, part.config)
        estimate = fit_target(given, Estimate(X, self.estimate.state), self.noise)
        points = measured_points(self.samples, self.problem)
        return points.select(np.isin(points.station, measured)).residuals(self.problem, estimate)


class _GivenTransform(Problem):
    """A problem with only the target unknown."""

    @property
    def columns(self) -> NDArray[np.intp]:
        return super().columns[6:]


Given: TypeAlias = Stations | Values


@dataclass(frozen=True)
class Estimator:
    """
    One estimator of the transform.

    fit: returns X (4, 4), from the mount to the sensor plane; raises DataError. refit: whether it
    is fast enough for cross-validation.
    """

    name: str
    fit: Callable[[Any], Array]
    refit: bool = True


def _by_method(name: str) -> Callable[[Stations], Array]:
    """Return the fit by one of the own methods."""
    def fit(stations: Stations) -> Array:
        config = replace(stations.config, method=name)
        solution = pipeline.answer(stations.samples, (), config).consensus()
        require_certain(solution.reported, config, missing_motion(solution, config))
        return solution.estimate.X
    return fit


def _line_on_one_edge(stations: Stations) -> Array:
    """Return the fit of the line to the plate's edge with more points."""
    kind = stations.problem.observations.kind
    edge = max((plate.P, plate.Q), key=lambda k: int((kind == k).sum()))
    points, samples = stations.problem.observations.select(kind == edge), []
    for i, sample in enumerate(stations.samples):
        mine = points.points[points.station == i]
        edges = tuple(f for f in sample.features if isinstance(f, EdgePoint)
                      and (mine == f.point).all(axis=1).any())
        samples += [replace(sample, features=edges)] if edges else []
    return _by_method('line')(replace(stations, samples=tuple(samples)))


def _edges(stations: Stations) -> tuple[Array, Array, Array]:
    """Return poses (n, 4, 4), points (n, 2) and edges (n,) of the points of a plate's edges."""
    obs = stations.problem.observations
    obs = obs.select((obs.kind == plate.P) | (obs.kind == plate.Q))
    return stations.problem.poses[obs.station], obs.points, np.array(plate.KINDS)[obs.kind]


def _ball(stations: Stations) -> tuple[Array, Array]:
    """Return poses (n, 4, 4), and the centres (n, 3) of the ball as the sensor sees it."""
    radius = stations.config.target.radius
    if radius <= 0:
        raise SingularError('the fixed point', 'it needs the radius of the sphere; set '
                            'target.radius')
    arcs = [(i, f) for i, sample in enumerate(stations.samples) for f in sample.features
            if isinstance(f, Arc)]
    poses = stations.problem.poses[[i for i, _ in arcs]]
    T_plane_base = se3.inverse(poses @ stations.estimate.X)
    centre = se3.apply(T_plane_base, stations.estimate.state[None, :3])[:, 0]
    return poses, fixed_point.ball_centres(
        np.array([arc.centre for _, arc in arcs]), np.array([arc.radius for _, arc in arcs]),
        radius, np.where(centre[:, 1] < 0, -1.0, 1.0))


def _zheng(stations: Stations) -> Array:
    obs = stations.problem.observations
    edge = obs.kind == line.EDGE_Y  # each point is there twice, for y and for z
    to_plane = zheng2018.T_plane_x_plane_y
    start = se3.perturb(stations.estimate.X, ZHENG_START_OFF) @ se3.inverse(to_plane)
    T = zheng2018.solve(stations.problem.poses[obs.station[edge]], obs.points[edge], start)
    return np.asarray(T @ to_plane)


def _from_files(values: Values) -> Array:
    answer = solve(values)
    answer.require_trusted(values)
    return answer.X


def _park(views: Views) -> Array:
    views.require_determined()
    return np.asarray(views.closed_form()[0])


ESTIMATORS: dict[str, tuple[Estimator, ...]] = {
    **{name: (Estimator(name, _by_method(name)),) for name in TARGETS},  # and with others:
    'plate': (
        Estimator('plate', _by_method('plate')),
        Estimator('plane, the face lines alone', _by_method('plane')),
        Estimator('line, one edge alone', _line_on_one_edge),
        Estimator('Chen 2023, nine parameters',
                  lambda given: chen2023.solve_nine(*_edges(given))),
        Estimator('Chen 2023, on SE(3)',
                  lambda given: chen2023.solve_rigid(*_edges(given))),
    ),
    'sphere': (
        Estimator('sphere', _by_method('sphere')),
        Estimator('fixed point, linear',
                  lambda given: fixed_point.solve_linear(*_ball(given))[0]),
        Estimator('fixed point, least squares',
                  lambda given: fixed_point.solve_least_squares(*_ball(given))),
    ),
    'line': (
        Estimator('line', _by_method('line')),
        Estimator('Zheng 2018', _zheng, refit=False),
    ),
    'points': (
        Estimator('points', _from_files),
        Estimator('Wu 2017, best of all quadruples', lambda given: wu2017.solve(
            given.seen, given.robot).T_base_camera),
    ),
    'hand_eye': (
        Estimator('hand_eye', _from_files),
        Estimator('closed form (Park and Martin 1994)', _park),
        Estimator('CN105021139A', lambda given: cn105021139a.solve_motions(
            *cn105021139a.motions(given.robot, given.seen))),
    ),
    'tracker': (
        Estimator('tracker', lambda given: given.chain().T_flange_sensor),
    ),
}
"""By target, its own method first."""
