# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Puts the same samples through every estimator of a target, ours and the published ones.

A published estimator is given what it cannot find itself, from the answer of the target's own
method: which edge a point is on (Chen 2023), on which side of the laser the centre of the ball is
(fixed point), where to start (Zheng 2018).
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
import math
import time
from typing import Any, ClassVar, TypeAlias

from handeye_ros import pipeline, se3, targets
from handeye_ros.arithmetic import rms
from handeye_ros.calibration import measured_points
from handeye_ros.checks.refusals import missing_motion, require_certain
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Indices, Reject, Sample
from handeye_ros.errors import DataError, InputError, SingularError
from handeye_ros.estimation.noise import NoiseModel
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import least_squares_fit
from handeye_ros.frames import T_sensor_plane
from handeye_ros.published import chen2023, jing2020, park1994, wang2015, wu2017, zheng2018
from handeye_ros.results.printed import figures_table
from handeye_ros.results.truth import errors_against, field_points, FIELD_TEXT
from handeye_ros.sampling.session import Session
from handeye_ros.tabulated.pairs import PairedRows, PosePairs
from handeye_ros.tabulated.problem import answer_table, TableProblem
from handeye_ros.targets import line, plate, TARGETS
import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

FOLD_COUNT = 10
FORMAT = 'handeye_ros/comparison/1'
# LinAlgError: of a published method whose matrix is singular
ESTIMATOR_FAILURES = (DataError, np.linalg.LinAlgError)
ROW_FIGURES = {  # of a row: the head of its column, in which unit, with how many digits
    'residual_rms': ('residual\nmm', 1e3, 4),
    'holdout_rms': ('left out\nmm', 1e3, 4),
    'error_translation': ('error\nmm', 1e3, 4),
    'error_rotation': ('\ndegrees', math.degrees(1), 4),
    'error_mapped_points': ('mapped\nmm', 1e3, 4),
    'seconds': ('time\ns', 1.0, 3)}

ZHENG_START_OFF = np.repeat([0.01, math.radians(5)], 3) / 3 ** 0.5
"""Offset of the start of Zheng 2018 from our answer: 10 mm and 5 degrees."""


@dataclass(frozen=True, eq=False)
class ComparedStations:
    """
    The stations that all estimators are given, with the solution of the target's own method.

    samples: in the order of their stamps
    problem: the same stations, each observation with the edge or face that it is on
    estimate, noise: the solution of the target's own method, and the noise that it found
    """

    samples: tuple[Sample, ...]
    problem: Problem
    estimate: Estimate
    noise: NoiseModel

    error_points_text: ClassVar[str] = FIELD_TEXT

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.samples)

    @property
    def T_sensor_plane(self) -> Array:
        """Return T_sensor_plane (4, 4): X and `error_points` are in the sensor plane."""
        return T_sensor_plane(self.problem.config)

    def error_points(self) -> Array:
        """Return points (k, 3) in the sensor plane over which errors are reported (m)."""
        return field_points()

    def subset(self, stations: Indices) -> ComparedStations:
        """Return some of the stations (ascending indices)."""
        return replace(self, samples=tuple(self.samples[i] for i in stations),
                       problem=self.problem.subset(stations))

    def residuals(self, X: Array, fitted: Indices, measured: Indices) -> Array:
        """
        Return the distances (k,) of the points of some stations from the target (m).

        X: (4, 4) the pose of the sensor plane in the mount; fitted: the stations to which the
        target is fitted, with X held; measured: the stations whose points are returned. Both are
        indices.
        """
        part = self.problem.subset(fitted)
        target_alone = _FixedTransformProblem(
            part.target, part.poses, part.observations, part.config)
        estimate = least_squares_fit(
            target_alone, Estimate(X, self.estimate.state), self.noise).estimate
        points = measured_points(self.samples, self.problem)
        return points.residuals(self.problem, estimate)[np.isin(points.station, measured)]


class _FixedTransformProblem(Problem):
    """A problem with only the target unknown, and the transform given."""

    @property
    def free_columns(self) -> Indices:
        return super().free_columns[6:]


ComparedData: TypeAlias = ComparedStations | PairedRows
"""What estimators are given: both can be counted, cut to a subset, and give residuals of an X."""


@dataclass(frozen=True)
class Estimator:
    """
    One estimator of the transform.

    fit: returns X (4, 4), the pose of the sensor plane in the mount, from the compared data;
        raises DataError or LinAlgError where it finds none
    is_cross_validated: whether it is fitted again without parts of the stations (it is fast)
    """

    name: str
    fit: Callable[[Any], Array]
    is_cross_validated: bool = True


def _by_own_method(name: str, stations: ComparedStations) -> Array:
    """Return X (4, 4) by one of the own methods, such as plane; raises DataError."""
    config = replace(stations.problem.config, method=name)
    solution = pipeline.answer_samples(stations.samples, (), config).require_solution()
    require_certain(solution.transform_covariance, config, missing_motion(solution, config))
    return solution.estimate.X


def _edges(stations: ComparedStations) -> tuple[Array, Array, Array]:
    """Return poses (n, 4, 4), points (n, 2) and edges (n,) of the points of a plate's edges."""
    observations = stations.problem.observations
    on_edges = observations.select(
        (observations.kind == plate.P) | (observations.kind == plate.Q))
    return (stations.problem.poses[on_edges.station], on_edges.points,
            np.array(plate.PLATE.kinds)[on_edges.kind])


def _ball(stations: ComparedStations) -> tuple[Array, Array]:
    """Return poses (n, 4, 4), and the centres (n, 3) of the ball as the sensor sees it."""
    radius = stations.problem.config.target.radius
    if radius <= 0:
        raise SingularError('the fixed point', 'it needs the radius of the sphere; set '
                            'target.radius')
    arcs = [(i, feature) for i, sample in enumerate(stations.samples)
            for feature in sample.features if isinstance(feature, Arc)]
    poses = stations.problem.poses[[i for i, _ in arcs]]
    T_plane_base = se3.inverse(poses @ stations.estimate.X)
    T_base_sphere = stations.estimate.T_base_target
    centre = se3.apply(T_plane_base, T_base_sphere[None, :3, 3])[:, 0]
    return poses, jing2020.ball_centres(
        np.array([arc.centre for _, arc in arcs]), np.array([arc.radius for _, arc in arcs]),
        radius, np.where(centre[:, 1] < 0, -1.0, 1.0))


def _zheng(stations: ComparedStations) -> Array:
    """
    Return X (4, 4) by Zheng 2018, started 10 mm and 5 degrees beside our answer.

    Raises DataError.
    """
    observations = stations.problem.observations
    on_edge = observations.kind == line.EDGE_Y  # each point is there twice, for y and for z
    to_plane = zheng2018.T_plane_x_plane_y
    start = se3.perturb(stations.estimate.X, ZHENG_START_OFF) @ se3.inverse(to_plane)
    T = zheng2018.solve(stations.problem.poses[observations.station[on_edge]],
                        observations.points[on_edge], start)
    return np.asarray(T @ to_plane)


def _from_files(pairs: PairedRows) -> Array:
    """Return X (4, 4) by our own method for values from files; raises DataError."""
    answer = answer_table(pairs)
    answer.require_trusted(pairs)
    return answer.X


def _park(pairs: PosePairs) -> Array:
    """Return X (4, 4) by the closed form of Park and Martin 1994; raises DataError."""
    pairs.require_usable()
    return pairs.closed_form()


OTHER_ESTIMATORS: dict[str, tuple[Estimator, ...]] = {
    'plate': (
        Estimator('plane, the face lines alone', partial(_by_own_method, 'plane')),
        Estimator('Chen 2023, nine parameters', lambda given: chen2023.solve_nine(*_edges(given))),
        Estimator('Chen 2023, on SE(3)', lambda given: chen2023.solve_rigid(*_edges(given)))),
    'sphere': (
        Estimator('fixed point, linear',
                  lambda given: jing2020.fixed_point_linear(*_ball(given))[0]),
        Estimator('fixed point, least squares',
                  lambda given: jing2020.fixed_point_least_squares(*_ball(given)))),
    'line': (Estimator('Zheng 2018', _zheng, is_cross_validated=False),),
    'points': (Estimator('Wu 2017, best of all quadruples',
                         lambda given: wu2017.solve(given.seen, given.robot)),),
    'hand_eye': (
        Estimator('closed form (Park and Martin 1994)', _park),
        Estimator('CN105021139A', lambda given: park1994.solve_motions(
            *wang2015.motions(given.robot, given.seen)))),
}
ESTIMATORS = {
    name: (Estimator(name, partial(_by_own_method, name) if name in TARGETS else _from_files),
           *OTHER_ESTIMATORS.get(name, ())) for name in {**TARGETS, **OTHER_ESTIMATORS}}
"""The estimators of each target, its own method first."""


@dataclass(frozen=True, eq=False)
class EstimatorResult:
    """
    Result of one estimator.

    figures: the known ones of ROW_FIGURES, in SI units. residual_rms: RMS residual of the target's
        own method with this transform, the target fitted to it; holdout_rms: RMS residual of
        stations left out of the estimate; error_...: against the true transform; seconds: duration
        of one fit
    T_flange_sensor: (4, 4), None if the estimator failed
    failure: why the estimator failed, '' if it did not
    """

    name: str
    figures: Mapping[str, float]
    T_flange_sensor: Array | None = None
    failure: str = ''


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    The rows, the target's own method first.

    used, rejected: number of stations that every estimator was given, and of the other stations
    refusal: why the target's own method has no answer, None if it has one
    error_points_text: the points over which the errors are reported, in words
    """

    rows: tuple[EstimatorResult, ...]
    used: int
    rejected: int
    refusal: DataError | None
    error_points_text: str


def compare(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
            T_true: Array | None = None, folds: int = FOLD_COUNT, session: Session | None = None
            ) -> Comparison:
    """
    Return the rows of all estimators for the target, from samples in any order.

    rejects: stations that gave no sample; T_true: T_flange_sensor (4, 4), where it is known;
    folds: how many parts of the stations are left out in turn, 0 for none; session: as in
    pipeline.answer_samples. All estimators are given the stations that the target's own method
    believes. Raises DataError where it believes none, BadValueError for a target or method that
    does not exist.
    """
    targets.target_for(config)
    started, config = time.perf_counter(), replace(config, method='auto')
    answer = pipeline.answer_samples(samples, rejects, config, session=session)
    solution = answer.require_solution()
    # the others know no motion
    used = tuple(replace(answer.samples[i], trajectory=None) for i in solution.used_stations)
    stations = ComparedStations(used, solution.problem, solution.estimate,
                                solution.posterior.noise)
    return _comparison(config.target.type, stations, answer.refusal or solution.estimate.X,
                       started, len(samples) + len(rejects), T_true, folds)


def compare_files(given: TableProblem, T_true: Array | None = None, folds: int = FOLD_COUNT
                  ) -> Comparison:
    """
    Return the rows of all estimators for values read from files; see `compare`.

    Raises InputError for a target with one estimator alone, DataError where there is no answer.
    """
    if not isinstance(given, PairedRows):
        raise InputError(f'for target.type {given.name} there is one estimator alone: use '
                         '"handeye solve"')
    started = time.perf_counter()
    answer = answer_table(given)
    own: Array | DataError = answer.X
    try:
        answer.require_trusted(given)
    except DataError as refusal:
        own = refusal
    believed = given.subset(np.flatnonzero(answer.used))
    return _comparison(given.name, believed, own, started, len(given), T_true, folds)


def _comparison(target: str, data: ComparedData, own: Array | DataError, started: float,
                count: int, T_true: Array | None, folds: int) -> Comparison:
    """
    Return the rows of the target's own method, and of the others, from the same data.

    own: X (4, 4) of the own method, the sensor plane in the mount, or why it is no answer;
    started: when that method began (s); count: number of all samples.
    """
    own_method, *others = ESTIMATORS[target]

    def row(estimator: Estimator, outcome: Array | Exception, start: float) -> EstimatorResult:
        """Return the result of an estimator: outcome is X (4, 4) or why there is none."""
        seconds, every = time.perf_counter() - start, np.arange(len(data))
        if isinstance(outcome, Exception):
            return EstimatorResult(estimator.name, {'seconds': seconds}, failure=str(outcome))
        figures = {'residual_rms': rms(data.residuals(outcome, every, every))}
        if folds and estimator.is_cross_validated:
            figures |= _left_out(data, estimator, min(folds, len(data)))
        if T_true is not None:
            errors = errors_against(outcome, T_true @ data.T_sensor_plane, data.error_points())
            figures |= {f'error_{name}': value for name, value in asdict(errors).items()}
        return EstimatorResult(estimator.name, {**figures, 'seconds': seconds},
                               outcome @ se3.inverse(data.T_sensor_plane))

    rows = [row(own_method, own, started)]
    for estimator in others:
        start = time.perf_counter()
        try:
            outcome: Array | Exception = estimator.fit(data)
        except ESTIMATOR_FAILURES as error:
            outcome = error
        rows.append(row(estimator, outcome, start))
    refusal = own if isinstance(own, DataError) else None
    return Comparison(tuple(rows), len(data), count - len(data), refusal, data.error_points_text)


def _left_out(data: ComparedData, estimator: Estimator, folds: int) -> dict[str, float]:
    """Return holdout_rms, of samples that the estimator was not given; nothing if it fails."""
    residuals, every = [], np.arange(len(data))
    for part in range(folds):
        in_part = every % folds == part
        try:
            X = estimator.fit(data.subset(every[~in_part]))
        except ESTIMATOR_FAILURES:
            return {}
        residuals.append(data.residuals(X, every[~in_part], every[in_part]))
    return {'holdout_rms': rms(np.concatenate(residuals))}


def tables(comparison: Comparison) -> RenderableType:
    """Return the transforms of all rows, and below them their figures."""
    rows = comparison.rows
    shown = {name: column for name, column in ROW_FIGURES.items()
             if any(name in row.figures for row in rows)}
    transforms = figures_table('estimator', 'x, y, z (mm)\nroll, pitch, yaw (degrees)',
                               rows=((row.name, _transform_text(row)) for row in rows))
    figures = figures_table(
        'estimator', *(head for head, _, _ in shown.values()), right=range(1, 1 + len(shown)),
        rows=((row.name, *(f'{row.figures[name] * unit:.{digits}f}' if name in row.figures else '-'
                           for name, (_, unit, digits) in shown.items())) for row in rows))
    rejected = f', {comparison.rejected} rejected' if comparison.rejected else ''
    title = (f'{comparison.used} samples{rejected}. The published estimators are given what '
             f'{rows[0].name} finds: which samples agree, and the labels, sides or start that '
             'they need.')
    legend = ('residual: RMS of what the first method minimises, with each transform, the target '
              'fitted to it; left out: of samples the estimator was not given')
    if 'error_mapped_points' in shown:
        legend += f'\nerror: against truth.yaml; mapped: RMS over {comparison.error_points_text}'
    return Group(Text(title), transforms, figures, Text(legend))


def _transform_text(row: EstimatorResult) -> str:
    """Return the transform in two lines of three numbers (mm, degrees), or why it failed."""
    if row.T_flange_sensor is None:
        return f'failed: {row.failure}'
    x, y, z = 1e3 * row.T_flange_sensor[:3, 3]
    roll, pitch, yaw = np.degrees(se3.rpy(row.T_flange_sensor))
    return f'{x:9.3f} {y:9.3f} {z:9.3f}\n{roll:9.4f} {pitch:9.4f} {yaw:9.4f}'


def plain_values(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as plain values, in SI units, for YAML."""
    rows = [{'name': row.name, 'failure': row.failure} if row.T_flange_sensor is None else
            {'name': row.name, 'transform': se3.transform_values(row.T_flange_sensor),
             **row.figures} for row in comparison.rows]
    return {'format': FORMAT, 'samples_used': comparison.used,
            'samples_rejected': comparison.rejected, 'estimators': rows}
