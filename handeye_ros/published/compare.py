# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Puts the same samples through every estimator of a target, and shows them side by side."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
import math
import time
from typing import Any

from handeye_ros import pipeline, se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.published.estimators import Estimator, ESTIMATORS, Given, Stations
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.results.truth_file import errors_against
from handeye_ros.sampling.session import Session
from handeye_ros.tabulated.values import Input, rms, solve
import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

FOLDS = 10
FORMAT = 'handeye_ros/comparison/1'
FAILURES = (DataError, np.linalg.LinAlgError)  # of an estimator
FIGURES = {  # of a row: the head of its column, in which unit, with how many digits
    'residual_rms': ('residual\nmm', 1e3, 4),
    'holdout_rms': ('held out\nmm', 1e3, 4),
    'error_translation': ('error\nmm', 1e3, 4),
    'error_rotation': ('\ndegrees', math.degrees(1), 4),
    'error_mapped_points': ('mapped\nmm', 1e3, 4),
    'seconds': ('time\ns', 1.0, 3)}

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Row:
    """
    Result of one estimator, in SI units.

    T_flange_sensor: (4, 4), None if the estimator failed; failure: the reason. residual_rms: RMS
    residual of the target's own method with this transform, the target fitted to it; holdout_rms:
    the same for stations left out of the estimate. error_...: against the true transform.
    seconds: duration of one fit. None: unknown.
    """

    name: str
    seconds: float
    T_flange_sensor: Array | None = None
    failure: str = ''
    residual_rms: float | None = None
    holdout_rms: float | None = None
    error_translation: float | None = None
    error_rotation: float | None = None
    error_mapped_points: float | None = None


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    The rows, the target's own method first.

    used, rejected: number of stations given to every estimator, and of the others. refusal: why
    the answer of the target's own method is none, or None. over: region of the errors, in words.
    """

    rows: tuple[Row, ...]
    used: int
    rejected: int
    refusal: DataError | None
    over: str


def compare(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
            T_true: Array | None = None, folds: int = FOLDS,
            progress: Progress = lambda doing: None, session: Session | None = None
            ) -> Comparison:
    """
    Return the rows of all estimators for the target, from samples in any order.

    rejects: stations that gave no sample; T_true: T_flange_sensor (4, 4), where it is known;
    folds: how many parts of the stations are left out in turn, 0 for none; progress: receives
    what is being done; session: as in pipeline.answer. All estimators are given the stations
    that the target's own method believes. Raises DataError where it believes none, BadValueError
    for a target or method that does not exist.
    """
    targets.target_for(config)
    config = replace(config, method='auto')
    progress(config.target.type)
    start = time.perf_counter()
    answer = pipeline.answer(samples, rejects, config, session=session)
    solution = answer.consensus()
    seconds = time.perf_counter() - start
    # the others know no motion
    used = tuple(replace(answer.samples[i], motion=None) for i in solution.used)
    given = Stations(used, config, solution.problem, solution.estimate, solution.noise)
    rejected = len(samples) + len(rejects) - len(used)
    return _compared(given, solution.estimate.X, answer.refusal, seconds, rejected, T_true, folds,
                     progress)


def compare_files(given: Input, T_true: Array | None = None, folds: int = FOLDS,
                  progress: Progress = lambda doing: None) -> Comparison:
    """Return the rows of all estimators for values read from files; see `compare`."""
    values, refusal = given.values, None
    progress(values.name)
    start = time.perf_counter()
    answer = solve(values, given.otherwise)
    try:
        answer.require_trusted(values)
    except DataError as error:
        refusal = error
    seconds = time.perf_counter() - start
    agreed = values.subset(np.flatnonzero(answer.used))
    return _compared(agreed, answer.X, refusal, seconds, len(values) - len(agreed), T_true, folds,
                     progress)


def _compared(given: Given, X: Array, refusal: DataError | None, seconds: float, rejected: int,
              T_true: Array | None, folds: int, progress: Progress) -> Comparison:
    """Return the row of the target's own method, whose answer is X, and those of the others."""
    def row_of(estimator: Estimator, X: Array, seconds: float) -> Row:
        every, errors = np.arange(len(given)), {}
        if T_true is not None:
            errors = {f'error_{name}': value for name, value in asdict(
                errors_against(X, T_true @ given.axes, given.field())).items()}
        left_out = None
        if folds and estimator.refit:
            left_out = _left_out(given, estimator, min(folds, len(given)), progress)
        return Row(estimator.name, seconds, X @ se3.inverse(given.axes), '',
                   rms(given.residuals(X, every, every)), left_out, **errors)

    own, *others = ESTIMATORS[given.config.target.type]
    rows = [Row(own.name, seconds, failure=str(refusal)) if refusal else row_of(own, X, seconds)]
    for estimator in others:
        progress(estimator.name)
        start = time.perf_counter()
        try:
            X = estimator.fit(given)
        except FAILURES as error:
            rows.append(Row(estimator.name, time.perf_counter() - start, failure=str(error)))
        else:
            rows.append(row_of(estimator, X, time.perf_counter() - start))
    return Comparison(tuple(rows), len(given), rejected, refusal, given.over)


def _left_out(given: Given, estimator: Estimator, folds: int, progress: Progress) -> float | None:
    """Return the RMS residual of samples that the estimator was not given, None if it fails."""
    residuals, every = [], np.arange(len(given))
    for part in range(folds):
        progress(f'{estimator.name}: left out, part {part + 1} of {folds}')
        out = every % folds == part
        try:
            X = estimator.fit(given.subset(every[~out]))
        except FAILURES:
            return None
        residuals.append(given.residuals(X, every[~out], every[out]))
    return rms(np.concatenate(residuals))


def tables(comparison: Comparison) -> RenderableType:
    """Return the transforms of all rows, and below them their figures."""
    rows = comparison.rows
    transforms, figures = (Table(box=box.SIMPLE_HEAD, pad_edge=False) for _ in range(2))
    for column in ('estimator', 'x, y, z (mm)\nroll, pitch, yaw (degrees)'):
        transforms.add_column(column)
    with_errors = any(row.error_mapped_points for row in rows)
    shown = {name: column for name, column in FIGURES.items()
             if with_errors or not name.startswith('error')}
    figures.add_column('estimator')
    for head, _, _ in shown.values():
        figures.add_column(head, justify='right', no_wrap=True)
    for row in rows:
        T, texts = row.T_flange_sensor, []
        transforms.add_row(row.name, Text(
            f'failed: {row.failure}' if T is None else
            ' '.join(f'{v * 1e3:9.3f}' for v in T[:3, 3]) + '\n'
            + ' '.join(f'{math.degrees(a):9.4f}' for a in se3.rpy(T))))
        for name, (_, unit, digits) in shown.items():
            value = getattr(row, name)
            texts.append('-' if value is None else f'{value * unit:.{digits}f}')
        figures.add_row(row.name, *texts)
    lost = f', {comparison.rejected} rejected' if comparison.rejected else ''
    title = (f'{comparison.used} samples{lost}. The published estimators are given what '
             f'{rows[0].name} finds: which samples agree, and the labels, sides or start that '
             'they need.')
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
        figures = {name: getattr(row, name) for name in FIGURES}
        rows.append({'name': row.name, 'transform': transform_values(row.T_flange_sensor),
                     **{name: value for name, value in figures.items()
                        if value is not None or not name.startswith('error')}})
    return {'format': FORMAT, 'samples_used': comparison.used,
            'samples_rejected': comparison.rejected, 'estimators': rows}
