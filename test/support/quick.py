# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What `make test` leaves out: rows of pytest.mark.parametrize that only the long run tries."""
from __future__ import annotations

from typing import Any

import pytest


def long_run(*rows: Any) -> list[Any]:
    """Return rows, each a value or a tuple of values, that are tried by `make test-all` alone."""
    return [pytest.param(*(row if isinstance(row, tuple) else (row,)), marks=pytest.mark.thorough)
            for row in rows]
