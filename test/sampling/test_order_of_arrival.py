# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The order in which poses and profiles arrive changes nothing."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Profile, Reject, Sample, TimedPose
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import LONGEST, NS
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest
from streams import add, BAD, CONFIG, key, played, profiles, results, START, stops

STREAM_POSES = stops((0, 1), (2, 2.8), (3.5, 4.5), rate=25.0)
STREAM_PROFILES = [*profiles(0.02, 2.9, rate=8.0), *profiles(3.4, 4.5, rate=8.0, points=BAD)]
IN_ORDER = key(results(played(STREAM_POSES, STREAM_PROFILES)))


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=len(STREAM_POSES) + len(STREAM_PROFILES),
                max_size=len(STREAM_POSES) + len(STREAM_PROFILES)), st.booleans())
def test_the_order_of_arrival_changes_nothing(pose_next: list[bool], collecting: bool) -> None:
    session, streams = Session(CONFIG), [list(STREAM_PROFILES), list(STREAM_POSES)]
    outcomes: list[Sample | Reject] = []
    for which in pose_next:
        stream = streams[which] or streams[not which]
        add(session, stream.pop(0))
        if collecting:
            outcomes += session.collect()
    outcomes += session.finish()
    assert key(outcomes) == IN_ORDER
    assert key([*session.samples, *session.rejects]) == key([
        *(o for o in outcomes if isinstance(o, Sample)),
        *(o for o in outcomes if isinstance(o, Reject))])


@pytest.mark.parametrize('first', ['poses', 'profiles'])
def test_one_whole_stream_may_come_before_the_other(first: str) -> None:
    session = Session(CONFIG)
    order = [STREAM_POSES, STREAM_PROFILES]
    for stream in order if first == 'poses' else order[::-1]:
        for item in stream:
            add(session, item)
    assert key(session.finish()) == IN_ORDER


def test_a_station_is_reported_once_and_as_soon_as_both_streams_have_passed_it() -> None:
    session, result = Session(CONFIG), []
    for item in sorted([*STREAM_POSES, *STREAM_PROFILES], key=lambda item: item.stamp):
        add(session, item)
        result += [(o, item.stamp) for o in session.collect()]
    result += [(o, 0) for o in session.finish()]
    assert key([o for o, _ in result]) == IN_ORDER
    assert START + NS < result[0][1] < START + round(1.3 * NS)
    assert session.collect() == [] == session.finish()


def test_profiles_of_the_past_are_forgotten() -> None:
    session = Session(CONFIG)
    most = 0
    for item in sorted([*stops((0, 60), rate=10.0), *profiles(0, 60)],
                       key=lambda item: item.stamp):
        add(session, item)
        session.collect()
        most = max(most, len(session._profiles.items))
    assert most < 1.2 * 20 * LONGEST / NS


@pytest.mark.parametrize('jump', [-1e9, -30.0, 1.5, 30.0, 1e9])
@pytest.mark.parametrize('kind', ['pose', 'profile'])
@pytest.mark.parametrize('place', [0, 7, 8])
def test_one_wild_stamp_changes_nothing_but_that_message(
        jump: float, kind: str, place: int) -> None:
    streams: dict[str, list[TimedPose | Profile]] = {
        'pose': [*STREAM_POSES], 'profile': [*STREAM_PROFILES]}
    wild = streams[kind][place]
    items = sorted([*STREAM_POSES, *STREAM_PROFILES], key=lambda item: item.stamp)
    outcomes = []
    for left_out in (True, False):
        session = Session(CONFIG)
        for item in items:
            if item is not wild:
                add(session, item)
            elif not left_out:
                add(session, replace(item, stamp=item.stamp + round(jump * NS)))
            session.collect()
        session.finish()
        outcomes.append(key(results(session)))
        assert not session.late
    assert outcomes[0] == outcomes[1]
    # the first of all may be early: nothing tells that it is
    assert len(session.warnings) == (0 if place == 0 and jump < 0 else 1)
