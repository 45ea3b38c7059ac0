# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Lengths and angles with a unit, such as 0.3mm and 5 deg; plain numbers are SI."""
from __future__ import annotations

import math
import re

from handeye_ros.errors import BadValueError

# factors of units, by the SI unit that they give; '' is of a plain number
UNITS = {'m': {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254},
         'rad': {'rad': 1.0, 'mrad': 1e-3, 'deg': math.pi / 180, 'degrees': math.pi / 180},
         's': {'s': 1.0, 'ms': 1e-3, 'us': 1e-6}, '': {'': 1.0}}
WITH_UNIT = re.compile(r'(?<![\w.])([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?) *([a-z]+)(?![\w.])')
MICRO = re.compile('[\u00b5\u03bc]')  # of µm, in the two ways that it is written


def in_si(text: str, unit: str) -> str:
    """
    Return a text with its numbers that have a unit, as 20mm, converted; all else is as before.

    unit: m, rad or s, into which they are converted; '': none is.
    """
    factors, text = UNITS[unit], MICRO.sub('u', text) if unit else text
    return WITH_UNIT.sub(lambda match: repr(float(match[1]) * factors[match[2]])
                         if match[2] in factors else match[0], text)


def parse_length(text: str, option: str, largest_plain: float, least: float = -math.inf) -> float:
    """
    Return a length in metres; raises BadValueError.

    option: for the message; largest_plain: a larger number without a unit is refused, as it was
    probably meant in millimetres; least: -inf also allows inf and -inf, no limit.
    """
    plain = in_si(text, 'm')
    try:
        metres = float(plain)
    except ValueError:
        metres = math.nan
    if math.isnan(metres) or math.isinf(metres) and least > -math.inf:
        raise BadValueError(option, text, 'a length: 0.3mm, or metres (0.0003)')
    if plain == text and largest_plain < abs(metres) < math.inf:
        raise BadValueError(option, text, f'{text}mm, or {text}m if you mean metres (plain '
                            f'numbers are metres, so this is {1e3 * metres:g} mm)')
    if metres < least:
        raise BadValueError(option, text, f'a length of at least {1e3 * least:g} mm')
    return metres
