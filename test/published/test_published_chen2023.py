# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Chen 2023: the scatter identity, its derivatives, and the truth from its starts."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.published import chen2023
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def pair_sum(p, q) -> float:
    """Return the sum over all unordered pairs of pairs of (v_p . v_q)^2 by brute force."""
    v_p, v_q = (x[i] - x[j] for x in (p, q) for i, j in [np.triu_indices(len(x), 1)])
    return float(np.sum((v_p @ v_q.T) ** 2))


def cell(rng: np.random.Generator, per_edge: int = 9,
         noise: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Return T_flange_sensor, poses, points and labels of a simulated plate (metres)."""
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                      rng.uniform(0.1, 0.2) * _unit(rng.normal(size=3)))
    tilt = np.append(rng.uniform(-10, 10, 2), rng.uniform(-180, 180))
    T_base_target = se3.transform(Rotation.from_euler('xyz', tilt, degrees=True).as_matrix(),
                                  np.array([0.8, 0.0, 0.3]) + rng.uniform(-0.3, 0.3, 3))
    poses, points = [], []
    for k in range(2 * per_edge):
        yaw = rng.uniform(-30, 30) + (90 if k < per_edge else 0)
        R = (Rotation.from_euler('z', yaw, degrees=True)
             * Rotation.from_euler('xy', rng.uniform(-25, 25, 2), degrees=True)
             * Rotation.from_euler('x', np.pi)).as_matrix()
        x, z = rng.uniform(-0.02, 0.02), rng.uniform(0.16, 0.19)
        on_edge = np.array([0.0, rng.uniform(0.02, 0.18), 0.0])
        if k < per_edge:
            on_edge = on_edge[[1, 0, 2]]
        T_target_sensor = se3.transform(R, on_edge - R @ [x, 0.0, z])
        poses.append(T_base_target @ T_target_sensor @ se3.inverse(X))
        points.append([x, z])
    measured = np.array(points) + noise * rng.normal(size=(2 * per_edge, 2))
    return X, np.array(poses), measured, np.repeat(['p', 'q'], per_edge)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def rows_of(poses: Array, points: Array, edges: Array) -> tuple[Array, Array]:
    """Return the rows of both edges."""
    p, q = (chen2023.edge_rows(poses[edges == e], points[edges == e]) for e in 'pq')
    return p, q


@pytest.mark.parametrize('counts', [(2, 2), (5, 9), (12, 7)])
def test_scatter_identity_is_the_sum_over_all_pairs(counts: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(counts))
    p, q = (rng.normal(size=(n, 3)) * [0.1, 0.02, 0.05] + 0.7 for n in counts)
    by_hand = sum(((p[a] - p[b]) @ (q[c] - q[d])) ** 2
                  for a in range(len(p)) for b in range(a)
                  for c in range(len(q)) for d in range(c))
    assert pair_sum(p, q) == pytest.approx(by_hand, rel=1e-12)
    assert chen2023.scatter_sum(p, q) == pytest.approx(by_hand, rel=1e-12)


def test_products_as_printed_are_no_objective() -> None:
    """Eq. 7 without squares is zero over ordered pairs, whatever the points."""
    rng = np.random.default_rng(3)
    p, q = rng.normal(size=(2, 6, 3))
    v_p, v_q = ((x[:, None] - x).reshape(-1, 3) for x in (p, q))
    assert abs((v_p @ v_q.T).sum()) < 1e-10
    assert ((v_p @ v_q.T) ** 2).sum() == pytest.approx(4 * chen2023.scatter_sum(p, q))


@pytest.mark.parametrize('per_edge', [9, 40])
def test_cost_is_the_sum_over_the_mapped_points(per_edge: int) -> None:
    rng = np.random.default_rng(per_edge)
    X, poses, points, edges = cell(rng, per_edge, 1e-3)
    sensor = np.insert(points, 1, 0.0, axis=1)
    X = se3.perturb(X, 0.02 * rng.normal(size=6))
    mapped = np.array([se3.apply(T @ X, s[None])[0] for T, s in zip(poses, sensor, strict=True)])
    u = np.concatenate([X[:3, 0], X[:3, 2], X[:3, 3] / chen2023.LENGTH])
    value = per_edge ** 2 * chen2023.cost(rows_of(poses, points, edges), u)[0]
    assert value == pytest.approx(
        pair_sum(mapped[edges == 'p'], mapped[edges == 'q']), rel=1e-9)


@pytest.mark.parametrize('per_edge', [6, 35])
def test_gradient_and_hessian(per_edge: int) -> None:
    rng = np.random.default_rng(per_edge)
    _, poses, points, edges = cell(rng, per_edge)
    rows, u, step = rows_of(poses, points, edges), rng.normal(size=9), 1e-5
    _, gradient, hessian = chen2023.cost(rows, u)
    ahead, behind = ([chen2023.cost(rows, u + s * e) for e in np.eye(9)] for s in (step, -step))
    for k, (a, b) in enumerate(zip(ahead, behind, strict=True)):
        assert gradient[k] == pytest.approx((a[0] - b[0]) / (2 * step), rel=1e-6)
        np.testing.assert_allclose(hessian[k], (a[1] - b[1]) / (2 * step), rtol=1e-6,
                                   atol=1e-8 * np.abs(hessian).max())


def test_starts_are_rotations_with_six_range_axes() -> None:
    np.testing.assert_allclose(chen2023.STARTS[:, :, 2],
                               np.vstack([np.eye(3), -np.eye(3)]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(chen2023.STARTS), 1.0)


@pytest.mark.parametrize(('seed', 'orthogonal'),
                         [(0, False), (1, False), (2, True)])
def test_nine_parameters_find_the_truth(seed: int, orthogonal: bool) -> None:
    X, poses, points, edges = cell(np.random.default_rng(seed))
    found = chen2023.solve_nine(poses, points, edges, orthogonal)
    error = se3.difference(found.T_flange_sensor, X)
    assert np.abs(error).max() < 1e-6
    np.testing.assert_allclose(found.matrix, X, atol=1e-6)


@pytest.mark.parametrize('per_edge', [5, 9, 200])
@pytest.mark.parametrize('seed', range(5))
def test_rigid_finds_the_truth(seed: int, per_edge: int) -> None:
    X, poses, points, edges = cell(np.random.default_rng(seed), per_edge)
    found = chen2023.solve_rigid(poses, points, edges)
    assert np.abs(se3.difference(found.T_flange_sensor, X)).max() < 1e-6


def test_both_minimise_the_same_sum() -> None:
    """With noise: the rigid minimum is the nine-parameter one with all three constraints."""
    X, poses, points, edges = cell(np.random.default_rng(5), noise=3e-5)
    nine = chen2023.solve_nine(poses, points, edges, orthogonal=True)
    free = chen2023.solve_nine(poses, points, edges)
    rigid = chen2023.solve_rigid(poses, points, edges)
    assert np.abs(se3.difference(nine.T_flange_sensor, rigid.T_flange_sensor)).max() < 1e-6
    assert free.cost < rigid.cost == pytest.approx(nine.cost, rel=1e-6)
    np.testing.assert_allclose(np.linalg.norm(free.matrix[:3, [0, 2]], axis=0), 1.0, atol=1e-9)
    assert 1e-5 < np.linalg.norm(se3.difference(rigid.T_flange_sensor, X)[:3]) < 5e-3


def test_too_few_points_are_refused() -> None:
    _, poses, points, edges = cell(np.random.default_rng(0), 5)
    with pytest.raises(TooFewError, match='at least 5 points on edge q, got 4'):
        chen2023.solve_rigid(poses[:-1], points[:-1], edges[:-1])
