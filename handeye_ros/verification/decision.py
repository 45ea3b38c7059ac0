# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The result of a verification, and its decision rule: pass, fail, undecided or insensitive.

ISO 14253-1 with the expanded uncertainty U = k u of the measurement here (sensor, robot, nominal
value): pass where |deviation| + U <= tolerance, fail where |deviation| - U > tolerance. The
covariance that the calibration claims is what is verified, and takes no part in U.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field, fields
from datetime import datetime, UTC
import math
from typing import Any

from handeye_ros import __version__, output
from handeye_ros.config import VerifyConfig
from handeye_ros.errors import mm
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.results.verification_file import COLUMNS, FORMAT, formatted, rows_of, title_of
from handeye_ros.verification.fixed_fit import FixedFit, K
import numpy as np
from rich.table import Table
import scipy.linalg
import yaml

EARLIEST = 10 ** 18  # ns (2001): stamps before it are of no clock of the world
SENSITIVE = 3.6  # sigmas: 1.96 + 1.64, an error is seen with 95 % if false alarms are 5 %
NORMAL_95, ONE_SIDED_95 = 1.96, 1.64
SIGNIFICANT = 0.01  # level of the tests of a calibration error
INCONSISTENT = 1e-3  # level of the test that the points agree
FOREIGN = 1e-6  # below this p no error of the calibration explains the points
LARGE = 0.01  # m: a larger tolerance gets a note


@dataclass(frozen=True)
class Quantity:
    """
    A measured value with its nominal value; metres, or radians where unit is rad.

    std: 1 sigma of the deviation by sensor, robot and nominal value; claimed: 1 sigma by the
    calibration's covariance. nominal: None where there is none.
    characteristic: its symbol in VDI/VDE 2634 or ISO 10360 (see results/pages.py).
    """

    name: str
    value: float
    std: float
    claimed: float
    nominal: float | None = None
    unit: str = 'm'
    characteristic: str = ''

    @property
    def error(self) -> float | None:
        """Return value less nominal."""
        return None if self.nominal is None else self.value - self.nominal

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty of the measurement, k times std."""
        return K * self.std


@dataclass(frozen=True)
class StationResult:
    """
    Result of one stop: the largest distance from the fit, and its 1 sigma (m).

    bag, number: of recording and stop, from 1; stamp: ns; p: probability that a good stop is as
    far off, whatever the error of the calibration; reason: why it is not used.
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
class Scatter:
    """
    Distances of the measured points from the fitted shape (m).

    expected: 95 % quantile of the RMS if the uncertainties are as stated (nan for very many
    points); p: probability that the points then disagree at least as much.
    """

    points: int
    mean: float
    std: float
    rms: float
    maximum: float
    expected: float
    p: float


@dataclass(frozen=True)
class Verification:
    """
    Result of a routine.

    verdict: pass, fail, undecided (the uncertainty is too large for the tolerance), or
    insensitive (an error of the calibration as large as the tolerance would not have shown).
    reasons: sentences. smallest_error: the smallest detectable error of the calibration, in the
    least sensitive direction (m). region: squared distance of the values from their nominals, in
    units of both covariances; freedom: number of values with a nominal; claim_p: probability of a
    larger region if the calibration's covariance is true. surface: the choice between several in
    sight. says: what the routine measures; recorded: when (ISO 8601; empty: unknown); certificate:
    U of the nominal values (m); record: record.* of the configuration. calibration_file: path and
    sha256 of the file that was verified; created: when it was evaluated (ISO 8601).
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
    inputs: tuple[str, ...] = ()
    says: str = ''
    recorded: str = ''
    certificate: float = 0.0
    record: dict[str, str] = field(default_factory=dict)
    calibration_file: dict[str, str] = field(default_factory=dict)
    created: str = ''


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
    by_rotation = np.sqrt(max(worst[3:] @ fit.shift[3:, 3:] @ worst[3:], 0.0))
    motion, axis = (('position along', worst[:3]) if np.linalg.norm(worst[:3]) >= by_rotation else
                    ('rotation about', worst[3:]))
    *others, last = [name for size, name in zip(np.abs(axis), 'xyz', strict=True)
                     if size > 0.5 * np.abs(axis).max()]
    axes = f'{", ".join(others)} and {last}' if others else last
    return Sensitivity(float(SENSITIVE / np.sqrt(max(power[0], 1e-12))),
                       abs(float(worst @ shift @ fit.error)), f'{motion} {axes} of the flange')


def claim_p(fit: FixedFit) -> float:
    """Return the p-value of the deviations under the calibration's stated covariance."""
    return float(chi2_sf(fit.region, fit.freedom)) if fit.freedom else 1.0


def decide(fit: FixedFit, weakest: Sensitivity, quantities: Sequence[Quantity],
           stations: Sequence[StationResult], limits: VerifyConfig
           ) -> tuple[str, tuple[str, ...]]:
    """Return the verdict (pass, fail, undecided or insensitive), and its reasons as sentences."""
    other_size = fit.p_error < FOREIGN < fit.p  # the shape fits, but not in its size
    notes = _notes(fit, other_size, stations, limits)
    failed = _failed(quantities, stations, limits)
    if fit.p_no_error <= SIGNIFICANT and not other_size and (
            fit.implied - ONE_SIDED_95 * fit.implied_std > limits.tolerance):
        failed.append(
            f'the pattern of the distances matches a calibration error of {mm(fit.implied)} ± '
            f'{mm(K * fit.implied_std)} (k = {K:g}) at the points')
    if failed:
        return 'fail', (*failed, *notes)
    used = sum(station.used for station in stations)
    if weakest.size > limits.tolerance:
        more = math.ceil(used * (weakest.size / limits.tolerance) ** 2)
        return 'insensitive', (
            f'an error of the calibration would show only from {mm(weakest.size)} on '
            f'({weakest.direction}), and the tolerance is {mm(limits.tolerance)}: turn the sensor '
            'more between the stops' + _or_measure(more, used, ', or'), *notes)
    undecided = _unsure(quantities, limits, used)
    for size, std, is_seen in (
            (fit.implied, fit.implied_std, fit.p_no_error < SIGNIFICANT),
            (weakest.estimate, weakest.std, weakest.estimate > NORMAL_95 * weakest.std)):
        if is_seen and size + ONE_SIDED_95 * std > limits.tolerance:
            undecided.append(
                f'the points suggest an error of the calibration of {mm(size)} ± {mm(K * std)} '
                f'(k = {K:g}), which may exceed the tolerance: measure at more stops')
            break
    return ('undecided', (*undecided, *notes)) if undecided else ('pass', notes)


def _failed(quantities: Sequence[Quantity], stations: Sequence[StationResult],
            limits: VerifyConfig) -> list[str]:
    """Return a sentence for each value, and for the points, beyond the tolerance for certain."""
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


def _unsure(quantities: Sequence[Quantity], limits: VerifyConfig, used: int) -> list[str]:
    """Return a sentence for each value that with its uncertainty exceeds the tolerance."""
    sentences = []
    for q in quantities:
        tolerance = _tolerance(q, limits)
        if q.error is None or abs(q.error) + q.expanded <= tolerance:
            continue
        margin = tolerance - abs(q.error)
        helps = margin > 0 and math.isfinite(q.std)
        more = math.ceil(used * (q.expanded / margin) ** 2) if helps else 0
        sentences.append(
            f'{q.name} is off by {formatted(q.error, q.unit)}, its uncertainty is '
            f'{formatted(q.expanded, q.unit)} (k = {K:g}), and together they exceed the tolerance '
            f'of {formatted(tolerance, q.unit)}' + _or_measure(more, used, ':'))
    return sentences


def _tolerance(q: Quantity, limits: VerifyConfig) -> float:
    return limits.tolerance if q.unit == 'm' else limits.angle_tolerance


def _or_measure(stops: int, used: int, conjunction: str) -> str:
    """Return the advice to measure at so many stops, '' if these would not help."""
    if not 0 < stops < 100 * used:
        return ''
    return f'{conjunction} measure at about {stops} stops like these'


def _notes(fit: FixedFit, other_size: bool, stations: Sequence[StationResult],
           limits: VerifyConfig) -> tuple[str, ...]:
    notes = [f'{s.name} is left out: {s.reason}' for s in stations if not s.used]
    if fit.p < INCONSISTENT:
        notes.append(f'the points disagree by more than calibration, noise.sensor and '
                     f'noise.robot_* explain (p = {fit.p:.1g}): the calibration is worse than '
                     'it claims, the artefact moved, or the noise is set too small')
    if other_size:
        notes.append('the points fit the shape, and no error of the calibration explains these '
                     'deviations: check the nominal values (verify.radius, verify.lengths)')
    claim = claim_p(fit)
    if claim < SIGNIFICANT:
        notes.append(f'the deviations are larger than the calibration claims (p = {claim:.1g})')
    if limits.tolerance > LARGE:
        notes.append(f'the tolerance is {mm(limits.tolerance)}: verify.tolerance is '
                     'in metres unless a unit is given')
    return tuple(notes)


def time_of(stamp: int) -> str:
    """Return a stamp (ns) as ISO 8601; empty if it is not of a wall clock."""
    if stamp < EARLIEST:
        return ''
    return datetime.fromtimestamp(stamp * 1e-9, UTC).isoformat(timespec='seconds')


def values(verification: Verification) -> dict[str, Any]:
    """Return a verification as plain values, for YAML and for the protocol."""
    return {'format': FORMAT, 'version': __version__, 'k': K, **asdict(verification)}


def yaml_text(verification: Verification) -> str:
    """Return a verification as YAML."""
    return yaml.safe_dump(values(verification), sort_keys=False, width=100,
                          default_flow_style=None)


def stations_csv(verification: Verification) -> str:
    """Return the results of the stops as CSV, in metres."""
    return output.csv_text((field.name for field in fields(StationResult)),
                           map(astuple, verification.per_station))


def sentence(verification: Verification) -> str:
    """Return a verification as one sentence: verdict, reasons, figures with units."""
    content = values(verification)
    figures = []
    for name, (measured, nominal, deviation, U, claimed) in rows_of(content):
        claims = f'; the calibration claims {claimed}, 1 sigma' if claimed else ''
        figures.append(f'{name} {measured}' + (f' ± {U} (k = {K:g}{claims})' if U else '')
                       + (f', nominal {nominal}, off by {deviation}' if nominal else ''))
    surface = [verification.surface] if verification.surface else []
    return '; '.join((title_of(content), *verification.reasons, *surface, *figures))


def table(verification: Verification) -> Table:
    """Return the table of a verification."""
    content = values(verification)
    result = Table(title=title_of(content), title_justify='left')
    for column in ('', *COLUMNS):
        result.add_column(column, justify='left' if not column else 'right')
    for name, texts in rows_of(content):
        result.add_row(name, *texts)
    return result
