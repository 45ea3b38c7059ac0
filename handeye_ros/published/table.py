"""The comparison of estimators: a table in millimetres and degrees, and plain values."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.published.compare import Comparison, Row
from handeye_ros.results.calibration_file import transform_values
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

NOT_KNOWN = '-'
ANY_WIDTH = 1000
TRANSFORM_WIDTH = 59
FORMAT = 'handeye_ros/comparison/1'


@dataclass(frozen=True)
class ComparisonTable:
    """A renderable of all rows, split in two tables on narrow terminals."""

    comparison: Comparison

    def __rich_console__(self, console: Console, options: ConsoleOptions
                         ) -> Iterator[RenderableType]:
        """Yield the renderables."""
        with_errors = any(row.errors for row in self.comparison.rows)
        yield Text(title(self.comparison))
        whole = _table(self.comparison, True, True)
        room = Measurement.get(console, options.update_width(ANY_WIDTH), whole)
        if room.minimum <= options.max_width:
            yield whole
        else:
            yield _table(self.comparison, True, False)
            yield _table(self.comparison, False, True)
        over = self.comparison.over if with_errors else ''
        yield from (Text(line) for line in _legend(over))


def title(comparison: Comparison) -> str:
    """Return the title: the samples of all estimators."""
    lost = f', {comparison.rejected} rejected' if comparison.rejected else ''
    return (f'{comparison.used} samples{lost}. The published estimators are given what '
            f'{comparison.rows[0].name} finds: which samples agree, and the labels, sides or '
            'start that they need.')


def _table(comparison: Comparison, transforms: bool, figures: bool) -> Table:
    """Return the rows with the given columns."""
    whole = transforms and figures
    with_errors = any(row.errors for row in comparison.rows)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column('estimator', no_wrap=whole)
    if transforms:
        table.add_column('x, y, z (mm)' + ('; ' if whole else '\n') + 'roll, pitch, yaw (degrees)',
                         min_width=TRANSFORM_WIDTH if whole else None)
    errors = ('error:\nmm', '\ndegrees', 'mapped\nmm') if with_errors else ()
    for name in ('residual\nmm', 'held out\nmm', *errors, 'time\ns') if figures else ():
        table.add_column(name, justify='right', no_wrap=True)
    for row in comparison.rows:
        table.add_row(row.name, *([_transform(row, whole)] if transforms else []),
                      *(_figures(row, with_errors) if figures else []))
    return table


def _transform(row: Row, one_line: bool) -> Text:
    """Return the transform in one or two lines, or the reason why it is missing."""
    if row.T_flange_sensor is None:
        return Text(f'failed: {row.failure}')
    return Text(transform_text(row.T_flange_sensor, ' ' if one_line else '\n'))


def transform_text(T: Array, separator: str = ' ') -> str:
    """Return x, y, z in millimetres and roll, pitch, yaw in degrees, of equal width."""
    return separator.join([' '.join(f'{v * 1e3:9.3f}' for v in T[:3, 3]),
                           ' '.join(f'{math.degrees(a):9.4f}' for a in se3.rpy(T))])


def _figures(row: Row, with_errors: bool) -> Iterator[str]:
    yield _millimetres(row.residual_rms)
    yield _millimetres(row.holdout_rms)
    if with_errors:
        e = row.errors
        yield _millimetres(e.translation if e else None)
        yield f'{math.degrees(e.rotation):.4f}' if e else NOT_KNOWN
        yield _millimetres(e.mapped_points if e else None)
    yield f'{row.seconds:.3f}'


def _millimetres(value: float | None) -> str:
    return NOT_KNOWN if value is None else f'{value * 1e3:.4f}'


def _legend(over: str) -> Iterator[str]:
    yield ('residual: RMS of what the first method minimises, with each transform, the target '
           'fitted to it; held out: of samples the estimator was not given')
    if over:
        yield f'error: against truth.yaml; mapped: RMS over {over}'


def values(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as plain values, in SI units, for YAML."""
    return {'format': FORMAT, 'samples_used': comparison.used,
            'samples_rejected': comparison.rejected,
            'estimators': [_row_values(row) for row in comparison.rows]}


def _row_values(row: Row) -> dict[str, Any]:
    if row.T_flange_sensor is None:
        return {'name': row.name, 'failure': row.failure}
    errors = row.errors
    return {'name': row.name, 'transform': transform_values(row.T_flange_sensor),
            'residual_rms': row.residual_rms, 'holdout_rms': row.holdout_rms,
            **({'error_translation': errors.translation, 'error_rotation': errors.rotation,
                'error_mapped_points': errors.mapped_points} if errors else {}),
            'seconds': row.seconds}
