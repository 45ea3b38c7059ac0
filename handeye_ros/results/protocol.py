# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The protocol of a verification, for the file of an inspector; it opens without a network."""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import hashlib
import json
from typing import Any

from handeye_ros.output import figure, image, page, style
from handeye_ros.results.verification_file import COLUMNS, formatted, look_of, rows_of, title_of
import numpy as np

# Characteristics of VDI/VDE 2634 parts 2 and 3: meaning, and factor to the error of the quantity
# (PS is of the diameter). E is the length measurement error of ISO 10360.
CHARACTERISTICS = {
    'PF': ('probing error, form: span of the radial distances', 1.0),
    'PS': ('probing error, size: error of the diameter', 2.0),
    'SD': ('sphere spacing error', 1.0),
    'F': ('flatness measurement error: span of the distances from the plane', 1.0),
    'E': ('length measurement error', 1.0)}
BARS = ('#1f6fb4', '#e07b00')  # colours of recordings, in turn


def protocol(content: Mapping[str, Any]) -> str:
    """
    Return the protocol of a verification, printable as PDF for an inspector.

    content: what the YAML of a verification holds (see verification_file.py).
    """
    # the same result gives the same number, another result another one
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode())
    with style():
        picture = _picture(content['per_station'], content['tolerance'], content['k'])
    return page(
        'protocol.html', t=content, number=digest.hexdigest()[:12], title=title_of(content),
        look=look_of(content['verdict']), columns=COLUMNS, rows=list(rows_of(content)),
        characteristics=list(_characteristics(content)), conformity=list(_conformity(content)),
        picture=picture, formatted=formatted)


def _characteristics(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield symbol, meaning, object, value and U of each characteristic."""
    for q in content['quantities']:
        meaning, factor = CHARACTERISTICS.get(q['characteristic'], ('', 0.0))
        if meaning and (q['nominal'] is not None or q['characteristic'] in ('PF', 'F')):
            value = factor * (q['value'] - (q['nominal'] or 0.0))
            yield (q['characteristic'], meaning, q['name'], formatted(value, q['unit']),
                   formatted(factor * content['k'] * q['std'], q['unit']))


def _conformity(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, |deviation| + U, tolerance and the decision of ISO 14253-1 of each quantity."""
    for q in content['quantities']:
        if q['nominal'] is None:
            continue
        deviation, U = abs(q['value'] - q['nominal']), content['k'] * q['std']
        tolerance = content['tolerance'] if q['unit'] == 'm' else content['angle_tolerance']
        decision = ('conforms' if deviation + U <= tolerance else
                    'does not conform' if deviation - U > tolerance else 'not decided')
        yield (q['name'], f'{formatted(deviation, q["unit"])} ± {formatted(U, q["unit"])}',
               formatted(tolerance, q['unit']), decision)


def _picture(stations: Sequence[Mapping[str, Any]], tolerance: float, k: float) -> str:
    """Return the bars of the stops: their largest distances from the fit, with U."""
    drawing, ax = figure(1, 1, width=8, height=2.6)
    used = [s for s in stations if s['used']]
    index = np.array([i for i, s in enumerate(stations) if s['used']])
    distance = 1e3 * np.array([s['distance'] for s in used])
    ax.bar(index, distance, 0.7, yerr=[1e3 * k * s['std'] for s in used],
           color=[BARS[s['bag'] % 2] for s in used])
    if tolerance < 3e-3 * distance.max(initial=0.0):
        ax.axhline(1e3 * tolerance, color='#c62828', linestyle='--')
    left_out = [i for i, s in enumerate(stations) if not s['used']]
    ax.plot(left_out, [0] * len(left_out), 'kx', clip_on=False)
    shown = range(0, len(stations), 1 + len(stations) // 40)
    ax.set_xticks(shown, [str(stations[i]['number']) for i in shown], fontsize=7)
    ax.set(xlabel='stop', ylabel='distance (mm)', ylim=(0, None))
    return image(drawing)
