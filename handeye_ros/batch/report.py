"""One page for a batch: the results, each cell over time, and the worst results first."""
from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import re

from handeye_ros.batch import trend
from handeye_ros.batch.jobs import Row
from handeye_ros.errors import HandeyeError
from handeye_ros.output import figure, save, write_whole
from jinja2 import Environment
import numpy as np

PICTURE = 'trend.png'  # in the folder of a cell
MOST_CHARTS = 4
WORST = 10
FIGURES = ('residual_rms', 'holdout_rms', 'weakest_std', 'rms', 'points_off', 'smallest_error',
           'seconds')
PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>handeye batch</title>
<style>body{font:14px sans-serif;margin:2em;max-width:70em}td,th{padding:.2em .8em;text-align:left}
table{border-collapse:collapse;margin-bottom:2em}tr:nth-child(even){background:#8882}
img{max-width:100%}</style>
{% macro link(row) %}<a href="{{ (page(row))|urlencode }}">{{ row.label }}</a>{% endmacro %}
{% macro table(rows) %}<table><tr><th>recording<th>result{% for name in figures %}<th>{{ name }}
{% endfor %}<th>cause{% for row in rows %}<tr><td>{{ link(row) }}<td>{{ result(row) }}
{% for name in figures %}<td>{{ shown(row.get(name)) }}{% endfor %}
<td>{{ row.get('cause') or '' }}{% endfor %}</table>{% endmacro %}
<h1>{{ rows|length }} recordings</h1>
<table>{% for name, count in counts %}<tr><td>{{ name }}<td>{{ count }}{% endfor %}</table>
{% if causes %}<h2>Without an answer, by cause</h2>
<table>{% for cause, found in causes %}<tr><td>{{ found|length }}<td>{{ cause }}<td>
{% for row in found[:most] %}{{ link(row) }} {% endfor %}{% endfor %}</table>
{% endif %}<h2>The worst answers</h2>
{{ table(answers[:most]) }}
{% if cells %}<h2>Cells</h2><table>{% for cell in cells %}<tr><td><a href="#c{{ loop.index }}">
{{ cell.name or 'all' }}</a><td>{{ cell.count }}<td>{{ cell.sentence }}{% endfor %}</table>
{% for cell in cells if cell.picture %}<h3 id="c{{ loop.index }}">{{ cell.name or 'all' }}</h3>
<p>{{ cell.sentence }}<br><img loading="lazy" alt="" src="{{ cell.picture|urlencode }}">
{% endfor %}{% endif %}<details><summary>All recordings, the worst first</summary>
{{ table(rows) }}</details></html>
"""


def result_of(row: Row) -> str:
    """Return the result of a job in one word."""
    if row['exit_code'] == 0:
        return 'warning' if row.get('warnings') else 'pass'
    return {1: 'failed or changed', 2: 'unreadable', 3: 'refused'}.get(row['exit_code'], 'crashed')


def worst_first(rows: Sequence[Row]) -> list[Row]:
    """Return rows without an answer, then the others by their residuals."""
    return sorted(rows, key=lambda row: (
        -row['exit_code'], -(row.get('residual_rms') or row.get('rms') or 0.0)))


def worst_answers(rows: Sequence[Row]) -> list[Row]:
    """Return the answers that should be opened first."""
    return worst_first([row for row in rows if row['exit_code'] in (0, 1)])[:WORST]


def write_report(rows: Sequence[Row], cells: Sequence[Cell], path: Path) -> None:
    """Write the page, with links to the report.html of calibrations that have one."""
    causes: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        if row.get('cause'):
            causes[re.sub(r'-?\d[\d.e+-]*', '#', row['cause'])[:200]].append(row)
    with_report = {row['label'] for row in worst_answers(rows)
                   if (path.parent / row['label'] / 'report.html').exists()}
    environment = Environment(autoescape=True)
    write_whole(path, environment.from_string(PAGE).render(
        rows=worst_first(rows), answers=worst_answers(rows), cells=cells, figures=[
            name for name in FIGURES if any(row.get(name) is not None for row in rows)],
        result=result_of, most=WORST,
        causes=sorted(causes.items(), key=lambda item: -len(item[1])),
        counts=Counter(map(result_of, rows)).most_common(),
        page=lambda row: f'{row["label"]}/' + (
            'report.html' if row['label'] in with_report else 'output.txt'),
        shown=lambda value: '' if value is None else f'{value:.3g}'))


@dataclass(frozen=True)
class Cell:
    """A cell: its recordings with an answer, its trend, and the name of the picture."""

    name: str
    count: int
    sentence: str
    picture: str


def cells_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows with values by cell and time; the cell is the label up to the last slash."""
    cells: dict[str, list[Row]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: (row.get('stamp', 0), row['label'])):
        if row['exit_code'] in (0, 1):
            cells[row['label'].rpartition('/')[0]].append(row)
    return {name: cell for name, cell in sorted(cells.items()) if len(cell) > 1}


def cell_of(name: str, rows: Sequence[Row], out: Path) -> Cell:
    """Return the trend of a cell, drawn if matplotlib is installed."""
    picture, sentence = out / name / PICTURE, ''
    try:
        if rows[0]['verb'] == 'solve':
            entries, _ = trend.trend(out / name, files=[
                out / row['label'] / 'calibration.yaml' for row in rows])
            sentence = trend.since_when(entries)
            trend.draw(entries, picture)
        else:
            sentence = _verdicts(rows)
            _draw(rows, picture)
    except HandeyeError as error:  # without matplotlib there is a sentence and no picture
        return Cell(name, len(rows), sentence or str(error), '')
    return Cell(name, len(rows), sentence, str(picture.relative_to(out)))


def _verdicts(rows: Sequence[Row]) -> str:
    """Return since when the verdict differs from the first one."""
    verdicts = [str(row.get('verdict', '')) for row in rows]
    changed = next((k for k, verdict in enumerate(verdicts) if verdict != verdicts[0]), None)
    return f'{verdicts[0]} in all' if changed is None else (
        f'{verdicts[0]}; {verdicts[changed]} since {rows[changed]["label"]}')


def _draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the residuals, and the figures whose uncertainty is stated."""
    names = ['rms', *(name for name in rows[0] if f'{name}_std' in rows[0])]
    names = [name for name in names if any(name in row for row in rows)][:MOST_CHARTS]
    if names:
        drawing, axes = figure(len(names), 1)
        for ax, name in zip(np.atleast_1d(axes), names, strict=True):
            values = np.array([row.get(name, np.nan) for row in rows])
            ax.plot(1e3 * values, 'o-', markersize=4)
            ax.set_ylabel(f'{name} [mm, mrad]')
        save(drawing, path)
