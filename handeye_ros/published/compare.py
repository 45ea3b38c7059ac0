# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Runs every estimator that applies to a target, ours and the published ones, on the same samples.

A published estimator is given what it cannot find itself, from the answer of the target's own
method: which edge a point is on (Chen 2023), on which side of the laser the centre of the ball is
(fixed point), where to start (Zheng 2018).
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
import time
from typing import Any, TypeAlias

from handeye_ros import pipeline, se3, targets
from handeye_ros.checks.consistency import require_certain, require_rotations
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, EdgePoint, Reject, Sample
from handeye_ros.errors import DataError, SingularError
from handeye_ros.estimation.noise import Noise
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import fit as fit_target
from handeye_ros.frames import mount_frame, sensor_axes
from handeye_ros.published import chen2023, cn105021139a, fixed_point, wu2017, zheng2018
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.results.outcome import measured_points
from handeye_ros.results.truth_file import Errors, errors_against, FIELD, field_points
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.sweep import synchronised
from handeye_ros.tabulated import hand_eye
from handeye_ros.tabulated.method import FileMethod, Input, plane_axes, require_trusted
from handeye_ros.targets import line, plate
import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

FOLDS = 10
FORMAT = 'handeye_ros/comparison/1'

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

    method: FileMethod[Any]
    data: Any
    config: Config

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.method.samples(self.data))

    def subset(self, samples: NDArray[np.intp]) -> Measurements:
        """Return some of the samples (ascending indices)."""
        return replace(self, data=self.method.subset(self.data, samples))

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """Return distances (m) of `measured` samples for X, the target fitted to `fitted` ones."""
        return self.method.residuals(self.data, X, fitted, measured, self.config)


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
        agreed = pipeline.estimate(stations.samples, (), config)
        require_certain(agreed, config)
        return agreed.estimate.X
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
    answer = given.method.solve(given.data, given.config)
    require_trusted(given.method, answer, given.config)
    return answer.X


def _park(given: Measurements) -> Array:
    require_rotations(given.data.T_fixed_mount, mount_frame(given.config),
                      hand_eye.LOST)
    return hand_eye.closed_form(given.data.T_fixed_mount, given.data.T_camera_target)[0]


def _cn105021139a(given: Measurements) -> Array:
    return np.asarray(cn105021139a.solve_motions(*cn105021139a.motions(
        given.data.T_fixed_mount, given.data.T_camera_target)))


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
            given.data.in_camera, given.data.in_base).T_base_camera),
    ),
    'hand_eye': (
        Estimator('hand_eye', _from_files),
        Estimator('closed form (Park and Martin 1994)', _park),
        Estimator('CN105021139A', _cn105021139a),
    ),
    'tracker': (
        Estimator('tracker', lambda given: given.data.chain(given.config).T_flange_sensor),
    ),
}
"""By target, its own method first."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Row:
    """
    Result of one estimator.

    T_flange_sensor: (4, 4), None if the estimator failed; failure: the reason. residual_rms: RMS
    residual of the target's own method with this transform, the target fitted to it; holdout_rms:
    the same for stations left out of the estimate (metres; None: unknown). errors: against the
    true transform, None if unknown. seconds: duration of one fit.
    """

    name: str
    seconds: float
    T_flange_sensor: Array | None = None
    failure: str = ''
    residual_rms: float | None = None
    holdout_rms: float | None = None
    errors: Errors | None = None


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    The rows, the target's own method first.

    used, rejected: number of stations given to every estimator, and of the others. refusal: why
    the target's own method has no answer, or None. over: region of the errors, in words.
    """

    rows: tuple[Row, ...]
    used: int
    rejected: int
    refusal: DataError | None
    over: str = FIELD

    @property
    def answered(self) -> bool:
        """Return whether any estimator has an answer."""
        return any(row.T_flange_sensor is not None for row in self.rows)


def own_method(config: Config) -> Config:
    """Return the configuration with the method of its target; raises BadValueError."""
    targets.method_for(config)
    return replace(config, method='auto')


def compare(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
            T_true: Array | None = None, folds: int = FOLDS,
            progress: Progress = lambda doing: None) -> Comparison:
    """
    Return the rows of all estimators for the target, from samples in any order.

    rejects: stations that gave no sample; T_true: T_flange_sensor (4, 4), where it is known;
    folds: how many parts of the stations are left out in turn, 0 for none; progress: receives
    what is being done. All estimators are given the stations that the target's own method
    believes. Raises BadValueError for a target or method that does not exist.
    """
    config = own_method(config)
    ordered = with_common_shape(sorted(samples, key=lambda sample: sample.stamp))
    progress(config.target.type)
    start = time.perf_counter()
    stations, refusal = _believed(ordered, rejects, config)
    seconds = time.perf_counter() - start
    X = stations.known.estimate.X if stations.known and not refusal else None
    return _compared(stations, X, refusal, seconds, len(samples) + len(rejects),
                     _Judge(T_true, folds, progress, sensor_axes(config), field_points()))


def compare_files(method: FileMethod[Any], given: Input[Any], config: Config,
                  T_true: Array | None = None, folds: int = FOLDS,
                  progress: Progress = lambda doing: None) -> Comparison:
    """Return the rows of all estimators for values read from files; see `compare`."""
    progress(method.name)
    start = time.perf_counter()
    measured, X, refusal = Measurements(method, given.data, config), None, None
    total = len(measured)
    try:
        answer = method.solve(given.data, config)
        measured = replace(measured, data=answer.agreed)
        require_trusted(method, answer, config)
        X = answer.X
    except DataError as error:
        refusal = error
    seconds = time.perf_counter() - start
    judge = _Judge(T_true, folds, progress, plane_axes(method, config),
                   method.field(measured.data))
    found = _compared(measured, X, refusal, seconds, total, judge)
    return replace(found, over=method.over)


@dataclass(frozen=True, eq=False)
class _Judge:
    """
    What all rows are compared with: see `compare`.

    T_sensor_plane: (4, 4), the sensor plane to which X refers; field: points (k, 3) in it over
    which errors are reported.
    """

    T_true: Array | None
    folds: int
    progress: Progress
    T_sensor_plane: Array
    field: Array


def _compared(given: Given, X: Array | None, refusal: DataError | None, seconds: float,
              total: int, judge: _Judge) -> Comparison:
    """Return the rows; the first is the answer X of the target's own method, if any."""
    own, *others = ESTIMATORS[given.config.target.type]
    first = Row(own.name, seconds, failure=str(refusal or ''))
    if X is not None:
        first = _judged(first, own, given, X, judge)
    rows = (first, *(_row(estimator, given, judge) for estimator in others))
    return Comparison(rows, len(given), total - len(given), refusal)


def _believed(ordered: Sequence[Sample], rejects: Sequence[Reject], config: Config
              ) -> tuple[Stations, DataError | None]:
    """Return the stations used by the target's own method, and why it has no answer."""
    try:
        moved = synchronised(ordered, config)
        agreed = pipeline.estimate(moved.samples, rejects, config, moved.estimate)
    except DataError as error:
        return Stations(tuple(ordered), config), error
    ordered = [replace(sample, motion=None) for sample in moved.samples]  # others: no motion
    known = Known(agreed.problem, agreed.estimate, agreed.noise)
    stations = Stations(tuple(ordered[i] for i in agreed.used), config, known)
    try:
        require_certain(agreed, config)
    except DataError as error:
        return stations, error
    return stations, None


def _row(estimator: Estimator, given: Given, judge: _Judge) -> Row:
    """Return the row of an estimator, with the reason if it fails."""
    judge.progress(estimator.name)
    start = time.perf_counter()
    try:
        X = estimator.fit(given)
    except (DataError, np.linalg.LinAlgError) as error:
        return Row(estimator.name, time.perf_counter() - start, failure=str(error))
    row = Row(estimator.name, time.perf_counter() - start)
    return _judged(row, estimator, given, X, judge)


def _judged(row: Row, estimator: Estimator, given: Given, X: Array, judge: _Judge) -> Row:
    """Return a row with a transform X (4, 4) of the sensor plane, its errors and residuals."""
    row = replace(row, T_flange_sensor=X @ se3.inverse(judge.T_sensor_plane))
    if judge.T_true is not None:
        T_true = judge.T_true @ judge.T_sensor_plane
        row = replace(row, errors=errors_against(X, T_true, judge.field))
    every = np.arange(len(given))
    residuals = given.residuals(X, every, every)
    if residuals is None:
        return row
    row = replace(row, residual_rms=_root_mean_square(residuals))
    if not judge.folds or not estimator.refit:
        return row
    return replace(row, holdout_rms=_left_out(estimator, given, judge))


def _left_out(estimator: Estimator, given: Given, judge: _Judge) -> float | None:
    """Return the cross-validated RMS residual over the parts of the samples."""
    residuals = []
    for part, (rest, left_out) in enumerate(_split(len(given), judge.folds)):
        judge.progress(f'{estimator.name}: left out, part {part + 1} of {judge.folds}')
        try:
            found = given.residuals(estimator.fit(given.subset(rest)), rest, left_out)
        except (DataError, np.linalg.LinAlgError):
            return None
        residuals += [] if found is None else [found]
    return _root_mean_square(np.concatenate(residuals))


def _split(count: int, folds: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield the remaining and the left-out indices for each part that is not empty."""
    index = np.arange(count)
    for part in range(min(folds, count)):
        mine = index % folds == part
        yield index[~mine], index[mine]


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt((values ** 2).mean()))


def tables(comparison: Comparison) -> RenderableType:
    """Return the transforms of all rows, and below them their figures."""
    with_errors = any(row.errors for row in comparison.rows)
    lost = f', {comparison.rejected} rejected' if comparison.rejected else ''
    title = (f'{comparison.used} samples{lost}. The published estimators are given what '
             f'{comparison.rows[0].name} finds: which samples agree, and the labels, sides or '
             'start that they need.')
    transforms, figures = (Table(box=box.SIMPLE_HEAD, pad_edge=False) for _ in range(2))
    transforms.add_column('estimator')
    transforms.add_column('x, y, z (mm)\nroll, pitch, yaw (degrees)')
    figures.add_column('estimator')
    errors = ('error\nmm', '\ndegrees', 'mapped\nmm') if with_errors else ()
    for name in ('residual\nmm', 'held out\nmm', *errors, 'time\ns'):
        figures.add_column(name, justify='right', no_wrap=True)
    for row in comparison.rows:
        T, e = row.T_flange_sensor, row.errors
        transforms.add_row(row.name, Text(
            f'failed: {row.failure}' if T is None else
            ' '.join(f'{v * 1e3:9.3f}' for v in T[:3, 3]) + '\n'
            + ' '.join(f'{math.degrees(a):9.4f}' for a in se3.rpy(T))))
        lengths = [row.residual_rms, row.holdout_rms]
        texts = ['-' if v is None else f'{v * 1e3:.4f}' for v in lengths]
        if with_errors:
            texts += ['-'] * 3 if e is None else [
                f'{e.translation * 1e3:.4f}', f'{math.degrees(e.rotation):.4f}',
                f'{e.mapped_points * 1e3:.4f}']
        figures.add_row(row.name, *texts, f'{row.seconds:.3f}')
    legend = ('residual: RMS of what the first method minimises, with each transform, the target '
              'fitted to it; held out: of samples the estimator was not given')
    if with_errors:
        legend += f'\nerror: against truth.yaml; mapped: RMS over {comparison.over}'
    return Group(Text(title), transforms, figures, Text(legend))


def values(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as plain values, in SI units, for YAML."""
    rows: list[dict[str, Any]] = []
    for row in comparison.rows:
        if row.T_flange_sensor is None:
            rows.append({'name': row.name, 'failure': row.failure})
            continue
        e = row.errors
        rows.append({
            'name': row.name, 'transform': transform_values(row.T_flange_sensor),
            'residual_rms': row.residual_rms, 'holdout_rms': row.holdout_rms,
            **({'error_translation': e.translation, 'error_rotation': e.rotation,
                'error_mapped_points': e.mapped_points} if e else {}),
            'seconds': row.seconds})
    return {'format': FORMAT, 'samples_used': comparison.used,
            'samples_rejected': comparison.rejected, 'estimators': rows}
