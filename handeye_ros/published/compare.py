"""Runs all estimators for a target on the same samples."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import time
from typing import Any

from handeye_ros import pipeline, se3, targets
from handeye_ros.checks.consistency import require_certain
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
from handeye_ros.results.truth_file import Errors, errors_against, FIELD, field_points
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.time_offset import synchronised
from handeye_ros.tabulated.method import FileMethod, Input, plane_axes, require_trusted
import numpy as np
from numpy.typing import NDArray

FOLDS = 10

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
    solution = agreed.solution
    known = Known(solution.problem, solution.estimate, solution.noise)
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
