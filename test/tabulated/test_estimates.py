# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points, A X = X B and the tracker: the truth, honest covariances, outliers, refusals."""
from __future__ import annotations

from dataclasses import replace

from cells import ONE_IN_100
from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.frames import mount_poses
from handeye_ros.published import jing2020
from handeye_ros.simulate.tables import (
    BALL_RADIUS,
    laser_tracker,
    points_in_two_frames,
    poses_of_target,
    SimulatedFiles,
)
from handeye_ros.tabulated.pairs import PointPairs, PosePairs
from handeye_ros.tabulated.problem import answer_table, TableAnswer
from handeye_ros.tabulated.tracker import PartPoints, sweep_from, SWEPT_PARTS, TrackerProblem
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracker_session import session, T_flange_sensor

IN_HAND = Config()
ON_BASE = with_values(IN_HAND, {'calibration_type': 'eye_on_base'}, 'test')


def chi_squared(answer: TableAnswer, T_true: Array) -> float:
    """Return the squared error over the covariance, 1 on average."""
    delta = se3.difference(answer.X, T_true)
    return float(delta @ np.linalg.solve(answer.covariance, delta) / 6)


def pairs(seed: int, count: int = 10, wrong: int = 0) -> tuple[Array, PointPairs]:
    """Return T_base_camera and points in both frames, the first ones wrong."""
    rng = np.random.default_rng(seed)
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    camera, base = points_in_two_frames(rng, T, count=count)
    camera[:wrong] += 5e-3 * rng.normal(size=(wrong, 3))
    return T, PointPairs(ON_BASE, camera, base)


@pytest.mark.thorough
@pytest.mark.parametrize(('count', 'mean'), [(4, 0.6), (6, 0.7), (12, 0.85)])
def test_points_are_as_sure_as_they_say(count: int, mean: float) -> None:
    squares, noise = [], []
    for seed in range(100):
        T, points = pairs(seed, count)
        answer = points.estimate()
        squares.append(chi_squared(answer, T))
        noise.append(answer.target['point_noise'])
        assert answer.used.sum() >= min(count, 4)
    assert np.mean(squares) == pytest.approx(mean, abs=0.25)
    assert np.mean(np.array(squares) < ONE_IN_100 / 6) >= 0.95
    assert np.median(noise) == pytest.approx(3e-5, rel=0.1)


@pytest.mark.parametrize(('count', 'wrong'), [(5, 1), (10, 2), (30, 8)])
def test_wrong_points_are_not_used(count: int, wrong: int) -> None:
    for seed in range(5):
        T, points = pairs(seed, count, wrong)
        answer = answer_table(points)
        assert np.flatnonzero(~answer.used).tolist() == list(range(wrong))
        assert answer.residuals[:wrong].min() > 5 * answer.residual_rms
        assert answer.residual_rms < answer.left_out_rms < 1e-3


def test_points_in_another_order_are_refused() -> None:
    _, points = pairs(1)
    with pytest.raises(DataError, match='same points in the same order'):
        answer_table(replace(points, robot=points.robot[::-1]))


def views(seed: int, robot: tuple[float, float], count: int = 12, on_base: bool = False
          ) -> tuple[Array, Array, PosePairs]:
    """Return X, Z and the views, with noise of the robot (m, rad) and the camera."""
    config = ON_BASE if on_base else IN_HAND
    X, Z, flange, seen = poses_of_target(np.random.default_rng(seed), robot,
                                         eye_on_base=on_base, count=count)
    return X, Z, PosePairs(config, seen, mount_poses(flange, config))


@pytest.mark.thorough
@pytest.mark.parametrize(('on_base', 'count'), [(False, 5), (False, 20), (True, 20)])
def test_views_are_as_sure_as_they_say(on_base: bool, count: int) -> None:
    """The robot turns about its flange, which is elsewhere with the camera on the base."""
    squares = []
    for seed in range(40):
        X, Z, poses = views(seed, (1e-4, 1e-3), count, on_base)
        answer = poses.estimate()
        squares.append(chi_squared(answer, X))
        assert list(answer.target['pose']['translation'].values()) == pytest.approx(
            Z[:3, 3], abs=2e-3 if count == 20 else 1e-2)
    assert np.mean(squares) == pytest.approx(0.9, abs=0.3)
    assert np.mean(np.array(squares) < ONE_IN_100 / 6) >= 0.95


def test_a_wrong_view_is_dropped() -> None:
    X, _, poses = views(5, (3e-5, 1e-4))
    seen = poses.seen.copy()
    seen[4] = se3.perturb(seen[4], np.array([5e-3, 0, 0, 0, 0.02, 0]))
    answer = answer_table(replace(poses, seen=seen))
    assert not answer.used[4] and answer.used.sum() >= 10
    assert np.linalg.norm(se3.difference(answer.X, X)[:3]) < 1e-3
    assert answer.residual_rms < answer.left_out_rms < 1e-3
    assert set(answer.target) == {'pose', 'residual_angle', 'left_out_angle'}


SENSOR = 3.7e-5
CELL = with_values(Config(), {'noise.sensor': SENSOR, 'target.radius': BALL_RADIUS}, 'test')


def tracked(measured: jing2020.Readings) -> TableAnswer:
    config = with_values(CELL, {'tracker.h0': measured.height, 'tracker.h1': 0.0}, 'test')
    part_points = {part: [PartPoints(row, point[None]) for row, point in enumerate(points)]
                   for part, points in measured.parts.items()}
    return answer_table(TrackerProblem(config, part_points, measured.q30))


def test_the_tracker_without_noise_finds_the_truth() -> None:
    """The block may be crooked; the ball and the faces are what was swept."""
    answer = tracked(session(1, skew=4.0))
    np.testing.assert_allclose(se3.difference(answer.X, T_flange_sensor), 0, atol=1e-9)
    assert answer.target['face_angle'] == pytest.approx(np.deg2rad(94.0))
    assert answer.target['radius'] == pytest.approx(0.01905)


@pytest.mark.thorough
def test_the_tracker_is_as_sure_as_it_says() -> None:
    squares = [chi_squared(tracked(session(seed, 2e-5, SENSOR)), T_flange_sensor)
               for seed in range(2)]
    assert 0.3 < np.mean(squares) < 2.0


def of_cell(cell: SimulatedFiles) -> Config:
    return with_values(CELL, cell.settings, 'test')


def test_the_rim_of_the_ball_is_no_block() -> None:
    cell = laser_tracker(np.random.default_rng(1003))
    part_points, q30 = sweep_from(cell.profiles, cell.poses, of_cell(cell))
    ball, *faces = (np.concatenate([one.points for one in part_points[part]])
                    for part in SWEPT_PARTS)
    assert faces[0][:, 2].min() > ball[:, 2].max()
    along = jing2020.fit_swept_ball(ball, q30, jing2020.SWEEP)[0]
    angle = jing2020.face_angle(*(jing2020.swept(face, q30, along) for face in faces))
    assert np.degrees(angle) == pytest.approx(90.0, abs=0.05)


@pytest.mark.parametrize(('part', 'row', 'shift'), [
    ('arc', 5, [0, 1e-3, 0]), ('face_c', 1, [3e-3, 2e-3, -1e-3])])
def test_a_wrong_point_of_the_tracker_is_named(part: str, row: int, shift: list[float]) -> None:
    measured = session(2, 2e-5, SENSOR)
    measured.parts[part][row] += shift
    with pytest.raises(DataError, match=f'most of all {part} of row {row}, by'):
        tracked(measured)


def test_what_of_the_tracker_cannot_carry_an_answer_is_refused() -> None:
    measured = session(0, 2e-5, SENSOR)
    parts, order = measured.parts, np.random.default_rng(1).permutation(30)
    wrong = parts['face_c'] + np.linspace(0, 9e-3, len(parts['face_c']))[:, None]
    for change, words in (
            ({'face_d': parts['face_c'] + 1e-3 * np.ones(3)}, 'check which face is which'),
            ({'arc': parts['arc'][order]}, 'the points of the arc go back and forth'),
            ({'line': parts['line'][order]}, 'the points of the line go back and forth'),
            ({'face_c': wrong}, 'most of all face_c of row')):
        with pytest.raises(DataError, match=words):
            tracked(replace(measured, parts=parts | change))


def test_a_sweep_that_is_none_is_refused() -> None:
    cell = laser_tracker(np.random.default_rng(5))
    turned = [replace(pose, quaternion=np.roll(pose.quaternion, i // 80))
              for i, pose in enumerate(cell.poses)]
    aside = [replace(pose, translation=pose.translation[[1, 0, 2]]) for pose in cell.poses]
    late = [replace(pose, stamp=pose.stamp + 10 ** 12) for pose in cell.poses]
    for profiles, poses, words in (
            (cell.profiles, turned, 'mm aside, and turns by'),
            (cell.profiles, aside, 'mm aside, and turns by .*: move P3 alone'),
            (cell.profiles[:50], cell.poses, 'the block is in'),
            (cell.profiles[80:], cell.poses, 'the ball is in 0 profiles only'),
            (cell.profiles, late, 'no profile lies within the time of the poses')):
        with pytest.raises(DataError, match=words):
            sweep_from(profiles, poses, of_cell(cell))
