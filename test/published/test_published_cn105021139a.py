# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""CN105021139A: circle target, vanishing points, light plane and two motions."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import SingularError, TooFewError
from handeye_ros.published import cn105021139a as patent
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

RADIUS = 0.03
CAMERA = patent.Camera(np.array([[2400.0, 0.0, 640.0], [0.0, 2390.0, 512.0], [0.0, 0.0, 1.0]]),
                       np.array([np.cos(0.45), 0.0, np.sin(0.45), 0.18 * np.sin(0.45)]))


def project(points: Array) -> Array:
    """Return pixels (n, 2) of points (n, 3) in the camera frame."""
    image = points @ CAMERA.matrix.T
    return np.asarray(image[:, :2] / image[:, 2:])


def view_of(T_camera_target: Array) -> patent.View:
    """Return the image of the target: the ends of its diameters, its centre and the stripe."""
    marks = RADIUS * np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 0]])
    along = np.cross(CAMERA.light_plane[:3], T_camera_target[:3, 2])
    stripe = T_camera_target[:3, 3] + np.linspace(-RADIUS, RADIUS, 40)[:, None] * along
    return patent.View(project(se3.apply(T_camera_target, marks)), project(stripe))


def session(seed: int, count: int = 3) -> tuple[Array, Array, tuple[patent.View, ...], Array]:
    """Return T_flange_camera, poses, views and T_camera_target; the laser crosses the centre."""
    rng = np.random.default_rng(seed)
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                      rng.uniform(-0.15, 0.15, 3))
    y, depth = rng.uniform([-0.02, 0.16], [0.02, 0.20], (count, 2)).T
    (n_x, _, n_z), d = CAMERA.light_plane[:3], CAMERA.light_plane[3]
    turns = Rotation.from_euler('xyz', rng.uniform(-30, 30, (count, 3)) + [180, 0, 0],
                                degrees=True)
    T = se3.transform(turns.as_matrix(), np.column_stack([(d - depth * n_z) / n_x, y, depth]))
    return X, se3.inverse(T) @ se3.inverse(X), tuple(map(view_of, T)), T


@pytest.mark.parametrize(('seed', 'count'), [(0, 3), (1, 3), (2, 8)])
def test_the_truth_without_noise(seed: int, count: int) -> None:
    X, poses, views, targets = session(seed, count)
    for view, target in zip(views, targets, strict=True):
        assert np.abs(se3.difference(patent.target_pose(view, CAMERA), target)).max() < 1e-9
    found = patent.solve(poses, views, CAMERA)
    assert np.abs(se3.difference(found, X)).max() < 1e-6


def test_views_without_the_centre_are_refused() -> None:
    _, _, (view, *_), _ = session(1)
    ray = np.linalg.solve(CAMERA.matrix, np.append(view.points[4], 1.0))
    edge_on = patent.Camera(CAMERA.matrix, np.append(np.cross(ray, [0.0, 1.0, 0.0]), 0.1))
    for seen, camera, words in (
            (patent.View(view.points, view.stripe + 12.0), CAMERA, 'misses the centre by'),
            (view, edge_on, 'along the light plane')):
        with pytest.raises(SingularError, match=words):
            patent.target_centre(seen, camera)


def test_turns_about_one_axis_are_refused() -> None:
    X, _, views, targets = session(2)
    turned = [targets[0] @ se3.transform(se3.exp_rotation(np.array([0, 0, a])), np.zeros(3))
              for a in (0.0, 0.4, 0.9)]
    poses = se3.inverse(np.array(turned)) @ se3.inverse(X)
    with pytest.raises(SingularError, match='one axis only'):
        patent.solve_motions(*patent.motions(poses, np.array(turned)))
    with pytest.raises(TooFewError, match='at least 3 views, got 2'):
        patent.solve(poses[:2], views[:2], CAMERA)
