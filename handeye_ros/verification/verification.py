# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The result of a verification: values, table, and YAML."""
from __future__ import annotations

from dataclasses import asdict, astuple, dataclass, fields
from datetime import datetime, UTC
import math
from typing import Any

from handeye_ros import __version__, output
from handeye_ros.results.verification_file import COLUMNS, FORMAT, formatted, rows_of, title_of
from rich.table import Table
import yaml

EARLIEST = 10 ** 18  # ns (2001): stamps before it are of no clock of the world
K = 2.0  # coverage factor of expanded uncertainties (GUM: about 95 %)


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
    record: tuple[tuple[str, str], ...] = ()
    calibration_file: tuple[tuple[str, str], ...] = ()
    created: str = ''


def time_of(stamp: int) -> str:
    """Return a stamp (ns) as ISO 8601; empty if it is not of a wall clock."""
    if stamp < EARLIEST:
        return ''
    return datetime.fromtimestamp(stamp * 1e-9, UTC).isoformat(timespec='seconds')


def values(verification: Verification) -> dict[str, Any]:
    """Return a verification as plain values, for YAML and for the report."""
    content = {'format': FORMAT, 'version': __version__, **asdict(verification)}
    content['reasons'], content['inputs'] = list(verification.reasons), list(verification.inputs)
    content['k'], content['record'] = K, dict(verification.record)
    content['calibration_file'] = dict(verification.calibration_file)
    content['quantities'] = [asdict(q) for q in verification.quantities]
    content['per_station'] = [asdict(s) for s in verification.per_station]
    return content


def yaml_text(verification: Verification) -> str:
    """Return a verification as YAML."""
    return yaml.safe_dump(values(verification), sort_keys=False, width=100,
                          default_flow_style=None)


def stations_csv(verification: Verification) -> str:
    """Return the results of the stops as CSV, in metres."""
    return output.csv_text((field.name for field in fields(StationResult)),
                           map(astuple, verification.per_station))


def sentence(verification: Verification) -> str:
    """Return a verification as one sentence: verdict, figures with units, reasons."""
    content = [f'{q.name} {formatted(q.value, q.unit)} ± {formatted(q.expanded, q.unit)} (k = '
               f'{K:g}; the calibration claims {formatted(q.claimed, q.unit)}, 1 sigma)'
               + ('' if q.nominal is None else f', nominal {formatted(q.nominal, q.unit)}, off by '
                  f'{formatted(q.error, q.unit)}') for q in verification.quantities]
    s = verification.scatter
    content.append(f'distances from the fit: mean {formatted(s.mean, "m")}, standard deviation '
                   f'{formatted(s.std, "m")}, maximum {formatted(s.maximum, "m")}, '
                   f'RMS {formatted(s.rms, "m")}')
    if not math.isnan(s.expected):
        content[-1] += f' (95 % of such RMS lie below {formatted(s.expected, "m")})'
    surface = [verification.surface] if verification.surface else []
    return '; '.join((title_of(values(verification)), *verification.reasons, *surface, *content))


def table(verification: Verification) -> Table:
    """Return the table of a verification."""
    content = values(verification)
    result = Table(title=title_of(content), title_justify='left')
    for column in ('', *COLUMNS):
        result.add_column(column, justify='left' if not column else 'right')
    for name, texts in rows_of(content):
        result.add_row(name, *texts)
    return result
