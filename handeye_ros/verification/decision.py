# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The decision rule of a verification: pass, fail or undecided.

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
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.results.verification_file import formatted
from handeye_ros.verification.fixed_fit import FixedFit
from handeye_ros.verification.verification import K, Quantity, StationResult
import numpy as np
import scipy.linalg

SENSITIVE = 3.6  # sigmas: 1.96 + 1.64, an error is seen with 95 % if false alarms are 5 %
NORMAL_95, ONE_SIDED_95 = 1.96, 1.64
SIGNIFICANT = 0.01  # level of the tests of a calibration error
INCONSISTENT = 1e-3  # level of the test that the points agree
FOREIGN = 1e-6  # below this p no error of the calibration explains the points
LARGE = 0.01  # m: a larger tolerance gets a note


@dataclass(frozen=True)
class Sensitivity:
    """
    The smallest detectable error of the calibration, in the least sensitive direction.

    size: root mean square displacement of the points (m); estimate: that of the estimated error
    in this direction; direction: in words.
    """

    size: float
    estimate: float
    direction: str

    @property
    def std(self) -> float:
        """Return 1 sigma of the estimate."""
        return self.size / SENSITIVE


def sensitivity(fit: FixedFit) -> Sensitivity:
    """Return the smallest detectable error of the calibration in the worst direction."""
    shift = fit.shift + 1e-12 * np.trace(fit.shift) * np.eye(6)
    power, directions = scipy.linalg.eigh(fit.information, shift)
    worst = directions[:, 0]  # displaces the points by 1 m RMS
    shift_size = np.linalg.norm(worst[:3])
    rotation_size = np.sqrt(max(worst[3:] @ fit.shift[3:, 3:] @ worst[3:], 0.0))
    motion, axis = (('position along', worst[:3]) if shift_size >= rotation_size else
                    ('rotation about', worst[3:]))
    return Sensitivity(float(SENSITIVE / np.sqrt(max(power[0], 1e-12))),
                       abs(float(worst @ shift @ fit.error)),
                       f'{motion} {_axis(axis)} of the flange')


def _axis(direction: Array) -> str:
    names = [name for size, name in zip(np.abs(direction), 'xyz', strict=True)
             if size > 0.5 * np.abs(direction).max()]
    return ' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)


def decide(fit: FixedFit, weakest: Sensitivity, quantities: Sequence[Quantity],
           stations: Sequence[StationResult], limits: VerifyConfig
           ) -> tuple[str, tuple[str, ...]]:
    """Return the verdict (pass, fail, undecided or insensitive), and its reasons as sentences."""
    notes = _notes(fit, stations, limits)
    failed = [*_failed(quantities, stations, limits), *_implied(fit, limits)]
    if failed:
        return 'fail', (*failed, *notes)
    used = sum(station.used for station in stations)
    if weakest.size > limits.tolerance:
        more = math.ceil(used * (weakest.size / limits.tolerance) ** 2)
        return 'insensitive', (
            f'an error of the calibration would show only from {mm(weakest.size)} on '
            f'({weakest.direction}), and the tolerance is {mm(limits.tolerance)}: turn the sensor '
            'more between the stops' + _or_measure(more, used, ', or'), *notes)
    undecided = _unsure(quantities, limits, used) + _suggested(fit, weakest, limits)
    return ('undecided', (*undecided, *notes)) if undecided else ('pass', notes)


def _suggested(fit: FixedFit, weakest: Sensitivity, limits: VerifyConfig) -> list[str]:
    """Return a sentence if the points indicate an error that may exceed the tolerance."""
    for size, std, is_seen in (
            (fit.implied, fit.implied_std, fit.p_no_error < SIGNIFICANT),
            (weakest.estimate, weakest.std, weakest.estimate > NORMAL_95 * weakest.std)):
        if is_seen and size + ONE_SIDED_95 * std > limits.tolerance:
            return [f'the points suggest an error of the calibration of {mm(size)} ± '
                    f'{mm(K * std)} (k = {K:g}), which may exceed the tolerance: measure at more '
                    'stops']
    return []


def _failed(quantities: Sequence[Quantity], stations: Sequence[StationResult],
            limits: VerifyConfig) -> list[str]:
    failed = [f'{q.name} is off by {formatted(q.error, q.unit)} ± {formatted(q.expanded, q.unit)} '
              f'(k = {K:g})' for q in quantities
              if q.error is not None and abs(q.error) - q.expanded > _tolerance(q, limits)]
    outside = [s for s in stations if s.used and K * s.std <= limits.tolerance
               and s.distance - K * s.std > limits.tolerance]
    if outside:
        worst = max(outside, key=lambda s: s.distance)
        failed.append(f'points of {len(outside)} of {len(stations)} stops lie up to '
                      f'{mm(worst.distance)} from the fit (the worst: {worst.name})')
    return failed


def _implied(fit: FixedFit, limits: VerifyConfig) -> list[str]:
    """Return a sentence if the points indicate a larger error of the calibration."""
    if fit.p_no_error > SIGNIFICANT or _other_size(fit) or (
            fit.implied - ONE_SIDED_95 * fit.implied_std <= limits.tolerance):
        return []
    return [f'the pattern of the distances matches a calibration error of {mm(fit.implied)} ± '
            f'{mm(K * fit.implied_std)} (k = {K:g}) at the points']


def _other_size(fit: FixedFit) -> bool:
    """Return whether the shape fits, and no error of the calibration explains its size."""
    return fit.p_error < FOREIGN < fit.p


def _unsure(quantities: Sequence[Quantity], limits: VerifyConfig, used: int) -> list[str]:
    sentences = []
    for q in quantities:
        margin = None if q.error is None else _tolerance(q, limits) - abs(q.error)
        if margin is None or q.expanded <= margin:
            continue
        more = math.ceil(used * (q.expanded / margin) ** 2) if margin > 0 else 0
        sentences.append(
            f'{q.name} is off by {formatted(q.error, q.unit)}, its uncertainty is '
            f'{formatted(q.expanded, q.unit)} (k = {K:g}), and together they exceed the tolerance '
            f'of {formatted(_tolerance(q, limits), q.unit)}'
            + _or_measure(more, used, ':'))
    return sentences


def _or_measure(stops: int, used: int, conjunction: str) -> str:
    """Return the advice to measure at so many stops, '' if these would not help."""
    if not 0 < stops < 100 * used:
        return ''
    return f'{conjunction} measure at about {stops} stops like these'


def _notes(fit: FixedFit, stations: Sequence[StationResult], limits: VerifyConfig
           ) -> tuple[str, ...]:
    notes = [f'{s.name} is left out: {s.reason}' for s in stations if not s.used]
    if fit.p < INCONSISTENT:
        notes.append(f'the points disagree by more than calibration, noise.sensor and '
                     f'noise.robot_* explain (p = {fit.p:.1g}): the calibration is worse than '
                     'it claims, the artefact moved, or the noise is set too small')
    if _other_size(fit):
        notes.append('the points fit the shape, and no error of the calibration explains these '
                     'deviations: check the nominal values (verify.radius, verify.lengths)')
    claim = claim_p(fit)
    if claim < SIGNIFICANT:
        notes.append(f'the deviations are larger than the calibration claims (p = {claim:.1g})')
    if limits.tolerance > LARGE:
        notes.append(f'the tolerance is {mm(limits.tolerance)}: verify.tolerance is '
                     'in metres unless a unit is given')
    return tuple(notes)


def claim_p(fit: FixedFit) -> float:
    """Return the p-value of the deviations under the calibration's stated covariance."""
    return float(chi2_sf(fit.region, fit.freedom)) if fit.freedom else 1.0


def _tolerance(q: Quantity, limits: VerifyConfig) -> float:
    return limits.tolerance if q.unit == 'm' else limits.angle_tolerance
