# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From the stations of several bags and a calibration to the verdict of a routine."""
from __future__ import annotations

from collections.abc import Collection, Sequence

from handeye_ros.config import Config, VerifyConfig
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.frames import sensor_axes
from handeye_ros.verification.decision import (
    claim_p,
    decide,
    FOREIGN,
    Quantity,
    Scatter,
    sensitivity,
    StationResult,
    time_of,
    Verification,
)
from handeye_ros.verification.fixed_fit import fit, FixedFit, K, refit
from handeye_ros.verification.routines import Routine, TEETH
from handeye_ros.verification.shapes import Shape, stacked, StationSet
import numpy as np

LEAST_STATIONS = 4  # of a bag
OUTLIER = 0.01  # probability that any good station is left out
MOST_OUTLIERS = 0.2  # of the stations: more are no outliers, but a disagreement


def verify(routine: Routine, bags: Sequence[StationSet], calibration: Calibration, config: Config,
           reason: str = '') -> Verification:
    """
    Return the verification by a routine; config.verify describes the artefact.

    bags: observations in the order that the routine expects; reason: why other stations gave
    none. Raises DataError, and InputError where two recordings are one.
    """
    stations, nominal = stacked(bags), config.verify
    if min(len(np.unique(bag.observations.station)) for bag in bags) < LEAST_STATIONS:
        raise too_few(len(np.unique(stations.observations.station)), LEAST_STATIONS * len(bags),
                      reason)
    _require_different(bags)
    X = calibration.T_flange_sensor @ sensor_axes(config)
    used, shape, result, left_out = _agreeing(routine, stations, X, calibration, config)
    if max(result.p, result.p_error) < FOREIGN and routine.target != TEETH:
        freed = refit(used, X, calibration.covariance, config.noise, shape, nominal)
        largest = float(np.abs(freed.distances).max())
        if freed.p_error < FOREIGN and largest > nominal.tolerance:
            raise DataError(
                f'this is not what "{routine.name}" measures: no error of the calibration brings '
                f'all points closer than {mm(largest)} to its shape. Check which object was under '
                'the sensor, that it did not move, and that nothing else was in view '
                '(verify.near)')
    std, claimed = (np.sqrt(np.maximum(np.diag(C), 0.0)).tolist() for C in (
        result.covariance, result.claimed))
    names = routine.names(len(bags), len(result.values))
    quantities = [Quantity(name, value, s, c, known, unit, symbol)
                  for (name, unit, symbol), value, s, c, known in zip(
                      names, result.values.tolist(), std, claimed, shape.nominals, strict=True)]
    quantities += routine.spread(used, X, result)
    station_results = _station_results(stations, used, result, left_out, nominal)
    weakest = sensitivity(result)
    verdict, reasons = decide(result, weakest, quantities, station_results, nominal)
    distances = np.abs(result.distances)
    scatter = Scatter(len(distances), float(distances.mean()), float(distances.std()),
                      float(np.sqrt((distances ** 2).mean())), float(distances.max()),
                      result.rms_expected, result.p)
    return Verification(
        routine.name, calibration.name, verdict, reasons, nominal.tolerance,
        nominal.angle_tolerance, len(np.unique(used.observations.station)), tuple(quantities),
        scatter, weakest.size, weakest.direction, result.region, result.freedom, claim_p(result),
        station_results, stations.surface, says=routine.says,
        recorded=time_of(int(stations.stamps.min())), certificate=nominal.certificate,
        record=dict(config.record))


def too_few(stations: int, minimum: int, reason: str) -> DataError:
    """Return the refusal of too few stations; reason: why others gave nothing."""
    others = f' (of the others: {reason})' if reason else ''
    return DataError(f'{stations} usable stations, fewer than {minimum}{others}: measure more, '
                     'with the sensor turned differently at each')


def _require_different(bags: Sequence[StationSet]) -> None:
    """Raise InputError where two bags hold the same stops."""
    stops = [{(int(stamp), T.tobytes()) for stamp, T in zip(bag.stamps, bag.poses, strict=True)}
             for bag in bags]
    for k, bag in enumerate(stops):
        for other in range(k):
            if bag & stops[other]:
                raise InputError(f'recordings {other + 1} and {k + 1} hold the same stops (equal '
                                 'stamps): give one recording of each face or ball')


def _agreeing(routine: Routine, stations: StationSet, X: Array, calibration: Calibration,
              config: Config) -> tuple[StationSet, Shape, FixedFit, dict[int, float]]:
    """
    Return the consistent stations, the shape and its fit, and p of each one left out.

    A station is left out when it contradicts the others whatever the error of the calibration.
    """
    def fitted(out: Collection[int]) -> tuple[StationSet, Shape, FixedFit]:
        selected = stations.without(out)
        used, shape = routine.shape(selected, selected.points(X), config.verify)
        return used, shape, fit(used, X, calibration.covariance, config.noise, shape,
                                config.verify)

    left_out = dict[int, float]()
    all_stations = result = fitted(())
    while (worst := _worst(result[2]))[1] < OUTLIER:
        left_out[worst[0]] = worst[1]
        rest = np.setdiff1d(stations.observations.station, list(left_out))
        fewest = np.bincount(stations.bags[rest]).min()
        if len(left_out) > MOST_OUTLIERS * len(stations.poses) or fewest < LEAST_STATIONS:
            return *all_stations, {}
        result = fitted(left_out)
    for group in list(left_out)[:-1]:  # it may only have looked bad beside a worse one
        without_group = fitted(left_out.keys() - {group})
        if _worst(without_group[2])[1] >= OUTLIER:
            del left_out[group]
            result = without_group
    return *result, left_out


def _worst(result: FixedFit) -> tuple[int, float]:
    """Return the group with the largest contradiction, and its p-value over all groups."""
    if not len(result.left_out):
        return -1, 1.0
    group, square, count = result.left_out.T
    p = np.where(count > 0, chi2_sf(square, count), 1.0)
    worst = int(np.argmin(p))
    return int(group[worst]), float(p[worst]) * len(p)


def _station_results(stations: StationSet, used: StationSet, result: FixedFit,
                     left_out: dict[int, float], limits: VerifyConfig
                     ) -> tuple[StationResult, ...]:
    """Return the results of all stops or passes."""
    results = []
    p_of = {int(g): float(chi2_sf(square, count))
            for g, square, count in result.left_out if count}
    for group in np.unique(stations.groups).tolist():
        first = int(np.argmax(stations.groups == group))
        bag = int(stations.bags[first])
        number = group - int(stations.groups[stations.bags == bag].min()) + 1
        identity = (bag + 1, number, int(stations.stamps[first]))
        rows = np.flatnonzero(used.row_groups == group)
        if group in left_out:
            results.append(StationResult(*identity, 0.0, 0.0, left_out[group], False, (
                'it contradicts the others under every possible calibration')))
        elif len(rows):
            worst = rows[np.argmax(np.abs(result.distances[rows]))]
            std = float(result.distance_std[worst])
            note = 'its uncertainty exceeds the tolerance' if K * std > limits.tolerance else ''
            results.append(StationResult(*identity, float(abs(result.distances[worst])), std,
                                         p_of.get(group, 1.0), reason=note))
    return tuple(results)
