# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Units of lengths, angles, times: plain numbers of a command are SI, `0.3mm`, `5 deg` say one."""
from collections.abc import Iterable
import math
import re

METRES = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254}
RADIANS = {'rad': 1.0, 'deg': math.pi / 180, 'degrees': math.pi / 180}
SECONDS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6}
WITH_UNIT = re.compile(r'(?<![\w.])([-+]?\d*\.?\d+(?:e[-+]?\d+)?) *([a-z]+)')


def assignment_in_si(text: str) -> str:
    """Return key=value with the numbers of its value that have a unit, as 20mm, in SI units."""
    from handeye_ros.config import parameters
    key, equals, value = text.partition('=')
    unit = next((p.unit for p in parameters() if p.key == key.strip()), '')
    factors = {'m': METRES, 'rad': RADIANS, 's': SECONDS}.get(unit, {})

    def in_si(match: re.Match[str]) -> str:
        factor = factors.get(match[2])
        return match[0] if factor is None else repr(float(match[1]) * factor)
    return f'{key}{equals}{WITH_UNIT.sub(in_si, value)}'


def parse_limits(texts: Iterable[str], option: str, usual: float) -> list[float]:
    """Return limits in metres, see parse_length; inf and -inf mean no limit."""
    return [float(text) if text in ('inf', '-inf') else parse_length(text, option, usual)
            for text in texts]


def parse_length(text: str, option: str, usual: float, least: float = -math.inf) -> float:
    """
    Return a length in metres; raises BadValueError.

    usual: a number without a unit above it is refused: it was probably meant in millimetres.
    """
    from handeye_ros.errors import BadValueError
    word = text.strip()
    unit = next((u for u in sorted(METRES, key=len, reverse=True) if word.endswith(u)), '')
    try:
        number = float(word.removesuffix(unit))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise BadValueError(option, text, 'a length: 0.3mm, or metres (0.0003)')
    if not unit and abs(number) > usual:
        raise BadValueError(option, text, f'{text}mm, or {text}m if you mean metres (plain '
                            f'numbers are metres, so this is {1e3 * number:g} mm)')
    metres = number * METRES[unit or 'm']
    if metres < least:
        raise BadValueError(option, text, f'a length of at least {1e3 * least:g} mm')
    return metres
