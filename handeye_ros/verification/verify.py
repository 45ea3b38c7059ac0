# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From the stations of several bags and a calibration to the verdict of a routine."""
from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.frames import mounted, sensor_axes
from handeye_ros.verification.decision import claim_p, decide, FOREIGN, sensitivity
from handeye_ros.verification.fixed_fit import fit, FixedFit, points_in_base, refit
from handeye_ros.verification.routines import Routine, TEETH
from handeye_ros.verification.samples import at_offset, in_region, on_nearest_surface
from handeye_ros.verification.shapes import groups_of, Shape, stacked, StationSet
from handeye_ros.verification.verification import (
    K,
    Quantity,
    Scatter,
    StationResult,
    time_of,
    Verification,
)
import numpy as np

LEAST_STATIONS = 4  # of a bag
LENGTHS = 'lengths (verify.lengths)'
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
        freed, _ = refit(used, X, calibration.covariance, config.noise, shape, nominal)
        largest = float(np.abs(freed.distances).max())
        if freed.p_error < FOREIGN and largest > nominal.tolerance:
            raise DataError(
                f'this is not what "{routine.name}" measures: no error of the calibration brings '
                f'all points closer than {mm(largest)} to its shape. Check which object was under '
                'the sensor, that it did not move, and that nothing else was in view '
                '(verify.near)')
    quantities = (*_quantities(routine, result, shape.nominals, len(bags)),
                  *routine.spread(used, X, result))
    station_results = _station_results(stations, used, result, left_out, nominal)
    weakest = sensitivity(result)
    verdict, reasons = decide(result, weakest, quantities, station_results, nominal)
    return Verification(
        routine.name, calibration.name, verdict, reasons, nominal.tolerance,
        nominal.angle_tolerance, len(np.unique(used.observations.station)), quantities,
        _scatter(result), weakest.size, weakest.direction, result.region, result.freedom,
        claim_p(result), station_results, stations.surface, says=routine.says,
        recorded=time_of(int(stations.stamps.min())), certificate=nominal.certificate,
        record=config.record)


def too_few(stations: int, minimum: int, reason: str) -> DataError:
    """Return the refusal of too few stations; reason: why others gave nothing."""
    others = f' (of the others: {reason})' if reason else ''
    return DataError(f'{stations} usable stations, fewer than {minimum}{others}: measure more, '
                     'with the sensor turned differently at each')


def _require_different(bags: Sequence[StationSet]) -> None:
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
        used, shape = routine.shape(selected, points_in_base(selected, X), config.verify)
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
    groups, results = groups_of(stations), []
    of_row = groups_of(used)[used.observations.station]
    p_of = {int(g): float(chi2_sf(square, count))
            for g, square, count in result.left_out if count}
    for group in np.unique(groups).tolist():
        first = int(np.argmax(groups == group))
        bag = int(stations.bags[first])
        number = group - int(groups[stations.bags == bag].min()) + 1
        identity = (bag + 1, number, int(stations.stamps[first]))
        rows = np.flatnonzero(of_row == group)
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


def stations_of(routine: Routine, samples: Sequence[Sample], calibration: Calibration,
                config: Config) -> StationSet:
    """
    Return the stations of one bag, with the conditions of a routine.

    Of several surfaces in sight the nearest one takes part; verify.near limits the region.
    """
    X, note = calibration.T_flange_sensor @ sensor_axes(config), ''
    if config.sampling.moving and samples:
        samples, note = at_offset(routine, samples, X, calibration, config)
    poses = mounted(samples, config) if samples else np.empty((0, 4, 4))
    if config.verify.near and samples:
        samples = in_region(samples, poses, X, config.verify.near)
    if routine.target == 'plane':
        samples, surface = on_nearest_surface(samples, poses, X, config.profile.range_sign)
        note = '; '.join(filter(None, [surface, note]))
    return StationSet(poses, routine.observe(samples, poses, X),
                      stamps=np.array([sample.stamp for sample in samples], dtype=np.int64),
                      surface=note)


def settings_for(routine: Routine, config: Config, bags: int) -> Config:
    """
    Return the settings that extract the features of a routine; raises InputError.

    bags: how many there are.
    """
    fewest, most = routine.bags
    if not fewest <= bags <= most:
        raise _wrong_count(routine, 'bags', bags, range(fewest, most + 1))
    lengths, count = routine.lengths(bags), len(config.verify.lengths)
    if count not in lengths:
        raise _wrong_count(routine, LENGTHS, count, lengths)
    if routine.target == TEETH:
        return config
    return with_values(config, {'target.type': routine.target, 'method': 'auto',
                                'target.radius': config.verify.radius}, routine.name)


def parts_of(routine: Routine, lengths: int) -> tuple[int, int]:
    """Return the least and largest number of bags for the lengths; raises InputError."""
    fewest, most = routine.bags
    fit = [n for n in range(fewest, most + 1) if lengths in routine.lengths(n)]
    if not fit:
        raise _wrong_count(routine, LENGTHS, lengths, routine.lengths(fewest))
    return fit[0], fit[-1]


def _wrong_count(routine: Routine, items: str, count: int, valid: Sequence[int]) -> InputError:
    needed = (f'{valid[0]} to {valid[-1]}' if len(valid) > 3 else
              ' or '.join(map(str, sorted(valid))))
    return InputError(f'{routine.name} needs {needed} {items}, and got {count}')


def _quantities(routine: Routine, result: FixedFit, nominals: tuple[float | None, ...], bags: int
                ) -> Iterator[Quantity]:
    std, claimed = (np.sqrt(np.maximum(np.diag(C), 0.0)) for C in (
        result.covariance, result.claimed))
    names = routine.names(bags, len(result.values))
    for (name, unit, symbol), value, s, c, nominal in zip(
            names, result.values, std, claimed, nominals, strict=True):
        yield Quantity(name, float(value), float(s), float(c), nominal, unit, symbol)


def _scatter(result: FixedFit) -> Scatter:
    distances = np.abs(result.distances)
    return Scatter(len(distances), float(distances.mean()), float(distances.std()),
                   float(np.sqrt((distances ** 2).mean())), float(distances.max()),
                   result.rms_expected, result.p)
