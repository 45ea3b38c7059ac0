# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The processes for long computations: what they answer, and what a killed one costs."""
from __future__ import annotations

import os
import signal
import subprocess
import sys

from command import PATIENCE
from handeye_ros.config import Config
from handeye_ros.errors import DataError
from handeye_ros.node.pool import Pool, PoolEndedError, result_or_ended
from handeye_ros.pipeline import calibrate
import pytest


@pytest.fixture
def pool() -> Pool:
    return Pool()


def test_it_answers_and_refuses_in_another_process(pool: Pool) -> None:
    assert pool.run(divmod, 7, 2) == (3, 1) and pool.run(os.getpid) != os.getpid()
    assert pool.run(os.nice, 0) == os.nice(0) + 5
    with pytest.raises(DataError) as refusal:
        pool.run(calibrate, [], [], Config())
    with pytest.raises(DataError) as here:
        calibrate([], [], Config())
    assert str(refusal.value) == str(here.value)
    with pytest.raises(ZeroDivisionError):
        pool.run(divmod, 1, 0)


def test_one_that_was_killed_is_started_again_once_for_a_call(pool: Pool) -> None:
    os.kill(pool.run(os.getpid), signal.SIGKILL)
    assert pool.run(divmod, 7, 2) == (3, 1)
    with pytest.raises(PoolEndedError, match='ended before it had an answer'):
        pool.run(os._exit, 1)
    with pytest.raises(PoolEndedError):
        result_or_ended(pool.submit(os._exit, 1))
    assert pool.run(divmod, 7, 2) == (3, 1)


PARENT = """
import os, sys, time
from handeye_ros.node.pool import Pool
if __name__ == '__main__':
    print(Pool().run(os.getpid), flush=True)
    time.sleep(60)
"""


def test_it_ends_with_a_node_that_is_killed(tmp_path) -> None:
    script = tmp_path / 'parent.py'
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        watch = os.pidfd_open(child)
        parent.kill()
    import select
    assert select.select([watch], [], [], PATIENCE)[0]
    os.close(watch)
