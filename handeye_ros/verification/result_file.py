# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A verification as the content of its YAML, and what is shown of it: table, sentence, protocol.

The protocol is one HTML file for an inspector; it opens without a network.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
import hashlib
import json
from pathlib import Path
from typing import Any

from handeye_ros import __version__
from handeye_ros.config import read_yaml
from handeye_ros.errors import unusable_file
from handeye_ros.output import now_text
from handeye_ros.results.file_values import input_provenance, require_format
from handeye_ros.results.printed import figures_table
from handeye_ros.results.templates import rendered
from handeye_ros.verification.fit import COVERAGE_FACTOR
from handeye_ros.verification.verify import decision, in_mm_or_degrees, Verification
from rich.table import Table

FORMAT = 'handeye_ros/verification/1'
TABLE_COLUMNS = ('measured', 'nominal', 'deviation', f'U (k = {COVERAGE_FACTOR:g})',
                 'claimed, 1 sigma', 'ISO 14253-1')
# Rows of a figure alone, of the scatter or of the whole: name, key, unit.
FIGURE_ROWS = (('mean distance from the fit', 'mean', 'm'), ('its standard deviation', 'std', 'm'),
               ('its maximum', 'maximum', 'm'), ('its RMS', 'rms', 'm'),
               ('tolerance of lengths', 'tolerance', 'm'),
               ('tolerance of angles', 'angle_tolerance', 'rad'),
               ('smallest error found in half of the cases', 'smallest_error', 'm'),
               ('smallest error found with 95 %', 'smallest_error_95', 'm'))
# Characteristics of VDI/VDE 2634 parts 2 and 3: meaning, and factor to the error of the quantity
# (PS is of the diameter). E is the length measurement error of ISO 10360.
CHARACTERISTICS = {
    'PF': ('probing error, form: span of the radial distances', 1.0),
    'PS': ('probing error, size: error of the diameter', 2.0),
    'SD': ('sphere spacing error', 1.0),
    'F': ('flatness measurement error: span of the distances from the plane', 1.0),
    'E': ('length measurement error', 1.0)}

# the names in FORMAT of fields that the code calls otherwise
KEYS = {'station_count': 'stations', 'measures': 'says', 'recording': 'bag', 'chi2': 'region',
        'degrees_of_freedom': 'freedom', 'per_group': 'per_station', 'p_calibration': 'claim_p',
        'std_by_calibration': 'claimed'}


def plain_values(verification: Verification, inputs: Iterable[object] = (),
                 calibration_file: Path | None = None) -> dict[str, Any]:
    """Return a verification as the content of its YAML, with its inputs and the time of now."""
    values = asdict(verification, dict_factory=lambda items: {
        KEYS.get(name, name): value for name, value in items if name != 'label'})
    fit = values.pop('fit')
    return {'format': FORMAT, 'version': __version__, 'k': COVERAGE_FACTOR, **values,
            'scatter': fit['scatter'], 'smallest_error': fit['misalignment'].even_chance,
            'smallest_error_95': fit['misalignment'].smallest_detectable,
            'weakest_direction': fit['misalignment'].weakest_direction,
            **{key: fit[key] for key in ('region', 'freedom', 'claim_p')},
            'inputs': list(map(str, inputs)),
            'calibration_file': input_provenance(calibration_file) if calibration_file else {},
            'created': now_text()}


def title_of(content: Mapping[str, Any]) -> str:
    """Return the routine with its verdict and its number of stations."""
    return f'{content["routine"]}: {content["verdict"].upper()}, {content["stations"]} stations'


def table_rows(content: Mapping[str, Any]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield name and texts of TABLE_COLUMNS of each quantity, then of each of FIGURE_ROWS."""
    for quantity in content['quantities']:
        value, nominal, unit = (quantity[key] for key in ('value', 'nominal', 'unit'))
        U, deviation, decided = content['k'] * quantity['std'], None, ''
        if nominal is not None:
            deviation = value - nominal
            decided = decision(deviation, U,
                               content['tolerance' if unit == 'm' else 'angle_tolerance'])
        claimed = quantity['claimed'] or None  # none of a scatter
        texts = (in_mm_or_degrees(figure, unit)
                 for figure in (value, nominal, deviation, U, claimed))
        yield quantity['name'], (*texts, decided)
    figures = {**content, **content['scatter']}
    for name, key, unit in FIGURE_ROWS:
        if key in figures:  # older files have no smallest_error_95
            yield name, (in_mm_or_degrees(figures[key], unit), *[''] * 5)


def table(content: Mapping[str, Any]) -> Table:
    """Return the table of a verification."""
    return figures_table('', *TABLE_COLUMNS, right=range(1, 7), title=title_of(content),
                         rows=((name, *texts) for name, texts in table_rows(content)))


def sentence(content: Mapping[str, Any]) -> str:
    """Return a verification as one sentence: verdict, reasons, figures with units."""
    return f'{title_of(content)}; {reasons_and_figures(content)}'


def reasons_and_figures(content: Mapping[str, Any]) -> str:
    """Return the reasons of the verdict, and the figures with units, in words."""
    figures = []
    for name, (measured, nominal, deviation, U, claimed, _) in table_rows(content):
        claims = f'; the calibration claims {claimed}, 1 sigma' if claimed else ''
        figures.append(f'{name} {measured}'
                       + (f' ± {U} (k = {content["k"]:g}{claims})' if U else '')
                       + (f', nominal {nominal}, off by {deviation}' if nominal else ''))
    return '; '.join(filter(None, (*content['reasons'], content['surface'], *figures)))


def protocol_of(path: Path) -> str | None:
    """Return the protocol of a verification in a file, None of another file; raises InputError."""
    content = read_yaml(path)
    text = str(content.get('format')) if isinstance(content, dict) else ''
    if text.rpartition('/')[0] != FORMAT.rpartition('/')[0]:
        return None
    require_format(path, text, FORMAT)
    from jinja2 import TemplateError
    try:
        return protocol(content)  # which uses all of it
    except (TemplateError, LookupError, TypeError, ValueError, AttributeError,
            ArithmeticError) as error:
        raise unusable_file(
            path, 'it is not the whole result of a verification: verify again') from error


def protocol(content: Mapping[str, Any]) -> str:
    """Return the protocol of the content of a verification, printable for an inspector."""
    # the same result gives the same number, another result another one
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode())
    return rendered(
        'protocol.html', t=content, number=digest.hexdigest()[:12], title=title_of(content),
        columns=TABLE_COLUMNS, rows=list(table_rows(content)),
        characteristics=list(_characteristics(content)), in_mm_or_degrees=in_mm_or_degrees)


def _characteristics(content: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield symbol, meaning, object, value and U of each characteristic that was measured."""
    for quantity in content['quantities']:
        symbol, nominal, unit = (quantity[key] for key in ('characteristic', 'nominal', 'unit'))
        meaning, factor = CHARACTERISTICS.get(symbol, ('', 0.0))
        if meaning and (nominal is not None or symbol in ('PF', 'F')):
            yield (symbol, meaning, quantity['name'],
                   in_mm_or_degrees(factor * (quantity['value'] - (nominal or 0.0)), unit),
                   in_mm_or_degrees(factor * content['k'] * quantity['std'], unit))
