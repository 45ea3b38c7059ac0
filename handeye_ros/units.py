# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Units of lengths, angles, times: plain numbers of a command are SI, `0.3mm`, `5 deg` say one."""
from __future__ import annotations

from collections.abc import Iterable
import math
import re

from handeye_ros.errors import BadValueError

METRES = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254}
RADIANS = {'rad': 1.0, 'mrad': 1e-3, 'deg': math.pi / 180, 'degrees': math.pi / 180}
SECONDS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6}
WITH_UNIT = re.compile(r'(?<![\w.])([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?) *([a-z]+)(?![\w.])')


def in_si(text: str, unit: str) -> str:
    """Return a text with its numbers that have a unit, as 20mm, in m, rad or s; others as is."""
    factors = {'m': METRES, 'rad': RADIANS, 's': SECONDS}.get(unit, {})
    if factors:
        text = re.sub('[\u00b5\u03bc]', 'u', text)  # µm, in the two ways that a micro is written
    return WITH_UNIT.sub(lambda found: repr(float(found[1]) * factors[found[2]])
                         if found[2] in factors else found[0], text)


def parse_limits(texts: Iterable[str], option: str, usual: float) -> list[float]:
    """Return limits in metres, see parse_length; inf and -inf mean no limit."""
    return [float(text) if text in ('inf', '-inf') else parse_length(text, option, usual)
            for text in texts]


def parse_length(text: str, option: str, usual: float, least: float = -math.inf) -> float:
    """
    Return a length in metres; raises BadValueError.

    usual: a number without a unit above it is refused: it was probably meant in millimetres.
    """
    plain = in_si(text, 'm')
    try:
        metres = float(plain)
    except ValueError:
        metres = math.nan
    if not math.isfinite(metres):
        raise BadValueError(option, text, 'a length: 0.3mm, or metres (0.0003)')
    if plain == text and abs(metres) > usual:
        raise BadValueError(option, text, f'{text}mm, or {text}m if you mean metres (plain '
                            f'numbers are metres, so this is {1e3 * metres:g} mm)')
    if metres < least:
        raise BadValueError(option, text, f'a length of at least {1e3 * least:g} mm')
    return metres
