"""
Control charts of a folder: verifications and checks through time, beside the calibrations.

Warning and action limits are 2 and 3 sigma from the first value (ISO 7870-2), and 10 and 100 times
the evidence for a change of a check.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass
import io
from pathlib import Path
from typing import Any

from handeye_ros.config import yaml_content
from handeye_ros.data import Array
from handeye_ros.estimation.outliers import chi2_isf
from handeye_ros.results.verified import FORMAT as VERIFICATION
from handeye_ros.results.verified import shown
from handeye_ros.scanning.pictures import figure, save
from handeye_ros.verification.check import FORMAT as CHECK
from handeye_ros.verification.trend import CHANGED, draw_chart, Entry, WARNING
from handeye_ros.verification.verification import time_of
import numpy as np
from rich.table import Table
from yaml import YAMLError

CHANGE = 'check: log10 of the evidence for a change'
EVIDENCE = (1.0, 2.0)  # its warning and action limit: 10 and 100 times as likely as none


@dataclass(frozen=True)
class Point:
    """A value of a control chart with its 1 sigma; failed: its file says so."""

    recorded: str
    path: Path
    value: float
    std: float
    failed: bool


@dataclass(frozen=True)
class Chart:
    """
    A measured value through time, the oldest first.

    limits: warning and action limit of the value itself; None: multiples of its 1 sigma and that
    of the first value, which it is compared with.
    """

    name: str
    unit: str
    points: tuple[Point, ...]
    limits: tuple[float, float] | None = None

    def reach(self, action: bool) -> Array:
        """Return how far (n,) each value may be from the first, or from 0."""
        if self.limits:
            return np.full(len(self.points), self.limits[action])
        return (3.0 if action else 2.0) * np.hypot(
            self.points[0].std, [point.std for point in self.points])

    @property
    def centre(self) -> float:
        """Return what the values are compared with."""
        return 0.0 if self.limits else self.points[0].value

    @property
    def states(self) -> list[str]:
        """Return '', warning or action for each value."""
        away = np.abs([point.value - self.centre for point in self.points])
        return ['action' if point.failed or action else 'warning' if warning else ''
                for point, action, warning in zip(
                    self.points, away > self.reach(True), away > self.reach(False), strict=True)]


def charts(folder: Path) -> tuple[list[Chart], list[str]]:
    """Return a chart of each value that several files hold, and a warning for each bad file."""
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
    at, failed = (content['recorded'], path), content['verdict'] == 'fail'
    for q in content['quantities']:
        if q['nominal'] is not None:
            yield (f'{content["routine"]}: {q["name"]}, deviation', q['unit'],
                   Point(*at, q['value'] - q['nominal'], q['std'], failed))
    scatter = content['scatter']
    yield (f'{content["routine"]}: RMS distance from the fit', 'm', Point(
        *at, scatter['rms'], scatter['rms'] / np.sqrt(2 * scatter['points']), failed))


def _checked(content: dict[str, Any], path: Path) -> Iterator[tuple[str, str, Point]]:
    """Yield the evidence of each check for a change."""
    for found in content['checks']:
        yield CHANGE, '', Point(time_of(found['stamp']), path, float(np.log10(max(
            found['evidence'], 1e-3))), 0.0, found['verdict'] != 'unchanged')


def charts_table(found: Sequence[Chart]) -> Table:
    """Return the last value of each chart beside its limits."""
    made = Table(title='measured through time', title_justify='left')
    for column in ('', 'values', 'first', 'last', 'warning', 'action', 'since'):
        made.add_column(column, justify='left' if not column else 'right')
    for chart in found:
        first, last = chart.points[0], chart.points[-1]
        states = chart.states
        since = next((p.recorded for p, state in zip(chart.points, states, strict=True)
                      if state), '')
        made.add_row(chart.name, str(len(states)), *(
            shown(v, chart.unit) if chart.unit else f'{v:.1f}' for v in (
                first.value, last.value, chart.reach(False)[-1], chart.reach(True)[-1])),
            f'{"action" if "action" in states else "warning"} {since}' if any(states) else '')
    return made


def charts_csv(found: Sequence[Chart]) -> str:
    """Return every value of the charts as CSV: metres and radians."""
    lines = io.StringIO()
    made = csv.writer(lines, lineterminator='\n')
    made.writerow(('chart', 'unit', 'recorded', 'path', 'value', 'std', 'centre', 'warning',
                   'action', 'state'))
    for chart in found:
        for point, warning, action, state in zip(
                chart.points, chart.reach(False), chart.reach(True), chart.states, strict=True):
            made.writerow((chart.name, chart.unit, point.recorded, point.path, point.value,
                           point.std, chart.centre, warning, action, state))
    return lines.getvalue()


def draw(entries: Sequence[Entry], found: Sequence[Chart], path: Path) -> None:
    """Write a picture of the trends; raises NoMatplotlibError, UnwritableError."""
    drawing, axes = figure(3 * bool(entries) + len(found), 1)
    axes = np.atleast_1d(axes)
    if entries:
        _draw_calibrations(entries, axes[:3])
    for ax, chart in zip(axes[3 * bool(entries):], found, strict=True):
        _draw_chart(chart, ax)
    save(drawing, path)


def _draw_calibrations(entries: Sequence[Entry], axes: Array) -> None:
    """
    Draw the differences of calibrations from the first.

    The bars reach as far as a joint test of all six differences takes for chance, once in 20;
    the residuals have the limits of an individuals chart.
    """
    at = np.arange(len(entries))
    difference = np.array([e.difference for e in entries])
    reach = float(np.sqrt(chi2_isf(WARNING, 6))) * np.array([e.std for e in entries])
    for ax, part, scale, unit in ((axes[0], slice(0, 3), 1e3, 'mm'),
                                  (axes[1], slice(3, 6), 180 / np.pi, 'degrees')):
        for k, name in enumerate('xyz'):
            ax.errorbar(at + 0.05 * (k - 1), scale * difference[:, part][:, k],
                        scale * reach[:, part][:, k], fmt='o-', capsize=3,
                        label=name if unit == 'mm' else f'about {name}')
        ax.set_ylabel(f'difference [{unit}], joint 95 %')
        ax.axhline(0, color='0.7', linewidth=0.8)
        for place in np.flatnonzero([e.p_before < CHANGED for e in entries]) - 0.5:
            ax.axvline(place, color='tab:red', linestyle='--', linewidth=1)
            ax.annotate('changed', (place, 1), xycoords=('data', 'axes fraction'), fontsize=8,
                        color='tab:red', va='bottom', ha='center')
        ax.legend(fontsize=8)
    draw_chart(axes[2], 1e3 * np.array([e.residual for e in entries]), 'residual RMS [mm]')
    axes[2].set_xticks(at, [e.recorded[:16] or e.path.parent.name for e in entries],
                       rotation=20, ha='right', fontsize=8)


def _draw_chart(chart: Chart, ax: Any) -> None:
    at, scale = np.arange(len(chart.points)), {'m': 1e3, 'rad': 180 / np.pi}.get(chart.unit, 1.0)
    states = np.array(chart.states)
    ax.errorbar(at, [scale * p.value for p in chart.points],
                [2 * scale * p.std for p in chart.points], fmt='o-', capsize=3)
    for action, colour in ((False, 'tab:orange'), (True, 'tab:red')):
        for side in (-1, 1):
            ax.step(at, scale * (chart.centre + side * chart.reach(action)), where='mid',
                    linestyle='--', linewidth=1, color=colour)
    for state, colour in (('warning', 'tab:orange'), ('action', 'tab:red')):
        of = np.flatnonzero(states == state)
        ax.plot(of, [scale * chart.points[k].value for k in of], 'o', color=colour, zorder=3)
    unit = {'m': ' [mm]', 'rad': ' [degrees]'}.get(chart.unit, '')
    ax.set_title(f'{chart.name}{unit}', fontsize=9, loc='left')
    ax.set_xticks(at, [p.recorded[:16] or p.path.stem for p in chart.points], rotation=20,
                  ha='right', fontsize=8)
