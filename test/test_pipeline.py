# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whole recordings, simulated, to the calibration; wrong values at the public door."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from cells import Recorded, recorded, settings_of, squared_error
from handeye_ros import Config, gather, se3, solve
from handeye_ros.config import ProfileConfig, TargetConfig
from handeye_ros.data import Calibration, EdgePoint, Profile, Reject, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS, settings, simulate_samples
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
import pytest
from quick import long_run


@lru_cache
def recording(name: str, seed: int = 0) -> Recorded:
    return recorded(name, seed)


@lru_cache
def calibration_of(name: str, seed: int = 0) -> Calibration:
    return recording(name, seed).calibrate()


# -- accuracy


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'seeds'), [
    ('plate', 5), ('plate_in_order', 3), ('plate_5_5', 4)])
def test_points_are_mapped_as_well_as_asked_for(name: str, seeds: int) -> None:
    errors = [recording(name, seed).error(calibration_of(name, seed).T_flange_sensor)
              for seed in range(seeds)]
    assert np.median(errors) < 4e-5 and max(errors) < 9e-5


@pytest.mark.parametrize('name', [
    'plate_in_air', 'plate_z_up', 'eye_on_base', *long_run(
        'plate_clutter', 'plate_omit', 'bumped', 'plate_on_table', 'plate_resampled',
        'plate_reflections', 'plate_inf', 'plate_x_reversed', 'plate_y_along_line',
        'wrong_edges')])
def test_surroundings_drivers_and_mounts_change_nothing(name: str) -> None:
    simulated, calibration = recording(name), calibration_of(name)
    assert simulated.error(calibration.T_flange_sensor) < 9e-5
    assert squared_error(calibration, simulated.truth) < 24
    frames = ('base', 'laser') if name == 'eye_on_base' else ('flange', 'laser')
    assert (calibration.parent_frame, calibration.child_frame) == frames


def beside(height: float, gap: float, width: float) -> Scenario:
    """Return a plate beside which something stands."""
    return replace(SCENARIOS['plate'], target=PlateTarget(
        clutter=height, clutter_gap=gap, clutter_width=width))


@pytest.mark.parametrize(('scenario', 'rejected'), [
    (FAULTS['neighbour lower, 3 mm'], 0), (FAULTS['neighbour higher, 3 mm'], 0),
    *long_run((beside(0.001, 0.012, 0.06), 1), (beside(0.002, 0.008, 0.01), 1))])
def test_all_stations_take_the_same_of_two_surfaces(scenario: Scenario, rejected: int) -> None:
    simulated = recorded(scenario, rate=6.0)
    calibration = simulated.calibrate()
    assert calibration.quality.samples_rejected <= rejected
    assert simulated.error(calibration.T_flange_sensor) < 9e-5


@pytest.mark.parametrize(('name', 'where', 'fewest', 'worst'), [
    # the rim of a ball is biased in the simulation, as on the real recording
    ('sphere', 'eye_in_hand', 12, 4e-4), ('sphere of unknown radius', 'eye_in_hand', 12, 6e-4),
    ('plane', 'eye_in_hand', 14, 5e-4), ('wedge', 'eye_in_hand', 12, 3e-4), *long_run(
        ('sphere', 'eye_on_base', 12, 4e-4), ('plane', 'eye_on_base', 14, 5e-4),
        ('groove', 'eye_in_hand', 12, 3e-4))])
def test_other_targets_are_enough_too(name: str, where: str, fewest: int, worst: float) -> None:
    simulated = recorded(replace(SCENARIOS[name.split()[0]], calibration_type=where), 1)
    calibration = simulated.calibrate(**({'target__radius': 0.0} if 'unknown' in name else {}))
    assert calibration.quality.samples_used >= fewest
    assert simulated.error(calibration.T_flange_sensor) < worst
    assert squared_error(calibration, simulated.truth) < 36
    if 'face_angle' in (target := calibration.target):
        assert abs(target['face_angle'] - np.pi / 2) < 4 * target['face_angle_std']
    if 'radius' in target:
        assert target['radius'] == pytest.approx(0.04, abs=1e-4)


def test_the_place_of_the_target_is_found_up_to_the_names_of_its_edges() -> None:
    calibration, truth = calibration_of('plate'), recording('plate').truth.T_base_target
    pose = calibration.target['pose']
    corner = [pose['translation'][axis] for axis in 'xyz']
    assert np.linalg.norm(corner - truth[:3, 3]) < 2e-3
    T = se3.from_quaternion(np.array(corner), np.array([pose['rotation'][k] for k in 'xyzw']))
    assert T[:3, 2] @ truth[:3, 2] > 1 - 1e-4, 'z out of the face, towards the sensor'
    # the face lies where x and y are positive, so only one assignment of p and q is left
    assert T[:3, 0] @ truth[:3, 0] > 1 - 1e-4 and T[:3, 1] @ truth[:3, 1] > 1 - 1e-4
    labels = {s.start: s.label for s in recording('plate').truth.stops}
    for report in calibration.samples:
        start = max(start for start in labels if start <= report.stamp)
        assert report.edge == labels[start]


def test_the_edge_angle_can_be_left_free() -> None:
    simulated = recorded('plate', 2, target__edge_angle_free=True)
    calibration = simulated.calibrate()
    error = calibration.target['edge_angle'] - np.pi / 2
    assert abs(error) < 4 * calibration.target['edge_angle_std'] < 0.02
    assert simulated.error(calibration.T_flange_sensor) < 9e-5
    assert calibration_of('plate').target['edge_angle'] == pytest.approx(np.pi / 2, abs=2e-3)


# -- the report


def test_every_station_is_accounted_for() -> None:
    for name in ('plate', 'bumped', 'sphere'):
        calibration, simulated = calibration_of(name), recording(name)
        assert len(calibration.samples) == len(simulated.truth.stops)
        used = [r for r in calibration.samples if r.used]
        assert calibration.quality.samples_used == len(used)
        assert calibration.quality.samples_rejected == len(calibration.samples) - len(used)
        for report, stop in zip(calibration.samples, simulated.truth.stops, strict=True):
            assert stop.start <= report.stamp <= stop.end
            assert (report.residual is not None) == report.used
            assert report.used or report.reason
        rms = np.sqrt(np.mean([r.residual ** 2 for r in used]))
        assert calibration.quality.residual_rms == pytest.approx(rms, rel=0.3)
        assert calibration.quality.residual_rms < calibration.quality.holdout_rms < 3 * (
            calibration.quality.residual_rms)


def test_streams_may_be_generators_and_stay_as_they_are() -> None:
    simulated = recording('plate_5_5')
    for item in simulated.profiles:
        item.points.setflags(write=False)
    for pose in simulated.poses:
        pose.translation.setflags(write=False)
        pose.quaternion.setflags(write=False)
    calibration = simulated.calibrate(iter(simulated.profiles), iter(simulated.poses))
    assert np.array_equal(calibration.T_flange_sensor, calibration_of('plate_5_5').T_flange_sensor)


# -- what carries no answer


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'codes'), [
    ('no_target', 'edges settings'), ('nothing_in_sight', 'few')])
def test_what_shows_no_target_is_refused(name: str, codes: str) -> None:
    with pytest.raises(DataError) as caught:
        recorded(name, 0, rate=5.0, columns=640).calibrate()
    assert caught.value.code in codes.split() and caught.value.exit_code == 3


def in_motion(profiles, poses, spans):
    return profiles, [p for p in poses if not any(a <= p.stamp <= b for a, b in spans)]


def of_two_sensors(profiles, poses, spans):
    return [replace(p, frame_id='other') if i % 2 else p for i, p in enumerate(profiles)], poses


def in_millimetres(profiles, poses, spans):
    return [replace(p, points=p.points * 1e3) for p in profiles], poses


@pytest.mark.parametrize(('change', 'error', 'words'), [
    (lambda profiles, poses, spans: ([], poses), DataError, 'no profile has a stamp of'),
    (in_motion, DataError, 'never stood still .* be sent while it stands'),
    (in_millimetres, DataError, 'no straight piece .* check target.type'),
    (of_two_sensors, InputError, 'two frames')])
def test_streams_without_an_answer_are_refused(
        change: Callable[..., object], error: type[Exception], words: str) -> None:
    simulated = recording('plate_5_5')
    spans = [(s.start, s.end) for s in simulated.truth.stops]
    with pytest.raises(error, match=words):
        simulated.calibrate(*change(simulated.profiles, simulated.poses, spans))


@pytest.mark.parametrize('scene', ['plate', 'sphere'])
def test_profiles_without_any_noise_are_no_trouble(scene: str) -> None:
    perfect = {'noise': 0.0, 'rim_bias': 0.0, 'mixed': 0.0, 'lost': 0.0, 'lost_at_edge': 0.0,
               'outliers': 0.0}
    base = SCENARIOS[scene]
    quiet = replace(base, sensor=replace(base.sensor, **perfect),
                    robot=replace(base.robot, repeatability=(0.0, 0.0), jitter=0.0))
    believed = settings(base)
    simulated = recorded(quiet, 0, rate=5.0, **{key.replace('.', '__'): believed[key]
                                                for key in believed if key.startswith('noise')})
    calibration = simulated.calibrate()
    assert simulated.error(calibration.T_flange_sensor) < 2e-5


def test_order_of_points_and_points_in_the_origin_are_no_matter() -> None:
    simulated, rng = recorded('plate', 0, columns=640), np.random.default_rng(0)
    shuffled = [replace(p, points=rng.permutation(p.points)) for p in simulated.profiles]
    origin = [replace(p, points=np.where(np.isnan(p.points).any(axis=1)[:, None], 0.0, p.points))
              for p in simulated.profiles]
    assert any((profile.points == 0).all(axis=1).any() for profile in origin)
    expected, in_no_order, with_origin = map(
        simulated.calibrate, (simulated.profiles, shuffled, origin))
    assert np.array_equal(with_origin.T_flange_sensor, expected.T_flange_sensor)
    assert in_no_order.quality.samples_used == expected.quality.samples_used
    assert simulated.error(in_no_order.T_flange_sensor) < 1e-4


ORIGIN, NO_TURN = np.zeros(3), np.array([0.0, 0, 0, 1])


@pytest.mark.parametrize(('make', 'named'), [
    (lambda: TargetConfig(type='sphere', radius=-1), 'target.radius'),
    (lambda: Config(calibration_type='hand'), 'calibration_type'),
    (lambda: Config(target='sphere'), 'target'),
    (lambda: ProfileConfig(axes=('x', '-x')), 'profile.axes'),
    (lambda: Profile(1, 'laser', np.zeros((5, 3))), r'points of a profile is an array \(5, 3\)'),
    (lambda: Profile(1, 'laser', [[0.0, 0.1]]), 'points of a profile is a list'),
    (lambda: Profile(2.5, 'laser', np.zeros((5, 2))), 'stamp of a profile is 2.5'),
    (lambda: Profile(True, 'laser', np.zeros((5, 2))), 'stamp of a profile is True'),
    (lambda: Profile(1, None, np.zeros((5, 2))), 'frame_id of a profile: a NoneType, expected'),
    (lambda: TimedPose(2e-9, ORIGIN, NO_TURN), 'stamp of a pose is 2e-09'),
    (lambda: TimedPose(1, np.zeros(2), NO_TURN), r'translation of a pose is an array \(2,\)'),
    (lambda: TimedPose(1, [0, 0, 0], NO_TURN), 'translation of a pose is a list'),
    (lambda: TimedPose(1, np.array(['a'] * 3), NO_TURN), 'translation of a pose is an array'),
    (lambda: gather([], [TimedPose(1, ORIGIN * np.nan, NO_TURN)], Config()),
     'translation of a pose'),
    (lambda: gather([], [TimedPose(1, ORIGIN, 0 * NO_TURN)], Config()), 'quaternion of a pose'),
    (lambda: gather([TimedPose(1, ORIGIN, NO_TURN)], [], Config()), 'profiles: a TimedPose, expe'),
    (lambda: gather([], [np.eye(4)], Config()), r'poses: an array \(4, 4\) of float64, expected'),
    (lambda: gather(None, [], Config()), 'profiles: a NoneType, expected Iterable'),
    (lambda: gather([], [], {}), 'config: a dict, expected Config')])
def test_wrong_input_is_refused_by_name(make: Callable[[], object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        make()


def test_integers_of_numpy_are_stamps() -> None:
    assert TimedPose(np.int64(3), ORIGIN, NO_TURN).stamp == 3  # type: ignore[arg-type]


def test_samples_that_carry_no_answer_are_refused_as_such() -> None:
    config = settings_of(SCENARIOS['line'])
    samples, _ = simulate_samples(SCENARIOS['line'], np.random.default_rng(0))
    lost = replace(samples[3], T_base_flange=np.full((4, 4), np.nan))
    with pytest.raises(InputError, match=f'of the sample of stamp {samples[3].stamp} is no rigid'):
        solve([*samples[:3], lost, *samples[4:]], [], config, 'laser')
    turned = samples[3].T_base_flange * [1.01, 1.01, 1.01, 1.0]
    with pytest.raises(InputError, match='no rigid transform'):
        solve([*samples[:3], replace(samples[3], T_base_flange=turned)], [], config, 'laser')
    with pytest.raises(InputError, match='two samples have the same stamp'):
        solve([*samples, samples[0]], [], config, 'laser')
    excluded = [Reject(k, f'sample {k} is excluded by samples.exclude', final=True)
                for k in range(9)]
    with pytest.raises(DataError, match='excluded by samples.exclude.*: take more'):
        solve(samples[:3], excluded, config, 'laser')
    seen_in_the_middle = [replace(sample, features=tuple(
        replace(feature, point=feature.point * [0, 1]) if isinstance(feature, EdgePoint)
        else feature for feature in sample.features)) for sample in samples]
    with pytest.raises(DataError):
        solve(seen_in_the_middle, [], config, 'laser')


@pytest.mark.parametrize('slash', ['', '/'])
def test_the_frame_of_the_robot_is_none_of_the_profiles(slash: str) -> None:
    samples, _ = simulate_samples(SCENARIOS['plate'], np.random.default_rng(0))
    config = replace(settings_of(SCENARIOS['plate']), robot_effector_frame=f'{slash}flange')
    for frame_id in ('flange', '/flange'):
        with pytest.raises(DataError, match='robot_effector_frame is the same frame'):
            solve(samples, [], config, frame_id)
    with pytest.raises(DataError, match='both "base"'):
        solve(samples, [], replace(config, robot_effector_frame=f'{slash}base'), 'laser')
