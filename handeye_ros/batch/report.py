"""One page for a batch: what became of the jobs, refusals by cause, the worst to open."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from handeye_ros.batch.jobs import Row
from handeye_ros.results.calibration_file import write_whole
from jinja2 import Environment

WORST = 10
FIGURES = ('residual_rms', 'holdout_rms', 'weakest_std', 'seconds')
PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>handeye batch</title>
<style>body{font:14px sans-serif;margin:2em;max-width:70em}td,th{padding:.2em .8em;text-align:left}
table{border-collapse:collapse;margin-bottom:2em}tr:nth-child(even){background:#8882}</style>
<h1>{{ rows|length }} recordings</h1>
<table>{% for name, count in counts %}<tr><td>{{ name }}<td>{{ count }}{% endfor %}</table>
{% if causes %}<h2>Refused, by cause</h2>
<table>{% for cause, count in causes %}<tr><td>{{ count }}<td>{{ cause }}{% endfor %}</table>
{% endif %}<h2>The worst first</h2>
<table><tr><th>recording<th>result{% for name in figures %}<th>{{ name }}{% endfor %}<th>cause
{% for row in rows %}<tr><td><a href="{{ row.label|urlencode }}/output.txt">{{ row.label }}</a>
<td>{{ result(row) }}{% for name in figures %}<td>{{ shown(row.get(name)) }}{% endfor %}
<td>{{ row.get('cause') or '' }}{% endfor %}</table></html>
"""


def result_of(row: Row) -> str:
    """Return what became of a job, in a word."""
    if row['exit_code'] == 0:
        return 'answer, with warnings' if row.get('warnings') else 'answer'
    return {1: 'failed or changed', 2: 'unreadable', 3: 'refused'}.get(row['exit_code'], 'crashed')


def write_report(rows: Sequence[Row], path: Path) -> None:
    """Write the page."""
    worst = sorted(rows, key=lambda row: (-row['exit_code'], -(row.get('residual_rms') or 0.0)))
    causes = Counter(row['cause'][:100] for row in rows if row.get('cause'))
    environment = Environment(autoescape=True)
    write_whole(path, environment.from_string(PAGE).render(
        rows=worst, figures=FIGURES, result=result_of, causes=causes.most_common(),
        counts=Counter(map(result_of, rows)).most_common(),
        shown=lambda value: '' if value is None else f'{value:.3g}'))
