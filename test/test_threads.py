# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How many threads linear algebra has while a solve runs."""
from __future__ import annotations

import json
import os

from command import run_python
import pytest

# In a process of its own: other tests load libraries with pools of their own, at any time.
PROGRAM = r"""
from threading import Event, Thread
from handeye_ros.threads import single_threaded
import handeye_ros.pipeline  # loads every library that a solve needs
from threadpoolctl import threadpool_info

def threads():
    return [pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas']

began, both_run, before = Event(), Event(), threads()
first = Thread(target=single_threaded(lambda: [began.set(), both_run.wait()]))
first.start()
began.wait()
inside = threads()
single_threaded(lambda: [both_run.set(), first.join()])()
print(before, inside, threads(), sep='\n')
"""


def test_solves_use_one_blas_thread_and_after_the_last_as_many_as_before() -> None:
    pytest.importorskip('threadpoolctl', reason='needs threadpoolctl')
    run = run_python('-c', PROGRAM, env={**os.environ, 'OPENBLAS_NUM_THREADS': '2'})
    before, inside, after = map(json.loads, run.stdout.splitlines())
    assert set(inside) == {1} and after == before
