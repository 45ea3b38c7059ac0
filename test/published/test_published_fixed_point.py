# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The fixed point from different poses: what a PRP arm cannot know (the rest: test_compare)."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.published import fixed_point
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

RADIUS = 0.03


def prp_arm(rng: np.random.Generator, X: Array, ball: Array,
            count: int) -> tuple[Array, Array]:
    """
    Return poses (n, 4, 4) of the arm of Jing 2020 and the ball (n, 3) as its sensor sees it.

    Frame 3 = shift d1 and turn about z, then a quarter turn about x: the axis is y of frame 3.
    """
    poses = []
    for d1, turn, d3 in rng.uniform([-0.03, -30, -0.03], [0.03, 30, 0.03], (count, 3)):
        R = (Rotation.from_euler('z', turn, degrees=True) * Rotation.from_euler('x', np.pi / 2))
        poses.append(se3.transform(R.as_matrix(), [0, 0, d1] + R.as_matrix()[:, 2] * d3))
    T = np.array(poses)
    return T, se3.apply(se3.inverse(T @ X), np.tile(ball, (count, 1, 1)))[:, 0]


def test_a_prp_arm_cannot_know_p_along_its_axis() -> None:
    """Section 4.1: p_y comes out as 0, whatever it is; all the rest is right."""
    rng = np.random.default_rng(0)
    X = se3.transform(Rotation.from_euler('xyz', [90.0, 1.5, -0.8], True).as_matrix(),
                      np.array([0.057, 0.447, 0.049]))
    ball = se3.apply(X, np.array([[0.0, 0.0, 0.175]]))[0] @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    poses, seen = prp_arm(rng, X, ball, 15)
    centres = np.array(seen)
    linear = fixed_point.solve_linear(poses, centres)
    assert linear.rank == 11
    assert abs(linear.matrix[1, 3]) < 1e-12
    expected = X.copy()
    expected[1, 3] = 0.0
    np.testing.assert_allclose(linear.matrix, expected, atol=1e-7)
    rigid = fixed_point.solve_least_squares(poses, centres)
    assert rigid.rank == 8
    np.testing.assert_allclose(rigid.matrix, expected, atol=1e-6)


def test_a_circle_larger_than_the_ball_cuts_its_centre() -> None:
    centres = fixed_point.ball_centres(np.array([[0.01, 0.17], [0.0, 0.18]]),
                                       np.array([0.0301, 0.018]), RADIUS, np.array([1, -1]))
    np.testing.assert_allclose(centres, [[0.01, 0.0, 0.17], [0.0, -0.024, 0.18]], atol=1e-15)


def test_too_few_profiles_are_refused() -> None:
    with pytest.raises(TooFewError, match='at least 4 profiles, got 3'):
        fixed_point.solve_linear(np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 3)))
