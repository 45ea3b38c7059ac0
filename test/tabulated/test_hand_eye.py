# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A X = X B: the truth, OpenCV beaten, degenerate motions refused."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.published import cn105021139a
from handeye_ros.tables import TableError
from handeye_ros.tabulated import hand_eye
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

NOISE, ROBOT = (1e-4, 1e-3), (3e-5, 1e-4)
TILTS = np.array([30.0, 30.0, 60.0])


def cell(seed: int, noise: tuple[float, float] = (0.0, 0.0), count: int = 12,
         tilts: Array = TILTS, robot: tuple[float, float] = ROBOT
         ) -> tuple[Array, Array, Array, Array]:
    """
    Return T_flange_camera, T_base_target, poses and views; noise of the views (m, rad).

    With noise, the poses have that of a robot.
    """
    rng = np.random.default_rng(seed)
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(), 0.1 * rng.normal(size=3))
    Z = se3.transform(Rotation.random(random_state=rng).as_matrix(), np.array([0.7, 0.1, 0.2]))
    turns = Rotation.from_euler('xyz', rng.uniform(-tilts, tilts, (count, 3)), degrees=True)
    place = rng.uniform([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3], (count, 3))
    views = se3.transform(turns.as_matrix() @ np.diag([1.0, -1.0, -1.0]), place)
    T = Z @ se3.inverse(views) @ se3.inverse(X)
    return X, Z, disturbed(T, robot, rng) if any(noise) else T, disturbed(views, noise, rng)


def disturbed(T: Array, noise: tuple[float, float], rng: np.random.Generator) -> Array:
    shift, turn = rng.normal(size=(2, len(T), 3)) * np.array(noise)[:, None, None]
    return se3.transform(se3.exp_rotation(turn) @ T[:, :3, :3], T[:, :3, 3] + shift)


@pytest.mark.parametrize('count', [3, 12])
@pytest.mark.parametrize('eye_on_base', [False, True])
def test_the_truth_without_noise(count: int, eye_on_base: bool) -> None:
    X, Z, T, views = cell(count, count=count)
    found = hand_eye.solve(se3.inverse(T) if eye_on_base else T, views,
                                    eye_on_base=eye_on_base)
    assert np.abs(se3.difference(found.T_flange_camera, X)).max() < 1e-9
    assert np.abs(se3.difference(found.T_base_target, Z)).max() < 1e-9


@pytest.mark.thorough
def test_as_near_as_opencv_on_a_hundred_seeds() -> None:
    cv2 = pytest.importorskip('cv2', reason='needs opencv-python-headless<5')
    names = ('TSAI', 'PARK', 'HORAUD', 'ANDREFF', 'DANIILIDIS')
    off: dict[str, list[tuple[float, float]]] = {name: [] for name in ('ours', *names)}
    for seed in range(100):
        X, _, T, views = cell(seed, NOISE)
        answers = {'ours': hand_eye.solve(T, views).T_flange_camera}
        for name in names:
            R, t = cv2.calibrateHandEye(
                T[:, :3, :3], T[:, :3, 3], views[:, :3, :3], views[:, :3, 3],
                method=getattr(cv2, f'CALIB_HAND_EYE_{name}'))
            answers[name] = se3.transform(R, t[:, 0])
        for name, answer in answers.items():
            delta = se3.difference(answer, X)
            off[name].append((np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:])))
    median = {name: np.median(values, axis=0) for name, values in off.items()}
    assert all((median['ours'] <= median[name]).all() for name in names)


@pytest.mark.thorough
@pytest.mark.parametrize(('noise', 'robot', 'count'), [
    (NOISE, (0.0, 0.0), 12), ((1e-9, 1e-9), (1e-4, 5e-4), 12), ((1e-4, 2e-4), (1e-4, 1e-3), 12),
    ((1e-4, 1e-2), ROBOT, 12), (NOISE, ROBOT, 5)])
def test_whoever_was_noisy_nearer_than_the_closed_form_and_near_the_noise_known(
        noise: tuple[float, float], robot: tuple[float, float], count: int) -> None:
    off = []
    for seed in range(1000, 1030):
        X, _, T, views = cell(seed, noise, count, robot=robot)
        known = hand_eye.PoseNoise(*noise, *robot)
        answers = (hand_eye.solve(T, views).T_flange_camera,
                   hand_eye.solve(T, views, known).T_flange_camera,
                   hand_eye.closed_form(T, views)[0])
        deltas = np.array([se3.difference(answer, X) for answer in answers])
        off.append(np.linalg.norm(deltas.reshape(3, 2, 3), axis=2))
    ours, known, closed = np.sqrt(np.mean(np.square(off), axis=0))
    assert (ours < closed).all()
    assert (ours < 1.15 * known).all()


@pytest.mark.thorough
def test_nearer_than_the_two_motions_of_the_patent() -> None:
    off = []
    for seed in range(50):
        X, _, T, views = cell(seed, NOISE)
        answers = (hand_eye.solve(T, views).T_flange_camera,
                   cn105021139a.solve_motions(*cn105021139a.motions(T, views)))
        deltas = np.array([se3.difference(answer, X) for answer in answers])
        off.append(np.linalg.norm(deltas.reshape(2, 2, 3), axis=2))
    ours, published = np.median(off, axis=0)
    assert (ours < published).all()


@pytest.mark.thorough
@pytest.mark.parametrize('eye_on_base', [False, True])
@pytest.mark.parametrize('known', [True, False])
def test_the_covariance_is_true(known: bool, eye_on_base: bool) -> None:
    """The robot turns about its flange, which is elsewhere with the camera on the base."""
    robot = (1e-4, 1e-3) if eye_on_base else ROBOT
    noise = hand_eye.PoseNoise(*NOISE, *robot) if known else None
    squares = []
    for seed in range(40):
        X, _, T, views = cell(seed, NOISE, 20, robot=(0.0, 0.0))
        poses = disturbed(se3.inverse(T) if eye_on_base else T, robot, np.random.default_rng(seed))
        found = hand_eye.solve(poses, views, noise, eye_on_base)
        delta = se3.difference(found.T_flange_camera, X)
        squares.append(delta @ np.linalg.solve(found.covariance, delta) / 6)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)


def test_derivatives_are_those_of_the_residuals() -> None:
    X, Z, T, views = cell(1)
    by_state, by_pose = hand_eye.derivatives(T, (X, Z))
    steps = 1e-6 * np.eye(6)
    for k, step in enumerate(steps):
        changed = [(T, (se3.perturb(X, step), Z)), (T, (X, se3.perturb(Z, step))),
                   (np.array([se3.perturb(pose, step) for pose in T]), (X, Z))]
        expected = (by_state[:, :, k], by_state[:, :, 6 + k], by_pose[:, :, k])
        for (poses, state), slope in zip(changed, expected, strict=True):
            r = hand_eye.residuals(poses, views, state)
            np.testing.assert_allclose(r / 1e-6, slope, atol=1e-5)
    _, by_pose = hand_eye.derivatives(T, (X, Z), eye_on_base=True)
    for k, step in enumerate(steps):
        moved = se3.perturb(np.eye(4), step) @ T
        r = hand_eye.residuals(moved, views, (X, Z))
        np.testing.assert_allclose(r / 1e-6, by_pose[:, :, k], atol=1e-5)


def test_a_wrong_view_is_left_out() -> None:
    X, _, T, views = cell(5, NOISE)
    views[4] = se3.perturb(views[4], np.array([5e-3, 0, 0, 0, 0.02, 0]))
    found = hand_eye.solve(T, views)
    assert 4 not in found.used and len(found.used) >= 10
    assert np.linalg.norm(se3.difference(found.T_flange_camera, X)[:3]) < 1e-3
    assert found.rms[0] < found.holdout_rms[0] < 1e-3 and found.rms[1] < found.holdout_rms[1]


def test_motions_that_leave_something_open_are_refused() -> None:
    _, _, T, views = cell(0, NOISE)
    with pytest.raises(TooFewError, match='at least 3 poses, got 2'):
        hand_eye.solve(T[:2], views[:2])
    _, _, T, views = cell(0, tilts=np.zeros(3))
    with pytest.raises(DataError, match='tilt the tool'):
        hand_eye.solve(T, views)
    _, _, T, views = cell(0, tilts=np.array([0, 0, 60.0]))
    with pytest.raises(DataError, match='the position along it is free'):
        hand_eye.solve(T, views)


def test_inverted_poses_are_refused() -> None:
    _, _, T, views = cell(2, NOISE)
    with pytest.raises(DataError, match='no pose is inverted'):
        hand_eye.solve(se3.inverse(T), views)


@pytest.mark.parametrize('rpy', [True, False])
def test_files_name_their_units(tmp_path: Path, rpy: bool) -> None:
    X, _, T, views = cell(4, count=5)
    header, columns = [], []
    for name, poses in (('flange', T), ('target', views)):
        header += [f'{name}_{axis} [mm]' for axis in 'xyz']
        columns.append(1e3 * poses[:, :3, 3])
        if rpy:
            header += [f'{name}_{angle} [deg]' for angle in ('roll', 'pitch', 'yaw')]
            columns.append(np.degrees([se3.rpy(pose) for pose in poses]))
        else:
            header += [f'{name}_q{axis}' for axis in 'xyzw']
            columns.append(se3.quaternion(poses))
    rows = np.hstack(columns).tolist()
    path = tmp_path / 'poses.csv'
    path.write_text('\n'.join(['# of the cell', ';'.join(header),
                               *(';'.join(map(repr, row)) for row in rows)]))
    found = hand_eye.solve(*hand_eye.read_table(path))
    assert np.abs(se3.difference(found.T_flange_camera, X)).max() < 1e-9
    if not rpy:
        path.write_text(path.read_text().replace(repr(rows[0][3]), '2.0'))
        with pytest.raises(TableError, match=r'row 1: flange_q\.\.\. is no unit quaternion'):
            hand_eye.read_table(path)
