# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Streams that are not as they should be, or arrive in any order: dropped, told or refused."""
from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

from handeye_ros.config import Config, with_values
from handeye_ros.data import NS, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.input_faults import late_streams
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.stream import in_majority_order
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from profiles import drawn, step_up_to, with_lost
import pytest
from quick import long_run
from streams import (
    add,
    BAD,
    collect,
    CONFIG,
    go_on,
    GOOD,
    in_order,
    key,
    MANUAL,
    played,
    pose,
    profile,
    profiles,
    START,
    stops,
    taken,
)


def test_time_that_goes_backwards_is_dropped_and_counted() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    for _ in range(3):
        session.add_pose(pose(0.5, x=3.0))
    session.add_profile(profile(0.4, BAD))
    session.add_pose(pose(1.0, x=3.0))  # the same stamp again
    session.evaluate_remaining()
    assert len(session.samples) == 1 and session.samples[0].T_base_flange[0, 3] == 0
    kinds = [(w.split(' whose')[0], w.rsplit('(', 1)[1]) for w in session.warnings]
    assert kinds == [('dropped a pose', '4 times)'), ('dropped a profile', '1 times)')]


def test_repeated_messages_are_not_late_but_a_clock_that_stands_is_told() -> None:
    session = Session(MANUAL)
    for item in in_order(stops((0, 1)), profiles(0, 1)):
        add(session, item)
        add(session, item)
    assert late_streams(session.streams) == () and taken(session, MANUAL).profile_count > 5
    for _ in range(20):
        session.add_pose(pose(1.0))
    with pytest.raises(DataError, match='clock of their driver stands still'):
        taken(session, MANUAL)


@pytest.mark.parametrize(('tilt', 'refused'), [(0.1, True), (0.0, False)])
def test_a_tilted_light_plane_is_told_from_an_encoder(tilt: float, refused: bool) -> None:
    spans, rng = [(3.0 * k, 3.0 * k + 1) for k in range(10)], np.random.default_rng(0)
    moved_profiles = []
    for start, end in spans:
        height = rng.uniform(-0.01, 0.01)
        beside = tilt * (np.nanmean(GOOD[:, 1]) + height) if tilt else 1e-3 * start
        moved_profiles += [replace(p, points=p.points + [0.0, height], out_of_plane=beside)
                           for p in profiles(start, end)]
    session = played(stops(*spans), moved_profiles, finish=False)
    with pytest.raises(InputError, match='light plane that is tilted') if refused else (
            nullcontext()):
        session.evaluate_remaining()
    assert refused or len(session.samples) == 10


@pytest.mark.parametrize('config', [CONFIG, MANUAL])
def test_a_clock_that_is_set_back_goes_on_by_itself(config: Config) -> None:
    session = played(stops((100, 101), (102, 103)), profiles(100, 103), config, finish=False)
    add(session, pose(40.0, x=0.5))
    assert late_streams(session.streams) == ('poses',)
    with pytest.raises(DataError, match='older stamps'):
        taken(session)  # of where the robot stood before its clock was set
    elsewhere = [replace(p, translation=p.translation + [0.5, 0.0, 0.0]) for p in stops((40, 42))]
    go_on(session, in_order(elsewhere, profiles(40, 42)), config)
    assert late_streams(session.streams) == () and session.motion.rest_time > 1.0
    if config is MANUAL:
        taken(session)
    else:
        session.evaluate_remaining()
    assert [round(s.T_base_flange[0, 3], 3) for s in session.samples] == (
        [0.5] if config is MANUAL else [0.0, 0.1, 0.5])
    clock_warnings = [w for w in session.warnings if 'clock' in w]
    assert clock_warnings[0].startswith('the clock of the poses was set back by 63.0 s (1 times)')
    assert clock_warnings[1].startswith('the clock of the profiles was set back by 6')


def test_a_stop_is_given_early_and_again_when_it_is_over() -> None:
    session, seconds = Session(CONFIG), []
    for item in in_order(stops((0, 3), (4, 5)), profiles(0, 5, 40.0)):
        add(session, item)
        stop = session.early_stop()
        if stop:
            seconds.append((item.stamp - START) / NS)
            session.add_stop(session.with_result(stop, result_of(stop, CONFIG)))
        collect(session)
    session.evaluate_remaining()
    assert len(session.samples) == session.last_number == 2
    assert len(seconds) == 2 and 0.7 <= seconds[0] < 1.1 and 4.7 <= seconds[1] <= 5.0
    without_early = played(stops((0, 3), (4, 5)), profiles(0, 5, 40.0))
    assert [s.profile_count for s in session.samples] == [
        s.profile_count for s in without_early.samples]


def test_a_stop_without_profiles_is_reported_while_the_robot_stands() -> None:
    session = Session(CONFIG)
    early_stops = []
    for item in stops((0, 3)):
        add(session, item)
        if early_stop := session.early_stop():
            early_stops.append(((item.stamp - START) / NS, early_stop))
    (seconds, stop), = early_stops
    assert 2.0 <= seconds < 3.0 and isinstance(result_of(stop, CONFIG), Reject)


@pytest.mark.parametrize('kind', ['pose', 'profile'])
def test_a_stray_of_another_frame_is_counted_and_more_are_refused(kind: str) -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)

    def stray(number: int) -> TimedPose | Profile:
        time = 1.5 + 0.01 * number
        return pose(time, frame='map') if kind == 'pose' else profile(time, frame='other')

    add(session, stray(0))
    session.copied().evaluate_remaining()
    assert 'map" (1 times)' in session.warnings[0] or 'other" (1 times)' in session.warnings[0]
    for number in range(1, 40):
        add(session, stray(number))
    with pytest.raises(InputError, match=f'{kind}.*two frames'):
        session.copied().evaluate_remaining()
    for item in in_order(stops((2, 6)), profiles(2, 6)):
        add(session, item)
    assert session.conflict is None, 'only the first frame has come for some seconds'
    set_back = session.copied()
    go_on(set_back, in_order(stops((-500, -498)), profiles(-500, -498)))
    assert set_back.conflict is None, 'a clock that is set back brings none of them back'
    add(session, stray(500))
    assert session.conflict is None, 'one more begins a new count'


def test_the_frames_of_a_session_that_continues_stay() -> None:
    session = Session(CONFIG, frames=('base', 'laser'))
    for p in profiles(0, 1.2):
        session.add_profile(replace(p, frame_id='other sensor'))
    with pytest.raises(InputError, match='two frames, "laser" and "other sensor"'):
        session.evaluate_remaining()


MOVING = [pose(t, x=0.2 * t) for t in np.arange(0, 3, 0.02)]
SPARSE = [pose(t, x=0.1 * (t // 10)) for t in range(60)]


@pytest.mark.parametrize(('poses', 'mode', 'code', 'words'), [
    ([], 'still', 'no_poses', 'no flange pose'), (MOVING, 'still', 'no_stops', 'never stood'),
    (SPARSE, 'still', 'sparse_poses', 'come only every 1 s'),
    ([replace(p, translation=p.translation * 1e3) for p in MOVING], 'still', 'position_unit',
     'in mm'),
    (stops((0, 1), (2, 2.3), (4, 4.3), (6, 6.3)), 'still', 'no_stops',
     'only 1 time, and 2 times for less'),
    (stops((0, 0.3)), 'still', 'no_stops', 'but for 0.3 s at most: stop at each'),
    (stops((0, 0.3)), 'moving', 'no_stops', 'make no sweep.*: record a longer')])
def test_why_there_are_no_stops_is_told(poses: list[TimedPose], mode: str, code: str, words: str
                                        ) -> None:
    config = with_values(CONFIG, {'sampling.mode': mode}, 'test')
    with pytest.raises(DataError, match=words) as refusal:
        played(poses, profiles(0, 60), config).require_any_stop()
    assert refusal.value.code == code


def test_stamps_against_the_order_of_the_others_are_found() -> None:
    stamps = START + NS * np.arange(50)
    late, wild = stamps.copy(), stamps.copy()
    late[7] -= NS
    wild[7] += 1000 * NS
    assert in_majority_order(late, 'of the poses').all(), 'as in transit'
    assert np.flatnonzero(~in_majority_order(wild, 'of the poses')).tolist() == [7]
    with pytest.raises(DataError, match='of the poses jump back by 49.0 s at message 51'):
        in_majority_order(np.append(stamps, stamps), 'of the poses')


def test_sparse_poses_are_enough_where_gaps_may_be_longer() -> None:
    wide = with_values(CONFIG, {'sampling.max_pose_gap': 2.0}, 'test')
    assert len(played(SPARSE, profiles(0, 60), wide).samples) == 6
    played(stops((0, 1)), []).require_any_stop()  # stops without samples are stops


@pytest.mark.parametrize(('cut', 'words'), [
    (0.3e-3, 'the border of the field of view'), (0.9e-3, '0.9 mm from the end of the view'),
    (2e-3, '')])
def test_an_edge_at_the_end_of_the_view_is_reported(cut: float, words: str) -> None:
    points = with_lost(drawn(step_up_to(0.002)))
    points = points[~(points[:, 0] > 0.002 + cut)].copy()
    points[0] = np.nan  # a driver that sends the columns without a return too
    config = with_values(CONFIG, {'sampling.min_points': 5}, 'test')
    session = played(stops((0, 1)), profiles(0, 1, points=points), config)
    reasons = [reject.reason for reject in session.rejects]
    assert (words in reasons[0]) if words else not reasons, reasons


STREAM_POSES = stops((0, 1), (2, 2.8), (3.5, 4.5), rate=25.0)
STREAM_PROFILES = [*profiles(0.02, 2.9, rate=8.0), *profiles(3.4, 4.5, rate=8.0, points=BAD)]
IN_ORDER = key(played(STREAM_POSES, STREAM_PROFILES))


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=len(STREAM_POSES) + len(STREAM_PROFILES),
                max_size=len(STREAM_POSES) + len(STREAM_PROFILES)), st.booleans())
def test_the_order_of_arrival_changes_nothing(poses_next: list[bool], collecting: bool) -> None:
    session, streams = Session(CONFIG), [list(STREAM_PROFILES), list(STREAM_POSES)]
    for take_pose in poses_next:
        stream = streams[take_pose] or streams[not take_pose]
        add(session, stream.pop(0))
        if collecting:
            collect(session)
    session.evaluate_remaining()
    assert key(session) == IN_ORDER
    assert {*session.samples, *session.rejects} == {stop.result for stop in session.stops}


@pytest.mark.parametrize('first', ['pose', 'profile'])
def test_one_stream_may_be_far_behind_the_other(first: str) -> None:
    poses = stops((0, 1), (8, 9), (16, 17), rate=25.0)
    late = profiles(0.0, 17.0, rate=8.0)
    streams = [poses, late] if first == 'pose' else [late, poses]
    session = Session(CONFIG)
    go_on(session, streams[0] + streams[1])
    session.evaluate_remaining()
    assert len(session.stops) == 3
    assert key(session) == key(played(poses, late))


@pytest.mark.parametrize('jump', [-30.0, 1e9, *long_run(-1e9, 1.5)])
@pytest.mark.parametrize('kind', ['pose', 'profile'])
@pytest.mark.parametrize('place', [0, 7])
def test_one_wild_stamp_changes_only_its_message(jump: float, kind: str, place: int) -> None:
    streams: dict[str, list[TimedPose | Profile]] = {
        'pose': [*STREAM_POSES], 'profile': [*STREAM_PROFILES]}
    wild = streams[kind][place]
    items = in_order(STREAM_POSES, STREAM_PROFILES)
    outcomes = []
    for changed in ([], [replace(wild, stamp=wild.stamp + round(jump * NS))]):
        session, at = Session(CONFIG), items.index(wild)
        go_on(session, [*items[:at], *changed, *items[at + 1:]])
        session.evaluate_remaining()
        outcomes.append(key(session))
        assert not late_streams(session.streams)
    assert outcomes[0] == outcomes[1]
    # the first of all may be early: nothing tells that it is
    assert len(session.warnings) == (0 if place == 0 and jump < 0 else 1)


def test_of_a_sweep_it_is_told_whether_the_robot_moves() -> None:
    session = Session(with_values(CONFIG, {'sampling.mode': 'moving'}, 'test'))
    for t in np.arange(0.0, 5.0, 0.02):
        session.add_pose(pose(t, x=0.1 * min(t, 3.0)))
        if t > 0.5:
            stood = max(t - 3.0, 0.0)
            assert session.is_standing == (stood > 0.49), t
            moves = session.motion.sentence.startswith('it moves by 100.0 mm/s')
            assert moves or stood, session.motion.sentence
    assert session.motion.sentence == 'it has stood still for 1.98 s'


def test_profiles_of_a_pass_beyond_its_poses_are_not_used() -> None:
    # as in a stored sweep after time_offset was changed
    config = with_values(CONFIG, {'sampling.mode': 'moving'}, 'test')
    track = tuple(stops((0.0, 1.0)))
    pass_profiles = profiles(0.5, 3.0)
    assert isinstance(result_of(Stop(track[0].stamp, track, tuple(pass_profiles)), config), Sample)
    beyond = result_of(Stop(track[0].stamp, track, tuple(profiles(2.0, 3.0))), config)
    assert isinstance(beyond, Reject) and 'stamp of the 1.0 s of this pass' in beyond.reason
