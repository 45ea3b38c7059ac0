# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is particular to single published estimators, and their refusals; test_compare: truth."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from math import comb
from operator import itemgetter

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import SingularError, TooFewError
from handeye_ros.published import chen2023, jing2020, park1994, wang2015, wu2017, zheng2018
from handeye_ros.simulate.tables import points_in_two_frames
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracker_session import session

POSES, POINTS = np.tile(np.eye(4), (9, 1, 1)), np.zeros((9, 3))


def tracked(part: str, count: int) -> object:
    measured = session(0)
    few = measured.parts | {part: measured.parts[part][:count]}
    return jing2020.solve(replace(measured, parts=few))


@pytest.mark.parametrize(('solve', 'words'), [
    (lambda: chen2023.solve_rigid(POSES, POINTS[:, :2], np.repeat(['p', 'q'], [5, 4])),
     'at least 5 points on edge q, got 4'),
    (lambda: jing2020.fixed_point_linear(POSES[:3], POINTS[:3]), 'at least 4 measurements, got 3'),
    (lambda: wu2017.solve(POINTS[:3], POINTS[:3]), 'at least 4 points, got 3'),
    (lambda: zheng2018.solve(POSES[:4], POINTS[:4, :2], np.eye(4)),
     'at least 5 points on the edge, got 4'),
    (lambda: tracked('swept_ball', 5), 'profile points on the ball, got 5'),
    (lambda: tracked('arc', 2), 'reflector points on the arc, got 2')])
def test_too_few_points_are_refused(solve: Callable[[], object], words: str) -> None:
    with pytest.raises(TooFewError, match=words):
        solve()


def pairs(seed: int, noise: float = 0.0) -> tuple[Array, Array, Array]:
    """Return T_camera_base and ten points in camera and base (metres)."""
    rng = np.random.default_rng(seed)
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    return T, *points_in_two_frames(rng, se3.inverse(T), noise)


def test_wu_takes_the_best_of_all_210_quadruples() -> None:
    _, camera, base = pairs(1, 3e-5)
    to_camera = []  # by eq. 4, and what it costs by eq. 5
    for four in map(list, combinations(range(10), 4)):
        T = (np.vstack([camera[four].T, np.ones(4)])
             @ np.linalg.inv(np.vstack([base[four].T, np.ones(4)])))
        cost = sum(np.linalg.norm(c - (T @ np.append(w, 1.0))[:3])
                   for c, w in zip(camera, base, strict=True))
        to_camera.append((cost, T))
    assert len(to_camera) == comb(10, 4) == 210
    _, best = min(to_camera, key=itemgetter(0))
    T_camera_base = se3.inverse(wu2017.solve(camera, base))
    np.testing.assert_allclose(
        T_camera_base[:3, :3], se3.nearest_rotation(best[:3, :3]), atol=1e-9)
    middle = base.mean(axis=0)[None]
    np.testing.assert_allclose(se3.apply(T_camera_base, middle), se3.apply(best, middle),
                               atol=1e-9)


def test_four_points_in_one_plane_are_not_used() -> None:
    T, _, base = pairs(2)
    base[:9, 2] = 0.3
    T_base_camera = wu2017.solve(se3.apply(T, base), base)
    assert np.abs(se3.difference(T_base_camera, se3.inverse(T))).max() < 1e-6
    base[9, 2] = 0.3
    with pytest.raises(SingularError, match='one plane'):
        wu2017.solve(se3.apply(T, base), base)


RADIUS = 0.03
CAMERA = wang2015.Camera(np.array([[2400.0, 0.0, 640.0], [0.0, 2390.0, 512.0], [0.0, 0.0, 1.0]]),
                         np.array([np.cos(0.45), 0.0, np.sin(0.45), 0.18 * np.sin(0.45)]))


def project(points: Array) -> Array:
    """Return pixels (n, 2) of points (n, 3) in the camera frame."""
    image = points @ CAMERA.matrix.T
    return np.asarray(image[:, :2] / image[:, 2:])


def view_of(T_camera_target: Array) -> wang2015.View:
    """Return the image of the target: the ends of its diameters, its centre and the stripe."""
    marks = RADIUS * np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 0]])
    along = np.cross(CAMERA.light_plane[:3], T_camera_target[:3, 2])
    stripe = T_camera_target[:3, 3] + np.linspace(-RADIUS, RADIUS, 40)[:, None] * along
    return wang2015.View(project(se3.apply(T_camera_target, marks)), project(stripe))


def cell_of(seed: int, count: int = 3) -> tuple[Array, Array, tuple[wang2015.View, ...], Array]:
    """Return T_flange_camera, poses, views and T_camera_target; the laser crosses the centre."""
    rng = np.random.default_rng(seed)
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.15, 0.15, 3))
    y, depth = rng.uniform([-0.02, 0.16], [0.02, 0.20], (count, 2)).T
    (n_x, _, n_z), d = CAMERA.light_plane[:3], CAMERA.light_plane[3]
    turns = Rotation.from_euler('xyz', rng.uniform(-30, 30, (count, 3)) + [180, 0, 0],
                                degrees=True)
    T = se3.transform(turns.as_matrix(), np.column_stack([(d - depth * n_z) / n_x, y, depth]))
    return X, se3.inverse(T) @ se3.inverse(X), tuple(map(view_of, T)), T


@pytest.mark.parametrize(('seed', 'count'), [(0, 3), (1, 3), (2, 8)])
def test_the_patent_finds_the_truth_without_noise(seed: int, count: int) -> None:
    X, poses, views, targets = cell_of(seed, count)
    for view, target in zip(views, targets, strict=True):
        assert np.abs(se3.difference(wang2015.target_pose(view, CAMERA), target)).max() < 1e-9
    T_flange_camera = wang2015.solve(poses, views, CAMERA)
    assert np.abs(se3.difference(T_flange_camera, X)).max() < 1e-6


def test_views_without_the_centre_are_refused() -> None:
    _, _, (view, *_), _ = cell_of(1)
    ray = np.linalg.solve(CAMERA.matrix, np.append(view.points[4], 1.0))
    edge_on = wang2015.Camera(CAMERA.matrix, np.append(np.cross(ray, [0.0, 1.0, 0.0]), 0.1))
    for seen, camera, words in (
            (wang2015.View(view.points, view.stripe + 12.0), CAMERA, 'misses the centre by'),
            (view, edge_on, 'along the light plane')):
        with pytest.raises(SingularError, match=words):
            wang2015.target_centre(seen, camera)


def test_turns_about_one_axis_are_refused() -> None:
    X, _, views, targets = cell_of(2)
    turned = [targets[0] @ se3.transform(se3.exp_rotation(np.array([0, 0, a])), np.zeros(3))
              for a in (0.0, 0.4, 0.9)]
    poses = se3.inverse(np.array(turned)) @ se3.inverse(X)
    with pytest.raises(SingularError, match='one axis only'):
        park1994.solve_motions(*wang2015.motions(poses, np.array(turned)))
    with pytest.raises(TooFewError, match='at least 3 views, got 2'):
        wang2015.solve(poses[:2], views[:2], CAMERA)
