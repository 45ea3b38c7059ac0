# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A verification from its YAML (see verification/decision.py), formatted."""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from handeye_ros.results.reading import content_of, require_format, unusable

KIND = 'handeye_ros/verification/'
FORMAT = f'{KIND}1'
COLUMNS = ('measured', 'nominal', 'deviation', 'U (k = 2)', 'claimed, 1 sigma')
SCATTER = (('mean distance from the fit', 'mean'), ('its standard deviation', 'std'),
           ('its maximum', 'maximum'), ('its RMS', 'rms'),
           ('95 % of such RMS lie below', 'expected'))
LIMITS = (('tolerance of lengths', 'tolerance', 'm'),
          ('tolerance of angles', 'angle_tolerance', 'rad'),
          ('smallest error of the calibration that would show', 'smallest_error', 'm'))


@dataclass(frozen=True)
class Verified:
    """Formatted verification: title, look (good, bad, open), sentences, rows by COLUMNS."""

    title: str
    look: str
    sentences: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]


def formatted(value: float | None, unit: str) -> str:
    """Return a value in millimetres or degrees, '' if there is none."""
    if value is None or math.isnan(value):
        return ''
    return f'{value * 1e3:.4f} mm' if unit == 'm' else f'{math.degrees(value):.4f} degrees'


def title_of(content: Mapping[str, Any]) -> str:
    """Return the routine with its verdict."""
    return f'{content["routine"]}: {content["verdict"].upper()}, {content["stations"]} stations'


def look_of(verdict: str) -> str:
    """Return how a verdict looks: good, bad, or open where nothing was decided."""
    return {'pass': 'good', 'fail': 'bad'}.get(verdict, 'open')


def rows_of(content: Mapping[str, Any]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the measured values: a name, and the texts of COLUMNS."""
    for q in content['quantities']:
        nominal = q['nominal']
        error = None if nominal is None else q['value'] - nominal
        yield q['name'], tuple(formatted(v, q['unit']) for v in (
            q['value'], nominal, error, content['k'] * q['std'],
            q['claimed'] or None))  # a scatter claims nothing
    for name, key in SCATTER:
        yield name, (formatted(content['scatter'][key], 'm'), '', '', '', '')
    for name, key, unit in LIMITS:
        yield name, (formatted(content[key], unit), '', '', '', '')


def read(path: Path) -> dict[str, Any]:
    """Return the content of a file of "handeye verify --out"; raises InputError."""
    content = content_of(path)
    if not isinstance(content, dict):
        raise unusable(path, 'it is no result of "handeye verify --out"')
    require_format(path, str(content.get('format')), KIND)
    try:
        if 'record' not in content:
            raise unusable(path, 'it is of an earlier version: verify again')
        verified(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise unusable(path, 'it is not the whole result of a verification') from error
    return content


def is_verification(path: Path) -> bool:
    """Return whether a file calls itself the result of a verification; raises InputError."""
    content = content_of(path)
    return isinstance(content, dict) and str(content.get('format')).startswith(KIND)


def verified(content: Mapping[str, Any]) -> Verified:
    """Return the verification that a file holds, formatted."""
    return Verified(title_of(content), look_of(content['verdict']),
                    tuple(map(str, content['reasons'])), tuple(rows_of(content)))
