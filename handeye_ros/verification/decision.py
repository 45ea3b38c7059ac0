"""
Pass, fail or undecided: the rule that a verification is decided by.

ISO 14253-1 with the expanded uncertainty U = k u of the measurement here (sensor, robot, nominal
value): pass where |deviation| + U <= tolerance, fail where |deviation| - U > tolerance. The
covariance that the calibration claims is what is verified, and takes no part in U.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array
from handeye_ros.errors import mm
from handeye_ros.estimation.outliers import chi2_sf
from handeye_ros.results.verified import shown
from handeye_ros.verification.fixed_fit import FixedFit
from handeye_ros.verification.verification import K, Quantity, StationResult
import numpy as np
import scipy.linalg

SENSITIVE = 3.6  # sigmas: 1.96 + 1.64, an error is seen with 95 % where false alarms are 5 %
NORMAL_95, ONE_SIDED_95 = 1.96, 1.64
SIGNIFICANT = 0.01  # p of what is no chance
INCONSISTENT = 1e-3  # p of points that disagree
FOREIGN = 1e-6  # p of points that no error of the calibration explains
LARGE = 0.01  # m: a tolerance that is questioned


@dataclass(frozen=True)
class Sensitivity:
    """
    The smallest error of the calibration that shows, in the direction that shows least.

    size: root mean square displacement of the points (m); estimate: the same of what was found in
    this direction; direction: in words.
    """

    size: float
    estimate: float
    direction: str

    @property
    def std(self) -> float:
        """Return 1 sigma of the estimate."""
        return self.size / SENSITIVE


def sensitivity(found: FixedFit) -> Sensitivity:
    """Return which error of the calibration would just show, in the worst direction."""
    shift = found.shift + 1e-12 * np.trace(found.shift) * np.eye(6)
    power, directions = scipy.linalg.eigh(found.information, shift)
    worst = directions[:, 0]  # displaces the points by 1 m RMS
    moved = np.linalg.norm(worst[:3])
    turned = np.sqrt(max(worst[3:] @ found.shift[3:, 3:] @ worst[3:], 0.0))
    what, axis = (('position along', worst[:3]) if moved >= turned else
                  ('rotation about', worst[3:]))
    return Sensitivity(float(SENSITIVE / np.sqrt(max(power[0], 1e-12))),
                       abs(float(worst @ shift @ found.error)),
                       f'{what} {_axis(axis)} of the flange')


def _axis(direction: Array) -> str:
    names = [name for size, name in zip(np.abs(direction), 'xyz', strict=True)
             if size > 0.5 * np.abs(direction).max()]
    return ' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)


def decide(found: FixedFit, weakest: Sensitivity, quantities: Sequence[Quantity],
           stations: Sequence[StationResult], limits: VerifyConfig
           ) -> tuple[str, tuple[str, ...]]:
    """Return the verdict (pass, fail, undecided or insensitive), and the reasons as sentences."""
    notes = _notes(found, stations, limits)
    failed = [*_failed(quantities, stations, limits), *_implied(found, limits)]
    if failed:
        return 'fail', (*failed, *notes)
    used = sum(station.used for station in stations)
    if weakest.size > limits.tolerance:
        more = math.ceil(used * (weakest.size / limits.tolerance) ** 2)
        return 'insensitive', (
            f'an error of the calibration would show only from {mm(weakest.size)} on '
            f'({weakest.direction}), and the tolerance is {mm(limits.tolerance)}: turn the sensor '
            'more between the stops' + _or_measure(more, used, ', or'), *notes)
    unsure = _unsure(quantities, limits, used) + _suggested(found, weakest, limits)
    return ('undecided', (*unsure, *notes)) if unsure else ('pass', notes)


def _suggested(found: FixedFit, weakest: Sensitivity, limits: VerifyConfig) -> list[str]:
    """Return a sentence where the points show an error that may exceed the tolerance."""
    for size, std, is_seen in (
            (found.implied, found.implied_std, found.p_no_error < SIGNIFICANT),
            (weakest.estimate, weakest.std, weakest.estimate > NORMAL_95 * weakest.std)):
        if is_seen and size + ONE_SIDED_95 * std > limits.tolerance:
            return [f'the points suggest an error of the calibration of {mm(size)} ± '
                    f'{mm(K * std)} (k = {K:g}), which may exceed the tolerance: measure at more '
                    'stops']
    return []


def _failed(quantities: Sequence[Quantity], stations: Sequence[StationResult],
            limits: VerifyConfig) -> list[str]:
    failed = [f'{q.name} is off by {shown(q.error, q.unit)} ± {shown(q.expanded, q.unit)} '
              f'(k = {K:g})' for q in quantities
              if q.error is not None and abs(q.error) - q.expanded > _tolerance(q, limits)]
    far = [s for s in stations if s.used and K * s.std <= limits.tolerance
           and s.distance - K * s.std > limits.tolerance]
    if far:
        worst = max(far, key=lambda s: s.distance)
        failed.append(f'points of {len(far)} of {len(stations)} stops lie up to '
                      f'{mm(worst.distance)} from the fit (the worst: {worst.name})')
    return failed


def _implied(found: FixedFit, limits: VerifyConfig) -> list[str]:
    """Return a sentence when the points show that the calibration is off by more."""
    if found.p_no_error > SIGNIFICANT or _other_size(found) or (
            found.implied - ONE_SIDED_95 * found.implied_std <= limits.tolerance):
        return []
    return [f'the pattern of the distances matches a calibration error of {mm(found.implied)} ± '
            f'{mm(K * found.implied_std)} (k = {K:g}) at the points']


def _other_size(found: FixedFit) -> bool:
    """Tell whether the shape fits, but no error of the calibration explains its size too."""
    return found.p_error < FOREIGN < found.p


def _unsure(quantities: Sequence[Quantity], limits: VerifyConfig, used: int) -> list[str]:
    unsure = []
    for q in quantities:
        left = None if q.error is None else _tolerance(q, limits) - abs(q.error)
        if left is None or q.expanded <= left:
            continue
        more = math.ceil(used * (q.expanded / left) ** 2) if left > 0 else 0
        unsure.append(
            f'{q.name} is off by {shown(q.error, q.unit)}, its uncertainty is '
            f'{shown(q.expanded, q.unit)} (k = {K:g}), and together they exceed the tolerance '
            f'of {shown(_tolerance(q, limits), q.unit)}'
            + _or_measure(more, used, ':'))
    return unsure


def _or_measure(more: int, used: int, before: str) -> str:
    """Return the advice to measure at more stops, nothing where nobody would."""
    return f'{before} measure at about {more} stops like these' if 0 < more < 100 * used else ''


def _notes(found: FixedFit, stations: Sequence[StationResult], limits: VerifyConfig
           ) -> tuple[str, ...]:
    notes = [f'{s.name} is left out: {s.reason}' for s in stations if not s.used]
    if found.p < INCONSISTENT:
        notes.append(f'the points disagree by more than calibration, noise.sensor and '
                     f'noise.robot_* explain (p = {found.p:.1g}): the calibration is worse than '
                     'it claims, the artefact moved, or the noise is set too small')
    if _other_size(found):
        notes.append('the points fit the shape, and no error of the calibration explains these '
                     'deviations: check the nominal values (--radius, --length)')
    claim = claim_p(found)
    if claim < SIGNIFICANT:
        notes.append(f'the deviations are larger than the calibration claims (p = {claim:.1g})')
    if limits.tolerance > LARGE:
        notes.append(f'the tolerance is {mm(limits.tolerance)}: verify.tolerance and --tolerance '
                     'are in metres unless a unit is given')
    return tuple(notes)


def claim_p(found: FixedFit) -> float:
    """Return how often deviations are as large with the calibration's claimed covariance."""
    return float(chi2_sf(found.region, found.freedom)) if found.freedom else 1.0


def _tolerance(q: Quantity, limits: VerifyConfig) -> float:
    return limits.tolerance if q.unit == 'm' else limits.angle_tolerance
