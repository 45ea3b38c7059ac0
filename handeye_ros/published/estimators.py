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
from handeye_ros.checks.refusals import missing_motion, require_certain
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, EdgePoint, Sample
from handeye_ros.errors import SingularError
from handeye_ros.estimation.noise import Noise
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import fit as fit_target
from handeye_ros.outcome import measured_points
from handeye_ros.published import chen2023, cn105021139a, fixed_point, wu2017, zheng2018
from handeye_ros.tabulated.method import FileMethod, require_trusted, solve
from handeye_ros.targets import line, plate
import numpy as np
from numpy.typing import NDArray

ZHENG_START_OFF = np.repeat([0.01, math.radians(5)], 3) / 3 ** 0.5
"""Offset of the start of Zheng 2018 from our answer: 10 mm and 5 degrees."""


@dataclass(frozen=True, eq=False)
class Known:
    """Solution of the target's own method: labelled stations, estimate and noise."""

    problem: Problem
    estimate: Estimate
    noise: Noise


@dataclass(frozen=True, eq=False)
class Stations:
    """
    The stations for all estimators.

    samples: in the order of their stamps; known: the solution for the same stations, in the same
    order, None where the target's own method has no answer.
    """

    samples: tuple[Sample, ...]
    config: Config
    known: Known | None = None

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.samples)

    def subset(self, samples: NDArray[np.intp]) -> Stations:
        """Return some of the stations (ascending indices)."""
        known = self.known and replace(self.known, problem=self.known.problem.subset(samples))
        return replace(self, samples=tuple(self.samples[i] for i in samples), known=known)

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """
        Return the distances (m) of `measured` stations from the target fitted to `fitted` ones.

        X (4, 4) is kept. None where the target's own method has no answer.
        """
        if (known := self.known) is None:
            return None
        part = known.problem.subset(fitted)
        given = _GivenTransform(part.method, part.poses, part.observations, part.config)
        estimate = fit_target(given, Estimate(X, known.estimate.target), known.noise)
        points = measured_points(self.samples, known.problem)
        return points.select(np.isin(points.station, measured)).residuals(known.problem, estimate)


class _GivenTransform(Problem):
    """A problem with only the target unknown."""

    @property
    def columns(self) -> NDArray[np.intp]:
        return super().columns[6:]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Values read from files, without those that the target's own method drops."""

    method: FileMethod
    values: Any
    config: Config

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.values.samples)

    def subset(self, samples: NDArray[np.intp]) -> Measurements:
        """Return some of the samples (ascending indices)."""
        return replace(self, values=self.values.subset(samples))

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """Return distances (m) of `measured` samples for X, the target fitted to `fitted` ones."""
        return np.asarray(self.values.residuals(X, fitted, measured))


Given: TypeAlias = Stations | Measurements


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


def _known(stations: Stations, name: str) -> Known:
    if stations.known is None:
        raise SingularError(name, f'it needs what the method {stations.config.target.type} finds '
                            'first, which has no answer')
    return stations.known


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
    known = _known(stations, 'the line on one edge')
    kind = known.problem.observations.kind
    edge = max((plate.P, plate.Q), key=lambda k: int((kind == k).sum()))
    points = known.problem.observations.select(kind == edge)
    samples = []
    for i, sample in enumerate(stations.samples):
        mine = points.points[points.station == i]
        edges = tuple(f for f in sample.features if isinstance(f, EdgePoint)
                      and (mine == f.point).all(axis=1).any())
        samples += [replace(sample, features=edges)] if edges else []
    return _by_method('line')(replace(stations, samples=tuple(samples)))


def _chen(solve: Callable[[Array, Array, Array], chen2023.Result]
          ) -> Callable[[Stations], Array]:
    def fit(stations: Stations) -> Array:
        problem = _known(stations, 'Chen 2023').problem
        obs = problem.observations
        obs = obs.select((obs.kind == plate.P) | (obs.kind == plate.Q))
        labels = np.array(plate.KINDS)[obs.kind]
        return solve(problem.poses[obs.station], obs.points, labels).T_flange_sensor
    return fit


def _fixed_point(solve: Callable[[Array, Array], fixed_point.Result]
                 ) -> Callable[[Stations], Array]:
    def fit(stations: Stations) -> Array:
        radius = stations.config.target.radius
        if radius <= 0:
            raise SingularError('the fixed point', 'it needs the radius of the sphere; set '
                                'target.radius')
        known = _known(stations, 'the fixed point')
        arcs = [(i, f) for i, sample in enumerate(stations.samples) for f in sample.features
                if isinstance(f, Arc)]
        poses = known.problem.poses[[i for i, _ in arcs]]
        T_plane_base = se3.inverse(poses @ known.estimate.X)
        centre = se3.apply(T_plane_base, known.estimate.target[None, :3])[:, 0]
        centres = fixed_point.ball_centres(
            np.array([arc.centre for _, arc in arcs]), np.array([arc.radius for _, arc in arcs]),
            radius, np.where(centre[:, 1] < 0, -1.0, 1.0))
        return solve(poses, centres).T_flange_sensor
    return fit


def _zheng(stations: Stations) -> Array:
    known = _known(stations, 'Zheng 2018')
    obs = known.problem.observations
    edge = obs.kind == line.EDGE_Y  # each point is there twice, for y and for z
    to_plane = zheng2018.T_plane_x_plane_y
    start = se3.perturb(known.estimate.X, ZHENG_START_OFF) @ se3.inverse(to_plane)
    found = zheng2018.solve(known.problem.poses[obs.station[edge]], obs.points[edge], start)
    return np.asarray(found.T_flange_sensor @ to_plane)


def _from_files(given: Measurements) -> Array:
    answer = solve(given.method, given.values, given.config)
    require_trusted(given.method, answer, given.config)
    return answer.X


def _park(given: Measurements) -> Array:
    given.values.require_determined(given.config)
    return np.asarray(given.values.closed_form()[0])


def _cn105021139a(given: Measurements) -> Array:
    return np.asarray(cn105021139a.solve_motions(*cn105021139a.motions(
        given.values.T, given.values.T_camera_target)))


ESTIMATORS: dict[str, tuple[Estimator, ...]] = {
    'plate': (
        Estimator('plate', _by_method('plate')),
        Estimator('plane, the face lines alone', _by_method('plane')),
        Estimator('line, one edge alone', _line_on_one_edge),
        Estimator('Chen 2023, nine parameters', _chen(chen2023.solve_nine)),
        Estimator('Chen 2023, on SE(3)', _chen(chen2023.solve_rigid)),
    ),
    'sphere': (
        Estimator('sphere', _by_method('sphere')),
        Estimator('fixed point, linear', _fixed_point(fixed_point.solve_linear)),
        Estimator('fixed point, least squares', _fixed_point(fixed_point.solve_least_squares)),
    ),
    'line': (
        Estimator('line', _by_method('line')),
        Estimator('Zheng 2018', _zheng, refit=False),
    ),
    'plane': (Estimator('plane', _by_method('plane')),),
    'wedge': (Estimator('wedge', _by_method('wedge')),),
    'points': (
        Estimator('points', _from_files),
        Estimator('Wu 2017, best of all quadruples', lambda given: wu2017.solve(
            given.values.in_camera, given.values.in_base).T_base_camera),
    ),
    'hand_eye': (
        Estimator('hand_eye', _from_files),
        Estimator('closed form (Park and Martin 1994)', _park),
        Estimator('CN105021139A', _cn105021139a),
    ),
    'tracker': (
        Estimator('tracker', lambda given: given.values.chain().T_flange_sensor),
    ),
}
"""By target, its own method first."""
