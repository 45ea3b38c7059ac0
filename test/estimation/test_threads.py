# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The threads of linear algebra: one inside a solve, as before outside of it."""
from __future__ import annotations

import json
import subprocess
import sys

import pytest

# In a process of its own: other tests load libraries with pools of their own, at any time.
PROGRAM = r"""
from handeye_ros.estimation.least_squares import single_threaded
import handeye_ros.pipeline  # loads every library that a solve needs
from threadpoolctl import threadpool_info, threadpool_limits

def threads():
    return [pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas']

with threadpool_limits(3):
    print(threads(), single_threaded(threads)(), threads(), sep='\n')
"""


def test_one_thread_inside_and_as_before_outside() -> None:
    pytest.importorskip('threadpoolctl', reason='needs threadpoolctl')
    output = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True,
                            check=True).stdout
    before, inside, after = map(json.loads, output.splitlines())
    assert set(before) == {3} and set(inside) == {1} and after == before
