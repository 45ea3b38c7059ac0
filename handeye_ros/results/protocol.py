"""
The protocol of a verification: one HTML file for the file of an inspector, printed to PDF.

It is made of what the YAML of a verification holds (see verified.py).
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, UTC
from typing import Any

from handeye_ros.results.report.page import templates
from handeye_ros.results.verified import COLUMNS, rows_of, shown, title_of

# Characteristics of VDI/VDE 2634 parts 2 and 3: what they are, and how often a quantity's error
# they are (PS is of the diameter). E is the length measurement error of ISO 10360.
CHARACTERISTICS = {
    'PF': ('probing error, form: span of the radial distances', 1.0),
    'PS': ('probing error, size: error of the diameter', 2.0),
    'SD': ('sphere spacing error', 1.0),
    'F': ('flatness measurement error: span of the distances from the plane', 1.0),
    'E': ('length measurement error', 1.0)}
WIDTH, HEIGHT, LEFT, BOTTOM = 760.0, 190.0, 60.0, 24.0  # of the picture and its margins


def html(content: Mapping[str, Any]) -> str:
    """Return the protocol; content: the values of a verification."""
    return templates().get_template('protocol.html').render(
        t=content, title=title_of(content), columns=COLUMNS, rows=list(rows_of(content)),
        characteristics=list(_characteristics(content)), conformity=list(_conformity(content)),
        picture=_picture(content['per_station'], content['tolerance'], content['k']),
        now=datetime.now(UTC).isoformat(timespec='seconds'), shown=shown)


def _characteristics(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield symbol, meaning, of what, value and U of each characteristic."""
    for q in content['quantities']:
        meaning, factor = CHARACTERISTICS.get(q['characteristic'], ('', 0.0))
        if meaning and (q['nominal'] is not None or q['characteristic'] in ('PF', 'F')):
            value = factor * (q['value'] - (q['nominal'] or 0.0))
            yield (q['characteristic'], meaning, q['name'], shown(value, q['unit']),
                   shown(factor * content['k'] * q['std'], q['unit']))


def _conformity(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, |deviation| + U, tolerance and the decision of ISO 14253-1 of each quantity."""
    for q in content['quantities']:
        if q['nominal'] is None:
            continue
        deviation, U = abs(q['value'] - q['nominal']), content['k'] * q['std']
        tolerance = content['tolerance'] if q['unit'] == 'm' else content['angle_tolerance']
        decision = ('conforms' if deviation + U <= tolerance else
                    'does not conform' if deviation - U > tolerance else 'not decided')
        yield (q['name'], f'{shown(deviation, q["unit"])} ± {shown(U, q["unit"])}',
               shown(tolerance, q['unit']), decision)


def _picture(stations: Sequence[Mapping[str, Any]], tolerance: float, k: float
             ) -> dict[str, Any]:
    """Return the bars of the stops: their largest distances from the fit, with U."""
    reach = max((float(s['distance'] + k * s['std']) for s in stations if s['used']), default=0.0)
    top = 1.1 * (max(reach, tolerance) if tolerance < 3 * reach else reach)
    step = (WIDTH - LEFT) / max(len(stations), 1)

    def height(value: float) -> float:
        return round((HEIGHT - BOTTOM) * (1 - max(value, 0.0) / (top or 1.0)), 1)

    bars = [{'x': round(LEFT + (i + 0.15) * step, 1), 'width': round(0.7 * step, 1),
             'y': height(s['distance']), 'low': height(s['distance'] - k * s['std']),
             'high': height(s['distance'] + k * s['std']), 'station': s}
            for i, s in enumerate(stations)]
    return {'bars': bars, 'top': top, 'tolerance': height(tolerance),
            'width': WIDTH, 'height': HEIGHT, 'left': LEFT, 'floor': HEIGHT - BOTTOM}
