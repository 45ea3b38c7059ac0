"""Joints and axes of simulated arms, found from a table of one ball; what is odd is refused."""
from __future__ import annotations

from dataclasses import replace
import importlib.util
from pathlib import Path
import sys

from command import handeye
from handeye_ros import se3
from handeye_ros.config import Config, TargetConfig
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.linearise import Problem
from handeye_ros.files.tables import Table
from handeye_ros.frames import in_mount
from handeye_ros.kinematics import profiles
from handeye_ros.kinematics.answer import corrected_urdf, read_arm
from handeye_ros.kinematics.chain import chain_of, read_urdf
from handeye_ros.kinematics.model import Arm, GEOMETRY, ON_DEMAND, one_configuration, parameters
from handeye_ros.kinematics.outcome import solve_points
from handeye_ros.kinematics.points import State
from handeye_ros.kinematics.samples import outcome_of, source_of
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.ros.bags import bag
from handeye_ros.simulate import arm as simulated_arm
from handeye_ros.simulate import SCENARIOS, simulate_samples
from handeye_ros.targets import method_for
import numpy as np
import pytest
import yaml

pinocchio = pytest.importorskip('pinocchio', reason='needs pinocchio')

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location('bench_kinematics', ROOT / 'bench/kinematics.py')
bench = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = bench
spec.loader.exec_module(bench)

ODD = """<?xml version="1.0"?>
<robot name="odd">
  <!-- a rail, axes that are not along z, a mimic joint, fixed frames between and beside -->
  <link name="world"/><link name="rail"/><link name="foot"/><link name="a"/><link name="b"/>
  <link name="c"/><link name="tip"/><link name="camera"/>
  <joint name="slide" type="prismatic"><origin xyz="0.1 0 0.2" rpy="0.1 0 0"/>
    <parent link="world"/><child link="rail"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="0" velocity="0"/></joint>
  <joint name="bolt" type="fixed"><origin xyz="0 0 0.3" rpy="0 0.5 0"/>
    <parent link="rail"/><child link="foot"/></joint>
  <joint name="ns/joint-a" type="continuous"><parent link="foot"/><child link="a"/>
    <axis xyz="1 2 0"/></joint>
  <joint name="j.b" type="revolute"><origin xyz="0.4 0 0" rpy="0 0 1"/><parent link="a"/>
    <child link="b"/><axis xyz="0 0 -1"/>
    <limit lower="-2" upper="2" effort="0" velocity="0"/></joint>
  <joint name="coupled" type="revolute"><origin xyz="0.3 0 0"/><parent link="b"/><child link="c"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="0" velocity="0"/>
    <mimic joint="j.b" multiplier="-0.5" offset="0.2"/></joint>
  <joint name="end" type="fixed"><origin xyz="0 0.1 0.1" rpy="1 0 0"/><parent link="c"/>
    <child link="tip"/></joint>
  <joint name="holder" type="fixed"><origin xyz="1 1 1"/><parent link="a"/>
    <child link="camera"/></joint>
</robot>
"""


def poses(urdf, joints, q, frame):
    """Return what pinocchio makes of joint values (n, joints)."""
    model = pinocchio.buildModelFromXML(urdf)
    data, found = model.createData(), []
    for row in q:
        at = pinocchio.neutral(model)
        for name, value in zip(joints, row, strict=True):
            joint = model.joints[model.getJointId(name)]
            at[joint.idx_q:joint.idx_q + joint.nq] = (
                [value] if joint.nq == 1 else [np.cos(value), np.sin(value)])
        pinocchio.framesForwardKinematics(model, data, at)
        found.append(data.oMf[model.getFrameId(frame)].homogeneous)
    return np.array(found)


def odd_arm(rng):
    chain = chain_of(ODD, flange='tip')
    own = parameters(chain, GEOMETRY)
    return Arm(chain, own, rng.normal(size=len(own)) * [p.prior for p in own])


def test_an_odd_urdf_moves_as_in_pinocchio_and_so_does_the_corrected_one():
    rng = np.random.default_rng(0)
    arm = odd_arm(rng)
    chain, names = arm.chain, [joint.name for joint in arm.chain.joints]
    assert chain.measured == ('slide', 'ns/joint-a', 'j.b')
    given = {name: rng.uniform(-1, 1, 5) for name in chain.measured}
    q = chain.values(given, 'test')
    np.testing.assert_allclose(q[:, 3], 0.2 - 0.5 * q[:, 2])
    np.testing.assert_allclose(chain.forward(q), poses(ODD, names, q, 'tip'), atol=1e-12)
    corrected = corrected_urdf(ODD, arm)
    np.testing.assert_allclose(arm.forward(q), poses(corrected, names, q, 'tip'), atol=1e-10)
    np.testing.assert_allclose(arm.forward(q), chain_of(corrected, flange='tip').forward(q),
                               atol=1e-10)
    assert 'a mimic joint' in corrected


@pytest.mark.parametrize('kind', ['six', 'odd'])
def test_twists_are_the_derivatives_of_the_pose(kind):
    rng = np.random.default_rng(1)
    chain = odd_arm(rng).chain if kind == 'odd' else chain_of(bench.urdf(bench.SIX))
    own = parameters(chain, (*GEOMETRY, *ON_DEMAND))
    arm, q = Arm(chain, own, np.zeros(len(own))), rng.uniform(-1, 1, (7, len(chain.joints)))
    twists = arm.with_twists(q)[1]
    for k, step in enumerate(1e-6 * np.eye(len(own))):
        after, before = (replace(arm, values=s * step).forward(q) for s in (1, -1))
        turn = se3.log_rotation(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2))
        moved = np.hstack([after[:, :3, 3] - before[:, :3, 3], turn]) / 2e-6
        np.testing.assert_allclose(twists[:, :, k], moved, atol=2e-6, err_msg=str(own[k]))


def write_table(path, chain, data, header='degrees'):
    names = [f'{joint.name} [{header}]' for joint in chain.joints]
    with path.open('w') as file:
        print(','.join([*names, 'x [mm]', 'y [mm]', 'z [mm]']), file=file)
        for q, point in zip(np.degrees(data.q), data.points * 1e3, strict=True):
            print(','.join(f'{v:.5f}' for v in (*q, *point)), file=file)


@pytest.fixture(scope='module')
def solved(tmp_path_factory):
    """Return a cell, the rows held out, and the folder of its answer from the command line."""
    folder = tmp_path_factory.mktemp('kinematics')
    cell = bench.draw(bench.CASES['six'], 62, 3)
    first = np.arange(62) < 40
    (folder / 'arm.urdf').write_text(bench.urdf(bench.SIX))
    write_table(folder / 'points.csv', cell.arm.chain, cell.data.select(first))
    done = handeye('kinematics', 'points.csv', '--urdf', 'arm.urdf', '--out', 'out', cwd=folder)
    assert done.returncode == 0, done.stderr
    return cell, cell.exact.select(~first), folder, done.stdout


def test_the_answer_in_files_predicts_points_that_were_held_out(solved):
    cell, held, folder, told = solved
    arm, X = read_arm(folder / 'out'), read_calibration(folder / 'out/calibration.yaml')
    values = X.target['point_target']
    ball = np.array([values[axis] for axis in 'xyz'])
    urdf = (folder / 'out/corrected.urdf').read_text()
    for T in (arm.forward(held.q),
              poses(urdf, [j.name for j in arm.chain.joints], held.q, 'tool0')):
        seen = se3.inverse(T @ X.T_flange_sensor) @ np.append(ball, 1)
        assert bench.rms(seen[:, :3] - held.points) < 0.06
    assert (X.parent_frame, X.method) == ('tool0', 'kinematics')
    assert 'offset, direction, position' in told


def test_a_wrong_row_is_left_out_and_several_points_are_distinguished():
    cell = bench.draw(bench.CASES['six'], 40, 5)
    points = cell.data.points.copy()
    points[7] += [0.01, 0, 0]
    points[20] += [0, 0, 0.001]
    T = cell.arm.forward(cell.data.q) @ cell.X
    second = cell.ball + [0.02, 0.01, 0.0]
    points[30:] = (se3.inverse(T[30:]) @ np.append(second, 1))[:, :3]
    data = replace(cell.data, points=points, names=('a', 'b'),
                   target=np.repeat([0, 1], [30, 10]))
    fit = solve_points(data, cell.arm.chain, (), 1e-3).chosen.fit
    assert np.flatnonzero(~fit.used).tolist() == [7, 20]
    np.testing.assert_allclose(fit.state.targets[1] - fit.state.targets[0], [0.02, 0.01, 0.0],
                               atol=2e-4)


def test_nothing_is_invented_of_a_robot_without_error():
    cell = bench.draw(bench.CASES['none'], 62, 1)
    first = np.arange(62) < 40
    outcome = solve_points(cell.data.select(first), cell.arm.chain, (), 1e-3)
    held = cell.exact.select(~first)
    before, after, nees, _ = bench.judged(cell, bench.CASES['none'], outcome, held)
    assert after < 1.05 * before and nees < 2


def test_another_elbow_and_wrist_at_once_is_another_configuration():
    arm = Arm(chain_of(bench.urdf(bench.SIX)))
    q = np.array([[0.0, 0.1, 0.3, 0.0, 1.0, 0.0], [0.1, 0.2, 0.4, 0.2, 0.8, 0.3]])
    flipped = [0.0, 0.9, -2.2, 0.0, -1.0, 0.0]
    assert one_configuration(arm, q) and not one_configuration(arm, np.vstack([q, flipped]))


REFUSED = {
    'another name': (lambda t: t.replace('joint_4', 'jiont_4'), 'no values of the joint joint_4'),
    'radians': (lambda t: t.replace('degrees', 'rad'), 'degrees that are stated as radians'),
    'no unit': (lambda t: t.replace(' [mm]', '', 1), 'names no unit'),
    'few': (lambda t: '\n'.join(t.splitlines()[:8]), 'need at least'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_bad_tables_are_refused_in_a_sentence(solved, tmp_path, name):
    change, words = REFUSED[name]
    table = tmp_path / 'points.csv'
    table.write_text(change((solved[2] / 'points.csv').read_text()))
    done = handeye('kinematics', table, '--urdf', solved[2] / 'arm.urdf', '--out', tmp_path,
                   cwd=tmp_path)
    assert done.returncode in (2, 3) and words in done.stderr and 'Traceback' not in done.stderr
    assert not (tmp_path / 'calibration.yaml').exists()


def wrong(cell, name):
    q, points = cell.data.q.copy(), cell.data.points
    if name == 'joint_5 seems to turn the other way':
        q[:, 4] *= -1
    elif name == 'stated as degrees':
        q = np.radians(q)
    elif name == 'counted from the horizontal':
        q[:, 2] -= q[:, 1]
    return replace(cell.data, q=q, points=points,
                   on_flange=name != 'set calibration_type to eye_in_hand')


@pytest.mark.parametrize('words', [
    'joint_5 seems to turn the other way',
    *(pytest.param(words, marks=pytest.mark.thorough) for words in (
        'stated as degrees', 'counted from the horizontal',
        'set calibration_type to eye_in_hand'))])
def test_joint_values_that_contradict_the_points_are_named(solved, words):
    with pytest.raises(Exception, match=words):
        solve_points(wrong(solved[0], words), solved[0].arm.chain, (), 1e-3)


URDFS = {
    'macros': ('<robot name="a"><xacro:macro/></robot>', 'xacro'),
    'no xml': ('<robot', 'no XML'),
    'a loop': (ODD.replace('<child link="camera"/>', '<child link="tip"/>'), 'closed loop'),
    'no such link': (ODD, 'has no link tool9'),
    'floating': (ODD.replace('type="continuous"', 'type="floating"'), 'floating'),
}


@pytest.mark.parametrize('name', URDFS)
def test_bad_urdfs_are_refused_in_a_sentence(name):
    text, words = URDFS[name]
    with pytest.raises(Exception, match=words):
        chain_of(text, flange='tool9' if name == 'no such link' else 'tip')


@pytest.fixture(scope='module')
def from_bag(tmp_path_factory):
    """Return the folder of the answer of the recording in bags/, and what was told."""
    folder = tmp_path_factory.mktemp('from_bag')
    done = handeye('kinematics', ROOT / 'bags/arm', '--urdf', ROOT / 'bags/arm/robot.urdf',
                   '--set', 'target.type=sphere', '--out', 'out', cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_profiles_and_joint_states_of_a_bag_correct_the_arm(from_bag):
    folder, done = from_bag
    arm, X = read_arm(folder / 'out'), read_calibration(folder / 'out/calibration.yaml')
    assert 'the controller and the URDF have the same kinematics' in done.stderr
    assert X.quality.holdout_rms < 6e-5 and X.parent_frame == 'flange'
    assert [p.kind for p in arm.parameters].count('position') == 12


def test_a_solve_with_the_corrected_arm_gives_the_same_transform(from_bag):
    folder, _ = from_bag
    done = handeye('solve', ROOT / 'bags/arm', '--set', 'target.type=sphere', '--kinematics',
                   'out/kinematics.yaml', '--out', 'again', cwd=folder)
    assert done.returncode == 0, done.stderr
    before, after = (read_calibration(folder / name / 'calibration.yaml')
                     for name in ('out', 'again'))
    np.testing.assert_allclose(after.T_flange_sensor, before.T_flange_sensor, atol=2e-5)


@pytest.fixture(scope='module')
def source():
    """Return the chain and the samples of the recording in bags/."""
    chain = chain_of(read_urdf(ROOT / 'bags/arm/robot.urdf'))
    config = Config(target=TargetConfig(type='sphere'))
    recording = bag.read_with_joints(ROOT / 'bags/arm', config, chain, lambda share: None)
    return chain, source_of(recording, chain, config)


def test_two_recordings_give_one_answer(source):
    chain, whole = source
    parts = [replace(whole, samples=whole.samples[k::2], recording=None) for k in (0, 1)]
    both = outcome_of(parts, chain, ())
    assert both.chosen.kinds == GEOMETRY and both.chosen.left_out_rms < 6e-5
    one = outcome_of([whole], chain, ())
    away = se3.difference(both.chosen.fit.state.X, one.chosen.fit.state.X)
    assert away @ np.linalg.solve(both.covariance[:6, :6], away) < 6


@pytest.mark.parametrize(('words', 'change'), [
    ('joint_5 seems to turn the other way', lambda s: replace(
        s, joints=s.joints * [1, 1, 1, 1, -1, 1])),
    pytest.param('set calibration_type to eye_in_hand', lambda s: replace(
        s, config=replace(s.config, calibration_type='eye_on_base')), marks=pytest.mark.thorough),
    ('11 of 30 samples have no joint values', lambda s: replace(
        s, stamps=s.stamps[:len(s.stamps) * 6 // 10], joints=s.joints[:len(s.stamps) * 6 // 10])),
])
def test_joint_values_that_contradict_profiles_are_named(source, words, change):
    chain, whole = source
    with pytest.raises(HandeyeError, match=words):
        outcome_of([change(whole)], chain, ())


def test_a_urdf_of_another_robot_is_refused(source):
    chain, whole = source
    longer = replace(chain, joints=tuple(replace(
        joint, origin=se3.transform(joint.origin[:3, :3], 1.1 * joint.origin[:3, 3]))
        for joint in chain.joints))
    with pytest.raises(HandeyeError, match='the URDF is of another robot'):
        outcome_of([whole], longer, ())


@pytest.mark.thorough
def test_proposed_configurations_see_the_same_in_other_postures(from_bag):
    folder, _ = from_bag
    done = handeye('kinematics', ROOT / 'bags/arm', '--urdf', ROOT / 'bags/arm/robot.urdf',
                   '--set', 'target.type=sphere', '--out', 'more', '--propose', '5', cwd=folder)
    assert done.returncode == 0, done.stderr
    after, before = (float(done.stdout.split(word)[1].split(' mm')[0])
                     for word in ('are predicted to', '(1 sigma), now'))
    assert after < 0.7 * before
    chain = read_arm(folder / 'more').chain
    table = Table(folder / 'more/programme.csv')
    q = np.column_stack([table.values([name], 'angle') for name in chain.measured])
    there = yaml.safe_load((folder / 'more/programme.yaml').read_text())
    np.testing.assert_allclose([p['positions'] for p in there['points']], q, atol=1e-5)
    recording = bag.read_with_joints(ROOT / 'bags/arm', Config(), chain, lambda share: None)
    seen = np.unique(np.round(recording.joints[::5], 2), axis=0)
    poses = chain.forward(recording.joints)
    for row in q:
        off = np.linalg.norm((poses - chain.forward(row[None]))[:, :3], axis=(1, 2))
        assert off.min() < 1e-4 and np.abs(seen - row).max(axis=1).min() > 0.4


@pytest.mark.parametrize('name', ['sphere', 'sphere_on_flange'])
def test_residuals_of_profiles_have_their_derivatives(monkeypatch, name):
    monkeypatch.setattr(profiles, 'whitening', lambda *given: lambda values: values)
    rng = np.random.default_rng(4)
    scenario = replace(SCENARIOS[name], stations=(12, 0))
    samples, _ = simulate_samples(scenario, rng)
    config = Config(calibration_type=scenario.calibration_type,
                    target=TargetConfig(type='sphere'))
    chain = chain_of(simulated_arm.urdf())
    own = parameters(chain, GEOMETRY)
    q = rng.uniform(-1, 1, (len(samples), 6))
    T = Arm(chain).forward(q)
    method = method_for(config)
    problem = Problem(method, in_mount(T, config), method.features.observe(samples), config)
    data = profiles.Profiles(np.vstack([q, q]), (problem, problem), (4, 4), np.arange(2 * len(q)))
    state = State(np.eye(4), np.array([0.1, 0.2, 0.3, 0.02, 0.2, -0.1, 0.4, 0.02]),
                  Arm(chain, own, np.zeros(len(own))), np.zeros((1, 3)))
    root = rng.normal(size=(len(data), 1))
    J = data.linearised(state, root)[1]
    for k, step in enumerate(1e-6 * np.eye(J.shape[1])):
        r = [data.linearised(data.moved(state, s * step), root)[0] for s in (1, -1)]
        np.testing.assert_allclose(J[:, k], (r[0] - r[1]) / 2e-6, atol=1e-5)
