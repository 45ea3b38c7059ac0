"""A running session without ROS: what it keeps, tells, and does when settings change."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cells import recorded
from handeye_ros import pipeline, se3
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.config import Config, with_values
from handeye_ros.data import TimedPose
from handeye_ros.errors import DataError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.state import samples_message, status_message
from handeye_ros.node.status import state_of
from handeye_ros.simulate import SCENARIOS, settings, simulate
from handeye_ros.simulate.measuring import rendered
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.stations import lift, Stops
from live_sessions import changed, fed, feed, SPHERE
import numpy as np
import pytest


def test_the_answer_is_that_of_the_recording() -> None:
    live = fed()
    found, text = live.answer.compute()
    offline = pipeline.calibrate(SPHERE.profiles, SPHERE.poses, SPHERE.config)
    assert np.array_equal(found.T_flange_sensor, offline.T_flange_sensor)
    assert found.samples == offline.samples
    state = state_of(live)
    assert state.calibration.state == 'current' and state.calibration.text == text
    assert state.calibration.translation == tuple(offline.T_flange_sensor[:3, 3])


@pytest.mark.thorough
def test_a_robot_that_moves_gives_passes_and_the_answer_of_the_recording(tmp_path: Path) -> None:
    made = simulate(SCENARIOS['small_plate_sweep'], np.random.default_rng(3))
    config = with_values(Config(), settings(made.scenario) | {
        'sampling.mode': 'moving', 'output_dir': str(tmp_path)}, 'a test')
    live = fed(config, made)
    found, _ = live.answer.compute()
    offline = pipeline.calibrate(made.profiles, made.poses, config)
    assert np.allclose(found.T_flange_sensor, offline.T_flange_sensor, atol=1e-9)
    assert found.time_offset is not None and abs(found.time_offset.value - 0.02) < 3e-4
    outcomes = live.streams.copied().outcomes
    assert len(outcomes) > 10 and sum(o.sample is not None for o in outcomes) > 10


def test_from_three_samples_on_each_has_its_residuals() -> None:
    live, result = LiveSession(SPHERE.config, OutputFolders()), []
    items = sorted([*SPHERE.poses, *SPHERE.profiles], key=lambda item: item.stamp)
    for item in items:
        (live.add_poses([item]) if isinstance(item, TimedPose) else live.add_profile(item))
        if len(live.copied().outcomes) > len(result):
            raise AssertionError('a message is never judged by who brings it')
        if live.streams.waiting:
            live.update()
            result.append(state_of(live))
    for n, state in enumerate(result, 1):
        assert len(state.samples) == n
        with_residual = [s.number for s in state.samples if s.left_out is not None]
        assert bool(with_residual) == (n >= 3), state.review
        assert sorted(state.worst) == with_residual
        assert (state.review == '') == (n >= 3)


def spoilt(number: int):
    """Return the recording with one stop whose poses are 5 mm off."""
    live = fed()
    began = live.copied().outcomes[number - 1].stop.began
    after = [o.stop.began for o in live.copied().outcomes if o.stop.began > began]
    until = min(after, default=2**62)
    poses = [replace(p, translation=p.translation + [0.0, 5e-3, 0.0])
             if began <= p.stamp < until else p for p in SPHERE.poses]
    return replace(SPHERE, poses=tuple(poses))


def test_the_worst_sample_comes_first_and_leaves_and_comes_back() -> None:
    live = fed(recording=spoilt(4))
    state = state_of(live)
    worst = {s.number: s for s in state.samples}[state.worst[0]]
    others = [s.left_out for s in state.samples if s.left_out and s.number != 4]
    assert worst.number == 4 and worst.left_out > 3 * max(others)
    live.answer.compute()
    changed(live, samples__exclude=[4])
    state = state_of(live)
    assert [s.number for s in state.samples if s.excluded] == [4]
    assert state.calibration.state == 'current', 'it was solved again'
    assert any('left out by samples.exclude' in r.reason for r in live.calibration.samples)
    assert state.worst[0] == 4, 'what is left out is still compared with the rest'
    without = live.calibration.T_flange_sensor
    changed(live, samples__exclude=[])
    assert not any(s.excluded for s in state_of(live).samples)
    assert not np.array_equal(live.calibration.T_flange_sensor, without)


def test_offline_the_same_number_leaves_the_same_sample_out() -> None:
    live = fed()
    changed(live, samples__exclude=[2, 5])
    found, _ = live.answer.compute()
    offline = pipeline.calibrate(
        SPHERE.profiles, SPHERE.poses,
        with_values(SPHERE.config, {'samples.exclude': [2, 5]}, 'test'))
    assert np.array_equal(found.T_flange_sensor, offline.T_flange_sensor)
    assert found.samples == offline.samples and found.quality.samples_rejected == 2


@pytest.mark.parametrize(('key', 'value'), [
    ('noise__robot_translation', 1e-3), ('limits__rotation', 1e-6), ('noise__sensor', 1e-4),
    ('target__radius', 0.0)])
def test_settings_that_change_need_no_new_samples(key: str, value: object) -> None:
    live = fed()
    live.answer.compute()
    changed(live, **{key: value})
    config = with_values(SPHERE.config, {key.replace('__', '.'): value}, 'test')
    try:
        expected = pipeline.calibrate(SPHERE.profiles, SPHERE.poses, config)
    except DataError as error:
        state = state_of(live).calibration
        assert state.state == 'withdrawn' and str(error) in state.text
        assert 'is not the answer' in state.text and live.calibration is None
        changed(live, limits__rotation=2e-2)
        assert state_of(live).calibration.state == 'current', 'and back'
    else:
        assert np.array_equal(live.calibration.T_flange_sensor, expected.T_flange_sensor)


def test_what_changes_extraction_extracts_anew() -> None:
    live = fed()
    taken = state_of(live).taken
    changed(live, sampling__min_points=5000)
    assert state_of(live).taken == 0
    assert all('5000' in s.text or s.text for s in state_of(live).samples)
    changed(live, sampling__min_points=20)
    assert state_of(live).taken == taken
    again, first = (session.answer.compute()[0] for session in (live, fed()))
    assert np.array_equal(again.T_flange_sensor, first.T_flange_sensor)


def test_a_laser_almost_along_an_edge_is_reported_with_the_angle_and_by_hand_refused() -> None:
    plate = recorded('plate')
    live = fed(plate.config, plate)
    taken = len(live.copied().outcomes)
    # another stop of the same cell, turned about the range axis in the edge's point
    scenario = replace(plate.scenario, stations=(1, 0))
    stop = SCENES['plate'].stops(scenario, np.random.default_rng(1))
    turn, point = se3.exp_rotation(np.array([0.0, 0.0, np.deg2rad(74)])), lift(stop.points)[0]
    T = stop.T_target_sensor[0]
    T = T @ se3.transform(turn, point - turn @ point)
    flat = rendered(scenario, plate.truth.T_flange_sensor, plate.truth.T_base_target,
                    Stops(T[None], stop.labels, stop.points), np.random.default_rng(2), 1000.0)
    changed(live, sampling__mode='manual')
    feed(live, [*flat.poses, *flat.profiles])
    with pytest.raises(DataError, match=r'crosses p at \d+ degrees, less than sampling.m'):
        live.samples.take()
    assert not state_of(live).attempt.accepted
    live.update()  # that no pose near it is advised again
    assert [T.tolist() for T in live.reviewer._refused()] == [
        live.streams.session.current_stop().pose(live.config).tolist()]
    changed(live, sampling__mode='still')
    live.answer.compute()  # for which the stop that the robot stands in is over
    assert len(live.copied().outcomes) == taken + 1 and live.copied().outcomes[-1].sample
    assert 'cannot count: turn the tool about the range axis' in state_of(live).attempt.text


def test_numbers_are_never_given_twice() -> None:
    live = fed()
    live.answer.compute()  # which takes the stop that the robot stands in
    numbers = [s.number for s in state_of(live).samples]
    assert numbers == list(range(1, len(numbers) + 1))
    assert f'removed sample {numbers[-1]}' in live.samples.remove_last()
    later = [replace(item, stamp=item.stamp + 10**12)
             for item in (*SPHERE.poses, *SPHERE.profiles)]
    feed(live, later)
    assert state_of(live).samples[len(numbers) - 1].number == numbers[-1] + 1


def test_another_setting_takes_no_sample_of_where_the_robot_stands() -> None:
    live = fed()
    live.answer.compute()
    count = len(live.copied().outcomes)
    shifted = [replace(item, stamp=item.stamp + 10**12)
               for item in (*SPHERE.poses, *SPHERE.profiles)]
    begun = shifted[0].stamp + 8 * 10**8  # not long enough to be judged by itself
    feed(live, [item for item in shifted if item.stamp <= begun])  # it stands in another stop
    before = live.calibration
    changed(live, noise__sensor=2 * live.config.noise.sensor)
    assert live.calibration is not before and len(live.copied().outcomes) == count
    live.answer.compute()
    assert len(live.copied().outcomes) == count + 1


def test_the_first_answer_that_is_refused_is_reported_with_the_reason() -> None:
    live = fed(with_values(SPHERE.config, {'limits.rotation': 1e-6}, 'test'))
    with pytest.raises(DataError) as error:
        live.answer.compute()
    state = state_of(live).calibration
    assert state.state == 'none' and str(error.value) in state.text


def test_cleared_and_refused_answers_are_withdrawn() -> None:
    live = fed()
    assert state_of(live).calibration.state == 'none'
    live.answer.compute()
    live.samples.remove_last()
    assert state_of(live).calibration.state == 'outdated'
    live.clear_samples()
    state = state_of(live).calibration
    assert (state.state, state.translation) == ('withdrawn', None)
    assert 'cleared' in state.text and 'is not the answer' in state.text
    with pytest.raises(DataError):
        live.answer.compute()
    assert state_of(live).calibration.state == 'withdrawn'


def test_what_was_saved_is_reported_until_there_is_another_answer(tmp_path: Path) -> None:
    live = fed(replace(SPHERE.config, output_dir=str(tmp_path)))
    live.answer.compute()
    assert state_of(live).calibration.saved == ''
    live.answer.save()
    assert state_of(live).calibration.saved == str(tmp_path / 'sphere' / 'calibration.yaml')
    live.answer.compute()
    assert state_of(live).calibration.saved == ''


def test_the_advice_says_of_which_sample_it_knows() -> None:
    live = fed()
    last = len(live.copied().outcomes)
    result = state_of(live).guidance
    assert result.sample == last and result.text.startswith(f'after sample {last}: ')
    live.samples.remove_last()
    assert state_of(live).guidance.sample == last, 'until it is advised anew'
    live.update()
    assert state_of(live).guidance.sample == last - 1


def test_nobody_asked_for_a_sample() -> None:
    manual = with_values(SPHERE.config, {'sampling.mode': 'manual'}, 'test')
    live = fed(manual)
    trouble = state_of(live).session.trouble
    assert 'no sample was requested: sampling.mode is manual' in trouble
    with pytest.raises(DataError, match='no sample was requested'):
        live.answer.compute()
    changed(live, sampling__mode='still')


def test_what_is_reported_is_plain() -> None:
    import json
    live = fed()
    live.answer.compute()
    state = state_of(live)
    samples = json.loads(json.dumps(samples_message(state)))
    status = json.loads(json.dumps(status_message(state)))
    assert samples['format'] == 'handeye_ros/samples/1'
    assert samples['samples'][0]['number'] == 1 and len(samples['worst_first']) > 5
    assert status['state'] == 'current' and len(status['std']) == 6


def test_a_result_lies_below_the_namespace(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    config = SPHERE.config
    assert OutputFolders().parent(config) == tmp_path / 'handeye_ros'
    assert OutputFolders('/cell1/left').parent(config) == tmp_path / 'handeye_ros/cell1/left'
    assert OutputFolders('/cell1').parent(replace(config, output_dir='/data')) == Path('/data')
