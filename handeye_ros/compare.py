"""The same samples through every estimator that applies to the target, side by side."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import time

from handeye_ros import methods, pipeline, se3
from handeye_ros.border import without_border_ends
from handeye_ros.config import Config
from handeye_ros.data import Array, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.estimators import Estimator, ESTIMATORS, Known, Stations
from handeye_ros.identify import require_certain
from handeye_ros.method import Estimate
from handeye_ros.outcome import measured_points, sensor_axes
from handeye_ros.pairing import Session
from handeye_ros.solve import least_squares, Problem
from handeye_ros.verify import Errors, errors_against
import numpy as np
from numpy.typing import NDArray

FOLDS = 10

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Row:
    """
    What became of one estimator.

    T_flange_sensor: (4, 4), None when it failed, then failure is the reason. residual_rms: of
    the residuals of the target's own method with this transform, the target fitted to it;
    holdout_rms: the same of stations that the estimator was not given (metres; None: not
    known). errors: against the truth, where that is known. seconds: of one fit.
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

    used, rejected: how many stations every estimator was given, and how many not. refusal: why
    the target's own method has no answer, or None.
    """

    rows: tuple[Row, ...]
    used: int
    rejected: int
    refusal: DataError | None

    @property
    def answered(self) -> bool:
        """Return whether any estimator has an answer."""
        return any(row.T_flange_sensor is not None for row in self.rows)


def compare_recording(profiles: Iterable[Profile], poses: Iterable[TimedPose], config: Config,
                      T_true: Array | None = None, progress: Progress = lambda doing: None
                      ) -> Comparison:
    """
    Return the rows of all estimators from a recording; see `compare`.

    Raises DataError when the recording holds no stations.
    """
    session = Session(own_method(config))
    for pose in poses:
        session.add_pose(pose)
    for profile in profiles:
        session.add_profile(profile)
    session.finish()
    session.require_stations()
    return compare(session.samples, session.rejects, config, T_true, progress=progress)


def own_method(config: Config) -> Config:
    """Return the configuration with the method of its target; raises BadValueError."""
    methods.of(config)
    return replace(config, method='auto')


def compare(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
            T_true: Array | None = None, folds: int = FOLDS,
            progress: Progress = lambda doing: None) -> Comparison:
    """
    Return the rows of all estimators for the target, from samples in any order.

    rejects: stations that gave no sample; T_true: T_flange_sensor (4, 4), where it is known;
    folds: how many parts of the stations are left out in turn, 0 for none; progress: is told
    what is being done. All estimators are given the stations that the target's own method
    believes. Raises BadValueError for a target or method that does not exist.
    """
    config = own_method(config)
    own, *others = ESTIMATORS[methods.of(config).name]
    ordered, at_border = without_border_ends(sorted(samples, key=lambda sample: sample.stamp))
    progress(own.name)
    start = time.perf_counter()
    stations, refusal = _believed(ordered, [*rejects, *at_border], config)
    first = Row(own.name, time.perf_counter() - start, failure=str(refusal or ''))
    if stations.known and not refusal:
        first = _judged(first, own, stations, stations.known.estimate.X, T_true, folds, progress)
    rows = (first, *(_row(estimator, stations, T_true, folds, progress) for estimator in others))
    used = len(stations.samples)
    return Comparison(rows, used, len(samples) + len(rejects) - used, refusal)


def _believed(ordered: Sequence[Sample], rejects: Sequence[Reject], config: Config
              ) -> tuple[Stations, DataError | None]:
    """Return the stations that the target's own method believes, and why it has no answer."""
    try:
        agreed, solution = pipeline.estimate(ordered, rejects, config)
    except DataError as error:
        return Stations(tuple(ordered), config), error
    known = Known(solution.problem, solution.estimate, solution.noise)
    stations = Stations(tuple(ordered[i] for i in agreed.used), config, known)
    try:
        require_certain(solution, config)
    except DataError as error:
        return stations, error
    return stations, None


def _row(estimator: Estimator, stations: Stations, T_true: Array | None, folds: int,
         progress: Progress) -> Row:
    """Return the row of an estimator, with its reason when it fails."""
    progress(estimator.name)
    start = time.perf_counter()
    try:
        X = estimator.fit(stations)
    except (DataError, np.linalg.LinAlgError) as error:
        return Row(estimator.name, time.perf_counter() - start, failure=str(error))
    row = Row(estimator.name, time.perf_counter() - start)
    return _judged(row, estimator, stations, X, T_true, folds, progress)


def _judged(row: Row, estimator: Estimator, stations: Stations, X: Array, T_true: Array | None,
            folds: int, progress: Progress) -> Row:
    """Return a row with the transform from the sensor plane X (4, 4) and all that tells of it."""
    T_sensor_plane = sensor_axes(stations.config)
    row = replace(row, T_flange_sensor=X @ se3.inverse(T_sensor_plane))
    if T_true is not None:
        row = replace(row, errors=errors_against(X, T_true @ T_sensor_plane))
    if stations.known is None:
        return row
    every = np.arange(len(stations.samples))
    row = replace(row, residual_rms=_root_mean_square(_residuals(stations, X, every, every)))
    if not folds or not estimator.refit:
        return row
    return replace(row, holdout_rms=_left_out(estimator, stations, folds, progress))


class _GivenTransform(Problem):
    """A problem of which only the target is unknown."""

    @property
    def columns(self) -> NDArray[np.intp]:
        return super().columns[6:]


def _residuals(stations: Stations, X: Array, fitted: NDArray[np.intp],
               measured: NDArray[np.intp]) -> Array:
    """Return the residuals of some stations with a transform, the target fitted to others."""
    assert stations.known
    known = stations.known
    part = known.problem.subset(fitted)
    given = _GivenTransform(part.method, part.poses, part.observations, part.config)
    estimate = least_squares(given, Estimate(X, known.estimate.target), known.noise)
    points = measured_points(stations.samples, known.problem)
    return points.select(np.isin(points.station, measured)).residuals(known.problem, estimate)


def _left_out(estimator: Estimator, stations: Stations, folds: int, progress: Progress
              ) -> float | None:
    """Return the RMS residual of each part of the stations, the rest having been fitted anew."""
    residuals = []
    for part, (rest, left_out) in enumerate(_split(len(stations.samples), folds)):
        progress(f'{estimator.name}: left out, part {part + 1} of {folds}')
        try:
            X = estimator.fit(stations.subset(rest))
        except (DataError, np.linalg.LinAlgError):
            return None
        residuals.append(_residuals(stations, X, rest, left_out))
    return _root_mean_square(np.concatenate(residuals))


def _split(count: int, folds: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield the indices that remain and those left out, for each part that is not empty."""
    index = np.arange(count)
    for part in range(min(folds, count)):
        mine = index % folds == part
        yield index[~mine], index[mine]


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt((values ** 2).mean()))
