# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Puts the same samples through every estimator of a target, and shows them side by side."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
import time
from typing import Any

from handeye_ros import pipeline, se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.frames import sensor_axes
from handeye_ros.published.estimators import (
    Estimator,
    ESTIMATORS,
    Given,
    Known,
    Measurements,
    Stations,
)
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.results.truth_file import Errors, errors_against, FIELD, field_points
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.tabulated.method import (
    FileMethod,
    Input,
    plane_axes,
    require_trusted,
    solve,
)
import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

FOLDS = 10
FORMAT = 'handeye_ros/comparison/1'

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
    start, X, refusal = time.perf_counter(), None, None
    stations = Stations(tuple(ordered), config)
    try:
        answer = pipeline.answer(ordered, rejects, config)
        solution = answer.consensus()
        # the others know no motion
        used = [replace(answer.samples[i], motion=None) for i in solution.used]
        stations = Stations(tuple(used), config,
                            Known(solution.problem, solution.estimate, solution.noise))
        answer.required()
        X = solution.estimate.X
    except DataError as error:
        refusal = error
    seconds = time.perf_counter() - start
    judge = _Judge(stations, T_true, folds, progress, sensor_axes(config), field_points())
    return Comparison(tuple(judge.rows(X, refusal, seconds)), len(stations),
                      len(samples) + len(rejects) - len(stations), refusal)


def compare_files(method: FileMethod, given: Input, config: Config,
                  T_true: Array | None = None, folds: int = FOLDS,
                  progress: Progress = lambda doing: None) -> Comparison:
    """Return the rows of all estimators for values read from files; see `compare`."""
    progress(method.name)
    start, X, refusal = time.perf_counter(), None, None
    measured = Measurements(method, given.values, config)
    total = len(measured)
    try:
        answer = solve(method, given.values, config)
        measured = replace(measured, values=answer.agreed)
        require_trusted(method, answer, config)
        X = answer.X
    except DataError as error:
        refusal = error
    seconds = time.perf_counter() - start
    judge = _Judge(measured, T_true, folds, progress, plane_axes(method, config),
                   measured.values.field())
    return Comparison(tuple(judge.rows(X, refusal, seconds)), len(measured),
                      total - len(measured), refusal, method.over)


@dataclass(frozen=True, eq=False)
class _Judge:
    """
    What all estimators are given, and compared with: see `compare`.

    T_sensor_plane: (4, 4), the sensor plane to which X refers; field: points (k, 3) in it over
    which errors are reported.
    """

    given: Given
    T_true: Array | None
    folds: int
    progress: Progress
    T_sensor_plane: Array
    field: Array

    def rows(self, X: Array | None, refusal: DataError | None, seconds: float) -> Iterator[Row]:
        """Yield the row of the target's own method, whose answer is X, and of the others."""
        own, *others = ESTIMATORS[self.given.config.target.type]
        first = Row(own.name, seconds, failure=str(refusal or ''))
        yield first if X is None else self.judged(first, own, X)
        for estimator in others:
            self.progress(estimator.name)
            start, X, failure = time.perf_counter(), None, ''
            try:
                X = estimator.fit(self.given)
            except (DataError, np.linalg.LinAlgError) as error:
                failure = str(error)
            row = Row(estimator.name, time.perf_counter() - start, failure=failure)
            yield row if X is None else self.judged(row, estimator, X)

    def judged(self, row: Row, estimator: Estimator, X: Array) -> Row:
        """Return a row with a transform X (4, 4) of the sensor plane, its errors and residuals."""
        row = replace(row, T_flange_sensor=X @ se3.inverse(self.T_sensor_plane))
        if self.T_true is not None:
            T_true = self.T_true @ self.T_sensor_plane
            row = replace(row, errors=errors_against(X, T_true, self.field))
        every = np.arange(len(self.given))
        residuals = self.given.residuals(X, every, every)
        if residuals is None:
            return row
        row = replace(row, residual_rms=_root_mean_square(residuals))
        if not self.folds or not estimator.refit:
            return row
        return replace(row, holdout_rms=self.left_out(estimator))

    def left_out(self, estimator: Estimator) -> float | None:
        """Return the cross-validated RMS residual over the parts of the samples."""
        residuals, index = [], np.arange(len(self.given))
        for part in range(min(self.folds, len(index))):
            self.progress(f'{estimator.name}: left out, part {part + 1} of {self.folds}')
            mine = index % self.folds == part
            try:
                X = estimator.fit(self.given.subset(index[~mine]))
                found = self.given.residuals(X, index[~mine], index[mine])
            except (DataError, np.linalg.LinAlgError):
                return None
            residuals += [] if found is None else [found]
        return _root_mean_square(np.concatenate(residuals))


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
