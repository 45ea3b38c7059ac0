"""A running session without ROS: clocks, silent streams and limits of memory."""
from __future__ import annotations

from dataclasses import replace
import re
from threading import Event

from command import PATIENCE
from handeye_ros import pipeline
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.config import with_values
from handeye_ros.data import TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.node import streams
from handeye_ros.node.errors import WorkerEndedError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.status import state_of
from handeye_ros.node.streams import Latest, MOST_STOPS
from handeye_ros.sampling import dwells
from handeye_ros.sampling.stream import MOST_REASONS
from live_sessions import fed, later, SPHERE
import pytest


def test_clocks_an_hour_apart_are_reported_with_their_size() -> None:
    live = LiveSession(SPHERE.config, OutputFolders())
    for item in SPHERE.profiles[:50]:
        live.add_profile(replace(item, stamp=item.stamp + 3600 * 10**9))
    live.add_poses(SPHERE.poses[:50])
    trouble = state_of(live).session.trouble
    assert 'the profiles are 1.00 hours ahead of those of the poses' in trouble


@pytest.mark.parametrize('set_to', ['', 'base', 'base_link'])
def test_poses_in_another_frame_than_the_one_set_are_refused(set_to: str) -> None:
    config = with_values(SPHERE.config, {'robot_base_frame': set_to}, 'test')
    poses = [replace(p, parent_frame='base_link') for p in SPHERE.poses]
    live = fed(config, replace(SPHERE, poses=poses))
    words = 'the poses are given in "base_link", but robot_base_frame is "base"'
    if set_to == 'base':
        assert words in state_of(live).session.trouble
        for ask in (live.answer.compute, live.samples.take,
                    lambda: pipeline.calibrate(SPHERE.profiles, poses, config)):
            with pytest.raises(InputError, match=words):
                ask()
    else:
        settings = live.answer.compute()[0].provenance['config']
        assert settings['robot_base_frame'] == live.framed.base_frame == 'base_link'


def test_poses_that_are_silent_while_profiles_come_take_no_sample(
        monkeypatch: pytest.MonkeyPatch) -> None:
    live = fed(with_values(SPHERE.config, {'sampling.mode': 'manual'}, 'test'))
    monkeypatch.setattr(live.streams.arrivals, 'silence',
                        lambda kind: {'pose': 3.0, 'profile': 0.1}[kind])
    with pytest.raises(DataError, match='no pose has come for 3.0 s'):
        live.samples.take()


def test_stamps_that_come_again_give_no_error() -> None:
    latest, config = Latest(), SPHERE.config
    poses, profile = SPHERE.poses[:30], SPHERE.profiles[1]
    latest.add_poses(poses[:1])
    latest.add_profile(profile)
    assert latest.current(config) is None
    latest.add_poses([*poses[1:], *poses])
    current = latest.current(config)
    assert current is not None and len(current.points)
    latest.clear()
    assert latest.current(config) is None


def test_work_that_fails_is_reported_and_the_next_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    live, result, done = LiveSession(SPHERE.config, OutputFolders()), Event(), Event()
    log: list[str] = []
    evaluate_all = live.samples.evaluate_all
    live.on_failure = lambda text: (log.append(text), result.set())
    live.on_change = done.set
    monkeypatch.setattr(live.samples, 'evaluate_all', lambda: 1 / 0)
    live.start()
    live.streams.wake.set()
    assert result.wait(PATIENCE) and 'ZeroDivisionError' in log[0]
    assert "failed, which should not happen: ZeroDivisionError('division by zero')" in state_of(
        live).session.trouble
    monkeypatch.setattr(live.samples, 'evaluate_all', evaluate_all)
    live.streams.wake.set()
    assert done.wait(PATIENCE)
    while live.threads.failure:
        done.wait(0.01)
    assert state_of(live).session.trouble == ''


def test_a_process_that_ends_is_asked_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    live, done, update = LiveSession(SPHERE.config, OutputFolders()), Event(), []

    def ended() -> None:
        update.append(state_of(live).session.trouble)
        if len(update) == 3:
            done.set()
            return
        raise WorkerEndedError(-9)

    monkeypatch.setattr(live.reviewer, 'update', ended)
    live.start()
    live._evaluated.set()
    while len(update) < 2:
        done.wait(0.01)
    while 'ended by signal 9' not in state_of(live).session.trouble:
        done.wait(0.01)
    live._evaluated.set()
    assert done.wait(PATIENCE), 'the next time'
    assert update[0] == '' and 'please report' not in update[1]


def test_of_stops_that_wait_the_newest_are_kept_and_the_others_counted(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, 'MOST_STOPS', 5)
    live = LiveSession(SPHERE.config, OutputFolders())
    for item in sorted([*SPHERE.poses, *SPHERE.profiles], key=lambda item: item.stamp):
        (live.add_poses([item]) if isinstance(item, TimedPose) else live.add_profile(item))
    live.update()
    state, newest = state_of(live), SPHERE.poses[-1].stamp - 15 * 10**9
    assert state.taken == 5 + 1, 'the newest that waited, and where the robot stands'
    assert min(s.stamp for s in state.samples) > newest
    assert any(re.match('left [1-9][0-9]* stops out, the oldest of more than 5', note)
               for note in state.session.notes)


def test_without_profiles_the_stops_that_wait_for_them_do_not_pile_up() -> None:
    live = LiveSession(SPHERE.config, OutputFolders())
    for lap in range(3):
        for pose in later(SPHERE.poses, 1000 * lap):
            live.add_poses([pose])
    assert len(live.copied()._waiting) == MOST_STOPS
    assert any('stops, the oldest that waited for profiles' in note
               for note in state_of(live).session.notes)


def test_poses_whose_stamps_barely_advance_do_not_pile_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dwells, 'MOST_POSES', 50)
    for mode in ('still', 'manual'):
        live = LiveSession(with_values(SPHERE.config, {'sampling.mode': mode}, 'test'),
                           OutputFolders())
        live.add_poses([replace(SPHERE.poses[0], stamp=10**18 + i) for i in range(1000)])
        finder = live.copied()._finder
        assert len(finder._run) <= 51 and len(finder._recent) <= 51
        assert (finder._run[-1].stamp == 10**18 + 999) == (mode == 'manual')


def test_frames_of_damaged_messages_are_distinguished_up_to_a_number() -> None:
    live = LiveSession(SPHERE.config, OutputFolders())
    for number in range(100):
        live.add_profile(replace(SPHERE.profiles[number], frame_id=f'f{number}'))
    dropped = [note for note in live.copied().warnings if 'dropped a profile of' in note]
    assert len(dropped) == MOST_REASONS + 1
    assert dropped[-1] == f'dropped a profile of some other frame ({99 - MOST_REASONS} times)'
