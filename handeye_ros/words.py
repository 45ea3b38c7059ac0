# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Numbers in words, for sentences: lengths, angles, counts."""
from __future__ import annotations

import math
import re


def mm(metres: float) -> str:
    """Return a length in words: `0.3 mm`."""
    return f'{metres * 1e3:.3g} mm' if metres < 1 else 'more than a metre'


def degrees(radians: float) -> str:
    """Return an angle in words: `0.5 degrees`."""
    return f'{math.degrees(radians):.3g} degrees' if radians < 1 else 'more than 57 degrees'


def count_of(count: int, what: str) -> str:
    """Return a number with its noun: `1 sample`, `2 samples`, `2 passes`."""
    return f'{count} {what}' + (count != 1) * ('es' if what.endswith('s') else 's')


def without_numbers(sentence: str) -> str:
    """Return a sentence with # for its numbers, as those that are equal then say the same."""
    return re.sub(r'[-+]?\d[\d.e+-]*', '#', sentence)
