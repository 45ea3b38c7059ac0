"""Does a calibration still hold: what moved is named, and chance is not taken for a change."""
from __future__ import annotations

from dataclasses import replace

from command import assert_refused, handeye
from handeye_ros import se3
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import Calibration, Quality
from handeye_ros.results.calibration_file import read_calibration, write_calibration
from handeye_ros.ros.bags import bag_write
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate import gauges, simulate
from handeye_ros.simulate.scenario import RobotModel
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.verification import check as checking
from handeye_ros.verification import trend
from handeye_ros.verification.errors import NoCheckError, NoTrendError, TooFewSeenError
import numpy as np
import pytest
import yaml

STD = np.repeat([3e-5, np.deg2rad(0.01)], 3)
ROBOT = RobotModel()
CONFIG = Config(noise=NoiseConfig(3e-5, 0.0, *ROBOT.repeatability))
COUNTS = {'plane': 8, 'line': 6, 'sphere': 6, 'wedge': 8}
MOVED = se3.transform(se3.exp_rotation(np.array([2e-3, 0, 1e-3])), np.array([0, 0, 4e-4]))


def calibration(X, method, target):
    return Calibration(method, method, 'flange', 'laser', X, np.diag(STD ** 2), target,
                       Quality(0, 0, 0.0, 0.0, '', 0.0), ())


def described(kind, T):
    point = dict(zip('xyz', map(float, T[:3, 3]), strict=True))
    if kind == 'plane':
        return {'normal': T[:3, 2].tolist(), 'distance': float(T[:3, 2] @ T[:3, 3])}
    if kind == 'line':
        return {'point': point, 'direction': T[:3, 0].tolist()}
    if kind == 'wedge':
        return {'point': point, 'direction': T[:3, 0].tolist(), 'normal_1': T[:3, 2].tolist(),
                'normal_2': T[:3, 1].tolist()}
    return {'centre': point, 'radius': 0.02}


def recording(kind, seed, moved=None, robot=ROBOT):
    """Return samples of a short recording, and the calibration before it."""
    rng = np.random.default_rng(seed)
    X, T = gauges.sensor_on_flange(rng), gauges.somewhere(rng)
    scenario = SCENARIOS[kind]
    if kind == 'sphere':
        scenario = replace(scenario, target=replace(scenario.target, radius=0.02, table=None,
                                                    clutter=False))
    scenario = replace(scenario, stations=(COUNTS[kind], 0), robot=robot, tilt=np.deg2rad(40))
    samples = gauges.stations(scenario, X, T if moved is None else T @ moved,
                              SCENES[scenario.scene].stops(scenario, rng), rng)
    X_told = se3.perturb(X, STD * rng.normal(size=6))
    return samples, calibration(X_told, kind, described(kind, T))


@pytest.mark.thorough
@pytest.mark.parametrize('kind', COUNTS)
def test_what_did_not_change_is_told_so(kind):
    verdicts = [checking.check(*recording(kind, seed), CONFIG).verdict for seed in range(20)]
    assert verdicts.count('unchanged') >= 17  # two tests at 1 % each


@pytest.mark.parametrize('kind', COUNTS)
def test_a_moved_target_is_named_and_measured(kind):
    for seed in range(4):
        found = checking.check(*recording(kind, seed, moved=MOVED), CONFIG)
        assert found.verdict == 'target'
        assert 'target, or the base' in found.sentence
    if kind == 'sphere':
        assert found.target_moved == pytest.approx(4e-4, rel=0.3)


@pytest.mark.parametrize('kind', COUNTS)
def test_a_moved_sensor_is_named(kind):
    named = []
    for seed in range(6):
        samples, cal = recording(kind, seed)
        rng = np.random.default_rng(seed)
        off = np.concatenate([1e-3 * rng.normal(size=3), np.deg2rad(0.3) * rng.normal(size=3)])
        cal = replace(cal, T_flange_sensor=se3.perturb(cal.T_flange_sensor, off))
        named.append(checking.check(samples, cal, CONFIG).verdict)
    assert named.count('sensor') >= 5 and 'unchanged' not in named, named


def test_a_robot_that_scatters_is_neither_sensor_nor_target():
    samples, cal = recording('sphere', 0)
    rng = np.random.default_rng(1)
    T = np.array([s.T_base_flange for s in samples])
    T = cells.perturbed(T, rng.normal(size=(len(T), 6)) * np.repeat([1e-3, 2e-3], 3))
    bad = [replace(s, T_base_flange=one) for s, one in zip(samples, T, strict=True)]
    found = checking.check(bad, cal, CONFIG)
    assert found.verdict == 'robot' and 'noise is set too small' in found.sentence


def test_what_cannot_be_checked_is_refused():
    samples, cal = recording('sphere', 0)
    with pytest.raises(TooFewSeenError, match='3 usable'):
        checking.check(samples[:3], cal, CONFIG)
    with pytest.raises(NoCheckError, match='points'):
        checking.check(samples, replace(cal, method='points'), CONFIG)
    with pytest.raises(NoCheckError):
        checking.check(samples, replace(cal, target={}), CONFIG)


def calibrations(folder, count, jump_at=None):
    rng = np.random.default_rng(0)
    X = gauges.sensor_on_flange(rng)
    for k in range(count):
        off = STD * rng.normal(size=6)
        off = off + (5e-4 if jump_at is not None and k >= jump_at else 0.0)
        made = replace(calibration(se3.perturb(X, off), 'plate', {}),
                       provenance={'created': f'2026-01-{k + 1:02d}T08:00:00+00:00'})
        write_calibration(made, folder / f'day_{k}' / 'calibration.yaml')


def test_a_trend_tells_since_when(tmp_path):
    calibrations(tmp_path, 6, jump_at=4)
    entries, warnings = trend.trend(tmp_path)
    assert [e.p_before < 0.01 for e in entries] == [False] * 4 + [True, False]
    assert '2026-01-05' in trend.since_when(entries)
    assert not warnings
    (tmp_path / 'day_0' / 'calibration.yaml').write_text('no')
    entries, warnings = trend.trend(tmp_path)
    assert len(entries) == 5 and len(warnings) == 1


def test_a_steady_trend_is_told_so(tmp_path):
    calibrations(tmp_path, 5)
    entries, _ = trend.trend(tmp_path)
    assert 'no calibration differs' in trend.since_when(entries)
    with pytest.raises(NoTrendError):
        trend.trend(tmp_path / 'day_0')


def test_the_verb_on_recordings_and_a_folder(tmp_path):
    made = simulate(replace(SCENARIOS['small_plate'], stations=(4, 3)), np.random.default_rng(5))
    bag_write.write(tmp_path / 'today', made.profiles, made.poses)
    T = made.truth.T_base_target
    pose = {'translation': dict(zip('xyz', map(float, T[:3, 3]), strict=True)),
            'rotation': dict(zip('xyzw', map(float, se3.quaternion(T)), strict=True))}
    cal = calibration(made.truth.T_flange_sensor, 'plate', {'pose': pose})
    write_calibration(cal, tmp_path / 'a' / 'calibration.yaml')
    moved = replace(cal, T_flange_sensor=se3.perturb(cal.T_flange_sensor, np.full(6, 3e-3)))
    write_calibration(moved, tmp_path / 'b' / 'calibration.yaml')
    run = handeye('check', 'today', '--against', 'a/calibration.yaml', '--out', 'c.yaml',
                  cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'UNCHANGED' in run.stdout
    assert yaml.safe_load((tmp_path / 'c.yaml').read_text())['checks'][0]['stations'] == 7
    run = handeye('check', 'today', 'today', '--against', 'b/calibration.yaml', cwd=tmp_path)
    assert run.returncode == 1, run.stderr
    assert 'UNCHANGED' not in run.stdout and run.stdout.endswith('since today\n')
    run = handeye('check', '--folder', '.', '--picture', 't.png', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'CHANGED' in run.stdout and (tmp_path / 't.png').stat().st_size > 1000
    assert_refused(handeye('check', 'today', cwd=tmp_path), 2, '--against')
    assert_refused(handeye('check', '--folder', 'today', cwd=tmp_path), 3, 'today')
    assert read_calibration(tmp_path / 'a' / 'calibration.yaml').method == 'plate'
