"""Lengths on the command line: metres, or a number with its unit."""
from typing import Any

import click

METRES = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254}


class Length(click.ParamType):
    """
    A length in metres; `0.3mm` and `12.5 mm` have their unit with them.

    usual: a plain number beyond it is refused, as it was most likely meant in millimetres.
    """

    name = 'length'

    def __init__(self, usual: float, least: float = 0.0) -> None:
        self.usual, self.least = usual, least

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the length in metres."""
        if isinstance(value, float):
            return value
        text = str(value).strip()
        unit = next((u for u in sorted(METRES, key=len, reverse=True) if text.endswith(u)), '')
        try:
            number = float(text.removesuffix(unit))
        except ValueError:
            self.fail(f'"{value}" is no length: write 0.3mm, or metres (0.0003).', param, ctx)
        length = number * METRES[unit or 'm']
        if not unit and abs(length) > self.usual:
            self.fail(f'{value} is {1e3 * length:g} mm, as plain numbers are metres: write '
                      f'{value}mm for millimetres, or {value}m if you mean it.', param, ctx)
        if not self.least <= length < float('inf'):
            self.fail(f'"{value}" is smaller than {self.least:g} m, or no finite number.',
                      param, ctx)
        return length


ANY_SIGN = -float('inf')
