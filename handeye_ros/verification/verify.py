# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From the stations of several recordings and a calibration to the verdict of a routine.

The decisions are those of ISO 14253-1: a tolerance with a margin on both sides, a factor times the
uncertainty u of the measurement here (sensor, robot, nominal value). The margin is

- for values with a nominal, and points: the expanded uncertainty U = 2 u; a point decides only
  where it does not conform
- for the calibration's error, if chance does not explain it (p_chance): 1.64 u, one-sided 95 %

It is insensitive where an error of the calibration as large as the tolerance is more often missed
than found (EVEN_CHANCE_SIGMAS); where it is missed in more than 5 % of cases (DETECTION_SIGMAS), a
note says so. The covariance that the calibration states is what is verified, and takes no part in
u.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
import math

from handeye_ros import output
from handeye_ros.config import Config, VerifyConfig
from handeye_ros.data import Calibration, Reject, ROBOT_POSITION_ERROR, Sample
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.outliers import FALSE_ALARM
from handeye_ros.frames import T_sensor_plane
from handeye_ros.verification.fit import (
    COVERAGE_FACTOR,
    EVEN_CHANCE_SIGMAS,
    fit_shape,
    INCONSISTENT_P,
    Quantity,
    refit_shape,
    ShapeFit,
    SIGNIFICANCE,
)
from handeye_ros.verification.group_fit import fit_without_outliers, ONE_SIDED_95
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.station_set import StationSet, stop_number
from handeye_ros.verification.stations import stations_of
from handeye_ros.words import count_of, mm
import numpy as np

UNEXPLAINED_P = 1e-6  # below this p no error of the calibration explains the points
OTHER_SIZE = ('the points fit the shape, and no error of the calibration explains these '
              'deviations: check the nominal values (verify.radius, verify.lengths)')
CONTRADICTS = 'it contradicts the others under every possible calibration'
# decisions of ISO 14253-1
CONFORMS, VIOLATES, UNDECIDED = 'conforms', 'does not conform', 'not decided'


@dataclass(frozen=True)
class GroupResult:
    """
    Result of one group of poses (see station_set.py).

    label: what it is called in a sentence; it is written to no file
    recording: its number, from 1
    number: from 1, of the stop among all of this recording, as a check counts them; of a profile
        among those used; of a pass 1, the only one of its recording
    stamp: its time in nanoseconds
    distance, std: the largest distance of its points from the fit, and its 1 sigma (m), nan where
        it is not used
    p: probability that a good stop is as far off, whatever the error of the calibration
    reason: CONTRADICTS where it is not used
    """

    label: str
    recording: int
    number: int
    stamp: int
    distance: float
    std: float
    p: float
    used: bool = True
    reason: str = ''


@dataclass(frozen=True)
class Verification:
    """
    Result of a routine.

    routine, calibration: their names
    verdict: pass, fail, undecided (a doubt, see _decide), or insensitive (see the module); fail
        before insensitive before undecided before pass
    reasons: sentences
    tolerance (m), angle_tolerance (rad): as configured
    station_count: number of poses used: of stops, of a sweep or of passes of profiles
    quantities: those of the fit, the scatter of each face or ball, and the error of the
        calibration that the points suggest, as the largest displacement of one of them
    fit: of the shape of the routine
    per_group: the results of all groups of poses that show the artefact
    surface: a sentence on the choice between several surfaces in sight
    measures: see Routine
    recorded: the time of the first stop (ISO 8601), empty where it is not known
    certificate: U of the nominal values (m)
    record: record.* of the configuration
    """

    routine: str
    calibration: str
    verdict: str
    reasons: tuple[str, ...]
    tolerance: float
    angle_tolerance: float
    station_count: int
    quantities: tuple[Quantity, ...]
    fit: ShapeFit
    per_group: tuple[GroupResult, ...] = ()
    surface: str = ''
    measures: str = ''
    recorded: str = ''
    certificate: float = 0.0
    record: dict[str, str] = field(default_factory=dict)


def verify_stations(routine: Routine, stations: StationSet, calibration: Calibration,
                    rejects: Sequence[Sequence[Reject]] = ()) -> Verification:
    """
    Return the result of a routine: its fit, and the verdict on the calibration.

    stations: of the recordings in the order that the routine expects, with the settings verify.*
    of the artefact; rejects: the stops of each recording that gave no sample. Raises DataError,
    and InputError where two recordings are one, or the covariance of the calibration is
    impossible.
    """
    stations.require_enough([*chain.from_iterable(rejects)])
    config, settings = stations.problem.config, stations.problem.config.verify
    stops = np.column_stack([stations.stamps, stations.problem.poses.reshape(-1, 16)])
    if len(np.unique(stops, axis=0)) < len(stops):
        raise InputError('two recordings hold the same stops: give one recording of each face, '
                         'ball or pass')
    X = calibration.T_flange_sensor @ T_sensor_plane(config)
    robot_smooth = float(calibration.target.get(ROBOT_POSITION_ERROR, 0.0))
    (shape, fit), p, dropped = fit_without_outliers(
        np.unique(stations.group_of_point), lambda groups: fit_shape(
            routine.shape(stations.of_groups(groups), X, settings), X,
            calibration.covariance, robot_smooth))
    # tooth_gauge.py refuses what is no gauge; a wrong calibration, which blurs it, is to fail
    if max(fit.scatter.p, fit.misalignment.p_explained) < UNEXPLAINED_P and not routine.in_passes:
        freed = refit_shape(shape, X, calibration.covariance, robot_smooth)
        if (freed.misalignment.p_explained < UNEXPLAINED_P
                and freed.scatter.maximum > settings.tolerance):
            raise DataError(
                f'this is not what "{routine.name}" measures: no small error of the calibration '
                f'brings all points closer than {mm(freed.scatter.maximum)} to its shape. Check '
                'that the calibration is of this sensor, which object was under it, that the '
                'object did not move, that nothing else was in view (verify.near), and, of a '
                'sweep, that the clocks are as they were (handeye check)')
    quantities = (*fit.quantities, *routine.form_errors(shape.stations, fit.distances), Quantity(
        'likeliest error of the calibration', fit.misalignment.largest,
        fit.misalignment.largest_std))
    group_noun = 'pass' if routine.in_passes else 'profile' if config.sampling.moving else 'stop'
    per_group = _group_results(group_noun, stations, shape.stations, fit, p, dropped,
                               rejects if group_noun == 'stop' else ())
    verdict, reasons = _decide(fit, quantities, per_group, group_noun, settings, robot_smooth)
    return Verification(
        routine.name, calibration.name, verdict, reasons, settings.tolerance,
        settings.angle_tolerance, len(np.unique(shape.stations.observations.station)), quantities,
        fit, per_group, surface=stations.surface_note, measures=routine.measures,
        recorded=output.iso_time(int(stations.stamps.min())), certificate=settings.certificate,
        record=dict(config.record))


def verify_stops(routine: Routine, recordings: Sequence[Sequence[Sample | Reject]],
                 calibration: Calibration, config: Config) -> Verification:
    """
    Return the result of a routine by what the stops of each recording, a face or ball, gave.

    config: Routine.settings. Raises as stations_of and verify_stations do.
    """
    samples = [[stop for stop in stops if isinstance(stop, Sample)] for stops in recordings]
    rejects = [[stop for stop in stops if isinstance(stop, Reject)] for stops in recordings]
    return verify_stations(routine, stations_of(routine, samples, calibration, config),
                           calibration, rejects)


def _group_results(group_noun: str, stations: StationSet, used: StationSet, fit: ShapeFit,
                   p: Mapping[int, float], dropped: Sequence[int],
                   rejects: Sequence[Sequence[Reject]]) -> tuple[GroupResult, ...]:
    """
    Return the results of all groups of poses that have points, or contradict the others.

    group_noun: what a group is, stop, profile or pass; used: the stations as fitted, without
    contradicting groups (dropped); p: of each group; rejects: stops of each recording that count,
    but gave no sample.
    """
    results = []
    groups, recordings = stations.group_of_pose, stations.recording_of_pose
    for group, first in zip(*np.unique(groups, return_index=True), strict=True):
        recording, stamp = int(recordings[first]), int(stations.stamps[first])
        number = stop_number(stamp, [
            *stations.stamps[recordings == recording].tolist(),
            *(reject.stamp for reject in (rejects[recording] if rejects else ()))])
        identity = (f'{group_noun} {number} of recording {recording + 1}', recording + 1, number,
                    stamp)
        rows = np.flatnonzero(used.group_of_point == group)
        if group in dropped:
            results.append(
                GroupResult(*identity, math.nan, math.nan, p[group], False, CONTRADICTS))
        elif len(rows):
            worst = rows[np.argmax(np.abs(fit.distances[rows]))]
            results.append(GroupResult(
                *identity, float(abs(fit.distances[worst])), float(fit.distance_stds[worst]),
                p[group]))
    return tuple(results)


def _decide(fit: ShapeFit, quantities: Sequence[Quantity], results: Sequence[GroupResult],
            group_noun: str, settings: VerifyConfig, robot_smooth: float
            ) -> tuple[str, tuple[str, ...]]:
    """
    Return the verdict (pass, fail, undecided or insensitive), and its reasons as sentences.

    group_noun: what a group is, in words; robot_smooth: 1 sigma (m) of the robot's smooth error,
    which more groups do not reduce.
    """
    used = sum(result.used for result in results)

    def remedy(size: float, largest: float) -> str:
        """Return what makes a size that is too large, but not hopelessly so, small enough."""
        if EVEN_CHANCE_SIGMAS * robot_smooth > settings.tolerance:
            return ('; more stops or passes hardly help, as the smooth error of the robot '
                    f'({mm(robot_smooth)}) stays: a larger tolerance or a better robot is needed')
        return '' if size >= 10 * largest else (
            f': record about {count_of(math.ceil(used * (size / largest) ** 2), group_noun)} like '
            'these, or turn the sensor more between them')

    # the shape fits, but not in its size
    other_size = fit.misalignment.p_explained < UNEXPLAINED_P < fit.scatter.p
    findings = [*_quantity_findings(quantities, settings, remedy),
                *_point_findings(fit, results, settings, other_size)]
    failed, undecided = ([sentence for outcome, sentence in findings if outcome == wanted]
                         for wanted in (VIOLATES, UNDECIDED))
    verdict = 'fail' if failed else 'undecided' if undecided else 'pass'
    error = fit.misalignment
    found = (f'an error of the calibration of {mm(error.even_chance)} (RMS over the points) would '
             f'be found in half of the cases, one of {mm(error.smallest_detectable)} with 95 % '
             f'({error.weakest_direction}), and the tolerance is {mm(settings.tolerance)}')
    if not failed and error.even_chance > settings.tolerance:
        verdict = 'insensitive'
        undecided.insert(0, (f'this decides nothing: {found}'
                             f'{remedy(error.even_chance, settings.tolerance)}'))
    notes = [*_notes(fit, other_size and OTHER_SIZE not in undecided, results)]
    if verdict == 'pass' and error.smallest_detectable > settings.tolerance:
        notes.append(found)
    return verdict, (*failed, *undecided, *notes)


def decision(deviation: float, margin: float, tolerance: float) -> str:
    """Return the decision of ISO 14253-1 on a deviation that is uncertain by a margin."""
    if abs(deviation) + margin <= tolerance:
        return CONFORMS
    return VIOLATES if abs(deviation) - margin > tolerance else UNDECIDED


def in_mm_or_degrees(value: float | None, unit: str) -> str:
    """Return a value in millimetres or degrees, '' if there is none."""
    if value is None or math.isnan(value):
        return ''
    return f'{value * 1e3:.4f} mm' if unit == 'm' else f'{math.degrees(value):.4f} degrees'


def _quantity_findings(quantities: Sequence[Quantity], settings: VerifyConfig,
                       remedy: Callable[[float, float], str]) -> Iterator[tuple[str, str]]:
    """
    Yield the decisions on values with a nominal that do not conform, each with a sentence.

    remedy(size, largest): of an uncertainty that is larger than what the tolerance leaves.
    """
    for q in quantities:
        if q.deviation is not None:
            tolerance = settings.tolerance if q.unit == 'm' else settings.angle_tolerance
            off, U = (in_mm_or_degrees(value, q.unit) for value in (q.deviation, q.expanded))
            if (outcome := decision(q.deviation, q.expanded, tolerance)) == CONFORMS:
                continue
            yield outcome, f'{q.name} is off by {off} ± {U} (k = {COVERAGE_FACTOR:g})' if (
                outcome == VIOLATES) else (
                f'{q.name} is off by {off}, its uncertainty is {U} (k = {COVERAGE_FACTOR:g}), and '
                f'together they exceed the tolerance of {in_mm_or_degrees(tolerance, q.unit)}'
                f'{remedy(q.expanded, tolerance - abs(q.deviation))}')


def _point_findings(fit: ShapeFit, results: Sequence[GroupResult], settings: VerifyConfig,
                    other_size: bool) -> Iterator[tuple[str, str]]:
    """
    Yield the decisions on points and calibration that do not conform, each with a sentence.

    other_size: whether another size of the artefact explains an error of the calibration as well.
    """
    outside = [s for s in results if s.used and COVERAGE_FACTOR * s.std <= settings.tolerance
               and s.distance - COVERAGE_FACTOR * s.std > settings.tolerance]
    if outside:
        worst = max(outside, key=lambda s: s.distance)
        yield VIOLATES, (f'points lie up to {mm(worst.distance)} from the fit (too far in '
                         f'{len(outside)} of {len(results)}, the worst: {worst.label})')
    size, margin = fit.misalignment.largest, ONE_SIDED_95 * fit.misalignment.largest_std
    outcome = decision(size, margin, settings.tolerance)
    error = (f'an error of the calibration of {mm(size)} ± {mm(margin)} '
             f'(k = {ONE_SIDED_95:g}, one-sided)')
    if fit.misalignment.p_chance <= SIGNIFICANCE and outcome == VIOLATES and not other_size:
        yield VIOLATES, f'the pattern of the distances matches {error} at the points'
    elif fit.misalignment.p_chance <= SIGNIFICANCE and outcome != CONFORMS:
        yield UNDECIDED, OTHER_SIZE if other_size else (
            f'the points suggest {error}, which may exceed the tolerance: measure more')
    contradicting = [s.label for s in results if s.used and s.p * len(results) < FALSE_ALARM]
    if contradicting:
        yield UNDECIDED, (f'{", ".join(contradicting)} contradict the others under every possible '
                          'calibration, and without them too little would be left: measure again')


def _notes(fit: ShapeFit, other_size: bool, results: Sequence[GroupResult]) -> Iterator[str]:
    """Yield the sentences that qualify a verdict; other_size: whether OTHER_SIZE is one."""
    yield from (f'{s.label} is not used: {s.reason}' for s in results if not s.used)
    if fit.scatter.p < INCONSISTENT_P:
        yield ('the points disagree by more than calibration, noise.sensor and noise.robot_* '
               f'explain (p = {fit.scatter.p:.1g}): the calibration is worse than it claims, the '
               'artefact moved, or the noise is set too small')
    if other_size:
        yield OTHER_SIZE
    if unknown := [q.name for q in fit.quantities if q.deviation is None]:
        yield (f'without a nominal value (verify.radius, verify.reference) nothing is said about '
               f'{", ".join(unknown)}')
    if (p := fit.p_calibration) < SIGNIFICANCE:
        yield f'the deviations are larger than the calibration claims (p = {p:.1g})'
