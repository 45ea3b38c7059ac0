# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The order in which poses and profiles arrive changes nothing."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Profile, Reject, Sample, TimedPose
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import NS
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest
from streams import add, BAD, collect, CONFIG, key, played, profiles, results, stops

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
            outcomes += collect(session)
    outcomes += session.finish()
    assert key(outcomes) == IN_ORDER
    assert key([*session.samples, *session.rejects]) == key([
        *(o for o in outcomes if isinstance(o, Sample)),
        *(o for o in outcomes if isinstance(o, Reject))])


@pytest.mark.parametrize('first', ['pose', 'profile'])
def test_one_stream_may_be_far_behind_the_other(first: str) -> None:
    poses = stops((0, 1), (8, 9), (16, 17), rate=25.0)
    late = profiles(0.0, 17.0, rate=8.0)
    streams = [poses, late] if first == 'pose' else [late, poses]
    session, outcomes = Session(CONFIG), list[Sample | Reject]()
    for item in streams[0] + streams[1]:
        add(session, item)
        outcomes += collect(session)
    outcomes += session.finish()
    assert len(outcomes) == 3 and key(outcomes) == key(results(played(poses, late)))


@pytest.mark.parametrize('jump', [-1e9, -30.0, 1.5, 1e9])
@pytest.mark.parametrize('kind', ['pose', 'profile'])
@pytest.mark.parametrize('place', [0, 7])
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
            collect(session)
        session.finish()
        outcomes.append(key(results(session)))
        assert not session.late
    assert outcomes[0] == outcomes[1]
    # the first of all may be early: nothing tells that it is
    assert len(session.warnings) == (0 if place == 0 and jump < 0 else 1)
