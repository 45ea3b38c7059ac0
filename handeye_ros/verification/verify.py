"""From the stations of some bags and a calibration to the verdict of a routine."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import mm
from handeye_ros.results.outcome import mounted, sensor_axes
from handeye_ros.verification import spreads
from handeye_ros.verification.errors import TooFewSeenError, WrongCountError
from handeye_ros.verification.fixed_fit import fit, FixedFit, points_in_base
from handeye_ros.verification.routine import Nominal, Routine, Seen, stacked, TEETH
from handeye_ros.verification.verification import Quantity, Scatter, Verification
import numpy as np
import scipy.linalg

LEAST_STATIONS = 4  # of a bag
NOTICED = 3e-4  # m: an error of the calibration that a verification must be able to notice
SURE = 3.6  # sigmas: found with 95 % where false alarms are 5 %
INCONSISTENT = 1e-3  # p of points that disagree
COVERAGE = 1.96
LEAST_OVER_NOISE = 1.8  # times what noise alone makes: an error that is implied


SPREADS: dict[str, Callable[[Seen, Array, FixedFit], tuple[Quantity, ...]]] = {
    'point': spreads.of_points, 'sphere': spreads.of_centres, 'ball_bar': spreads.of_centres,
    'plane': spreads.of_faces, 'square': spreads.of_faces}
"""What is told of single stations, by routine."""


def _no_spread(seen: Seen, X: Array, found: FixedFit) -> tuple[Quantity, ...]:
    return ()


@dataclass(frozen=True)
class Tolerances:
    """What the errors may reach: of lengths (m) and of angles (rad)."""

    length: float = VerifyConfig.tolerance
    angle: float = VerifyConfig.angle_tolerance

    def of(self, unit: str) -> float:
        """Return that of a unit."""
        return self.length if unit == 'm' else self.angle


def verify(routine: Routine, bags: Sequence[Seen], calibration: Calibration, config: Config,
           nominal: Nominal, tolerances: Tolerances | None = None, reason: str = ''
           ) -> Verification:
    """
    Return what a routine says of a calibration.

    bags: what was seen, in the order that the routine wants; reason: why other stations gave
    nothing. Raises TooFewSeenError.
    """
    seen = stacked(bags)
    stations = len(np.unique(seen.observations.station))
    if min(len(np.unique(bag.observations.station)) for bag in bags) < LEAST_STATIONS:
        raise TooFewSeenError(stations, LEAST_STATIONS * len(bags), reason)
    X = calibration.T_flange_sensor @ sensor_axes(config)
    p = points_in_base(seen, X)
    seen, shape = routine.shape(seen, p, nominal)
    found = fit(seen, X, calibration.covariance, config.noise, shape, nominal.aim)
    quantities = (*_quantities(routine, found, shape.nominals),
                  *SPREADS.get(routine.name, _no_spread)(seen, X, found))
    tolerances = tolerances or Tolerances()
    noticed, direction = _noticed(found)
    scatter = _scatter(found)
    verdict, reasons = _verdict(quantities, scatter, tolerances, (noticed, direction),
                                _implied(found, tolerances))
    return Verification(
        routine.name, calibration.name, verdict, tuple(reasons), tolerances.length,
        tolerances.angle, stations, quantities, scatter, noticed, direction, found.region,
        found.freedom)


def seen_in(routine: Routine, samples: Sequence[Sample], calibration: Calibration,
            config: Config) -> Seen:
    """Return what the samples of one bag are to a routine."""
    poses = mounted(samples, config) if samples else np.empty((0, 4, 4))
    X = calibration.T_flange_sensor @ sensor_axes(config)
    return Seen(poses, routine.observe(samples, poses, X))


def settings_for(routine: Routine, config: Config, nominal: Nominal, bags: int) -> Config:
    """
    Return the settings that find the features of a routine; raises WrongCountError.

    bags: how many there are.
    """
    least, most = routine.bags
    if not least <= bags <= most:
        needed = str(least) if least == most else f'{least} to {most}'
        raise WrongCountError(routine.name, 'bags', bags, needed)
    lengths = routine.lengths(bags)
    if len(nominal.lengths) != lengths:
        raise WrongCountError(routine.name, 'lengths (--length, verify.lengths)',
                              len(nominal.lengths), str(lengths))
    if routine.target == TEETH:
        return config
    return with_values(config, {'target.type': routine.target, 'target.radius': nominal.radius,
                                'method': 'auto'}, routine.name)


def parts_of(routine: Routine, nominal: Nominal) -> tuple[int, int]:
    """Return how many bags fit the lengths, least and most; raises WrongCountError."""
    least, most = routine.bags
    fit = [n for n in range(least, most + 1) if routine.lengths(n) == len(nominal.lengths)]
    if not fit:
        raise WrongCountError(routine.name, 'lengths (--length, verify.lengths)',
                              len(nominal.lengths), str(routine.lengths(least)))
    return fit[0], fit[-1]


def nominal_of(config: Config) -> Nominal:
    """Return what the settings tell of the artefact."""
    known = config.verify
    return Nominal(known.lengths, known.radius, known.reference, known.aim, known.flank)


def tolerances_of(config: Config) -> Tolerances:
    """Return the tolerances of the settings."""
    return Tolerances(config.verify.tolerance, config.verify.angle_tolerance)


def _quantities(routine: Routine, found: FixedFit, nominals: tuple[float | None, ...]
                ) -> tuple[Quantity, ...]:
    names = routine.names(len(found.values))
    std, part = (np.sqrt(np.maximum(np.diag(C), 0.0)) for C in (
        found.covariance, found.from_calibration))
    return tuple(
        Quantity(name, float(value), float(s), float(c), nominal, unit)
        for (name, unit), value, s, c, nominal in zip(
            names, found.values, std, part, nominals, strict=True))


def _scatter(found: FixedFit) -> Scatter:
    away = np.abs(found.distances)
    return Scatter(len(away), float(away.mean()), float(away.std()),
                   float(np.sqrt((away ** 2).mean())), float(away.max()), found.rms_expected,
                   found.p)


def _noticed(found: FixedFit) -> tuple[float, str]:
    """Return the displacement of the points that would just be noticed, in the worst direction."""
    size = found.shift + 1e-12 * np.trace(found.shift) * np.eye(6)
    power, directions = scipy.linalg.eigh(found.information, size)
    worst = directions[:, 0]
    moved = np.linalg.norm(worst[:3])
    turned = np.sqrt(max(worst[3:] @ found.shift[3:, 3:] @ worst[3:], 0.0))
    if moved >= turned:
        name = f'position along {_axis(worst[:3])} of the flange'
    else:
        name = f'rotation about {_axis(worst[3:])} of the flange'
    return float(SURE / np.sqrt(max(power[0], 1e-12))), name


def _implied(found: FixedFit, tolerances: Tolerances) -> list[str]:
    """Return a sentence when the distances are those of a calibration that is off by more."""
    sure = found.implied ** 2 - (LEAST_OVER_NOISE * found.implied_noise) ** 2
    if sure <= tolerances.length ** 2:
        return []
    return [f'the points disagree as those of a calibration do that is {mm(found.implied)} off at '
            'them']


def _axis(direction: Array) -> str:
    names = [name for size, name in zip(np.abs(direction), 'xyz', strict=True)
             if size > 0.5 * np.abs(direction).max()]
    return ' and '.join(names)


def _verdict(quantities: tuple[Quantity, ...], scatter: Scatter, tolerances: Tolerances,
             noticed: tuple[float, str], implied: list[str]) -> tuple[str, list[str]]:
    notes = []
    if scatter.p < INCONSISTENT:
        notes.append(f'the points disagree by more than calibration, noise.sensor and '
                     f'noise.robot_* explain (p = {scatter.p:.1g}): the calibration is worse than '
                     'it states, the artefact moved, or the noise is set too small')
    failed = [f'{q.name} is off by {_shown(q.error, q.unit)}' for q in quantities
              if q.error is not None and abs(q.error) > tolerances.of(q.unit)]
    if scatter.maximum > tolerances.length:
        failed.append(f'a point lies {mm(scatter.maximum)} from the fit')
    failed += implied
    if failed:
        return 'fail', failed + notes
    if noticed[0] > NOTICED:
        return 'blind', [f'an error of the calibration would show only from {mm(noticed[0])} on '
                         f'({noticed[1]}): measure more stations, and turn the sensor more '
                         'between them', *notes]
    unsure = [q.name for q in quantities if q.error is not None
              and abs(q.error) + COVERAGE * q.std > tolerances.of(q.unit)]
    if unsure:
        return 'undecided', [f'the uncertainty of {", ".join(unsure)} is too large for the '
                             'tolerance: measure more stations', *notes]
    return 'pass', notes


def _shown(error: float | None, unit: str) -> str:
    error = error or 0.0
    return f'{error * 1e3:.3f} mm' if unit == 'm' else f'{np.degrees(error):.3f} degrees'
