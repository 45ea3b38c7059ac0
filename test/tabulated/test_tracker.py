# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Laser tracker, ball and block: from files and profiles to the transform, and what is refused."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from handeye_ros import se3
from handeye_ros.bags import bag, bag_write
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.published import jing2020
from handeye_ros.simulate.measured import RADIUS, simulate_tracker, TrackerCell
from handeye_ros.tables import TableError
from handeye_ros.tabulated import tracker
from handeye_ros.tabulated.method import Answer
from handeye_ros.tabulated.sweeps import Sweep, sweep_from, SWEPT
import numpy as np
import pytest
from tracker_session import session, T_flange_sensor

NOISE = 3.7e-5
CONFIG = with_values(Config(), {'noise.sensor': NOISE, 'target.radius': RADIUS}, 'test')


def solved(measured: jing2020.Tracker, sweep: jing2020.Sweep, noise: float = NOISE
           ) -> Answer[tracker.Session]:
    """Return the answer; noise: 1 sigma of the sensor, or more than 1 mm of both instruments."""
    parts = {part: np.insert(getattr(sweep, part), 3, noise, axis=1) for part in SWEPT}
    stamps = {part: np.arange(len(points)) + 10_000 * (part != 'ball')
              for part, points in parts.items()}
    rows = [(kind, point) for kind in ('arc', 'line', 'ball', 'face_c', 'face_d')
            for point in np.atleast_2d(getattr(measured, kind))]
    config = with_values(CONFIG, {
        'tracker.h0': measured.h0, 'tracker.h1': measured.h1,
        'tracker.noise': min(noise, 0.01) if noise > 1e-3 else 2e-5}, 'test')
    return tracker.TRACKER.solve(tracker.session_of(
        rows, Sweep(**parts, q30=sweep.q30, stamps=stamps), config), config)


def written(cell: TrackerCell, path: Path) -> Path:
    rows = [[kind, *map(repr, point)] for kind, points in cell.reflector.items()
            for point in (1e3 * points).tolist()]
    path.write_text('\n'.join(map(', '.join, [['kind', 'x [mm]', 'y [mm]', 'z [mm]'], *rows])))
    return path


def off(T: Array, T_true: Array) -> Array:
    return np.array(jing2020.errors(T, T_true))


@pytest.mark.parametrize('skew', [0.0, 4.0])
def test_the_truth_without_noise(skew: float) -> None:
    """The block may be crooked; the ball and the faces are what was swept."""
    found = solved(*session(1, skew=skew))
    assert np.abs(se3.difference(found.X, T_flange_sensor)).max() < 1e-9
    assert found.target['face_angle'] == pytest.approx(np.deg2rad(90.0 + skew))
    assert found.target['radius'] == pytest.approx(0.01905)


def test_the_answer_is_as_sure_as_it_says() -> None:
    squares = []
    for seed in range(6):
        found = solved(*session(seed, 2e-5, NOISE))
        delta = se3.difference(found.X, T_flange_sensor)
        squares.append(delta @ np.linalg.solve(found.covariance, delta) / 6)
    assert 0.4 < np.mean(squares) < 2.0


@pytest.mark.parametrize('seed', range(2))
def test_from_files_and_profiles(tmp_path: Path, seed: int) -> None:
    """Noise as in the paper, and the faults of the sensor beside it; against the truth."""
    cell = simulate_tracker(np.random.default_rng(seed))
    sweep = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    config = with_values(CONFIG, {'tracker.h0': cell.h0, 'tracker.h1': cell.h1}, 'test')
    rows = tracker.read_table(written(cell, tmp_path / 'tracker.csv'))
    found = tracker.TRACKER.solve(tracker.session_of(rows, sweep, config), config)
    e_v, e_theta, e_p = off(found.X, cell.T_flange_sensor)
    assert e_v < 1e-3 and e_theta < np.deg2rad(0.07) and e_p < 0.25e-3
    assert found.target['radius'] == pytest.approx(RADIUS, abs=2e-5)
    std = np.sqrt(np.diag(found.covariance))
    assert 1e-6 < std[:3].max() < 0.25e-3 and 1e-6 < std[3:].max() < 1e-3


@pytest.mark.parametrize('seed', [1003, 1011, 1035])
def test_the_rim_of_the_ball_is_no_block(seed: int) -> None:
    cell = simulate_tracker(np.random.default_rng(seed))
    sweep = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    assert sweep.face_c[:, 2].min() > sweep.ball[:, 2].max()
    faces = [jing2020.swept(points, sweep.q30, jing2020.fit_swept_ball(
        sweep.ball[:, :3], sweep.q30, jing2020.SWEEP)[0])
        for points in (sweep.face_c[:, :3], sweep.face_d[:, :3])]
    assert np.degrees(jing2020.face_angle(*faces)) == pytest.approx(90.0, abs=0.05)


def test_wrong_points_are_left_out() -> None:
    measured, sweep = session(2, 2e-5, NOISE)
    measured.arc[5] += [1e-3, 0, 0]
    measured.face_c[1] += [3e-3, 2e-3, -1e-3]
    found = solved(measured, sweep)
    delta = se3.difference(found.X, T_flange_sensor)
    assert delta @ np.linalg.solve(found.covariance, delta) < 20
    assert np.flatnonzero(~found.used).tolist() == [
        5, len(measured.arc) + len(measured.line) + 1]


def test_what_cannot_carry_an_answer_is_refused() -> None:
    measured, sweep = session(0, 2e-5, NOISE)
    order = np.random.default_rng(1).permutation(30)
    wrong = measured.face_c + np.linspace(0, 9e-3, len(measured.face_c))[:, None]
    for change, words in (
            ({'arc': measured.arc[:4]}, 'the arc spans 9.* degrees; turn R2 by 30'),
            ({'face_d': measured.face_c + 1e-3 * np.ones(3)}, 'nearly parallel'),
            ({'arc': measured.arc[order]}, 'the points of the arc go back and forth'),
            ({'line': measured.line[order]}, 'the points of the line go back and forth'),
            ({'face_c': wrong}, 'contradict each other')):
        with pytest.raises(DataError, match=words):
            solved(replace(measured, **change), sweep)
    with pytest.raises(DataError, match='check which face is which'):
        solved(measured, replace(sweep, face_c=sweep.face_d, face_d=sweep.face_c))
    with pytest.raises(DataError, match='is uncertain by'):
        solved(measured, sweep, 5e-2)


def test_a_sweep_that_is_none_is_refused() -> None:
    cell = simulate_tracker(np.random.default_rng(5))

    def sweep(profiles=cell.profiles, poses=cell.poses):
        return sweep_from(profiles, poses, CONFIG, cell.q3_first, cell.q30)

    turned = [replace(pose, quaternion=np.roll(pose.quaternion, i // 80))
              for i, pose in enumerate(cell.poses)]
    with pytest.raises(DataError, match='the flange turns by'):
        sweep(poses=turned)
    aside = [replace(pose, translation=pose.translation[[1, 0, 2]]) for pose in cell.poses]
    with pytest.raises(DataError, match='mm aside; move P3 alone'):
        sweep(poses=aside)
    with pytest.raises(DataError, match='profiles show the block'):
        sweep(profiles=cell.profiles[:50])
    with pytest.raises(DataError, match='0 profiles show the ball'):
        sweep(profiles=cell.profiles[80:])
    late = [replace(pose, stamp=pose.stamp + 10 ** 12) for pose in cell.poses]
    with pytest.raises(DataError, match='no profile lies within the time of the poses'):
        sweep(poses=late)


@pytest.mark.parametrize(('change', 'message'), [
    (('arc,', 'arch,'), 'row 1: kind is "arch", expected arc, line'),
    (('ball,', 'arc,'), 'holds 0 points of the kind ball; at least 1'),
    (('x [mm]', 'x'), 'the column x names no unit'), (('z [mm]', 'y [mm]'), 'the same name')])
def test_files_that_cannot_be_used(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = written(simulate_tracker(np.random.default_rng(0)), tmp_path / 'tracker.csv')
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(TableError) as caught:
        tracker.read_table(path)
    assert message in str(caught.value)


def test_the_sweep_of_a_bag_is_that_of_its_messages(tmp_path: Path) -> None:
    cell = simulate_tracker(np.random.default_rng(6))
    bag_write.write(tmp_path / 'sweep', cell.profiles, cell.poses)
    recording = bag.read(tmp_path / 'sweep', CONFIG)
    read = sweep_from(recording.profiles, recording.poses, CONFIG, cell.q3_first, cell.q30)
    made = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    for there, here in ((read.ball, made.ball), (read.face_c, made.face_c)):
        np.testing.assert_allclose(there[:, :3], here[:, :3], atol=1e-6)
