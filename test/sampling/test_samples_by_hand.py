# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Samples that are taken by hand, removed and cleared."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.errors import DataError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
import numpy as np
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
    stops,
    taken,
)


def removed_last(session: Session) -> Stop:
    last = session.stops[-1]
    session.remove(last)
    return last


def test_a_sample_is_kept_when_taking_it_again_fails() -> None:
    session = played(stops((0, 1)), profiles(0, 1), MANUAL, finish=False)
    sample = taken(session)
    for p in [pose(1.02 + 0.02 * i) for i in range(200)]:
        session.add_pose(p)
    for p in profiles(1.0, 4.9, points=BAD):
        session.add_profile(p)
    with pytest.raises(DataError, match='edge'):
        taken(session)
    assert session.samples == (sample,)


def test_a_sample_by_hand_takes_none_from_the_stop_before() -> None:
    session = Session(CONFIG)  # one profile a stop: the first stop waits for that of the second
    for start in (0, 20):
        for t in np.arange(start, start + 1, 0.02):
            add(session, pose(t, x=0.01 * start))
        add(session, profile(start + 0.5))
        collect(session)
    taken(session)
    session.finish()
    assert sorted(round(float(s.T_base_flange[0, 3]), 6) for s in session.samples) == [0.0, 0.2]


def test_a_sample_by_hand_is_not_taken_again_by_itself() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    taken(session)
    for item in sorted([*stops((0, 1), (2, 3))[52:], *profiles(1.02, 3)],
                       key=lambda item: item.stamp):
        add(session, item)
        collect(session)
    session.finish()
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.0, 0.1]


def test_why_no_sample_can_be_taken_is_reported() -> None:
    session = Session(MANUAL)
    with pytest.raises(DataError, match='no flange pose'):
        taken(session)
    session = played([pose(t, x=t) for t in np.arange(0, 1, 0.02)], profiles(0, 1), MANUAL)
    with pytest.raises(DataError, match='0.5 s'):
        taken(session)
    with pytest.raises(DataError, match='no profile has a stamp'):
        taken(played(stops((0, 1)), [], MANUAL))
    with pytest.raises(DataError, match='edge'):
        taken(played(stops((0, 1)), profiles(0, 1, points=BAD), MANUAL))


def test_the_last_sample_can_be_removed() -> None:
    session = played(stops((0, 1), (2, 3)), profiles(0, 3))
    first, second = session.samples
    assert removed_last(session).result is second and session.samples == (first,)
    assert removed_last(session).result is first and not session.samples
    session.require_stops()  # they were stops


def test_clearing_forgets_everything_also_the_frames_and_the_time() -> None:
    session = played(stops((0, 1)), [*profiles(0, 1), profile(1.5, frame='x')], finish=False)
    session.clear()
    assert session.samples == session.rejects == session.warnings == ()
    assert session.frame_id == ''
    again = sorted([*stops((0, 1)), *(replace(p, frame_id='x') for p in profiles(0, 1))],
                   key=lambda item: item.stamp)
    for item in again:
        add(session, item)
    assert len(session.finish()) == 1 and session.frame_id == 'x'
