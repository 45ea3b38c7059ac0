# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Chen 2023: the sum over all pairs and its derivatives; test_compare has the truth."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
from handeye_ros.published import chen2023
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def cell(rng: np.random.Generator, per_edge: int = 9, noise: float = 0.0
         ) -> tuple[Array, Array, Array, Array]:
    """Return T_flange_sensor, poses, points and labels of a simulated plate (metres)."""
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                      rng.uniform(-0.15, 0.15, 3))
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


def costs(poses: Array, points: Array, edges: Array, u: Array) -> tuple[float, Array, Array]:
    """Return the cost of parameters u (9,), its gradient and its Hessian."""
    p, q = (chen2023.edge_rows(poses[edges == e], points[edges == e]) for e in 'pq')
    return chen2023.cost((p, q), u)


@pytest.mark.parametrize('per_edge', [9, 40])
def test_cost_is_the_sum_over_all_pairs_of_the_mapped_points(per_edge: int) -> None:
    rng = np.random.default_rng(per_edge)
    X, poses, points, edges = cell(rng, per_edge, 1e-3)
    X = se3.perturb(X, 0.02 * rng.normal(size=6))
    mapped = se3.apply(poses @ X, np.insert(points, 1, 0.0, axis=1)[:, None])[:, 0]
    p, q = (mapped[edges == e] for e in 'pq')
    v_p, v_q = (x[i] - x[j] for x in (p, q) for i, j in [np.triu_indices(len(x), 1)])
    u = np.concatenate([X[:3, 0], X[:3, 2], X[:3, 3] / chen2023.LENGTH])
    assert per_edge ** 2 * costs(poses, points, edges, u)[0] == pytest.approx(
        np.sum((v_p @ v_q.T) ** 2), rel=1e-9)


@pytest.mark.parametrize('per_edge', [6, 35])
def test_gradient_and_hessian(per_edge: int) -> None:
    rng = np.random.default_rng(per_edge)
    _, *seen = cell(rng, per_edge)
    u, step = rng.normal(size=9), 1e-5
    _, gradient, hessian = costs(*seen, u)
    ahead, behind = ([costs(*seen, u + s * e) for e in np.eye(9)] for s in (step, -step))
    for k, (a, b) in enumerate(zip(ahead, behind, strict=True)):
        assert gradient[k] == pytest.approx((a[0] - b[0]) / (2 * step), rel=1e-6)
        np.testing.assert_allclose(hessian[k], (a[1] - b[1]) / (2 * step), rtol=1e-6,
                                   atol=1e-8 * np.abs(hessian).max())


def test_both_minimise_the_same_sum() -> None:
    """With noise: the rigid minimum is the nine-parameter one with all three constraints."""
    _, poses, points, edges = cell(np.random.default_rng(5), noise=3e-5)
    nine = chen2023.solve_nine(poses, points, edges, orthogonal=True)
    free = chen2023.solve_nine(poses, points, edges)
    rigid = chen2023.solve_rigid(poses, points, edges)
    assert np.abs(se3.difference(nine.T_flange_sensor, rigid.T_flange_sensor)).max() < 1e-6
    assert free.cost < rigid.cost == pytest.approx(nine.cost, rel=1e-6)


def test_too_few_points_are_refused() -> None:
    _, poses, points, edges = cell(np.random.default_rng(0), 5)
    with pytest.raises(TooFewError, match='at least 5 points on edge q, got 4'):
        chen2023.solve_rigid(poses[:-1], points[:-1], edges[:-1])
