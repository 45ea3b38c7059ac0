# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From the stations of several recordings and a calibration to the verdict of a routine.

The decision is that of ISO 14253-1 with the expanded uncertainty U = k u of the measurement here
(sensor, robot, nominal value). The covariance that the calibration claims is what is verified, and
takes no part in U.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, UTC
import math
from pathlib import Path
from typing import Any

from handeye_ros import __version__, output
from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array, Calibration, Reject
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.estimation.least_squares import FALSE_ALARM
from handeye_ros.frames import T_sensor_plane
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.verification_file import (
    CONFORMS,
    decision,
    FORMAT,
    formatted,
    UNDECIDED,
    VIOLATES,
)
from handeye_ros.verification.fit import (
    COVERAGE_FACTOR,
    DETECTION_SIGMAS,
    Fit,
    fit_shape,
    fit_without_outliers,
    Indices,
    Quantity,
    refit_shape,
    Scatter,
    Shape,
    StationSet,
)
from handeye_ros.verification.routines import Routine
import numpy as np

ONE_SIDED_95 = 1.64
SIGNIFICANCE = 0.01  # level of the tests of a calibration error
INCONSISTENT_P = 1e-3  # level of the test that the points agree
UNEXPLAINED_P = 1e-6  # below this p no error of the calibration explains the points


@dataclass(frozen=True)
class StationResult:
    """
    Result of one stop: the largest distance from the fit, and its 1 sigma (m).

    bag, number: of recording, and of the stop among those that show the artefact, from 1
    stamp: ns
    p: probability that a good stop is as far off, whatever the error of the calibration
    reason: why it is not used
    """

    bag: int
    number: int
    stamp: int
    distance: float
    std: float
    p: float
    used: bool = True
    reason: str = ''

    @property
    def name(self) -> str:
        """Return the name of the stop."""
        return f'stop {self.number} of recording {self.bag}'


@dataclass(frozen=True)
class Verification:
    """
    Result of a routine.

    calibration: its name
    verdict: pass, fail, undecided (the uncertainty is too large for the tolerance), or insensitive
        (an error of the calibration as large as the tolerance would not have shown)
    reasons: sentences
    tolerance (m), angle_tolerance (rad): as configured
    stations: number of stops used, of a sweep of profiles
    smallest_error: the smallest detectable error of the calibration, in the least sensitive
        direction (m)
    weakest_direction: this direction, in words
    region: squared distance of the values from their nominals, in units of both covariances
    freedom: number of values with a nominal
    claim_p: probability of a larger region if the calibration's covariance is true
    surface: the choice between several in sight
    says: what the routine measures
    recorded: when (ISO 8601; empty: unknown)
    certificate: U of the nominal values (m)
    record: record.* of the configuration
    """

    routine: str
    calibration: str
    verdict: str
    reasons: tuple[str, ...]
    tolerance: float
    angle_tolerance: float
    stations: int
    quantities: tuple[Quantity, ...]
    scatter: Scatter
    smallest_error: float
    weakest_direction: str
    region: float
    freedom: int
    claim_p: float
    per_station: tuple[StationResult, ...] = ()
    surface: str = ''
    says: str = ''
    recorded: str = ''
    certificate: float = 0.0
    record: dict[str, str] = field(default_factory=dict)


def verify(routine: Routine, stations: StationSet, calibration: Calibration,
           others: Sequence[Reject] = ()) -> Verification:
    """
    Return the verification by a routine.

    stations: of the recordings in the order that the routine expects, with the settings verify.*
    of the artefact; others: the stops that gave no sample. Raises DataError, and InputError where
    two recordings are one.
    """
    stations.require_enough(others)
    config = stations.problem.config
    stops = np.column_stack([stations.stamps, stations.problem.poses.reshape(-1, 16)])
    if len(np.unique(stops, axis=0)) < len(stops):
        raise InputError('two recordings hold the same stops: give one recording of each face, '
                         'ball or pass')
    X = calibration.T_flange_sensor @ T_sensor_plane(config)
    smooth_std = float(calibration.target.get('robot_position_error', 0.0))

    def fitted(groups: Indices) -> tuple[tuple[Shape, Fit], Array, Array, Indices]:
        shape = routine.shape(stations.of_groups(groups), X, config.verify)
        fit = fit_shape(shape, X, calibration.covariance, smooth_std)
        return (shape, fit), fit.white_distances, fit.wrt_unknowns, shape.stations.group_of_point

    (shape, fit), p, dropped = fit_without_outliers(np.unique(stations.group_of_point), fitted)
    if max(fit.scatter.p, fit.p_error) < UNEXPLAINED_P and not routine.in_passes:
        freed = refit_shape(shape, X, calibration.covariance, smooth_std)
        if freed.p_error < UNEXPLAINED_P and freed.scatter.maximum > config.verify.tolerance:
            raise DataError(
                f'this is not what "{routine.name}" measures: no error of the calibration brings '
                f'all points closer than {mm(freed.scatter.maximum)} to its shape. Check which '
                'object was under the sensor, that it did not move, that nothing else was in view '
                '(verify.near), and, of a sweep, that the clocks are as they were (handeye check)')
    quantities = (*fit.quantities, *routine.scatter(shape.stations, fit.distances))
    per_station = _station_results(stations, shape.stations, fit, p, dropped)
    verdict, reasons = _decide(fit, quantities, per_station, config.verify, smooth_std)
    return Verification(
        routine.name, calibration.name, verdict, reasons, config.verify.tolerance,
        config.verify.angle_tolerance, len(np.unique(shape.stations.observations.station)),
        quantities, fit.scatter, fit.detectable_error, fit.weakest_direction, fit.nominal_chi2,
        fit.freedom, fit.claim_p, per_station, stations.surface, says=routine.says,
        recorded=output.time_of(int(stations.stamps.min())), certificate=config.verify.certificate,
        record=dict(config.record))


def _station_results(stations: StationSet, used: StationSet, fit: Fit,
                     p: Mapping[int, float], dropped: Sequence[int]) -> tuple[StationResult, ...]:
    """Return the results of all stops or passes of which points are used, or were left out."""
    results = []
    groups, bags = stations.group_of_pose, stations.recording_of_pose
    for group, first in zip(*np.unique(groups, return_index=True), strict=True):
        bag = int(bags[first])
        before = groups[np.searchsorted(bags, bag)]  # the first one of its bag
        identity = bag + 1, int(group - before) + 1, int(stations.stamps[first])
        rows = np.flatnonzero(used.group_of_point == group)
        if group in dropped:
            results.append(StationResult(*identity, 0.0, 0.0, p[group], False, (
                'it contradicts the others under every possible calibration')))
        elif len(rows):
            worst = rows[np.argmax(np.abs(fit.distances[rows]))]
            results.append(StationResult(
                *identity, float(abs(fit.distances[worst])), float(fit.distance_std[worst]),
                p[group]))
    return tuple(results)


def _decide(fit: Fit, quantities: Sequence[Quantity], stations: Sequence[StationResult],
            limits: VerifyConfig, smooth_std: float) -> tuple[str, tuple[str, ...]]:
    """
    Return the verdict (pass, fail, undecided or insensitive), and its reasons as sentences.

    smooth_std: 1 sigma (m) of the robot's smooth error, which more stops do not reduce.
    """
    used = sum(station.used for station in stations)

    def remedy(size: float, largest: float) -> str:
        """Return what makes a size that is too large, but not hopelessly so, small enough."""
        if DETECTION_SIGMAS * smooth_std > limits.tolerance:
            return (f': the smooth error of the robot that the calibration found '
                    f'({mm(smooth_std)}) hides less')
        return '' if size >= 10 * largest else (
            f': measure at about {math.ceil(used * (size / largest) ** 2)} stops like these, or '
            'turn the sensor more between them')

    other_size = fit.p_error < UNEXPLAINED_P < fit.scatter.p  # the shape fits, but not in its size
    failed, undecided = _values_off(quantities, limits, remedy)
    shown, suggested = _calibration_off(fit, limits, other_size)
    failed += [*_points_off(stations, limits), *shown]
    undecided += [*suggested, *_contradiction(stations)]
    verdict = 'fail' if failed else 'undecided' if undecided else 'pass'
    if not failed and fit.detectable_error > limits.tolerance:
        verdict = 'insensitive'
        undecided.insert(0, (
            'this decides nothing: an error of the calibration would show only from '
            f'{mm(fit.detectable_error)} on ({fit.weakest_direction}), and the tolerance is '
            f'{mm(limits.tolerance)}{remedy(fit.detectable_error, limits.tolerance)}'))
    return verdict, (*failed, *undecided, *_notes(fit, other_size, stations))


def _values_off(quantities: Sequence[Quantity], limits: VerifyConfig,
                remedy: Callable[[float, float], str]) -> tuple[list[str], list[str]]:
    """
    Return the values that violate their tolerance, and those of which that is not decided.

    remedy(size, largest): of an uncertainty that is larger than what the tolerance leaves.
    """
    violated, undecided = list[str](), list[str]()
    for q in quantities:
        if q.error is None:
            continue
        tolerance = limits.tolerance if q.unit == 'm' else limits.angle_tolerance
        off = f'{q.name} is off by {formatted(q.error, q.unit)}'
        U, decided = f'{formatted(q.expanded, q.unit)} (k = {COVERAGE_FACTOR:g})', decision(
            q.error, q.expanded, tolerance)
        if decided == VIOLATES:
            violated.append(f'{off} ± {U}')
        elif decided == UNDECIDED:
            undecided.append(
                f'{off}, its uncertainty is {U}, and together they exceed the tolerance of '
                f'{formatted(tolerance, q.unit)}{remedy(q.expanded, tolerance - abs(q.error))}')
    return violated, undecided


def _points_off(stations: Sequence[StationResult], limits: VerifyConfig) -> list[str]:
    """Return in words which stops surely have points outside of the tolerance."""
    outside = [s for s in stations if s.used and COVERAGE_FACTOR * s.std <= limits.tolerance
               and s.distance - COVERAGE_FACTOR * s.std > limits.tolerance]
    if not outside:
        return []
    worst = max(outside, key=lambda s: s.distance)
    return [f'points of {len(outside)} of {len(stations)} stops lie up to '
            f'{mm(worst.distance)} from the fit (the worst: {worst.name})']


def _calibration_off(fit: Fit, limits: VerifyConfig, other_size: bool
                     ) -> tuple[list[str], list[str]]:
    """
    Return the error of the calibration that violates the tolerance, and one that may, in words.

    other_size: whether another size of the artefact explains it as well.
    """
    decided = decision(fit.largest_error, ONE_SIDED_95 * fit.largest_error_std, limits.tolerance)
    if fit.p_of_error > SIGNIFICANCE or decided == CONFORMS:
        return [], []
    error = (f'an error of the calibration of {mm(fit.largest_error)} ± '
             f'{mm(COVERAGE_FACTOR * fit.largest_error_std)} (k = {COVERAGE_FACTOR:g})')
    if decided == VIOLATES and not other_size:
        return [f'the pattern of the distances matches {error} at the points'], []
    return [], [f'the points suggest {error}, which may exceed the tolerance: measure at more '
                'stops']


def _contradiction(stations: Sequence[StationResult]) -> list[str]:
    """Return in words which used stops contradict the others."""
    names = [s.name for s in stations if s.used and s.p * len(stations) < FALSE_ALARM]
    return [f'{", ".join(names)} contradict the others under every possible calibration, '
            'and without them too little would be left: measure again'] if names else []


def _notes(fit: Fit, other_size: bool, stations: Sequence[StationResult]) -> list[str]:
    """Return what a verdict must be read with, in sentences."""
    notes = [f'{s.name} is left out: {s.reason}' for s in stations if not s.used]
    if fit.scatter.p < INCONSISTENT_P:
        notes.append('the points disagree by more than calibration, noise.sensor and '
                     f'noise.robot_* explain (p = {fit.scatter.p:.1g}): the calibration is worse '
                     'than it claims, the artefact moved, or the noise is set too small')
    if other_size:
        notes.append('the points fit the shape, and no error of the calibration explains these '
                     'deviations: check the nominal values (verify.radius, verify.lengths)')
    if fit.claim_p < SIGNIFICANCE:
        notes.append('the deviations are larger than the calibration claims '
                     f'(p = {fit.claim_p:.1g})')
    return notes


def plain_values(verification: Verification, inputs: Iterable[object] = (),
                 calibration_file: Path | None = None) -> dict[str, Any]:
    """Return a verification, of now and what it comes from, as the content of its YAML."""
    return {'format': FORMAT, 'version': __version__, 'k': COVERAGE_FACTOR, **asdict(verification),
            'inputs': list(map(str, inputs)),
            'calibration_file': input_values(calibration_file) if calibration_file else {},
            'created': datetime.now(UTC).isoformat(timespec='seconds')}
