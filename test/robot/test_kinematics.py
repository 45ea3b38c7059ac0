# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Errors of simulated arms, found from tables and recordings; what is odd is refused."""
from __future__ import annotations

from dataclasses import replace
import math
import re
import shutil

from calibrations import calibration_at
from cells import ONE_IN_1000, squared_error
from command import assert_refused, bench_of, handeye, ROOT, succeeds
from handeye_ros import pipeline, se3
from handeye_ros.arm import arm_of, corrected_urdf, KINDS, OFFSET, read_urdf
from handeye_ros.bags.recording import read_bag
from handeye_ros.config import Config, TargetConfig
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mount_poses
from handeye_ros.results.calibration_file import read_calibration, write_calibration
from handeye_ros.results.kinematics_file import read_arm
from handeye_ros.robot.from_recordings import arm_samples_of, ArmSamples, solve_samples
from handeye_ros.robot.from_table import select_from_points, solve_table
from handeye_ros.sampling.session import Session
from handeye_ros.simulate import robot as simulated_arm
from handeye_ros.simulate import SCENARIOS, simulate_samples
from handeye_ros.targets import target_for
import numpy as np
import pytest
import yaml

pinocchio = pytest.importorskip('pinocchio', reason='needs pinocchio')

bench = bench_of('kinematics')

ODD = """<?xml version="1.0"?>
<robot name="odd">
  <!-- a rail, axes that are not along z, fixed frames between and beside -->
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
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="0" velocity="0"/></joint>
  <joint name="end" type="fixed"><origin xyz="0 0.1 0.1" rpy="1 0 0"/><parent link="c"/>
    <child link="tip"/></joint>
  <joint name="holder" type="fixed"><origin xyz="1 1 1"/><parent link="a"/>
    <child link="camera"/></joint>
</robot>
"""


def with_errors(arm, rng):
    arm = arm.with_errors_of(KINDS)
    sigmas = arm.prior_stds[arm.is_estimated]
    return replace(arm, error_values=rng.normal(size=len(sigmas)) * sigmas)


def poses(urdf, joints, q, frame):
    """Return what pinocchio makes of joint values (n, joints)."""
    model = pinocchio.buildModelFromXML(urdf)
    data, flange_poses = model.createData(), []
    for row in q:
        configuration = pinocchio.neutral(model)
        for name, value in zip(joints, row, strict=True):
            joint = model.joints[model.getJointId(name)]
            configuration[joint.idx_q:joint.idx_q + joint.nq] = (
                [value] if joint.nq == 1 else [np.cos(value), np.sin(value)])
        pinocchio.framesForwardKinematics(model, data, configuration)
        flange_poses.append(data.oMf[model.getFrameId(frame)].homogeneous)
    return np.array(flange_poses)


def test_an_odd_urdf_moves_as_in_pinocchio_and_so_does_the_corrected_one():
    rng = np.random.default_rng(0)
    arm = with_errors(arm_of(ODD, flange='tip'), rng)
    names = [joint.name for joint in arm.joints]
    q = arm.joint_values({name: rng.uniform(-1, 1, 5) for name in names}, 'test')
    np.testing.assert_allclose(
        arm.with_errors_of(()).forward(q), poses(ODD, names, q, 'tip'), atol=1e-12)
    corrected = corrected_urdf(ODD, arm)
    np.testing.assert_allclose(arm.forward(q), poses(corrected, names, q, 'tip'), atol=1e-10)
    assert 'axes that are not along z' in corrected


@pytest.mark.parametrize('urdf', [bench.urdf(bench.SIX), ODD])
def test_twists_are_the_derivatives_of_the_pose(urdf):
    rng = np.random.default_rng(1)
    arm = arm_of(urdf, flange='tip' if urdf == ODD else '').with_errors_of(KINDS)
    q = rng.uniform(-1, 1, (7, len(arm.joints)))
    twists = arm.error_jacobian(q)[:, :, arm.is_estimated]
    for k, step in enumerate(1e-6 * np.eye(len(arm.error_values))):
        after, before = (replace(arm, error_values=s * step).forward(q) for s in (1, -1))
        np.testing.assert_allclose(twists[:, :, k], se3.difference(after, before) / 2e-6,
                                   atol=2e-6)


@pytest.fixture(scope='module')
def from_table(tmp_path_factory):
    """Return a cell, the rows held out, the folder of the answer, and what was shown."""
    folder = tmp_path_factory.mktemp('kinematics')
    cell = bench.draw(bench.CASES['six'], 62, 3)
    is_given = np.arange(62) < 40
    (folder / 'arm.urdf').write_text(bench.urdf(bench.SIX))
    rows = np.hstack([np.degrees(cell.data.q), cell.data.points * 1e3])[is_given]
    header = [*(f'{joint.name} [degrees]' for joint in cell.arm.joints), 'x [mm]', 'y [mm]',
              'z [mm]']
    np.savetxt(folder / 'points.csv', rows, '%.5f', ',', header=','.join(header), comments='')
    run = succeeds('kinematics', 'points.csv', '--urdf', 'arm.urdf', '--out', 'out', cwd=folder)
    return cell, bench.selected(cell.exact, ~is_given), folder, run.stdout


def test_the_answer_in_files_predicts_points_that_were_held_out(from_table):
    _, held, folder, output = from_table
    arm, calibration = read_arm(folder / 'out'), read_calibration(folder / 'out/calibration.yaml')
    ball = np.array([calibration.target['point_target'][axis] for axis in 'xyz'])
    urdf = (folder / 'out/corrected.urdf').read_text()
    for T in (arm.forward(held.q), poses(urdf, [j.name for j in arm.joints], held.q, 'tool0')):
        points = se3.apply(se3.inverse(T @ calibration.T_flange_sensor), ball[None])[:, 0]
        assert bench.rms(points - held.points) < 0.06
    assert (calibration.parent_frame, calibration.method) == ('tool0', 'kinematics')
    assert 'offset, direction, position' in output


def test_a_wrong_row_is_dropped_and_several_points_are_distinguished():
    cell = bench.draw(bench.CASES['six'], 40, 5)
    points = cell.data.points.copy()
    points[7] += [0.01, 0, 0]
    points[20] += [0, 0, 0.001]
    T = cell.arm.forward(cell.data.q) @ cell.X
    second = cell.ball + [0.02, 0.01, 0.0]
    points[30:] = se3.apply(se3.inverse(T[30:]), second[None])[:, 0]
    is_first, data = np.arange(40) < 30, replace(cell.data, points=points)
    both = [bench.selected(data, is_first), bench.selected(data, ~is_first)]
    selection = select_from_points(both, cell.arm.with_errors_of(()), 1e-3)
    fit = selection.chosen.fit
    assert np.flatnonzero(~fit.used).tolist() == [7, 20]
    assert np.array_equal(selection.arm.configurations, cell.data.q[fit.used])
    assert '2 of 40 stops contradict the others' in ' '.join(selection.notes)
    first, other = fit.targets
    np.testing.assert_allclose(other - first, [0.02, 0.01, 0.0], atol=2e-4)


@pytest.mark.parametrize(('change', 'words'), [
    (lambda t: t.replace('joint_4', 'jiont_4'), 'no values of the joint joint_4'),
    (lambda t: t.replace('degrees', 'rad'), 'degrees stated as radians'),
    (lambda t: t.replace(' [mm]', '', 1), 'names no unit'),
    (lambda t: t.replace('[mm]', '[m]'), 'all units'),
    (lambda t: '\n'.join(t.splitlines()[:8]), 'need at least'),
])
def test_bad_tables_are_refused_in_a_sentence(from_table, tmp_path, change, words):
    table = tmp_path / 'points.csv'
    table.write_text(change((from_table[2] / 'points.csv').read_text()))
    with pytest.raises(HandeyeError, match=words):
        solve_table(table, arm_of(bench.urdf(bench.SIX)), Config(), ())


def test_few_poses_do_not_make_an_error_less_certain_than_before():
    cell = bench.draw(bench.CASES['six'], 17, 2)
    arm = select_from_points([cell.data], cell.arm.with_errors_of(()), 1e-3).arm
    assert (np.sqrt(np.diag(arm.covariance)) < 1.2 * arm.prior_stds[arm.is_estimated]).all()


@pytest.mark.parametrize(('kinds', 'words'), [((), 'the URDF as it is'), ((OFFSET,), 'offset')])
def test_errors_that_an_arm_does_not_have_are_not_added(kinds, words):
    cell = bench.draw(bench.CASES['none'], 40, 4)
    arm = cell.arm.with_errors_of(kinds)
    arm = replace(arm, error_values=np.resize([1e-3, -2e-3, 1.5e-3], len(arm.error_values)))
    points = se3.apply(se3.inverse(arm.forward(cell.data.q) @ cell.X), cell.ball[None])[:, 0]
    noise = cell.data.points - cell.exact.points
    found = select_from_points([replace(cell.data, points=points + noise)],
                               cell.arm.with_errors_of(()), 1e-3)
    assert found.arm.estimated_kinds == kinds
    note, = found.notes
    assert note.endswith(f'stops no better than {words}: the simpler one is the answer')
    off = found.arm.error_values - arm.error_values
    assert (np.abs(off) < 4 * np.sqrt(np.diag(found.arm.covariance))).all()


@pytest.mark.parametrize(('joints', 'in_hand'), [
    (np.diag([1, 1, 1, 1, -1, 1]), True),
    pytest.param(np.eye(6), False, marks=pytest.mark.thorough)])
def test_joint_values_that_contradict_the_points_are_refused(from_table, joints, in_hand):
    cell, data = from_table[0], from_table[0].data
    with pytest.raises(HandeyeError, match='check that .* the sign of each .* calibration_type'):
        select_from_points([replace(data, q=data.q @ joints.T, in_hand=in_hand)],
                           cell.arm.with_errors_of(()), 1e-3)


@pytest.mark.parametrize(('urdf', 'flange', 'words'), [
    ('<robot name="a"><xacro:macro/></robot>', 'tip', 'xacro'),
    ('<robot', 'tip', 'no valid URDF'),
    (ODD.replace('<child link="camera"/>', '<child link="tip"/>'), 'tip', 'closed loops'),
    (ODD, 'tool9', '^the URDF has no link tool9'),
    (ODD, '', r'^the URDF ends in several links \(.*\): name the flange, as in --flange '),
    (ODD.replace('type="continuous"', 'type="floating"'), 'tip', 'floating'),
    (ODD.replace('<child link="c"/>', '<child link="c"/><mimic joint="j.b"/>'), 'tip', 'mimics'),
])
def test_bad_urdfs_are_refused_in_a_sentence(urdf, flange, words):
    with pytest.raises(HandeyeError, match=words):
        arm_of(urdf, flange=flange)


def test_a_former_arm_is_kept_with_its_calibration(from_table, tmp_path):
    names = ('kinematics.yaml', 'corrected.urdf', 'calibration.yaml')
    shutil.copytree(from_table[2] / 'out', tmp_path / 'out')
    former = {name: (tmp_path / 'out' / name).read_text() for name in names}
    lines = (from_table[2] / 'points.csv').read_text().splitlines()
    (tmp_path / 'points.csv').write_text('\n'.join(lines[:36]))
    words = succeeds('kinematics', 'points.csv', '--urdf', from_table[2] / 'arm.urdf', '--out',
                     'out', cwd=tmp_path).stdout
    kept, = (tmp_path / 'out/history').iterdir()
    assert {name: (kept / name).read_text() for name in names} == former
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {*names, 'history'}
    for folder in (kept, tmp_path / 'out'):
        arm, calibration = read_arm(folder), read_calibration(folder)
        stored = yaml.safe_load((folder / 'kinematics.yaml').read_text())['transform']
        np.testing.assert_allclose(se3.transform_from_values(stored), calibration.T_flange_sensor)
        assert len(arm.configurations) == calibration.quality.samples_used
    at = [words.index(f'out/{name}') for name in names]
    assert at == sorted(at), 'the calibration names the arm, so it is written after it'


@pytest.mark.parametrize(('change', 'words'), [
    (lambda arm: arm.pop('end'), 'it is no kinematics.yaml as'),
    (lambda arm: arm['joints'][1].pop('direction'), 'errors of joints or all configurations are'),
    (lambda arm: arm.update(configurations=[]), 'errors of joints or all configurations are'),
    (lambda arm: arm['joints'][0].update(follows='a'), 'or joints follow others, as in files of'),
    (lambda arm: arm['covariance'].pop(), 'it is no kinematics.yaml as'),
    (lambda arm: arm['joints'][1]['offset'].update(value=[math.nan]),
     r'joint_2\.offset\[0\] is nan, expected a finite number'),
    (lambda arm: arm['joints'][2].update(axis=[0, math.nan, 1]), r'joint_3\.axis\[1\] is nan'),
    (lambda arm: arm['joints'][2].update(lower=math.nan), 'a limit of a joint is no number'),
    (lambda arm: arm['covariance'][3].__setitem__(2, math.nan), r'covariance\[\d+\] is nan'),
    (lambda arm: arm['configurations'][4].__setitem__(1, math.inf), r'ions\[25\] is inf')])
def test_a_damaged_kinematics_file_is_refused(from_table, tmp_path, change, words):
    content = yaml.safe_load((from_table[2] / 'out/kinematics.yaml').read_text())
    change(content)
    (tmp_path / 'kinematics.yaml').write_text(yaml.dump(content))
    with pytest.raises(HandeyeError, match=words):
        read_arm(tmp_path)


def test_the_file_of_an_arm_without_errors_is_read(from_table, tmp_path):
    content = yaml.safe_load((from_table[2] / 'out/kinematics.yaml').read_text())
    joints = [{key: joint[key] for key in joint.keys() - set(KINDS)}
              for joint in content['joints']]
    (tmp_path / 'kinematics.yaml').write_text(yaml.dump(
        content | {'joints': joints, 'covariance': []}))
    assert read_arm(tmp_path).estimated_kinds == ()


def test_profiles_and_joint_states_of_a_bag_correct_the_arm(tmp_path):
    succeeds('kinematics', ROOT / 'bags/arm', '--urdf', ROOT / 'bags/arm/robot.urdf',
             '--set', 'target.type=sphere', '--out', 'out', cwd=tmp_path)
    out = tmp_path / 'out'
    arm, calibration = read_arm(out), read_calibration(out / 'calibration.yaml')
    assert calibration.quality.holdout_rms < 6e-5
    assert (calibration.parent_frame, arm.estimated_kinds) == ('flange', KINDS)
    assert calibration.quality.weakest_std == pytest.approx(
        se3.weakest_direction(calibration.covariance)[0])
    run = succeeds('solve', ROOT / 'bags/arm', '--set', 'target.type=sphere', '--kinematics',
                   'out/kinematics.yaml', '--budget', '--out', 'again', cwd=tmp_path)
    match = re.search(r'corrected arm .* ([\d.]+) %', run.stdout)
    assert match and float(match[1]) > 50, 'the arm is told apart from a station that is wrong'
    solved = read_calibration(tmp_path / 'again/calibration.yaml')
    np.testing.assert_allclose(solved.T_flange_sensor, calibration.T_flange_sensor, atol=2e-5)
    write_calibration(calibration_at(np.eye(4)), tmp_path / 'of_poses.yaml')
    run = handeye('seam', ROOT / 'bags/plate', '--calibration', 'of_poses.yaml', '--kinematics',
                  'out', cwd=tmp_path)
    assert_refused(run, 2, 'has no topic /joint_states')


@pytest.mark.thorough
def test_the_truth_of_a_corrected_arm_is_of_its_own_flange(tmp_path):
    for words in ('simulate small_arm cell --seed 962',
                  'kinematics cell --urdf cell/robot.urdf --set target.type=sphere --out arm',
                  'solve cell --set target.type=sphere --kinematics arm --out out'):
        run = succeeds(*words.split(), cwd=tmp_path)
    shown = ' '.join(run.stdout.split())
    assert re.search('poses of the corrected arm in .*; with those of the controller it is', shown)
    match = re.search(r'truth.yaml: translation ([\d.]+) mm', shown)
    assert match and float(match[1]) < 0.2, 'against the flange of the controller: 1.1 mm'
    truth = yaml.safe_load((tmp_path / 'cell/truth.yaml').read_text())
    T_true = se3.transform_from_values(truth['T_corrected_sensor'])
    for folder in ('arm', 'out'):
        calibration = read_calibration(tmp_path / folder / 'calibration.yaml')
        error = se3.difference(calibration.T_flange_sensor, T_true)
        assert error @ np.linalg.solve(calibration.covariance, error) < ONE_IN_1000


@pytest.fixture(scope='module')
def recorded():
    """Return the arm, the session and the joint values of the recording in bags/."""
    arm, config = read_urdf(ROOT / 'bags/arm/robot.urdf')[1], Config(
        target=TargetConfig(type='sphere'))
    recording = read_bag(ROOT / 'bags/arm', config, arm=arm)
    return arm, pipeline.gather(recording.profiles, recording.poses, config), recording, config


def every_other(source, first):
    return replace(source, samples=source.samples[first::2], q=source.q[first::2],
                   problem=source.problem.subset(np.arange(first, len(source.samples), 2)))


@pytest.mark.thorough
def test_two_recordings_give_one_answer(recorded):
    """Also with other axes of the profile: the features are those of its plane."""
    arm, session, recording, config = recorded
    config = replace(config, profile=replace(config.profile, axes=('y', 'z')))
    source = arm_samples_of(session, recording, arm, config)
    from_two, from_one = (solve_samples(parts, arm) for parts in (
        [every_other(source, 0), every_other(source, 1)], [source]))
    assert from_two.selection.arm.estimated_kinds == KINDS
    assert from_two.selection.chosen.left_out_rms < 6e-5
    assert from_two.calibration.quality.samples_used == len(source.samples)
    assert squared_error(from_two.calibration, from_one.calibration) < 6


@pytest.mark.thorough
def test_a_stop_of_a_recording_that_contradicts_the_others_is_told(recorded):
    arm, session, recording, config = recorded
    source = arm_samples_of(session, recording, arm, config)
    q = source.q.copy()
    q[4] += 0.1
    poses = mount_poses(arm.forward(q), source.problem.config)
    answer = solve_samples([replace(source, q=q, problem=replace(
        source.problem, poses=poses))], arm)
    assert '1 of 30 stops contradict the others' in ' '.join(answer.warnings)
    assert len(answer.selection.arm.configurations) == 29


def test_stops_without_joint_values_are_counted(recorded):
    arm, session, recording, config = recorded
    most = len(recording.poses) * 6 // 10
    recording = replace(recording, poses=recording.poses[:most], joints=recording.joints[:most])
    with pytest.raises(HandeyeError, match='11 of 30 samples have no joint values'):
        arm_samples_of(session, recording, arm, config)


@pytest.mark.parametrize(('setting', 'words'), [
    ('target.radius=30mm', 'radius of 40.0 mm, which does not fit the sphere of 30 mm'),
    ('target.type=plate', 'do not agree on where the edge is')])
def test_stops_that_do_not_show_the_stated_target_are_told(tmp_path, setting, words):
    run = handeye('kinematics', ROOT / 'bags/arm', '--urdf', ROOT / 'bags/arm/robot.urdf', '--set',
                  'target.type=sphere', '--set', setting, cwd=tmp_path)
    assert_refused(run, 3, '27 stops gave none' if 'plate' in setting else '30 stops', words)


def test_a_urdf_of_another_robot_is_refused(recorded):
    arm, session, recording, config = recorded
    longer = replace(arm, joints=tuple(replace(
        joint, origin=se3.transform(joint.origin[:3, :3], 1.1 * joint.origin[:3, 3]))
        for joint in arm.joints))
    with pytest.raises(HandeyeError, match='the URDF is of another robot'):
        solve_samples([arm_samples_of(session, recording, longer, config)], longer)


def test_a_solve_with_a_corrected_arm_carries_its_uncertainty(tmp_path):
    stated, rng, scenario = arm_of(simulated_arm.URDF), np.random.default_rng(1), SCENARIOS[
        'sphere']
    scenario = replace(scenario, stops=(30, 0), tilt=0.6, robot=replace(
        scenario.robot, geometry=1e-9, systematic=(0.0, 0.0)))
    samples, truth = simulate_samples(scenario, rng)
    real = np.array([stop.T_base_flange for stop in truth.stops])
    arm = replace(with_errors(stated, rng), configurations=simulated_arm.inverse(real))
    q = arm.inverse(real)
    np.testing.assert_allclose(arm.forward(q), real, atol=1e-9)
    config = Config(target=TargetConfig(type='sphere'), robot_effector_frame='flange')
    method = target_for(config)
    problem = Problem(method, stated.forward(q), method.observe(samples), config)
    measured = ArmSamples(Session(config), samples, problem, q)
    answer = solve_samples([measured], stated)
    answer.save(simulated_arm.URDF, tmp_path, ())
    corrected = [replace(s, T_base_flange=T) for s, T in zip(
        samples, read_arm(tmp_path).forward(q), strict=True)]
    config = replace(config, kinematics=str(tmp_path / 'kinematics.yaml'))
    calibration = pipeline.solve(corrected, (), config, 'laser')
    assert squared_error(calibration, truth) < ONE_IN_1000
    strict = replace(config, limits=replace(config.limits, translation=1e-6))
    with pytest.raises(DataError, match='most of that comes from the corrected arm'):
        pipeline.solve(corrected, (), strict, 'laser')
