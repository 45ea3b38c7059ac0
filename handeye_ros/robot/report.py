"""Report of the corrected arm, on the screen and as a page: degrees and mm, with 1 sigma."""
from __future__ import annotations

from collections.abc import Iterator
import math
from pathlib import Path

from handeye_ros.output import figure, style, svg, write_whole
from handeye_ros.robot.answer import Answer, UNKNOWN
from handeye_ros.robot.model import DIRECTION, OFFSET, POSITION, REVOLUTE
from jinja2 import Environment
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

NAME = 'kinematics.html'
JOINT_COLUMNS = ('joint', 'zero offset', 'axis direction', 'axis position', 'not known')
MODEL_COLUMNS = ('model', 'residual RMS', 'left out RMS', 'left out median', '')
VIEWS = (('from above', 0, 1), ('from the side', 0, 2))
PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{{ title }}</title>
<style>body{font:14px sans-serif;margin:2em;max-width:70em}td,th{padding:.2em .8em;text-align:left}
table{border-collapse:collapse;margin-bottom:2em}tr:nth-child(even){background:#8882}
svg{max-width:100%;height:auto}</style><h1>{{ title }}</h1><p>{{ sentence }}.</p>
{% for warning in warnings %}<p>Warning: {{ warning }}.</p>{% endfor %}
<h2>Error over the workspace</h2><p>Each dot is the flange of the uncorrected arm at one
configuration. Its colour is the error of what the sensor sees there, predicted from the other
regions of the joint space. Crosses contradict the others and are left out.</p>
<div role="img" aria-label="error over the workspace">{{ picture | safe }}</div>
{% for rows in tables %}<table>{% for row in rows %}<tr>{% for cell in row %}
<td>{{ cell }}{% endfor %}{% endfor %}</table>
{% endfor %}<p>Zero offset: add it to the reading of the joint.</p></html>
"""


def table(answer: Answer) -> RenderableType:
    """Return the joints with their errors, and the cross-validation error of each model."""
    tables = []
    for header, *rows in (_joint_rows(answer), _model_rows(answer)):
        tables.append(Table(*header, box=box.SIMPLE_HEAD, pad_edge=False))
        for row in rows:
            tables[-1].add_row(*row)
    return Group(Text('Zero offset: add it to the reading of the joint.'), *tables,
                 Text(answer.sentence))


def _joint_rows(answer: Answer) -> Iterator[tuple[str, ...]]:
    yield JOINT_COLUMNS
    for i, joint in enumerate(answer.arm.chain.joints):
        zero = (math.degrees(1), 4, 'deg') if joint.kind == REVOLUTE else (1e3, 3, 'mm')
        yield (joint.name, _cell(answer, i, OFFSET, *zero),
               _cell(answer, i, DIRECTION, math.degrees(1), 4, 'deg'),
               _cell(answer, i, POSITION, 1e3, 3, 'mm'), ', '.join(_unknown(answer, i)))


def _model_rows(answer: Answer) -> Iterator[tuple[str, ...]]:
    yield MODEL_COLUMNS
    for model in answer.outcome.models:
        yield (model.words, *(f'{v * 1e3:.3f} mm' for v in (
            model.fit.noise_rms, model.left_out_rms, model.left_out_median)),
            'the answer' if model is answer.outcome.chosen else '')


def _unknown(answer: Answer, joint: int) -> Iterator[str]:
    """Yield the kinds of errors of a joint that the data do not determine."""
    unknown_kinds: dict[str, list[bool]] = {}
    for p, ratio in zip(answer.arm.parameters, answer.outcome.sigma_ratios, strict=True):
        if p.joint == joint:
            unknown_kinds.setdefault(p.kind, []).append(ratio > UNKNOWN)
    yield from (kind for kind, uncertain in unknown_kinds.items() if all(uncertain))


def _cell(answer: Answer, joint: int, kind: str, factor: float, digits: int, unit: str) -> str:
    values = [(value, std) for p, value, std in zip(
        answer.arm.parameters, answer.arm.values, answer.outcome.stds, strict=True)
        if (p.joint, p.kind) == (joint, kind)]
    cells = [f'{value * factor:+.{digits}f} ± {std * factor:.{digits}f}' for value, std in values]
    return f'{", ".join(cells)} {unit}' if cells else '-'


def write_page(answer: Answer, folder: Path) -> None:
    """Write the page with the error over the workspace; raises UnwritableError."""
    write_whole(folder / NAME, Environment(autoescape=True).from_string(PAGE).render(
        title=f'Corrected arm: {answer.calibration.name}', sentence=answer.sentence,
        warnings=answer.warnings, picture=_picture(answer),
        tables=[list(_joint_rows(answer)), list(_model_rows(answer))]))


def _picture(answer: Answer) -> str:
    """Return the cross-validation errors over the workspace, before and after, as SVG."""
    models = (answer.outcome.models[0], answer.outcome.chosen)
    used, fit = models[0].fit.used, models[0].fit
    positions = answer.arm.chain.forward(fit.data.q)[:, :3, 3]
    largest = 1e3 * float(max(model.left_out[used].max() for model in models))
    with style():
        drawing, axes = figure(2, 2, 4.5, 3.2)
        for row, model, title in zip(axes, models, ('before', 'after'), strict=True):
            for ax, (view, i, j) in zip(row, VIEWS, strict=True):
                dots = ax.scatter(*positions[used][:, [i, j]].T, c=1e3 * model.left_out[used],
                                  vmin=0, vmax=largest, cmap='viridis_r', s=28)
                ax.plot(*positions[~used][:, [i, j]].T, 'x', color='#c62828')
                ax.set(xlabel='x (m)', ylabel=f'{"xyz"[j]} (m)', aspect='equal',
                       title=f'{title}, {view}: {1e3 * model.left_out_rms:.2f} mm RMS')
        drawing.colorbar(dots, ax=axes, label='error of left-out points (mm)')
        return svg(drawing)
