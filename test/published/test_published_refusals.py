# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Too few points are refused by every published estimator."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from handeye_ros.errors import TooFewError
from handeye_ros.published import chen2023, fixed_point, jing2020, wu2017, zheng2018
import numpy as np
import pytest
from tracker_session import session

POSES, POINTS = np.tile(np.eye(4), (9, 1, 1)), np.zeros((9, 3))


def tracked(ball: int, arc: int) -> object:
    tracker, sweep = session(0)
    return jing2020.solve(replace(tracker, arc=tracker.arc[:arc]),
                          replace(sweep, ball=sweep.ball[:ball]))


@pytest.mark.parametrize(('solve', 'words'), [
    (lambda: chen2023.solve_rigid(POSES, POINTS[:, :2], np.repeat(['p', 'q'], [5, 4])),
     'at least 5 points on edge q, got 4'),
    (lambda: fixed_point.solve_linear(POSES[:3], POINTS[:3]), 'at least 4 profiles, got 3'),
    (lambda: wu2017.solve(POINTS[:3], POINTS[:3]), 'at least 4 points, got 3'),
    (lambda: zheng2018.solve(POSES[:4], POINTS[:4, :2], np.eye(4)),
     'at least 5 points on the edge, got 4'),
    (lambda: tracked(5, 40), 'profile points on the ball, got 5'),
    (lambda: tracked(900, 2), 'reflector points on the arc, got 2')])
def test_too_few_points_are_refused(solve: Callable[[], object], words: str) -> None:
    with pytest.raises(TooFewError, match=words):
        solve()
