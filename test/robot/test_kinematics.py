# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Joints and axes of simulated arms, found from a table of one ball; what is odd is refused."""
from __future__ import annotations

from dataclasses import replace
import importlib.util
from pathlib import Path
import sys

from command import handeye
from handeye_ros import se3
from handeye_ros.arm import (
    Arm,
    chain_of,
    corrected_urdf,
    GEOMETRY,
    parameters,
    read_arm,
)
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.robot.outcome import one_configuration
from handeye_ros.robot.points import solve_points
import numpy as np
import pytest

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
    own = parameters(chain, GEOMETRY)
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
    cell, held, folder, result = solved
    arm, X = read_arm(folder / 'out'), read_calibration(folder / 'out/calibration.yaml')
    values = X.target['point_target']
    ball = np.array([values[axis] for axis in 'xyz'])
    urdf = (folder / 'out/corrected.urdf').read_text()
    for T in (arm.forward(held.q),
              poses(urdf, [j.name for j in arm.chain.joints], held.q, 'tool0')):
        seen = se3.inverse(T @ X.T_flange_sensor) @ np.append(ball, 1)
        assert bench.rms(seen[:, :3] - held.points) < 0.06
    assert (X.parent_frame, X.method) == ('tool0', 'kinematics')
    assert 'offset, direction, position' in result


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
    fit = solve_points(data, cell.arm.chain, 1e-3).chosen.fit
    assert np.flatnonzero(~fit.used).tolist() == [7, 20]
    np.testing.assert_allclose(fit.state.targets[1] - fit.state.targets[0], [0.02, 0.01, 0.0],
                               atol=2e-4)


def test_nothing_is_invented_of_a_robot_without_error():
    cell = bench.draw(bench.CASES['none'], 62, 1)
    first = np.arange(62) < 40
    outcome = solve_points(cell.data.select(first), cell.arm.chain, 1e-3)
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
    'radians': (lambda t: t.replace('degrees', 'rad'), 'degrees stated as radians'),
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
        solve_points(wrong(solved[0], words), solved[0].arm.chain, 1e-3)


URDFS = {
    'macros': ('<robot name="a"><xacro:macro/></robot>', 'xacro'),
    'no xml': ('<robot', 'no valid URDF'),
    'a loop': (ODD.replace('<child link="camera"/>', '<child link="tip"/>'), 'closed loop'),
    'no such link': (ODD, 'has no link tool9'),
    'floating': (ODD.replace('type="continuous"', 'type="floating"'), 'floating'),
}


@pytest.mark.parametrize('name', URDFS)
def test_bad_urdfs_are_refused_in_a_sentence(name):
    text, words = URDFS[name]
    with pytest.raises(Exception, match=words):
        chain_of(text, flange='tool9' if name == 'no such link' else 'tip')
