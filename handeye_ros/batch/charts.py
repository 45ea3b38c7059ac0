"""
Control charts of a folder: verifications and checks over time, beside the calibrations.

Warning and action limits are 2 and 3 sigma from the first value (ISO 7870-2), and 10 and 100 times
the evidence for a change of a check.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handeye_ros import output
from handeye_ros.config import yaml_content
from handeye_ros.data import Array
from handeye_ros.results.verification_file import FORMAT as VERIFICATION
from handeye_ros.results.verification_file import formatted
from handeye_ros.verification.check import FORMAT as CHECK
from handeye_ros.verification.verification import time_of
import numpy as np
from rich.table import Table
from yaml import YAMLError

CHANGE = 'check: log10 of the evidence for a change'
EVIDENCE = (1.0, 2.0)  # its warning and action limit: 10 and 100 times as likely as none


@dataclass(frozen=True)
class Point:
    """A value of a control chart with its 1 sigma; failed: the verdict in its file."""

    recorded: str
    path: Path
    value: float
    std: float
    failed: bool


@dataclass(frozen=True)
class Chart:
    """
    A measured value over time, the oldest first.

    limits: warning and action limit of the value; None: multiples of 1 sigma of its difference
    from the first value.
    """

    name: str
    unit: str
    points: tuple[Point, ...]
    limits: tuple[float, float] | None = None

    def reach(self, action: bool) -> Array:
        """Return the control limits (n,) of the values, relative to the centre."""
        if self.limits:
            return np.full(len(self.points), self.limits[action])
        return (3.0 if action else 2.0) * np.hypot(
            self.points[0].std, [point.std for point in self.points])

    @property
    def centre(self) -> float:
        """Return the centre line."""
        return 0.0 if self.limits else self.points[0].value

    @property
    def states(self) -> list[str]:
        """Return '', warning or action for each value."""
        away = np.array([point.value - self.centre for point in self.points])
        away = away if self.limits else np.abs(away)
        return ['action' if point.failed or action else 'warning' if warning else ''
                for point, action, warning in zip(
                    self.points, away > self.reach(True), away > self.reach(False), strict=True)]


def charts(folder: Path) -> tuple[list[Chart], list[str]]:
    """Return a chart of each value present in several files, and a warning for each bad file."""
    series: dict[tuple[str, str], list[Point]] = {}
    warnings = []
    for path in sorted(folder.rglob('*.yaml')):
        try:
            content = yaml_content(path.read_text(encoding='utf-8'))
            kind = content.get('format') if isinstance(content, dict) else ''
            read = {VERIFICATION: _verified, CHECK: _checked}.get(str(kind))
            for name, unit, point in read(content, path) if read else ():
                series.setdefault((name, unit), []).append(point)
        except (OSError, UnicodeDecodeError, YAMLError, KeyError, TypeError, ValueError) as error:
            warnings.append(f'{path} is left out: {str(error).splitlines()[0]}')
    return [Chart(name, unit, tuple(sorted(points, key=lambda p: (p.recorded, str(p.path)))),
                  EVIDENCE if name == CHANGE else None)
            for (name, unit), points in series.items() if len(points) > 1], warnings


def _verified(content: dict[str, Any], path: Path) -> Iterator[tuple[str, str, Point]]:
    """Yield the deviations of a verification, and the RMS distance from the fit."""
    origin, failed = (content['recorded'], path), content['verdict'] == 'fail'
    for q in content['quantities']:
        if q['nominal'] is not None:
            yield (f'{content["routine"]}: {q["name"]}, deviation', q['unit'],
                   Point(*origin, q['value'] - q['nominal'], q['std'], failed))
    scatter = content['scatter']
    yield (f'{content["routine"]}: RMS distance from the fit', 'm', Point(
        *origin, scatter['rms'], scatter['rms'] / np.sqrt(2 * scatter['points']), failed))


def _checked(content: dict[str, Any], path: Path) -> Iterator[tuple[str, str, Point]]:
    """Yield the evidence of each check for a change."""
    for check in content['checks']:
        yield CHANGE, '', Point(time_of(check['stamp']), path, float(np.log10(max(
            check['evidence'], 1e-3))), 0.0, check['verdict'] != 'unchanged')


def charts_table(items: Sequence[Chart]) -> Table:
    """Return the last value of each chart with its limits."""
    table = Table(title='measured over time', title_justify='left')
    for column in ('', 'values', 'first', 'last', 'warning', 'action', 'since'):
        table.add_column(column, justify='left' if not column else 'right')
    for chart in items:
        first, last = chart.points[0], chart.points[-1]
        states = chart.states
        since = next((p.recorded for p, state in zip(chart.points, states, strict=True)
                      if state), '')
        table.add_row(chart.name, str(len(states)), *(
            formatted(v, chart.unit) if chart.unit else f'{v:.1f}' for v in (
                first.value, last.value, chart.reach(False)[-1], chart.reach(True)[-1])),
            f'{"action" if "action" in states else "warning"} {since}' if any(states) else '')
    return table


def charts_csv(items: Sequence[Chart]) -> str:
    """Return all values of the charts as CSV: metres and radians."""
    return output.csv_text(
        ('chart', 'unit', 'recorded', 'path', 'value', 'std', 'centre', 'warning', 'action',
         'state'),
        ((chart.name, chart.unit, point.recorded, point.path, point.value, point.std, chart.centre,
          *limits_and_state) for chart in items for point, *limits_and_state in zip(
             chart.points, chart.reach(False), chart.reach(True), chart.states, strict=True)))


def draw_chart(chart: Chart, ax: Any) -> None:
    """Draw a chart with its limits; values beyond them in other colours."""
    index = np.arange(len(chart.points))
    scale = {'m': 1e3, 'rad': 180 / np.pi}.get(chart.unit, 1.0)
    states = np.array(chart.states)
    ax.errorbar(index, [scale * p.value for p in chart.points],
                [2 * scale * p.std for p in chart.points], fmt='o-', capsize=3)
    for action, colour in ((False, 'tab:orange'), (True, 'tab:red')):
        for side in (1,) if chart.limits else (-1, 1):
            ax.step(index, scale * (chart.centre + side * chart.reach(action)), where='mid',
                    linestyle='--', linewidth=1, color=colour)
    for state, colour in (('warning', 'tab:orange'), ('action', 'tab:red')):
        marked = np.flatnonzero(states == state)
        ax.plot(marked, [scale * chart.points[k].value for k in marked], 'o', color=colour,
                zorder=3)
    if chart.limits:
        ax.set_yscale('symlog', linthresh=chart.limits[1])
    unit = {'m': ' [mm]', 'rad': ' [degrees]'}.get(chart.unit, '')
    ax.set_title(f'{chart.name}{unit}', fontsize=9, loc='left')
    ax.set_xticks(index, [p.recorded[:16] or p.path.stem for p in chart.points], rotation=20,
                  ha='right', fontsize=8)
