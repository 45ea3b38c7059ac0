"""How each cell of a batch went through time: its calibrations and residuals in order."""
from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handeye_ros.batch.jobs import Row
from handeye_ros.errors import HandeyeError
from handeye_ros.output import figure, save
from handeye_ros.verification import trend
import numpy as np

PICTURE = 'trend.png'  # in the folder of a cell
MOST_CHARTS = 4


@dataclass(frozen=True)
class Cell:
    """A cell: its recordings with an answer, what its trend says, and the picture's name."""

    name: str
    count: int
    sentence: str
    picture: str


def cells_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows with figures of each cell, by time: what stands before the last slash."""
    cells: dict[str, list[Row]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: (row.get('stamp', 0), row['label'])):
        if row['exit_code'] in (0, 1):
            cells[row['label'].rpartition('/')[0]].append(row)
    return {name: found for name, found in sorted(cells.items()) if len(found) > 1}


def cell_of(name: str, rows: Sequence[Row], out: Path) -> Cell:
    """Return what the trend of a cell says, and draw it where matplotlib is."""
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
    """Return since when the verdict is another than that of the first."""
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
            trend.draw_chart(ax, 1e3 * values, f'{name} [mm, mrad]')
        save(drawing, path)
