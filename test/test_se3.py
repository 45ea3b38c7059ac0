# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms against series, products and scipy; inputs stay as they are."""
from __future__ import annotations

from handeye_ros import se3
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

vectors = arrays(float, 3, elements=st.floats(-10, 10))
quaternions = arrays(float, 4, elements=st.floats(-1, 1)).filter(
    lambda q: np.linalg.norm(q) > 1e-3)


transforms = st.builds(se3.from_quaternion, vectors, quaternions)


@st.composite
def deltas(draw: st.DrawFn) -> np.ndarray:
    """Return perturbations (6,) whose rotation is less than half a turn."""
    axis = draw(vectors.filter(lambda v: np.linalg.norm(v) > 1e-3))
    turn = axis / np.linalg.norm(axis) * draw(st.floats(0, 3.1))
    return np.concatenate([draw(vectors), turn])


@pytest.mark.parametrize('size', [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1e-2])
def test_exp_of_small_vectors_is_its_series(size: float) -> None:
    S = se3.skew(size * np.array([0.6, -0.48, 0.64]))
    series, term = np.eye(3), np.eye(3)
    for k in range(1, 9):
        term = term @ S / k
        series = series + term
    assert np.allclose(se3.exp_rotation(size * np.array([0.6, -0.48, 0.64])), series,
                       rtol=0, atol=1e-15)


@given(deltas())
def test_log_undoes_exp(delta: np.ndarray) -> None:
    R = se3.exp_rotation(delta[3:])
    assert np.allclose(R, Rotation.from_rotvec(delta[3:]).as_matrix(), rtol=0, atol=1e-13)
    assert np.allclose(se3.log_rotation(R), delta[3:], atol=1e-7)
    assert se3.angle(se3.exp_rotation(delta[3:])) == pytest.approx(
        np.linalg.norm(delta[3:]), abs=1e-7)


@given(transforms, vectors)
def test_inverse_times_transform_is_nothing(T: np.ndarray, point: np.ndarray) -> None:
    assert np.allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
    assert np.allclose(se3.apply(se3.inverse(T), se3.apply(T, point[None])), point, atol=1e-10)
    assert np.allclose(se3.apply(T, point[None])[0], (T @ np.append(point, 1))[:3])


@given(transforms, deltas())
def test_difference_undoes_perturb(T: np.ndarray, delta: np.ndarray) -> None:
    assert np.allclose(se3.difference(se3.perturb(T, delta), T), delta, atol=1e-6)


def test_a_perturbation_acts_in_the_parent_frame() -> None:
    # a quarter turn about the parent's z, 1 m along the parent's x
    T = se3.transform(Rotation.from_euler('x', 90, degrees=True).as_matrix(), np.array([1., 2, 3]))
    moved = se3.perturb(T, np.array([1.0, 0, 0, 0, 0, np.pi / 2]))
    assert np.allclose(moved[:3, 3], [2, 2, 3])
    assert np.allclose(moved[:3, 0], [0, 1, 0]), 'the child x lay along the parent x'


@given(transforms)
def test_quaternions_come_back_with_w_not_negative(T: np.ndarray) -> None:
    q = se3.quaternion(T)
    assert q[3] >= 0 and np.linalg.norm(q) == pytest.approx(1)
    assert np.allclose(se3.from_quaternion(T[:3, 3], q), T, atol=1e-12)
    assert np.allclose(se3.from_quaternion(T[:3, 3], -q), T, atol=1e-12)


@given(quaternions, arrays(float, (3, 3), elements=st.floats(-0.2, 0.2)))
def test_nearest_rotation_is_one_and_none_is_nearer(q: np.ndarray, off: np.ndarray) -> None:
    M = Rotation.from_quat(q).as_matrix() + off
    R = se3.nearest_rotation(M)
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1)
    assert np.linalg.det(se3.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)
    rng = np.random.default_rng(0)
    for step in rng.normal(size=(20, 3)) * 0.01:
        nearby = se3.exp_rotation(step) @ R
        assert np.linalg.norm(nearby - M) >= np.linalg.norm(R - M) - 1e-12


def test_mean_pose_lies_in_the_middle_and_turns_are_from_it() -> None:
    T = se3.transform(Rotation.from_quat([0.5, 0.1, -0.3, 0.8]).as_matrix(), np.ones(3))
    step = np.array([0.01, -0.02, 0.03, 0.002, -0.001, 0.003])
    both = np.array([se3.perturb(T, step), se3.perturb(T, -step)])
    assert np.allclose(se3.mean_pose(both), T, atol=1e-9)
    turns = np.linalg.inv(T[:3, :3]) @ step[3:]  # in the frame that the sensor is fixed in
    assert np.allclose(se3.turns_from_mean(both), [turns, -turns], atol=1e-9)


def test_stacks_give_what_single_transforms_give() -> None:
    rng = np.random.default_rng(1)
    T = se3.from_quaternion(rng.normal(size=(5, 2, 3)), rng.normal(size=(5, 2, 4)))
    points = rng.normal(size=(5, 2, 7, 3))
    vectors = rng.normal(size=(5, 2, 3))
    for i, j in np.ndindex(5, 2):
        assert np.allclose(se3.inverse(T)[i, j], se3.inverse(T[i, j]))
        assert np.allclose(se3.apply(T, points)[i, j], se3.apply(T[i, j], points[i, j]))
        assert np.allclose(se3.quaternion(T)[i, j], se3.quaternion(T[i, j]))
        assert np.allclose(se3.log_rotation(T[..., :3, :3])[i, j],
                           se3.log_rotation(T[i, j, :3, :3]))
        assert np.allclose(se3.exp_rotation(vectors)[i, j], se3.exp_rotation(vectors[i, j]))


@given(transforms, vectors, deltas())
def test_points_move_with_their_frame_as_the_derivatives_say(T, point, delta) -> None:
    before, delta = se3.apply(T, point[None])[0], 1e-6 * delta
    moved = se3.apply(se3.perturb(T, delta), point[None])[0] - before
    predicted = se3.perturbation_jacobian(before - T[:3, 3]) @ delta
    assert np.allclose(moved, predicted, rtol=0, atol=1e-9)


def test_the_error_of_mapped_points_is_that_of_points_that_moved() -> None:
    rng = np.random.default_rng(2)
    levers, delta = rng.normal(size=(7, 3)), 1e-6 * rng.normal(size=6)
    moved = se3.apply(se3.perturb(np.eye(4), delta), levers) - levers
    covariance = np.outer(delta, delta)
    assert np.allclose(se3.mapped_covariance(levers, covariance), moved.T @ moved / 7, rtol=1e-4)
    assert se3.mapped_std(levers, covariance) ** 2 == pytest.approx((moved ** 2).sum() / 7)
