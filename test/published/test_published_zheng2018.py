# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Zheng 2018: the truth from the nominal mounting, and the line search."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.published import zheng2018
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def cell(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Return T_flange_sensor (plane x = 0), poses and points of a simulated edge (metres)."""
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                      rng.uniform(-0.15, 0.15, 3))
    turn = Rotation.from_euler('xyz', [*rng.uniform(-10, 10, 2), rng.uniform(-180, 180)], True)
    T_base_line = se3.transform(turn.as_matrix(), np.array([0.8, 0.1, 0.3]))
    poses, points = [], []
    for _ in range(count):
        R = (Rotation.from_euler('z', rng.uniform(-30, 30), degrees=True)
             * Rotation.from_euler('xy', rng.uniform(-25, 25, 2), degrees=True)
             * Rotation.from_euler('y', np.pi)).as_matrix()
        y, z = rng.uniform(-0.02, 0.02), rng.uniform(0.16, 0.19)
        T_line_sensor = se3.transform(R, [rng.uniform(0.02, 0.18), 0, 0] - R @ [0.0, y, z])
        poses.append(T_base_line @ T_line_sensor @ se3.inverse(X))
        points.append([y, z])
    return X, np.array(poses), np.array(points)


@pytest.mark.parametrize(('seed', 'count'), [(0, 30), (4, 12)])
def test_the_truth_from_the_nominal_mounting(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    X, poses, points = cell(rng, count)
    shift, turn = rng.normal(size=(2, 3)) / 3 ** 0.5 * [[20e-3], [np.deg2rad(10)]]
    found = zheng2018.solve(poses, points, se3.perturb(X, np.append(shift, turn)))
    assert np.abs(se3.difference(found.T_flange_sensor, X)).max() < 1e-6
    assert found.distances.max() < 1e-7


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.floats(1e-3, 10))
def test_line_search_never_climbs_and_finds_a_minimum(c: list[float], top: float) -> None:
    a, b, d = c
    line = [float(v) for v in np.polynomial.polynomial.polymul([a, b, 1.0], [a, d, 1.0])]
    line[4] = top
    s = zheng2018.line_search(line)
    value = zheng2018.quartic(line, s)
    assert value <= line[0]
    assert min(zheng2018.quartic(line, s + h) for h in (-1e-4, 1e-4)) >= value - 1e-9


def test_too_few_points_are_refused() -> None:
    _, poses, points = cell(np.random.default_rng(0), 4)
    with pytest.raises(TooFewError, match='at least 5 points on the edge, got 4'):
        zheng2018.solve(poses, points, np.eye(4))
