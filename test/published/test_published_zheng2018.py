# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Zheng 2018: the line search; test_compare has the truth."""
from __future__ import annotations

from handeye_ros.published import zheng2018
from hypothesis import given
from hypothesis import strategies as st
import numpy as np


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.floats(1e-3, 10))
def test_line_search_never_climbs_and_finds_a_minimum(c: list[float], top: float) -> None:
    a, b, d = c
    line = [float(v) for v in np.polynomial.polynomial.polymul([a, b, 1.0], [a, d, 1.0])]
    line[4] = top
    s = zheng2018.line_search(line)
    value = zheng2018.quartic(line, s)
    assert value <= line[0]
    assert min(zheng2018.quartic(line, s + h) for h in (-1e-4, 1e-4)) >= value - 1e-9
