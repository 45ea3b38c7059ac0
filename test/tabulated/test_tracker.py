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
from handeye_ros.tabulated import tracker_estimate
from handeye_ros.tabulated.sweeps import sweep_from
import numpy as np
import pytest
from tracker_session import session, T_flange_sensor

NOISE = 3.7e-5
CONFIG = with_values(Config(), {'noise.sensor': NOISE, 'target.radius': RADIUS}, 'test')


def with_sigma(sweep: jing2020.Sweep, sigma: float) -> tracker_estimate.Sweep:
    points = [np.insert(p, 3, sigma, axis=1) for p in (sweep.ball, sweep.face_c, sweep.face_d)]
    return tracker_estimate.Sweep(*points, sweep.q30)


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
    measured, sweep = session(1, skew=skew)
    found = tracker_estimate.solve(measured, with_sigma(sweep, NOISE))
    assert np.abs(se3.difference(found.T_flange_sensor, T_flange_sensor)).max() < 1e-9
    assert found.face_angle == pytest.approx(np.deg2rad(90.0 + skew))
    assert abs(found.skew) < 1e-9 and found.radius == pytest.approx(0.01905)


@pytest.mark.thorough
def test_nearer_than_the_published_chain_and_as_sure_as_it_says() -> None:
    ours, published, squares = [], [], []
    for seed in range(8):
        measured, sweep = session(seed, 2e-5, NOISE)
        found = tracker_estimate.solve(measured, with_sigma(sweep, NOISE))
        chain = jing2020.solve(measured, sweep).T_flange_sensor
        ours.append(off(found.T_flange_sensor, T_flange_sensor))
        published.append(off(chain, T_flange_sensor))
        delta = se3.difference(found.T_flange_sensor, T_flange_sensor)
        squares.append(delta @ np.linalg.solve(found.covariance, delta) / 6)
        assert found.variance_factor == pytest.approx(1.0, abs=0.1)
        assert found.variance_factor ** 0.5 < found.holdout_rms < 1.2
    assert (np.median(ours, axis=0) < np.median(published, axis=0)).all()
    assert 0.4 < np.mean(squares) < 2.0


@pytest.mark.parametrize('seed', range(4))
def test_from_files_and_profiles(tmp_path: Path, seed: int) -> None:
    """Noise as in the paper, and the faults of the sensor beside it; against the truth."""
    cell = simulate_tracker(np.random.default_rng(seed))
    measured = tracker_estimate.read(written(cell, tmp_path / 'tracker.csv'), cell.h0, cell.h1)
    sweep = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    found = tracker_estimate.solve(measured, sweep)
    e_v, e_theta, e_p = off(found.T_flange_sensor, cell.T_flange_sensor)
    assert e_v < 1e-3 and e_theta < np.deg2rad(0.07) and e_p < 0.25e-3
    assert found.radius == pytest.approx(RADIUS, abs=2e-5)
    std = np.sqrt(np.diag(found.covariance))
    assert 1e-6 < std[:3].max() < 0.25e-3 and 1e-6 < std[3:].max() < 1e-3


@pytest.mark.parametrize('seed', [1003, 1011, 1035])
def test_the_rim_of_the_ball_is_no_block(seed: int) -> None:
    cell = simulate_tracker(np.random.default_rng(seed))
    sweep = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    assert sweep.face_c[:, 2].min() > sweep.ball[:, 2].max()
    faces = [jing2020.swept(points, sweep.q30, jing2020.fit_swept_ball(
        sweep.published.ball, sweep.q30, jing2020.SWEEP)[0])
        for points in (sweep.published.face_c, sweep.published.face_d)]
    assert np.degrees(jing2020.face_angle(*faces)) == pytest.approx(90.0, abs=0.05)


def test_wrong_points_are_left_out() -> None:
    measured, sweep = session(2, 2e-5, NOISE)
    measured.arc[5] += [1e-3, 0, 0]
    measured.face_c[1] += [0, 2e-3, 1e-3]
    found = tracker_estimate.solve(measured, with_sigma(sweep, NOISE))
    delta = se3.difference(found.T_flange_sensor, T_flange_sensor)
    assert delta @ np.linalg.solve(found.covariance, delta) < 20
    spot = 2 * 40 + 2 * 30 + 3 + 1
    assert spot not in found.used and not {5, 45} <= set(found.used.tolist())


def test_what_cannot_carry_an_answer_is_refused() -> None:
    measured, sweep = session(0, 2e-5, NOISE)
    sigma = with_sigma(sweep, NOISE)
    with pytest.raises(DataError, match='the arc spans 9.* degrees; turn R2 by 30'):
        tracker_estimate.solve(replace(measured, arc=measured.arc[:4]), sigma)
    with pytest.raises(DataError, match='nearly parallel'):
        tracker_estimate.solve(
            replace(measured, face_d=measured.face_c + 1e-3 * np.ones(3)), sigma)
    order = np.random.default_rng(1).permutation(30)
    with pytest.raises(DataError, match='the points of the arc go back and forth'):
        tracker_estimate.solve(replace(measured, arc=measured.arc[order]), sigma)
    with pytest.raises(DataError, match='the points of the line go back and forth'):
        tracker_estimate.solve(replace(measured, line=measured.line[order]), sigma)
    wrong = measured.face_c + np.linspace(0, 9e-3, len(measured.face_c))[:, None]
    with pytest.raises(DataError, match='% of those of .* left out'):
        tracker_estimate.solve(replace(measured, face_c=wrong), sigma)
    with pytest.raises(DataError, match='check which face is which'):
        tracker_estimate.solve(measured, replace(sigma, face_c=sigma.face_d, face_d=sigma.face_c))
    with pytest.raises(DataError, match='is uncertain by'):
        tracker_estimate.solve(measured, with_sigma(sweep, 5e-2), tracker_noise=5e-2)


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
        tracker_estimate.read(path, 0.02, 0.03)
    assert message in str(caught.value)


def test_the_sweep_of_a_bag_is_that_of_its_messages(tmp_path: Path) -> None:
    cell = simulate_tracker(np.random.default_rng(6))
    bag_write.write(tmp_path / 'sweep', cell.profiles, cell.poses)
    recording = bag.read(tmp_path / 'sweep', CONFIG)
    read = sweep_from(recording.profiles, recording.poses, CONFIG, cell.q3_first, cell.q30)
    made = sweep_from(cell.profiles, cell.poses, CONFIG, cell.q3_first, cell.q30)
    for there, here in ((read.ball, made.ball), (read.face_c, made.face_c)):
        np.testing.assert_allclose(there[:, :3], here[:, :3], atol=1e-6)
