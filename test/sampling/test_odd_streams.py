# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Streams that are not as they should be: dropped, told or refused, whatever it is."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.config import Config, with_values
from handeye_ros.data import Profile, Reject, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import NS
import numpy as np
from profiles import drawn, step_up_to, with_lost
import pytest
from streams import (
    add,
    BAD,
    collect,
    CONFIG,
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
    session.finish()
    assert len(session.samples) == 1 and session.samples[0].T_base_flange[0, 3] == 0
    kinds = [(w.split(' whose')[0], w.rsplit('(', 1)[1]) for w in session.warnings]
    assert kinds == [('dropped a pose', '4 times)'), ('dropped a profile', '1 times)')]


@pytest.mark.parametrize('config', [CONFIG, MANUAL])
def test_a_clock_that_is_set_back_goes_on_by_itself(config: Config) -> None:
    session = played(stops((100, 101), (102, 103)), profiles(100, 103), config, finish=False)
    add(session, pose(40.0, x=0.5))
    assert session.late == ('poses',)
    with pytest.raises(DataError, match='older stamps'):
        taken(session)  # of where the robot stood before its clock was set
    for item in sorted([*stops((40, 42)), *profiles(40, 42)], key=lambda item: item.stamp):
        add(session, replace(item, translation=item.translation + [0.5, 0.0, 0.0])
            if isinstance(item, TimedPose) else item)
        collect(session, config)
    assert session.late == () and session.motion.still > 1.0
    if config is MANUAL:
        taken(session)
    else:
        session.finish()
    assert [round(s.T_base_flange[0, 3], 3) for s in session.samples] == (
        [0.5] if config is MANUAL else [0.0, 0.1, 0.5])
    result = [w for w in session.warnings if 'clock' in w]
    assert result[0].startswith('the clock of the poses was set back by 63.0 s (1 times)')
    assert result[1].startswith('the clock of the profiles was set back by 6')


def test_the_stop_of_now_is_given_while_the_robot_stands_and_again_when_it_is_over() -> None:
    session, early = Session(CONFIG), []
    for item in sorted([*stops((0, 3), (4, 5)), *profiles(0, 5, 40.0)], key=lambda i: i.stamp):
        add(session, item)
        stop = session.current_if_ready()
        if stop:
            early.append((item.stamp - START) / NS)
            session.put(session.numbered(stop, result_of(stop, CONFIG)), over=False)
        collect(session)
    session.finish()
    assert len(session.samples) == session.numbers == 2
    assert len(early) == 2 and 0.7 <= early[0] < 1.1 and 4.7 <= early[1] <= 5.0
    whole = played(stops((0, 3), (4, 5)), profiles(0, 5, 40.0))
    assert [s.profiles for s in session.samples] == [s.profiles for s in whole.samples]


def test_a_stop_without_profiles_is_reported_while_the_robot_stands() -> None:
    session = Session(CONFIG)
    found = []
    for item in stops((0, 3)):
        add(session, item)
        if ready := session.current_if_ready():
            found.append(((item.stamp - START) / NS, ready))
    (seconds, stop), = found
    assert 2.0 <= seconds < 3.0 and isinstance(result_of(stop, CONFIG), Reject)


@pytest.mark.parametrize('kind', ['pose', 'profile'])
def test_a_stray_of_another_frame_is_counted_and_more_are_refused(kind: str) -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)

    def stray(number: int) -> TimedPose | Profile:
        time = 1.5 + 0.01 * number
        return pose(time, frame='map') if kind == 'pose' else profile(time, frame='other')

    add(session, stray(0))
    session.copied().finish()
    assert 'map" (1 times)' in session.warnings[0] or 'other" (1 times)' in session.warnings[0]
    for number in range(1, 4):
        add(session, stray(number))
    with pytest.raises(InputError, match=f'{kind}.*two frames'):
        session.finish()


def test_a_first_message_of_another_frame_is_the_stray_unless_the_session_continues() -> None:
    session = played([pose(0, frame='map'), *stops((0.1, 1.2), rate=25.0)], profiles(0, 1.2))
    assert session.base_frame == 'base' and len(session.samples) == 1
    session.restore((), 0, 'laser')
    for one in profiles(0, 1.2):
        session.add_profile(replace(one, frame_id='other sensor'))
    with pytest.raises(InputError, match='two frames, "laser" and "other sensor"'):
        session.finish()


def test_no_poses_no_stops_and_millimetres_are_distinguished() -> None:
    with pytest.raises(DataError, match='no flange pose'):
        played([], profiles(0, 3)).require_stops()
    moving = [pose(t, x=0.2 * t) for t in np.arange(0, 3, 0.02)]
    with pytest.raises(DataError, match='150 poses'):
        played(moving, profiles(0, 3)).require_stops()
    metres_per_thousand = [replace(p, translation=p.translation * 1e3) for p in moving]
    with pytest.raises(DataError, match='mm'):
        played(metres_per_thousand, profiles(0, 3)).require_stops()
    sparse = [pose(t, x=0.1 * (t // 10)) for t in range(60)]
    with pytest.raises(DataError, match='only every 1 s, .*raise sampling.max_pose_gap'):
        played(sparse, profiles(0, 60)).require_stops()
    wide = with_values(CONFIG, {'sampling.max_pose_gap': 2.0}, 'test')
    assert len(played(sparse, profiles(0, 60), wide).samples) == 6
    played(stops((0, 1)), []).require_stops()


def test_silent_poses_are_reported() -> None:
    session = played(stops((0, 1)), profiles(0, 1.32), MANUAL, finish=False)
    with pytest.raises(DataError, match=r'no pose has come for 0\.3 s'):
        taken(session)


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
