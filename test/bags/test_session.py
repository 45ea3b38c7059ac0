# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Sessions on the disk: what is told to be there is there, and gives the same answer."""
from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
import re
import resource
import shutil

from command import assert_refused, handeye, run_python, succeeds
from handeye_ros.bags.recording import read_bag
from handeye_ros.bags.session_files import (
    files_of,
    is_session,
    read_session,
    SessionFiles,
    sessions_in,
)
from handeye_ros.bags.writer import write
from handeye_ros.config import Config, with_values
from handeye_ros.errors import DataError, InputError
from handeye_ros.node.folders import OutputFolders, settings_and_session
from handeye_ros.node.live import LiveSession
from handeye_ros.node.state import sample_count, state_of
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.report import verdict
from handeye_ros.review import solved_recording
from handeye_ros.sampling.stops import NOT_EVALUATED
from live_sessions import changed, computed, feed_one, new, SPHERE, update
import numpy as np
import pytest
from recordings import POINTS, with_layout
from rosbags.highlevel import AnyReader
from streams import in_order
import yaml


def stored(tmp_path: Path, config: Config = SPHERE.config) -> LiveSession:
    return new(replace(config, output_dir=str(tmp_path)))


def feed(live: LiveSession, recording=SPHERE, stops: int = 99) -> LiveSession:
    """Give a session a recording up to so many stops, in the order of the stamps."""
    for item in in_order(recording.poses, recording.profiles):
        feed_one(live, item)
        if any(map(live.session.is_done, live.to_evaluate.values())):  # not while it stands
            update(live)
        if len(live.session_copy().stops) >= stops:
            break
    return live


def again(live: LiveSession) -> LiveSession:
    """Return another node that goes on with the session of one that has ended."""
    live.files.close()
    other = new(replace(live.config, session=live.path))
    update(other)
    return other


def test_every_stop_is_a_file_that_stock_readers_read(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=3)
    folder = Path(live.path)
    assert folder.parent == tmp_path / 'sphere'
    text = (folder / 'metadata.yaml').read_text()
    metadata = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert metadata['message_count'] == sum(file['message_count'] for file in metadata['files'])
    assert metadata['relative_file_paths'] == [file.name for file in files_of(folder)] == [
        f'{folder.name}_{i}.mcap' for i in range(3)]
    with AnyReader([folder]) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        counts = Counter(c.topic for c, _, raw in reader.messages()
                         if reader.deserialize(raw, c.msgtype))
        assert counts == {c.topic: c.msgcount for c in reader.connections}
    assert types['/flange_pose'] == 'geometry_msgs/msg/PoseStamped'
    assert counts['/handeye_ros/session/outcome'] == 3 and counts['/profile'] > 20
    assert len(read_bag(folder, SPHERE.config).profiles) == counts['/profile']  # as any bag


def test_what_was_received_is_stored_byte_for_byte(tmp_path: Path) -> None:
    write(tmp_path / 'bag', SPHERE.profiles, SPHERE.poses, SPHERE.config)
    bag = with_layout(tmp_path / 'bag', tmp_path, POINTS['scancontrol'])
    recording = read_bag(bag, SPHERE.config)
    live = feed(stored(tmp_path), recording, stops=2)
    sent = {profile.stamp: profile.fetch() for profile in recording.profiles}
    for stop in live.session_copy().stops:
        loaded = stop.load(live.config)
        assert loaded.profiles
        assert all(p.fetch() == sent[p.stamp] for p in loaded.profiles)


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give the folder of a session of all stops, with one removed and one excluded."""
    live = feed(stored(tmp_path_factory.mktemp('session')))
    computed(live)
    live.remove_last_sample()
    changed(live, samples__exclude=[3])
    computed(live)
    np.save(Path(live.path).parent / 'answer.npy', live.solver.calibration.T_flange_sensor)
    live.files.close()
    return Path(live.path)


@pytest.mark.thorough
def test_the_command_line_gives_the_answer_of_the_node(whole: Path, tmp_path: Path) -> None:
    succeeds('solve', whole, '--out', tmp_path, cwd=tmp_path)
    answer = np.load(whole.parent / 'answer.npy')
    calibration = read_calibration(tmp_path / 'calibration.yaml')
    assert np.abs(calibration.T_flange_sensor - answer).max() < 1e-9
    succeeds('solve', whole, '--set', 'samples.exclude=[]', '--out', tmp_path, cwd=tmp_path)
    n = read_calibration(tmp_path / 'calibration.yaml').quality.samples_used
    assert n == calibration.quality.samples_used + 1


@pytest.mark.thorough
def test_a_sample_taken_again_is_reported_and_compared(whole: Path, tmp_path: Path) -> None:
    # the stop is stored twice: as a bag its stamps would jump back
    session = Path(shutil.copytree(whole, tmp_path / 'session'))
    first, *_, last = files_of(session)
    shutil.copy(first, last.with_name(last.name.replace(
        f'_{len(files_of(session)) - 1}.', f'_{len(files_of(session))}.')))
    assert handeye('solve', session, '--out', tmp_path, cwd=tmp_path).returncode == 0
    calibration = read_calibration(tmp_path / 'calibration.yaml')
    for bag in (session, None):
        recording = solved_recording(calibration, bag, tmp_path)
        assert not recording.refusal and not recording.missing
        assert sum(stop.used for stop in recording.stops) == calibration.quality.samples_used
        assert verdict(calibration, recording, np.empty((0, 3)))[0]
    run = succeeds('compare', session, cwd=tmp_path)
    assert f'{calibration.quality.samples_used} samples' in run.stdout


@pytest.mark.once
def test_the_command_line_shows_the_samples(whole: Path, tmp_path: Path) -> None:
    run = succeeds('samples', whole, cwd=tmp_path)
    lines = [line.split() for line in run.stdout.splitlines() if line.strip()[:1].isdigit()]
    assert sorted(int(line[0]) for line in lines) == list(range(1, 14))
    assert [float(line[3]) for line in lines] == sorted((float(line[3]) for line in lines),
                                                        reverse=True)
    assert [line[0] for line in lines if 'excluded' in ' '.join(line)] == ['3']
    assert_refused(handeye('samples', tmp_path, cwd=tmp_path), 2, 'is not a bag')


def test_a_session_goes_on_after_a_restart(tmp_path: Path) -> None:
    live = feed(stored(tmp_path, with_values(SPHERE.config, {'record.operator': 'Ada'})), stops=5)
    live.remove_last_sample()
    other = again(live)
    assert read_session(Path(other.path)).config.record == (('operator', 'Ada'),)
    assert [s['number'] for s in state_of(other)['samples']] == [1, 2, 3, 4]
    feed(other, stops=9)
    state = state_of(other)
    assert [s['number'] for s in state['samples']][:5] == [1, 2, 3, 4, 6], 'no number comes twice'
    computed(other)
    T = other.solver.calibration.T_flange_sensor
    third = again(other)
    assert state_of(third)['calibration']['state'] == 'current', 'it is solved without being asked'
    assert np.abs(third.solver.calibration.T_flange_sensor - T).max() < 1e-9


def test_a_restart_keeps_the_frames_of_poses_and_profiles(tmp_path: Path) -> None:
    other = again(feed(stored(tmp_path), stops=3))
    settings = other.session.config_with_base_frame(other.config)
    assert settings.robot_base_frame == 'base', 'before the first message'
    foreign = [replace(pose, parent_frame='map') for pose in SPHERE.poses]
    feed(other, replace(SPHERE, poses=tuple(foreign)))
    assert 'two frames, "base" and "map"' in state_of(other)['session']['trouble']
    assert sample_count(state_of(other)) == 3


def test_another_session_is_opened_with_what_it_excludes_or_not_at_all(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=3)
    changed(live, samples__exclude=[2])
    before, text = Path(live.path), live.clear_samples()
    assert text.startswith('3 samples removed') and live.config.samples.exclude == ()
    changed(live, noise__sensor=4e-5)  # which is to be written
    session, path = read_session(before), live.path
    config = replace(live.config, samples=session.config.samples)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(InputError, match='cannot write'):
            live.open_session(session, config)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (live.path, sample_count(state_of(live)), live.config.samples.exclude) == (path, 0, ())
    assert live.open_session(session, config) == (
        f'continuing with 3 samples of {before}; noise.sensor is 4e-05 now, was '
        f'{session.config.noise.sensor}')
    assert [s['number'] for s in state_of(live)['samples'] if s['excluded']] == [2]
    assert read_session(before).config == live.config
    live.files.close()
    last = {'output_dir': str(tmp_path), 'session': 'last'}
    assert settings_and_session(last, OutputFolders())[1].path == before, 'used last'


def test_clearing_begins_another_session_and_keeps_the_one_before(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=2)
    before = Path(live.path)
    with pytest.raises(InputError, match='in use by another node'):
        SessionFiles(OutputFolders().folder, read_session(before))
    assert f'they are kept in {before}' in live.clear_samples()
    assert len(read_session(before).stops) == 2
    assert next(sessions_in(tmp_path / 'sphere')) == Path(live.path) != before
    assert again(live).session_copy().stops == ()


def test_last_is_the_newest_of_the_name_or_of_all(tmp_path: Path) -> None:
    parameters = {'output_dir': str(tmp_path), 'session': 'last'}
    assert settings_and_session(parameters, OutputFolders())[1] is None
    live = feed(stored(tmp_path), stops=1)
    live.files.close()
    config, session = settings_and_session(parameters, OutputFolders())
    assert session and session.path == Path(live.path)
    assert (config.target.type, config.target.radius) == ('sphere', SPHERE.config.target.radius)
    assert settings_and_session(parameters | {'name': 'other'}, OutputFolders())[1] is None


# -- what goes wrong


def test_a_full_disk_is_a_refusal_and_goes_on_where_there_is_room_again(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=2)
    before = live.config
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        feed(live, stops=3)
        state = state_of(live)
        assert sample_count(state) == 2 and 'cannot write' in state['session']['trouble']
        assert 'File too large' in state['samples'][2]['text']
        for setting in ({'noise__sensor': 4e-5}, {'sampling__min_points': 21}):
            with pytest.raises(InputError, match='cannot write'):
                changed(live, **setting)
        assert live.config == before, 'what is used is stored'
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(read_session(Path(live.path)).stops) == 2
    changed(live, sampling__min_points=20)
    session = read_session(Path(live.path))
    assert sorted(session.stops) == [1, 2, 3]
    assert sample_count(state_of(live)) == sum(
        stop.result is NOT_EVALUATED for stop in session.stops.values())
    assert not list(Path(live.path).glob('.*.tmp'))
    feed(live, stops=4)
    state = state_of(live)
    assert (sample_count(state), state['session']['trouble']) == (3, '')
    assert sorted(read_session(Path(live.path)).stops) == [1, 2, 3, 4]


def test_a_folder_that_vanishes_is_a_refusal_and_may_come_back(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=2)
    folder = Path(live.path)
    folder.rename(tmp_path / 'away')
    feed(live, stops=3)
    assert 'its folder is gone' in state_of(live)['session']['trouble']
    assert not folder.exists()
    with pytest.raises(InputError, match='its folder is gone .* for a new session$'):
        live.remove_last_sample()
    with pytest.raises(InputError, match='its folder is gone'):
        changed(live, noise__sensor=4e-5)
    (tmp_path / 'away').rename(folder)
    with pytest.raises(DataError):  # too few
        computed(live)
    update(live)
    session = read_session(folder)
    assert (sorted(session.stops), session.config) == ([1, 2, 3], replace(live.config, session=''))
    state = state_of(live)
    assert (sample_count(state), state['session']['trouble']) == (2, '')  # 3 is as 1
    shutil.rmtree(folder)
    with pytest.raises(DataError):
        computed(live)
    assert 'its folder is gone' in state_of(live)['session']['trouble']
    assert 'kept in' not in live.clear_samples()
    assert not state_of(live)['session']['trouble']


def test_by_hand_nothing_is_taken_that_is_not_stored(tmp_path: Path) -> None:
    manual = with_values(SPHERE.config, {'sampling.mode': 'manual'}, 'test')
    live = stored(tmp_path, manual)
    (tmp_path / 'sphere').write_text('in the way')
    feed(live)
    with pytest.raises(InputError, match='cannot write'):
        live.take_sample()
    assert sample_count(state_of(live)) == 0 and not state_of(live)['attempt']['accepted']
    (tmp_path / 'sphere').unlink()
    assert live.take_sample().startswith('sample 1 taken: ')
    assert list(read_session(Path(live.path)).stops) == [1]
    assert live.take_sample().startswith('sample 1 taken again')
    assert list(read_session(Path(live.path)).stops) == [1]


def test_a_session_without_its_last_metadata_is_whole(tmp_path: Path) -> None:
    live = feed(stored(tmp_path), stops=2)
    folder = Path(live.path)
    metadata = (folder / 'metadata.yaml').read_bytes()
    feed(live, stops=3)
    (folder / 'metadata.yaml').write_bytes(metadata)
    (folder / f'.{folder.name}_9.mcap.tmp').write_bytes(b'\x89MCAP0\r\nhalf')
    assert sorted(read_session(folder).stops) == [1, 2, 3]
    with AnyReader([folder]) as reader:
        assert reader.message_count > 10
    other = again(live)
    with AnyReader([folder]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts['/handeye_ros/session/outcome'] == 3 == len(other.session_copy().stops)


def test_what_is_no_session_is_reported(tmp_path: Path) -> None:
    assert not any(map(is_session, (tmp_path, *(tmp_path / name for name in ('no', 'n\0')))))
    with pytest.raises(InputError, match='is no session'):
        settings_and_session({'session': str(tmp_path)}, OutputFolders())
    live = feed(stored(tmp_path), stops=1)
    file = files_of(Path(live.path))[0]
    shutil.copy(file, file.with_name(file.name.replace('_0', '_1')))
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(InputError, match='damaged|cut off|no session'):
        read_session(Path(live.path))


@pytest.mark.thorough
@pytest.mark.parametrize(('of_node', 'count', 'fewest'), [
    pytest.param((), 20, 10, marks=pytest.mark.once),
    pytest.param(('--node',), 4, 2, marks=pytest.mark.ros)])
def test_kills_lose_no_sample(of_node: tuple[str, ...], count: int, fewest: int) -> None:
    if of_node:
        pytest.importorskip('rclpy', reason='needs rclpy')
    run = run_python('bench/kills.py', *of_node, '--count', count)
    assert run.returncode == 0, run.stderr
    result = re.match(rf'{count} kills.*: (\d+) samples acknowledged, .* none lost',
                      run.stdout.splitlines()[-1])
    assert result and int(result[1]) >= fewest, run.stdout
