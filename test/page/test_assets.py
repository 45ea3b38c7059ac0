# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The files of the page: its colours can be read (WCAG 2)."""
from __future__ import annotations

from pathlib import Path
import re

import handeye_ros.page
import pytest

ASSETS = Path(handeye_ros.page.__path__[0]) / 'assets'
READABLE = 5.7
LIGHT, DARK = (dict(re.findall(r'--(\w+): #(\w+)', part)) for part in (
    (ASSETS / 'page.css').read_text().split('prefers-color-scheme: dark')))
PAIRS = [(letters, ground) for letters in ('text', 'dim', 'main', 'good', 'bad', 'aim')
         for ground in ('card', 'back')] + [('onmain', 'main')]


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour as in CSS, without its #."""
    long = colour if len(colour) == 6 else ''.join(2 * c for c in colour)
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in (int(long[k:k + 2], 16) / 255 for k in (0, 2, 4))]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize('scheme', [LIGHT, DARK], ids=['light', 'dark'])
@pytest.mark.parametrize(('letters', 'ground'), PAIRS)
def test_letters_are_readable(scheme: dict[str, str], letters: str, ground: str) -> None:
    low, high = sorted(luminance(scheme[name]) for name in (letters, ground))
    assert (high + 0.05) / (low + 0.05) >= READABLE
