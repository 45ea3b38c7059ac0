# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A robot that moves: where the flange was, and what single profiles give with the time offset."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
import math
import re
from typing import Any

from cells import ONE_IN_20, settings_of, squared_error
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, NS, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import blocks_at
from handeye_ros.estimation.problem import Estimate, linearise
from handeye_ros.results.truth import errors_against
from handeye_ros.sampling.interpolation import interpolate
from handeye_ros.sampling.stops import StopFinder
from handeye_ros.sampling.sweep import with_estimated_clocks
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.simulate import Scenario, SCENARIOS, simulate
from handeye_ros.simulate.scenario import Sweep
from handeye_ros.targets.plate import Plate
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from streams import pose, START


def true_motion(t: Array) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and twists (n, 6) of a smooth motion at times (n,)."""
    place = np.column_stack([0.1 * np.sin(2 * t), 0.05 * np.cos(3 * t), 0.3 + 0 * t])
    rate = np.column_stack([0.2 * np.cos(2 * t), -0.15 * np.sin(3 * t), 0 * t])
    axis = np.array([0.6, 0.0, 0.8])
    R = Rotation.from_rotvec(0.4 * np.sin(2.5 * t)[:, None] * axis).as_matrix()
    return se3.transform(R, place), np.column_stack([rate, np.cos(2.5 * t)[:, None] * axis])


def poses(times: Array, noise: float = 0.0, step: float = 0.0) -> list[TimedPose]:
    T, _ = true_motion(times)
    T = se3.perturb(T, np.random.default_rng(0).normal(size=(len(T), 6)) * noise)
    place = np.round(T[:, :3, 3] / step) * step if step else T[:, :3, 3]
    sign = np.where(np.arange(len(T)) % 7 < 3, 1.0, -1.0)  # q and -q are one rotation
    return [TimedPose(round(t * NS), p, q) for t, p, q in zip(
        times, place, se3.quaternion(T) * sign[:, None], strict=True)]


@pytest.mark.parametrize('rate', [30.0, 250.0])
def test_noisy_rounded_poses_are_averaged_to_the_true_motion(rate: float) -> None:
    trajectory = trajectory_of(poses(np.arange(0.0, 10.0, 1 / rate), 2e-5, 1e-4), 0.5)
    times = np.random.default_rng(1).uniform(0.1, 9.8, 200)
    stamps = np.rint(times * NS).astype(np.int64)
    at = trajectory.at(stamps)
    T, twists = true_motion(times)
    assert at.inside.all()
    distances = np.linalg.norm(at.T_base_flange[:, :3, 3] - T[:, :3, 3], axis=1)
    usual_std = np.median(trajectory.std(stamps)[:, 0])
    assert distances.max() < 1e-4 and np.sqrt((distances ** 2).mean() / 3) < 2 * usual_std
    assert np.abs(at.twists - twists).max() < 5e-3
    assert se3.angle(at.T_base_flange[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2)).max() < 6e-5


@pytest.mark.parametrize('seconds', [4.0, 30.0])
def test_rare_poses_of_a_slow_robot_state_their_errors(seconds: float) -> None:
    # two poses and a half a second of a motion that takes five times as long
    rare = [replace(pose, stamp=5 * pose.stamp)
            for pose in poses(np.arange(0.0, seconds / 5, 0.08), 2e-5)]
    trajectory = trajectory_of(rare, 0.5)
    times = np.linspace(0.1, seconds / 5 - 0.1, 200)
    stamps = np.rint(5 * times * NS).astype(np.int64)
    distances = np.linalg.norm(
        trajectory.at(stamps).T_base_flange[:, :3, 3] - true_motion(times)[0][:, :3, 3], axis=1)
    assert 2 * np.median(trajectory.std(stamps)[:, 0]) > np.sqrt((distances ** 2).mean() / 3)


def test_no_pose_is_reported_outside_of_the_poses_or_in_a_gap() -> None:
    times = np.arange(0.0, 10.0, 0.01)
    trajectory = trajectory_of(poses(times[(times < 4.0) | (times > 4.5)]), 0.5)
    at = trajectory.at(np.array([-0.1, 0.0, 3.9, 4.2, 4.6, 9.98, 10.1]) * NS)
    assert at.inside.tolist() == [False, True, True, False, True, True, False]
    assert np.isfinite(at.T_base_flange).all()
    near_an_end = trajectory.at(np.array([4.02, 4.5]) * NS - np.array([0, NS // 100]))
    expected, _ = true_motion(np.array([4.0, 4.5]))
    error = near_an_end.T_base_flange[:, :3, 3] - expected[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.01 and not near_an_end.inside.any()


def test_a_rest_during_a_sweep_is_one_pass() -> None:
    times = np.arange(0.0, 4.0, 0.01)
    rest = [replace(pose, stamp=pose.stamp + round(later * NS)) for later in np.arange(1, 9, 0.01)
            for pose in poses(times[-1:])]
    second_pass = [replace(pose, stamp=pose.stamp + 13 * NS) for pose in poses(times)]
    finder = StopFinder(with_values(Config(), {'sampling.mode': 'moving'}, 'a test').sampling)
    ended = [finder.add(pose) for pose in [*poses(times), *rest, *second_pass]]
    spans = [(stop.start / NS, stop.end / NS) for stop in ended if stop]
    assert [end - start > 3.0 for start, end in spans].count(True) == 1
    assert len(spans) == 4


def sweep(target: str, offset: float, **values: object) -> Scenario:
    base = SCENARIOS[target]
    two_edges = base.scene == 'plate'
    return replace(base, stops=(8, 8) if two_edges else (16, 0),
                   tilt=math.radians(24 if target == 'wedge' else 20),  # the light is lost
                   sensor=replace(base.sensor, columns=320, delay=-offset),
                   sweep=Sweep(**{'knot': 1.2} | values))  # type: ignore[arg-type]


def config_of(scenario: Scenario, **values: object) -> Config:
    return settings_of(scenario, sampling__mode='moving', **values)


@pytest.mark.parametrize(('target', 'offset', 'kind'), [
    ('sphere', -0.035, 'eye_on_base'),
    *(pytest.param(*values, 'eye_in_hand', marks=pytest.mark.thorough)
      for values in (('wedge', 0.15), ('line', 0.02), ('plane', 0.0), ('plate', 0.3)))])
def test_a_sweep_gives_transform_and_time_offset(target: str, offset: float, kind: str) -> None:
    scenario = replace(sweep(target, offset), calibration_type=kind)
    recording = simulate(scenario, np.random.default_rng(3))
    config = config_of(scenario, time_offset=0.01)  # of the whole that is to be found
    profiles = [replace(p, stamp=p.stamp + config.offset_ns) for p in recording.profiles]
    calibration = pipeline.calibrate(profiles, recording.poses, config)
    errors = errors_against(calibration.T_flange_sensor, recording.truth.T_flange_sensor)
    assert errors.mapped_points < 6e-5
    assert calibration.time_offset is not None
    offset_error = calibration.time_offset.value - offset
    assert abs(offset_error) < 2e-4 and abs(offset_error) < 4 * calibration.time_offset.std < 1e-3


@pytest.mark.thorough
def test_clocks_that_drift_apart_are_no_move_of_the_sensor() -> None:
    scenario, drift = sweep('plate', 0.02), 5e-3 / 30  # 10 ms a minute
    recording = simulate(scenario, np.random.default_rng(0))
    t_0, t_1 = (recording.profiles[k].stamp for k in (0, -1))
    late = [replace(p, stamp=p.stamp + round(drift * (p.stamp - t_0))) for p in recording.profiles]
    calibration = pipeline.calibrate(late, recording.poses, config_of(scenario))
    assert squared_error(calibration, recording.truth) < 15
    target = calibration.target
    assert abs(target['clock_drift'] + drift) < 4 * target['clock_drift_std'] < 1e-4
    match = re.search(r'drift apart by (-[\d.]+) ms a minute', target['note'])
    assert match and float(match[1]) == pytest.approx(-10.0, abs=1.0)
    in_the_middle = 0.02 - drift * (t_1 - t_0) / 2 / NS
    assert calibration.time_offset.value == pytest.approx(in_the_middle, abs=3e-4)
    assert 'moved' not in ' '.join(calibration.provenance.get('warnings', ()))


@pytest.mark.thorough
def test_a_wrong_radius_in_a_sweep_is_told_as_configured() -> None:
    scenario = sweep('sphere', 0.02)
    recording = simulate(scenario, np.random.default_rng(3))
    wrong = config_of(scenario, target__radius=0.0406, target__radius_std=1e-4)
    calibration = pipeline.calibrate(recording.profiles, recording.poses, wrong)
    assert 'not the configured 40.600:' in calibration.target['note']


@pytest.mark.thorough
def test_what_jumps_in_the_middle_of_a_sweep_is_named() -> None:
    scenario = sweep('plane', 0.02)
    recording, config = simulate(scenario, np.random.default_rng(1)), config_of(scenario)
    middle = (recording.poses[0].stamp + recording.poses[-1].stamp) // 2
    late = [replace(p, stamp=p.stamp + (NS // 20 if p.stamp > middle else 0))
            for p in recording.profiles]
    with pytest.raises(DataError, match='one of them jumped') as caught:
        pipeline.calibrate(late, recording.poses, config)
    assert caught.value.code == 'clocks_differ'
    shift = np.array([0.6e-3, 0.48e-3, 0.64e-3])
    moved = [replace(p, translation=p.translation + (p.stamp > middle) * shift)
             for p in recording.poses if abs(p.stamp - middle) > 0.4 * NS]
    with pytest.raises(DataError) as caught:
        pipeline.calibrate(recording.profiles, moved, config)
    assert caught.value.code == 'moved'


@pytest.mark.thorough
@pytest.mark.parametrize('name', ['small_plate_sweep', 'sphere_sweep'])
def test_a_sensor_that_slips_is_no_scale_and_no_error_of_the_robot(name: str) -> None:
    scenario, rng = SCENARIOS[name], np.random.default_rng(1)
    recording, direction = simulate(scenario, rng), rng.normal(size=3)
    slip = recording.truth.T_flange_sensor[:3, :3] @ direction / np.linalg.norm(direction) * 1e-3
    middle = (recording.poses[0].stamp + recording.poses[-1].stamp) // 2
    # the flange reported is that from which a sensor that had not slipped would see the same
    poses = [replace(p, translation=p.translation - (p.stamp > middle)
                     * Rotation.from_quat(p.quaternion).apply(slip)) for p in recording.poses]
    config = config_of(scenario)
    answer = pipeline.answer_session(pipeline.gather(recording.profiles, poses, config), config)
    sentence = str(answer.refusal) if answer.refusal else ' '.join(
        answer.calibration.provenance['warnings'])
    assert 'the sensor seems to have moved' in sentence and 'length' not in sentence


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [0, 4])
def test_a_robot_that_drifts_makes_the_answer_less_certain(seed: int) -> None:
    scenario = SCENARIOS['sphere_sweep']
    assert scenario.sweep is not None
    drifting = replace(scenario, sweep=replace(scenario.sweep, drift=(1e-4, 3e-4)))
    recording = simulate(drifting, np.random.default_rng(seed))
    calibration = pipeline.calibrate(recording.profiles, recording.poses, config_of(drifting))
    assert squared_error(calibration, recording.truth) < ONE_IN_20
    offset, true_offset = calibration.time_offset, recording.truth.time_offset
    assert offset is not None and true_offset is not None
    assert abs(offset.value - true_offset) < 1.96 * offset.std


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'fault'), [
    ('plate_sweep', 'times jump'), ('line_sweep', 'times jump'),
    ('plate_sweep', 'points are taken one after the other')])
def test_what_is_wrong_with_times_is_no_move(name: str, fault: str) -> None:
    scenario = SCENARIOS[name]
    recording = simulate(scenario, np.random.default_rng(2))
    profiles, poses = recording.profiles, recording.poses
    if fault == 'times jump':
        last = poses[int(0.9 * len(poses))].stamp
        poses = [replace(p, stamp=p.stamp + (15_000_000 if p.stamp > last else 0)) for p in poses]
    else:
        middle = len(profiles[0].points) // 2
        profiles = [replace(p, points=np.concatenate([p.points[:middle], later.points[middle:]]))
                    for p, later in pairwise(profiles)]
    calibration = pipeline.calibrate(profiles, poses, config_of(scenario))
    assert 'moved' not in ' '.join(calibration.provenance.get('warnings', ()))


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [1, 2])
def test_an_error_of_the_robot_that_is_smooth_in_time_is_no_move(seed: int) -> None:
    scenario, rng = SCENARIOS['small_plate_sweep'], np.random.default_rng(100 + seed)
    recording = simulate(scenario, np.random.default_rng(seed))
    seconds = (np.array([p.stamp for p in recording.poses]) - recording.poses[0].stamp) * 1e-9
    knots = np.arange(0.0, seconds[-1] + 20.0, 6.0)
    errors = CubicSpline(knots, rng.normal(0.0, 3e-5, (len(knots), 3)))(seconds)
    poses = [replace(pose, translation=pose.translation + error)
             for pose, error in zip(recording.poses, errors, strict=True)]
    calibration = pipeline.calibrate(recording.profiles, poses, config_of(scenario))
    assert squared_error(calibration, recording.truth) < 15
    assert 'moved' not in ' '.join(calibration.provenance.get('warnings', ()))


@pytest.mark.thorough
def test_a_start_at_another_plate_is_not_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start is found with few edges, among which ends of other objects may agree."""
    starts, aside = Plate.starts, iter([0.04])  # m, of the first one

    def first_aside(self: Plate, *problem: Any) -> Iterator[Estimate]:
        for start in starts(self, *problem):
            T = start.T_base_target.copy()
            T[:3, 3] += next(aside, 0.0) * T[:3, 0]
            yield replace(start, state=np.append(T, start.state[16:]))
    monkeypatch.setattr(Plate, 'starts', first_aside)
    scenario = sweep('plate', 0.02)
    recording = simulate(scenario, np.random.default_rng(0))
    calibration = pipeline.calibrate(recording.profiles, recording.poses, config_of(scenario))
    assert squared_error(calibration, recording.truth) < 15
    assert next(aside, None) is None, 'the first start was aside'


@pytest.mark.thorough
def test_profiles_in_gaps_between_the_poses_do_not_pull_the_time_offset() -> None:
    recording = simulate(sweep('sphere', 0.02), np.random.default_rng(0))
    t_0, cuts = recording.poses[0].stamp, np.cumsum(np.random.default_rng(100).uniform(0.8, 2, 40))
    poses = [p for p in recording.poses if not ((0 <= (p.stamp - t_0) / NS - cuts)
                                                & ((p.stamp - t_0) / NS - cuts < 0.2)).any()]
    config = config_of(recording.scenario)
    samples = pipeline.gather(recording.profiles, poses, config).samples
    timed = with_estimated_clocks(samples, config)
    assert 10 < len(timed.rejects) < 0.2 * len(timed.samples)
    assert abs(timed.samples[0].clock_values.offset - 0.02) < 5e-4
    calibration = pipeline.calibrate(recording.profiles, poses, config)
    delta = se3.difference(calibration.T_flange_sensor, recording.truth.T_flange_sensor)
    assert np.linalg.norm(delta[:3]) < 5e-5
    assert calibration.quality.weakest_std < 1e-4


def test_a_late_rotation_and_an_exposure_are_part_of_the_model() -> None:
    scenario = sweep('plate', 0.02, rotation_lag=0.01, exposure=2e-3)
    recording = simulate(scenario, np.random.default_rng(4))
    calibration = pipeline.calibrate(recording.profiles, recording.poses,
                                     config_of(scenario, profile__exposure=2e-3))
    errors = errors_against(calibration.T_flange_sensor, recording.truth.T_flange_sensor)
    assert errors.mapped_points < 8e-5
    assert calibration.time_offset is not None and abs(calibration.time_offset.value - 0.02) < 2e-4
    lag, std = (calibration.target[key] for key in ('rotation_lag', 'rotation_lag_std'))
    assert abs(lag - 0.01) < 4 * std < 1e-3


def test_an_exposure_is_allowed_for_whatever_the_set_back_of_faces() -> None:
    scenario = sweep('plate', 0.02, exposure=2e-3)
    recording = simulate(scenario, np.random.default_rng(4))
    config = config_of(scenario, profile__exposure=2e-3, target__setback_std=0.0)
    timed = with_estimated_clocks(
        pipeline.gather(recording.profiles, recording.poses, config).samples, config)
    blocks = blocks_at(linearise(timed.problem, timed.estimate))
    assert 'exposure' in [block.name for block in blocks]


@pytest.mark.thorough
def test_edges_that_a_long_exposure_shifts_are_no_scale() -> None:
    scenario = sweep('plate', 0.02, exposure=0.02)
    recording = simulate(scenario, np.random.default_rng(2))
    exposed, instant = (config_of(scenario, profile__exposure=time) for time in (0.02, 0.0))
    calibration = pipeline.calibrate(recording.profiles, recording.poses, exposed)
    assert squared_error(calibration, recording.truth) < ONE_IN_20
    with pytest.raises(DataError, match='lengths of robot and sensor differ'):
        pipeline.calibrate(recording.profiles, recording.poses, instant)


@pytest.mark.thorough
def test_jitter_of_the_stamps_is_noise_along_the_path() -> None:
    scenario = sweep('sphere', 0.02, stamp_jitter=1e-3)
    recording = simulate(scenario, np.random.default_rng(4))
    along_path, isotropic = (pipeline.calibrate(recording.profiles, recording.poses, config_of(
        scenario, clock_drift_std=0.0, **stamps)) for stamps in ({}, {'noise__stamps': 0.0}))
    assert along_path.time_offset is not None and isotropic.time_offset is not None
    assert abs(along_path.time_offset.value - 0.02) < 3 * along_path.time_offset.std
    # the fastest profiles, which say most of the offset, have most of this noise
    assert along_path.time_offset.std > 1.2 * isotropic.time_offset.std
    assert along_path.quality.weakest_std < isotropic.quality.weakest_std


@given(st.integers(0, 1000), st.floats(0, 1))
def test_poses_between_are_linear_and_on_the_great_circle(seed: int, at: float) -> None:
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.integers(1, 50, 6)) * 1_000_000  # of milliseconds
    quaternions = rng.normal(size=4) + 0.3 * rng.normal(size=(6, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    poses = [TimedPose(int(s), rng.normal(size=3), q) for s, q in
             zip(stamps, quaternions, strict=True)]
    stamp = poses[0].stamp + round(at * (poses[-1].stamp - poses[0].stamp))
    k = min(max(sum(p.stamp <= stamp for p in poses) - 1, 0), len(poses) - 2)
    a, b = poses[k], poses[k + 1]
    share = (stamp - a.stamp) / (b.stamp - a.stamp)
    translation = (1 - share) * a.translation + share * b.translation
    first, second = (Rotation.from_quat(pose.quaternion) for pose in (a, b))
    turned = first * Rotation.from_rotvec(share * (first.inv() * second).as_rotvec())
    expected = se3.transform(turned.as_matrix(), translation)
    assert np.allclose(interpolate(poses, [stamp])[0], expected, atol=1e-6)


def test_stamps_of_this_century_keep_their_nanoseconds() -> None:
    a, b = pose(0.0), pose(1.0, x=1.0)
    at = [a.stamp + 1, a.stamp + 500_000_001]
    assert np.allclose(interpolate([a, b], at)[:, 0, 3], [1e-9, 0.500000001], atol=1e-15, rtol=0)


def test_a_sweep_too_short_or_without_poses_is_refused() -> None:
    recording = simulate(sweep('wedge', 0.02), np.random.default_rng(0))
    config = config_of(recording.scenario, time_offset_std=0.1)
    first = recording.poses[0].stamp + 4 * NS
    # with quaternions of another order the best offset is beyond the poses
    for seconds, words in (1.1, 'of 32 profiles have poses'), (0.8, 'of 0.8 s.* a longer sweep'):
        within = [pose for pose in recording.poses if 0 <= pose.stamp - first <= seconds * NS]
        few_poses = [replace(within[i], quaternion=np.roll(within[i].quaternion, 1))
                     for i in np.linspace(0, len(within) - 1, 10).astype(int)]
        profiles = [p for p in recording.profiles if 0 <= p.stamp - first <= seconds * NS]
        with pytest.raises(DataError, match=words):
            pipeline.calibrate(profiles, few_poses, config)
