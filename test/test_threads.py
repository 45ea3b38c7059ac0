"""The threads of linear algebra: one inside a solve, as before outside of it."""
from __future__ import annotations

from handeye_ros.threads import single_threaded
import numpy as np
import pytest
import scipy.linalg


def test_one_thread_inside_and_as_before_outside() -> None:
    threadpoolctl = pytest.importorskip('threadpoolctl', reason='needs threadpoolctl')

    scipy.linalg.inv(np.eye(3))  # both libraries have pools of their own

    def threads() -> list[int]:
        return [pool['num_threads'] for pool in threadpoolctl.threadpool_info()]

    with threadpoolctl.threadpool_limits(3):
        before = threads()
        inside = single_threaded(threads)()
        assert set(inside) == {1} and before == threads() and set(before) != {1}
