"""From the stations of some bags and a calibration to the verdict of a routine."""
from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.estimation.outliers import chi2_sf
from handeye_ros.frames import mounted, sensor_axes
from handeye_ros.verification import clock, surfaces
from handeye_ros.verification.decision import claim_p, decide, FOREIGN, sensitivity
from handeye_ros.verification.errors import (
    any_of,
    NotTheArtefactError,
    SameRecordingError,
    TooFewSeenError,
    WrongCountError,
)
from handeye_ros.verification.fixed_fit import fit, FixedFit, points_in_base, refit
from handeye_ros.verification.routines import Routine, TEETH
from handeye_ros.verification.shapes import groups_of, Seen, Shape, stacked
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
LENGTHS = 'lengths (--length, verify.lengths)'
OUTLIER = 0.01  # chance that any of the good stations is left out
MOST_OUTLIERS = 0.2  # of the stations: more are no outliers, but a disagreement


def verify(routine: Routine, bags: Sequence[Seen], calibration: Calibration, config: Config,
           reason: str = '') -> Verification:
    """
    Return what a routine says of a calibration, by what config.verify states of the artefact.

    bags: what was seen, in the order that the routine wants; reason: why other stations gave
    nothing. Raises TooFewSeenError, SameRecordingError and NotTheArtefactError.
    """
    seen, nominal = stacked(bags), config.verify
    if min(len(np.unique(bag.observations.station)) for bag in bags) < LEAST_STATIONS:
        raise TooFewSeenError(len(np.unique(seen.observations.station)),
                              LEAST_STATIONS * len(bags), reason)
    _require_different(bags)
    X = calibration.T_flange_sensor @ sensor_axes(config)
    used, shape, found, left_out = _agreeing(routine, seen, X, calibration, config)
    if max(found.p, found.p_error) < FOREIGN and routine.target != TEETH:
        freed, _ = refit(used, X, calibration.covariance, config.noise, shape, nominal)
        largest = float(np.abs(freed.distances).max())
        if freed.p_error < FOREIGN and largest > nominal.tolerance:
            raise NotTheArtefactError(routine.name, largest)
    quantities = (*_quantities(routine, found, shape.nominals, len(bags)),
                  *routine.spread(used, X, found))
    stations = _station_results(seen, used, found, left_out, nominal)
    shown = sensitivity(found)
    verdict, reasons = decide(found, shown, quantities, stations, nominal)
    return Verification(
        routine.name, calibration.name, verdict, reasons, nominal.tolerance,
        nominal.angle_tolerance, len(np.unique(used.observations.station)), quantities,
        _scatter(found), shown.size, shown.direction, found.region, found.freedom,
        claim_p(found), stations, seen.surface, says=routine.says,
        recorded=time_of(int(seen.stamps.min())), certificate=nominal.certificate,
        record=config.record)


def _require_different(bags: Sequence[Seen]) -> None:
    stops = [{(int(stamp), T.tobytes()) for stamp, T in zip(bag.stamps, bag.poses, strict=True)}
             for bag in bags]
    for k, bag in enumerate(stops):
        for other in range(k):
            if bag & stops[other]:
                raise SameRecordingError(other + 1, k + 1)


def _agreeing(routine: Routine, seen: Seen, X: Array, calibration: Calibration, config: Config
              ) -> tuple[Seen, Shape, FixedFit, dict[int, float]]:
    """
    Return the stations that agree, the shape and its fit, and the p of each that is left out.

    A station is left out when it contradicts the others whatever the error of the calibration.
    """
    def fitted(out: Collection[int]) -> tuple[Seen, Shape, FixedFit]:
        some = seen.without(out)
        used, shape = routine.shape(some, points_in_base(some, X), config.verify)
        return used, shape, fit(used, X, calibration.covariance, config.noise, shape,
                                config.verify)

    left_out = dict[int, float]()
    everything = found = fitted(())
    while (worst := _worst(found[2]))[1] < OUTLIER:
        left_out[worst[0]] = worst[1]
        kept = np.bincount(seen.bags[np.setdiff1d(seen.observations.station, list(left_out))])
        if len(left_out) > MOST_OUTLIERS * len(seen.poses) or kept.min() < LEAST_STATIONS:
            return *everything, {}
        found = fitted(left_out)
    for group in list(left_out)[:-1]:  # it may only have looked bad beside a worse one
        again = fitted(left_out.keys() - {group})
        if _worst(again[2])[1] >= OUTLIER:
            del left_out[group]
            found = again
    return *found, left_out


def _worst(found: FixedFit) -> tuple[int, float]:
    """Return the group that contradicts the others most, and the chance that any is so bad."""
    if not len(found.deleted):
        return -1, 1.0
    group, square, count = found.deleted.T
    p = np.where(count > 0, chi2_sf(square, count), 1.0)
    worst = int(np.argmin(p))
    return int(group[worst]), float(p[worst]) * len(p)


def _station_results(seen: Seen, used: Seen, found: FixedFit, left_out: dict[int, float],
                     limits: VerifyConfig) -> tuple[StationResult, ...]:
    """Return what each stop, or pass, showed."""
    groups, results = groups_of(seen), []
    of_row = groups_of(used)[used.observations.station]
    p_of = {int(g): float(chi2_sf(square, count))
            for g, square, count in found.deleted if count}
    for group in np.unique(groups).tolist():
        first = int(np.argmax(groups == group))
        bag = int(seen.bags[first])
        number = group - int(groups[seen.bags == bag].min()) + 1
        at, rows = (bag + 1, number, int(seen.stamps[first])), np.flatnonzero(of_row == group)
        if group in left_out:
            results.append(StationResult(*at, 0.0, 0.0, left_out[group], False, (
                'it contradicts the others under every possible calibration')))
        elif len(rows):
            worst = rows[np.argmax(np.abs(found.distances[rows]))]
            std = float(found.distance_std[worst])
            note = 'its uncertainty exceeds the tolerance' if K * std > limits.tolerance else ''
            results.append(StationResult(*at, float(abs(found.distances[worst])), std,
                                         p_of.get(group, 1.0), reason=note))
    return tuple(results)


def seen_in(routine: Routine, samples: Sequence[Sample], calibration: Calibration,
            config: Config) -> Seen:
    """
    Return what the samples of one bag are to a routine.

    Of several surfaces in sight it takes the nearest; verify.near limits what takes part.
    """
    X, note = calibration.T_flange_sensor @ sensor_axes(config), ''
    if config.sampling.moving and samples:
        samples, note = clock.at_offset(routine, samples, X, calibration, config)
    poses = mounted(samples, config) if samples else np.empty((0, 4, 4))
    if config.verify.near and samples:
        samples = surfaces.near(samples, poses, X, config.verify.near)
    if routine.target == 'plane':
        samples, of = surfaces.nearest(samples, poses, X, config.profile.range_sign)
        note = '; '.join(filter(None, [of, note]))
    return Seen(poses, routine.observe(samples, poses, X),
                stamps=np.array([sample.stamp for sample in samples], dtype=np.int64),
                surface=note)


def settings_for(routine: Routine, config: Config, bags: int) -> Config:
    """
    Return the settings that find the features of a routine; raises WrongCountError.

    bags: how many there are.
    """
    least, most = routine.bags
    if not least <= bags <= most:
        raise WrongCountError(routine.name, 'bags', bags, any_of(range(least, most + 1)))
    lengths, given = routine.lengths(bags), len(config.verify.lengths)
    if given not in lengths:
        raise WrongCountError(routine.name, LENGTHS, given, any_of(lengths))
    if routine.target == TEETH:
        return config
    return with_values(config, {'target.type': routine.target, 'method': 'auto',
                                'target.radius': config.verify.radius}, routine.name)


def parts_of(routine: Routine, lengths: int) -> tuple[int, int]:
    """Return how many bags fit the lengths, least and most; raises WrongCountError."""
    least, most = routine.bags
    fit = [n for n in range(least, most + 1) if lengths in routine.lengths(n)]
    if not fit:
        raise WrongCountError(routine.name, LENGTHS, lengths, any_of(routine.lengths(least)))
    return fit[0], fit[-1]


def _quantities(routine: Routine, found: FixedFit, nominals: tuple[float | None, ...], bags: int
                ) -> Iterator[Quantity]:
    std, claimed = (np.sqrt(np.maximum(np.diag(C), 0.0)) for C in (
        found.covariance, found.claimed))
    names = routine.names(bags, len(found.values))
    for (name, unit, symbol), value, s, c, nominal in zip(
            names, found.values, std, claimed, nominals, strict=True):
        yield Quantity(name, float(value), float(s), float(c), nominal, unit, symbol)


def _scatter(found: FixedFit) -> Scatter:
    away = np.abs(found.distances)
    return Scatter(len(away), float(away.mean()), float(away.std()),
                   float(np.sqrt((away ** 2).mean())), float(away.max()), found.rms_expected,
                   found.p)
