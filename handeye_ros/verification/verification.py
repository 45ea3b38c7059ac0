"""What a verification found: plain values, the table that tells them, and their YAML."""
from __future__ import annotations

from dataclasses import asdict, astuple, dataclass, fields
from datetime import datetime, UTC
import math
from typing import Any

from handeye_ros import __version__, output
from handeye_ros.results.verified import COLUMNS, FORMAT, rows_of, shown, title_of
from rich.table import Table
import yaml

EARLIEST = 10 ** 18  # ns (2001): stamps before it are of no clock of the world
K = 2.0  # coverage factor of expanded uncertainties (GUM: about 95 %)


@dataclass(frozen=True)
class Quantity:
    """
    A measured value beside its nominal one; metres, or radians where unit is rad.

    std: 1 sigma of the deviation by sensor and robot here, and by the nominal value; claimed: 1
    sigma that the calibration's covariance makes of it. nominal: None where there is none.
    characteristic: its symbol in VDI/VDE 2634 or ISO 10360 (see results/protocol.py).
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
    What one stop showed: its largest distance from the fit and 1 sigma of it (m).

    bag, number: which stop of which recording, from 1; stamp: ns; p: how often a good stop is
    as far off, whatever the error of the calibration; reason: why it is not used.
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
        """Return which stop it is."""
        return f'stop {self.number} of recording {self.bag}'


@dataclass(frozen=True)
class Scatter:
    """
    Distances of the measured points from the fitted shape (m).

    expected: below this RMS lie 95 % of verifications whose uncertainty is as stated (not a
    number where there are very many points); p: the share
    of them whose points disagree at least as much.
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
    The result of a routine.

    verdict: pass, fail, undecided (the uncertainty is too large for the tolerance), or
    insensitive (an error of the calibration as large as the tolerance would not have shown).
    reasons: sentences. smallest_error: of the calibration that would have shown, in the direction
    that shows least (m). region: squared distance of all values with a nominal from it, in units
    of both covariances; freedom: how many they are; claim_p: how often it is as large where the
    calibration's covariance is true. surface: what was taken of several in sight. says: what the
    routine measures; recorded: when (ISO 8601; empty: unknown); certificate: U of the nominal
    values (m); record: record.* of the configuration.
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


def time_of(stamp: int) -> str:
    """Return a stamp (ns) as ISO 8601; empty where it is of no clock of the world."""
    if stamp < EARLIEST:
        return ''
    return datetime.fromtimestamp(stamp * 1e-9, UTC).isoformat(timespec='seconds')


def values(found: Verification) -> dict[str, Any]:
    """Return a verification as plain values, for YAML and for the report."""
    content = {'format': FORMAT, 'version': __version__, **asdict(found)}
    content['reasons'], content['inputs'] = list(found.reasons), list(found.inputs)
    content['k'], content['record'] = K, dict(found.record)
    content['quantities'] = [asdict(q) for q in found.quantities]
    content['per_station'] = [asdict(s) for s in found.per_station]
    return content


def yaml_text(found: Verification) -> str:
    """Return a verification as YAML."""
    return yaml.safe_dump(values(found), sort_keys=False, width=100, default_flow_style=None)


def stations_csv(found: Verification) -> str:
    """Return what each stop showed as CSV, in metres."""
    return output.csv_text((field.name for field in fields(StationResult)),
                           map(astuple, found.per_station))


def sentence(found: Verification) -> str:
    """Return a verification as one sentence: verdict, figures with units, reasons."""
    content = [f'{q.name} {shown(q.value, q.unit)} ± {shown(q.expanded, q.unit)} (k = '
               f'{K:g}; the calibration claims {shown(q.claimed, q.unit)}, 1 sigma)'
               + ('' if q.nominal is None else f', nominal {shown(q.nominal, q.unit)}, off by '
                  f'{shown(q.error, q.unit)}') for q in found.quantities]
    s = found.scatter
    content.append(f'distances from the fit: mean {shown(s.mean, "m")}, standard deviation '
                   f'{shown(s.std, "m")}, maximum {shown(s.maximum, "m")}, '
                   f'RMS {shown(s.rms, "m")}')
    if not math.isnan(s.expected):
        content[-1] += f' (95 % of such RMS lie below {shown(s.expected, "m")})'
    taken = [found.surface] if found.surface else []
    return '; '.join((title_of(values(found)), *found.reasons, *taken, *content))


def table(found: Verification) -> Table:
    """Return what is reported of a verification."""
    content = values(found)
    made = Table(title=title_of(content), title_justify='left')
    for column in ('', *COLUMNS):
        made.add_column(column, justify='left' if not column else 'right')
    for name, texts in rows_of(content):
        made.add_row(name, *texts)
    return made
