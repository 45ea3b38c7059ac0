# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A running session without ROS: its samples and answer, and what changes and disturbs them."""
from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import re
from threading import Event

from cells import set_to, settings_of
from command import PATIENCE, ROOT
from handeye_ros import pipeline
from handeye_ros.bags.recording import read_bag
from handeye_ros.config import Config
from handeye_ros.errors import DataError, InputError
from handeye_ros.node import live as lives
from handeye_ros.node.message_counts import MessageCount
from handeye_ros.node.state import (
    sample_count,
    samples_message,
    state_of,
    status_message,
)
from handeye_ros.node.worker import Worker
from handeye_ros.simulate import SCENARIOS, simulate
from live_sessions import (
    changed,
    computed,
    fed,
    feed,
    feed_one,
    Inline,
    later,
    new,
    SPHERE,
    update,
)
import numpy as np
import pytest
from quick import long_run


def documented(topic: str, key: str = '') -> set[str]:
    """Return the keys of a topic by docs/contract.md, or the names told of one of its keys."""
    page = (ROOT / 'docs' / 'contract.md').read_text(encoding='utf-8')
    table = page.split(f'| `~/{topic}` | |\n|---|---|\n', 1)[1].split('\n\n', 1)[0]
    rows = [[re.findall('`([^`]+)`', cell) for cell in row.split('|')[1:3]]
            for row in table.splitlines()]
    return {name for keys, names in rows
            for name in (names if key in keys else () if key else keys)}


# -- samples and answer


def test_one_solve_gives_the_answer_of_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    live, solves, answer = fed(), [], pipeline.answer_samples
    monkeypatch.setattr(pipeline, 'answer_samples',
                        lambda *args: solves.append(args) or answer(*args))
    text = computed(live)
    update(live)
    assert computed(live) == text
    assert len(solves) == 1, 'review, advice and the next call are of the same answer'
    monkeypatch.undo()
    offline = pipeline.calibrate(SPHERE.profiles, SPHERE.poses, SPHERE.config)
    online = live.solver.calibration
    assert np.allclose(online.T_flange_sensor, offline.T_flange_sensor, atol=1e-12)
    assert online.samples == offline.samples
    state = state_of(live)
    assert state['calibration']['state'] == 'current'
    assert text == f'{state["calibration"]["text"]}; save it with ~/save_calibration'
    samples, status = (json.loads(json.dumps(message(state)))
                       for message in (samples_message, status_message))
    assert samples.keys() == documented('samples') and status.keys() == documented('status')
    assert all(sample.keys() == documented('samples', 'samples') for sample in samples['samples'])
    assert samples['attempt'].keys() <= documented('samples', 'attempt')
    assert samples['format'] == 'handeye_ros/samples/1' and len(samples['worst_first']) > 5
    assert status['state'] == 'current' and len(status['std']) == 6


def test_each_stop_that_waits_for_an_answer_is_told() -> None:
    stop_numbers = set()
    live = new(changed=lambda: stop_numbers.add(live.attempt and live.attempt.stop.number))
    for item in SPHERE.messages:
        feed_one(live, item)
    computed(live)
    assert {stop.number for stop in live.session_copy().stops} <= stop_numbers


def test_changes_are_published_before_an_answer_and_after_a_failure(
        capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise ValueError('the work')

    published: list[str] = []
    worker = Worker(Inline(), fail, lambda: published.append(worker.trouble))
    assert worker.call(lambda: 3, then_publish=True) == 3 and published == ['']
    with pytest.raises(ValueError):
        worker.call(fail, then_publish=True)
    assert published == ['', '']
    worker.start()
    worker.call(lambda: None)  # the work that is due has been done
    assert len(published) == 3 and "ValueError('the work')" in published[-1]
    assert 'Traceback' in capfd.readouterr().err


def test_a_long_computation_is_published_before_its_answer() -> None:
    order, asked = list[str](), Event()
    worker = Worker(Inline(), lambda: None, lambda: order.append('published'))

    def accept(result: int) -> int:
        assert asked.wait(PATIENCE)
        return result
    answer = worker.run_job('a computation', accept, lambda: 3)
    answer.add_done_callback(lambda _: order.append('answered'))
    asked.set()
    assert answer.result(PATIENCE) == 3
    worker.call(lambda: None)  # what called back has ended
    assert order[:2] == ['published', 'answered']


def test_what_the_streams_dropped_is_told_with_the_answer() -> None:
    live = new(SPHERE.config)
    feed(live, [*SPHERE.poses, SPHERE.poses[9], *SPHERE.profiles])
    computed(live)
    warnings = live.solver.calibration.provenance['warnings']
    assert [text for text in warnings if text.startswith('dropped a pose whose stamp')], warnings
    assert warnings == list(dict.fromkeys(warnings))


def test_lost_messages_are_told_until_many_have_come() -> None:
    count = MessageCount('profile')
    count.add_lost(50)
    for stamp in range(900):
        count.add(stamp)
    assert '50 of the last 950 profiles were lost' in count.state('/profile', '')['trouble']
    for stamp in range(900, 1000):
        count.add(stamp)
    state = count.state('/profile', '')
    assert (state['lost'], state['trouble']) == (50, '')


@pytest.mark.thorough
def test_a_robot_that_moves_gives_passes_and_the_answer_of_the_recording() -> None:
    recording = simulate(SCENARIOS['small_plate_sweep'], np.random.default_rng(3))
    config = settings_of(recording.scenario, sampling__mode='moving')
    live = fed(config, recording)
    text = computed(live)
    offline = pipeline.calibrate(recording.profiles, recording.poses, config)
    assert np.allclose(live.solver.calibration.T_flange_sensor, offline.T_flange_sensor, atol=1e-9)
    assert ' profiles used, ' in text


def test_the_worst_sample_comes_first_and_leaves_and_comes_back() -> None:
    began = [stop.stamp for stop in fed().session_copy().stops]
    poses = [replace(p, translation=p.translation + [0.0, 5e-3, 0.0])
             if began[3] <= p.stamp < began[4] else p for p in SPHERE.poses]
    live = fed(recording=replace(SPHERE, poses=tuple(poses)))
    assert state_of(live)['worst_first'][0] == 4
    computed(live)
    changed(live, samples__exclude=[4])
    state = state_of(live)
    assert [s['number'] for s in state['samples'] if s['excluded']] == [4]
    assert state['calibration']['state'] == 'current', 'it was solved again'
    assert state['worst_first'][0] == 4, 'what is left out is still compared with the rest'
    without = live.solver.calibration.T_flange_sensor
    changed(live, samples__exclude=[])
    assert not np.array_equal(live.solver.calibration.T_flange_sensor, without)


@pytest.mark.thorough
def test_the_review_follows_a_stop_that_goes_on() -> None:
    live, shared = new(SPHERE.config), []
    for item in SPHERE.messages:
        feed_one(live, item)
        if live.to_evaluate:
            update(live)
            answer, last = live.solver.review.answer, live.session.stops[-1].sample
            if answer and last:
                shared.append((last.stamp, last.profile_count) in {
                    (sample.stamp, sample.profile_count) for sample in answer.samples})
    assert all(shared) and len(shared) > 10


@pytest.mark.thorough
def test_settings_that_change_as_a_stop_ends_lose_no_profiles() -> None:
    other = set_to(SPHERE.config, sampling__min_points=21)
    live, waited = new(), False
    for item in SPHERE.messages:
        feed_one(live, item)
        if live.to_evaluate:
            if not waited and {stop.stamp for stop in live.session.stops} & {*live.to_evaluate}:
                waited = True
                live.configure(replace(other, output_dir=live.config.output_dir))
            update(live)
    live.worker.call(live.evaluate_all)
    whole = fed(other)
    whole.worker.call(whole.evaluate_all)
    assert waited and [sample.profile_count for sample in live.session.samples] == [
        sample.profile_count for sample in whole.session.samples]


@pytest.mark.parametrize(('before', 'lost'), [
    (4.8, 4), (-0.02, 0), *long_run(
        (-4.8, 4), (0.02, 0))])
def test_a_time_offset_set_during_a_stop_holds_for_it_too(before: float, lost: int) -> None:
    live = new(set_to(SPHERE.config, time_offset=before))
    began = fed().session_copy().stops[3].stamp
    received = {profile.stamp: profile.points for profile in SPHERE.profiles}
    for item in SPHERE.messages:
        if live.config.time_offset and item.stamp > began + 0.8e9:
            changed(live, time_offset=0.0)
        shift = live.config.offset_ns if hasattr(item, 'points') else 0
        feed_one(live, replace(item, stamp=item.stamp + shift))
    live.worker.call(live.evaluate_all)
    stops = live.session_copy().stops
    assert [bool(stop.sample) for stop in stops] == [False] * lost + [True] * (len(stops) - lost)
    for profile in [one for stop in stops for one in stop.load(live.config).profiles]:
        points = profile.read(live.config.profile).points
        assert np.array_equal(points, received[profile.stamp], equal_nan=True)


@pytest.mark.parametrize('kind', ['pose', 'profile', 'sample'])
def test_a_new_frame_begins_anew_unless_another_gave_a_sample(kind: str) -> None:
    exclude = () if kind == 'sample' else (1, 2)  # of samples that are gone then
    live, restarts = new(set_to(SPHERE.config, samples__exclude=exclude)), []
    live.restart_streams = lambda: restarts.append('transforms too')
    items = SPHERE.messages
    live.start()
    feed(live, [replace(pose, parent_frame='map') for pose in SPHERE.poses[:400]]
         if kind == 'pose' else [replace(p, frame_id='other') for p in SPHERE.profiles[:400]])
    feed(live, SPHERE.poses[:400] if kind == 'sample' else ())
    count = sample_count(state_of(live))
    assert bool(count) == (kind == 'sample')
    feed(live, later(items, 1000))  # of which the first seconds decide
    feed(live, later(items, 2000))
    assert bool(restarts) == (not count)
    if count:
        assert sample_count(state_of(live)) == count
        assert f'two frames, "other" and "{SPHERE.profiles[0].frame_id}"' in (
            state_of(live)['session']['trouble'])
    else:
        assert sample_count(state_of(live)) > 10 and not state_of(live)['session']['trouble']
        assert not any(sample['excluded'] for sample in state_of(live)['samples'])


def test_two_frames_before_the_first_sample_tell_of_no_sample() -> None:
    live = new()
    feed(live, [replace(p, frame_id='other') for p in SPHERE.profiles[:9]])
    feed(live, SPHERE.profiles[9:18])
    trouble = state_of(live)['session']['trouble']
    assert 'two frames' in trouble and 'samples' not in trouble


@pytest.mark.parametrize('kind', [
    'profile', *long_run('pose')])
def test_another_frame_after_the_samples_is_told_and_they_are_computed(kind: str) -> None:
    live, items = fed(), SPHERE.messages
    count, before = sample_count(state_of(live)), computed(live)
    end = max(item.stamp for item in items)
    feed(live, [replace(pose, parent_frame='map', stamp=end + pose.stamp % 10**9) for pose in
                SPHERE.poses[:90]] if kind == 'pose' else
         [replace(p, frame_id='other', stamp=end + p.stamp % 10**9) for p in SPHERE.profiles[:90]])
    trouble = state_of(live)['session']['trouble']
    assert 'two frames' in trouble and 'all samples are of the first' in trouble
    changed(live, noise__sensor=2e-5)
    changed(live, noise__sensor=SPHERE.config.noise.sensor)
    answer, save = before.split('; save it')
    assert computed(live).startswith(f'{answer}; dropped a {kind} of frame')
    assert save in computed(live) and sample_count(state_of(live)) == count
    live.add_poses([replace(SPHERE.poses[-1], stamp=end + 10**9)])  # none are missing
    with pytest.raises(InputError, match='two frames'):
        live.worker.call(live.take_sample)


@pytest.mark.thorough
def test_cleared_samples_leave_no_joints_and_no_view() -> None:
    live, wide = fed(), fed()
    wide.solver.view = np.array([[-0.5, 0.5], [0.5, 0.5]])  # by another sensor
    wide.add_joints(SPHERE.poses[0].stamp, b'')
    wide.worker.call(wide.clear_samples)
    assert not wide.joints
    feed(wide, SPHERE.messages)
    assert wide.solver.review.advice.sigmas == live.solver.review.advice.sigmas


@pytest.mark.thorough
def test_settings_that_change_need_no_new_samples() -> None:
    live, config = fed(), SPHERE.config
    computed(live)
    count = sample_count(state_of(live))
    for key, value in (('noise__robot_translation', 1e-3), ('target__radius', 0.0)):
        changed(live, **{key: value})
        config = set_to(config, **{key: value})
        expected = pipeline.calibrate(SPHERE.profiles, SPHERE.poses, config)
        calibration = live.solver.calibration
        assert np.allclose(calibration.T_flange_sensor, expected.T_flange_sensor, atol=1e-12)
        solved_with, name = calibration.provenance['config'], key.replace('__', '.')
        assert solved_with[name] == expected.provenance['config'][name]
    live.configure(set_to(live.config, time_offset_std=0.06))
    assert not live.to_evaluate, 'it changes no sample'
    changed(live, sampling__min_points=5000)  # extracts again
    assert sample_count(state_of(live)) == 0
    changed(live, sampling__min_points=20)
    assert sample_count(state_of(live)) == count


@pytest.mark.thorough
def test_stops_of_one_pose_are_one_sample_where_other_settings_revive_them() -> None:
    items = SPHERE.messages
    once, live = fed(), new(set_to(SPHERE.config, sampling__min_points=5000))
    feed(live, items)
    feed(live, later(items, 1000))
    assert sample_count(state_of(live)) == 0
    changed(live, sampling__min_points=20)
    assert sample_count(state_of(live)) == sample_count(state_of(once))
    assert sample_count(state_of(live)) == len(live.session_copy().stops) / 2


def test_a_retaken_stop_has_a_new_number_and_outdates_the_answer() -> None:
    live = fed()
    computed(live)  # which takes the stop that the robot stands in
    state = state_of(live)
    last = len(state['samples'])
    assert [s['number'] for s in state['samples']] == list(range(1, last + 1))
    assert state['guidance']['text'].startswith(f'after sample {last}: ')
    assert f'removed sample {last}' in live.remove_last_sample()
    update(live)
    state = state_of(live)
    assert (state['calibration']['state'], state['guidance']['sample']) == ('outdated', last - 1)
    assert live.take_sample().startswith(f'sample {last + 1} taken: ')
    status = state_of(live)['calibration']
    assert status['state'] == 'outdated' and '1 removed and 1 added' in status['text']


def test_cleared_and_refused_answers_are_withdrawn() -> None:
    live = fed(set_to(SPHERE.config, limits__rotation=1e-6))
    with pytest.raises(DataError) as error:
        computed(live)
    status = state_of(live)['calibration']
    assert status['state'] == 'none' and str(error.value) in status['text']
    changed(live, limits__rotation=2e-2)
    assert state_of(live)['calibration']['state'] == 'current', 'it was asked for'
    changed(live, limits__rotation=1e-6)
    status = state_of(live)['calibration']
    assert status['state'] == 'withdrawn' and str(error.value) in status['text']
    changed(live, limits__rotation=2e-2)
    live.clear_samples()
    status = state_of(live)['calibration']
    assert (status['state'], status['translation']) == ('withdrawn', None)
    assert 'cleared' in status['text'] and 'is not the answer' in status['text']


def test_one_pass_alone_has_a_review() -> None:
    config = set_to(Config(), sampling__mode='moving')
    bag = read_bag(ROOT / 'bags' / 'plate_sweep', config)
    end = bag.poses[0].stamp + 23 * 10**8
    live = fed(config, replace(SPHERE, profiles=tuple(p for p in bag.profiles if p.stamp < end),
                               poses=tuple(p for p in bag.poses if p.stamp < end)))
    live.worker.call(live.evaluate_all)
    update(live)
    assert [sample['taken'] for sample in state_of(live)['samples']] == [True]
    assert not state_of(live)['review_refusal'] and not live.worker.trouble


def test_an_answer_is_saved_once_and_by_one_node(tmp_path: Path) -> None:
    config = replace(SPHERE.config, output_dir=str(tmp_path))
    live, folder = fed(config), tmp_path / 'sphere'
    with pytest.raises(DataError, match='there is no calibration to save'):
        live.solver.save_calibration()
    computed(live)
    assert state_of(live)['calibration']['saved'] == ''
    for _ in range(3):
        live.solver.save_calibration()
    assert state_of(live)['calibration']['saved'] == str(folder / 'calibration.yaml')
    assert not (folder / 'history').exists()
    changed(live, guidance__accuracy=1e-3)  # of which no answer follows
    assert state_of(live)['calibration']['saved'] == str(folder / 'calibration.yaml')
    changed(live, record__operator='A. Nother')  # a text, of which no answer follows
    live.solver.save_calibration()
    assert 'A. Nother' in (folder / 'calibration.yaml').read_text()
    (folder / 'calibration.yaml').write_text('of another')
    assert live.solver.save_calibration().startswith('wrote ')
    assert 'of another' in [
        file.read_text() for file in (folder / 'history').glob('*/calibration.yaml')]
    other = new(config)
    other.solver.calibration = live.solver.calibration
    before = (folder / 'calibration.yaml').read_bytes()
    with pytest.raises(InputError, match='another running node saves its results in'):
        other.solver.save_calibration()
    assert (folder / 'calibration.yaml').read_bytes() == before
    other.configure(set_to(other.config, name='other'))
    assert str(tmp_path / 'other' / 'calibration.yaml') in other.solver.save_calibration()


# -- streams that are disturbed


def test_a_base_frame_unlike_that_of_the_poses_is_refused() -> None:
    poses = [replace(p, parent_frame='base_link') for p in SPHERE.poses]
    live = fed(recording=replace(SPHERE, poses=poses))
    computed(live)
    assert live.solver.calibration.provenance['config']['robot_base_frame'] == 'base_link'
    changed(live, robot_base_frame='base')
    for ask in (live.solver.compute_calibration, live.take_sample):
        with pytest.raises(InputError, match='robot_base_frame is "base"'):
            ask()
    assert live.solver.calibration is not None


def test_the_newest_stops_are_kept_and_others_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lives, 'MAX_STOPS', 5)
    state, newest = state_of(fed()), SPHERE.poses[-1].stamp - 15 * 10**9
    assert sample_count(state) == 5, 'the newest that waited'
    assert min(s['stamp'] for s in state['samples']) > newest
    assert any(re.match('dropped [1-9][0-9]* stops, the oldest of more than 5', note)
               for note in state['session']['warnings'])
    live = new()
    for lap in range(3):
        for pose in later(SPHERE.poses, 1000 * lap):
            live.add_poses([pose])
    assert any('stops, the oldest that waited for profiles' in note
               for note in state_of(live)['session']['warnings'])
    session = live.session_copy()
    session.limit_waiting(0)
    assert len(session.take_remaining()) <= 1, 'the current one'
