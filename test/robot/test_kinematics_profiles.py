# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from profiles: bags, several recordings, contradictions."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from command import handeye
from handeye_ros import pipeline, se3
from handeye_ros.arm import Arm, chain_of, GEOMETRY, parameters, read_arm, read_chain
from handeye_ros.bags import bag
from handeye_ros.config import Config, TargetConfig
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import in_mount
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.robot import profiles
from handeye_ros.robot.estimate import State
from handeye_ros.robot.sources import of_recording, outcome_of, solve_sources, Source
from handeye_ros.simulate import arm as simulated_arm
from handeye_ros.simulate import SCENARIOS, simulate_samples
from handeye_ros.targets import method_for
import numpy as np
import pytest

pinocchio = pytest.importorskip('pinocchio', reason='needs pinocchio')

ROOT = Path(__file__).parents[2]


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
    chain = read_chain(ROOT / 'bags/arm/robot.urdf')[1]
    config = Config(target=TargetConfig(type='sphere'))
    found = bag.read(ROOT / 'bags/arm', config, arm=Arm(chain))
    return chain, of_recording(found, (), chain, config)


def test_two_recordings_give_one_answer(source):
    chain, whole = source
    parts = [replace(whole, samples=whole.samples[k::2], recording=None) for k in (0, 1)]
    both = outcome_of(parts, chain)
    assert both.chosen.kinds == GEOMETRY and both.chosen.left_out_rms < 6e-5
    one = outcome_of([whole], chain)
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
        outcome_of([change(whole)], chain)


def test_a_urdf_of_another_robot_is_refused(source):
    chain, whole = source
    longer = replace(chain, joints=tuple(replace(
        joint, origin=se3.transform(joint.origin[:3, :3], 1.1 * joint.origin[:3, 3]))
        for joint in chain.joints))
    with pytest.raises(HandeyeError, match='the URDF is of another robot'):
        outcome_of([whole], longer)


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
    problem = Problem(method, in_mount(T, config), method.observe(samples), config)
    data = profiles.Profiles(np.vstack([q, q]), (problem, problem), (4, 4), np.arange(2 * len(q)))
    state = State(np.eye(4), np.array([0.1, 0.2, 0.3, 0.02, 0.2, -0.1, 0.4, 0.02]),
                  Arm(chain, own, np.zeros(len(own))), np.zeros((1, 3)))
    root = rng.normal(size=(len(data), 1))
    J = data.linearised(state, root)[1]
    for k, step in enumerate(1e-6 * np.eye(J.shape[1])):
        r = [data.linearised(data.retracted(state, s * step), root)[0] for s in (1, -1)]
        np.testing.assert_allclose(J[:, k], (r[0] - r[1]) / 2e-6, atol=1e-5)


def test_a_solve_with_a_corrected_arm_is_as_uncertain_as_the_arm_makes_it(tmp_path):
    chain, squares = chain_of(simulated_arm.urdf()), []
    own = parameters(chain, GEOMETRY)
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        scenario = SCENARIOS['sphere']
        scenario = replace(scenario, stations=(30, 0), tilt=0.6, robot=replace(
            scenario.robot, geometry=1e-9, systematic=(0.0, 0.0)))
        samples, truth = simulate_samples(scenario, rng)
        real = np.array([station.T_base_flange for station in truth.stations])
        near = simulated_arm.inverse(real)
        arm = Arm(chain, own, rng.normal(size=len(own)) * [p.prior for p in own],
                  configurations=near)
        q = arm.joints_near(real)
        np.testing.assert_allclose(arm.forward(q), real, atol=1e-9)
        config = Config(target=TargetConfig(type='sphere'), robot_effector_frame='flange')
        stated = [replace(s, T_base_flange=T)
                  for s, T in zip(samples, chain.forward(q), strict=True)]
        stamps = np.array([s.stamp for s in stated])
        answer = solve_sources([Source(stated, (), 'laser', config, stamps, q)], chain)
        answer.save(simulated_arm.urdf(), tmp_path, ())
        T = read_arm(tmp_path).forward(q)
        corrected = [replace(s, T_base_flange=pose) for s, pose in zip(stated, T, strict=True)]
        found = pipeline.solve(corrected, (), replace(
            config, kinematics=str(tmp_path / 'kinematics.yaml')), 'laser')
        away = se3.difference(found.T_flange_sensor, truth.T_flange_sensor)
        squares.append(away @ np.linalg.solve(found.covariance, away))
    assert sum(squares) < 33  # chi-squared of 12 degrees of freedom
