# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stops from streams of poses and profiles, by themselves or by hand: what is kept of each."""
from __future__ import annotations

from dataclasses import replace
from functools import partial

from handeye_ros.config import Config, ProfileConfig, with_values
from handeye_ros.data import EdgePoint, NS, Profile, RawProfile, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import ProfileBuffer, PROFILES_OF_SAMPLE
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from streams import (
    add,
    BAD,
    collect,
    CONFIG,
    go_on,
    GOOD,
    in_order,
    MANUAL,
    played,
    pose,
    profile,
    profiles,
    START,
    stops,
    taken,
)


def test_every_stop_gives_a_sample_with_its_pose_and_its_first_stamp() -> None:
    session = played(stops((0, 1), (2, 3), (4, 5.2)), profiles(0, 5.2))
    assert [round((s.stamp - START) / NS, 3) for s in session.samples] == [0.103, 2.103, 4.103]
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.0, 0.1, 0.2]
    assert not session.rejects
    assert not session.warnings
    assert session.frame_id == 'laser'


@pytest.mark.parametrize('still_time', [0.3, 0.8])
def test_a_stop_shorter_than_still_time_is_none(still_time: float) -> None:
    config = with_values(CONFIG, {'sampling.still_time': still_time}, 'test')
    session = played(stops((0, 0.5), (2, 3)), profiles(0, 3), config)
    assert len(session.samples) == (2 if still_time < 0.5 else 1)


@pytest.mark.parametrize(('mode', 'poses'), [
    ('still', stops((0, 30))), ('moving', [pose(t, x=0.1 * t) for t in np.arange(0, 30, 0.02)])])
def test_the_longest_still_time_can_be_met(mode: str, poses: list[TimedPose]) -> None:
    config = with_values(CONFIG, {'sampling.still_time': 9.0, 'sampling.mode': mode}, 'test')
    assert played(poses, profiles(0, 30), config).samples


def test_a_robot_that_creeps_does_not_stand_still() -> None:
    creeping = [pose(t, x=9e-4 * t) for t in np.arange(0, 4, 0.02)]  # 0.9 mm/s
    assert len(played(creeping, profiles(0, 4)).samples) >= 4, 'the limit is 0.5 mm'
    strict = with_values(CONFIG, {'sampling.still_translation': 1e-4}, 'test')
    assert not played(creeping, profiles(0, 4), strict).samples
    turning = [pose(t, turn=8e-3 * t) for t in np.arange(0, 4, 0.02)]
    assert not played(turning, profiles(0, 4)).samples


def test_the_sign_of_a_quaternion_is_no_motion() -> None:
    poses = [replace(p, quaternion=p.quaternion * (-1) ** i) for i, p in enumerate(stops((0, 1)))]
    sample, = played(poses, profiles(0, 1)).samples
    assert np.allclose(sample.T_base_flange[:3, :3], np.eye(3))


def test_profiles_near_the_ends_of_a_stop_are_dropped() -> None:
    for settle in (0.0, 0.1, 0.3):
        config = with_values(CONFIG, {'sampling.settle_time': settle}, 'test')
        sample, = played(stops((0, 1)), profiles(0, 1), config).samples
        times = np.arange(0, 1, 0.05) + 0.003
        assert sample.profile_count == ((times >= settle) & (times <= 1 - settle)).sum()
    config = with_values(CONFIG, {'sampling.settle_time': 0.6}, 'test')
    reject, = played(stops((0, 1)), profiles(0, 1), config).rejects
    assert reject.reason.startswith('sampling.settle_time takes off 0.6 s at either end of')


def test_a_number_to_exclude_that_no_stop_has_is_told() -> None:
    config = with_values(CONFIG, {'samples.exclude': [1, 7]}, 'test')
    warning, = played(stops((0, 1)), profiles(0, 1), config).warnings
    assert warning == 'samples.exclude names no stop of these: [7]'


def test_a_gap_in_the_poses_ends_a_stop() -> None:
    poses = [p for p in stops((0, 3)) if not 1.0 < (p.stamp - START) / NS < 1.7]
    session = played(poses, profiles(0, 3))
    assert len(session.samples) == 2
    wide = with_values(CONFIG, {'sampling.max_pose_gap': 1.0}, 'test')
    assert len(played(poses, profiles(0, 3), wide).samples) == 1


def test_a_fast_sensor_is_thinned_out_evenly() -> None:
    settle = round(CONFIG.sampling.settle_time * NS)
    session = played(stops((0, 2)), profiles(0, 2, rate=500.0), finish=True)
    sample, = session.samples
    assert sample.profile_count == PROFILES_OF_SAMPLE < 900
    stop, = session.stops
    stamps = np.array([p.stamp for p in stop.load(CONFIG).profiles]) - START
    inside = (stamps >= settle) & (stamps <= 2 * NS - settle)
    assert [sum(stamps < settle), sum(inside), sum(stamps > 2 * NS - settle)] == [8, 73, 8]
    assert np.diff(stamps[inside]).max() <= NS / 40 + NS / 500
    edge, = (f for f in sample.features if isinstance(f, EdgePoint))
    slow_sample, = played(stops((0, 2)), profiles(0, 2, rate=50.0)).samples
    slow_edge, = (f for f in slow_sample.features if isinstance(f, EdgePoint))
    assert np.allclose(edge.point, slow_edge.point, atol=1e-9)


def test_a_stop_without_profiles_or_target_is_refused_with_a_reason() -> None:
    session = played(stops((0, 1), (2, 3), (4, 5)), [*profiles(0, 1), *profiles(2, 3, points=BAD)])
    assert len(session.samples) == 1
    no_edge, no_profile = session.rejects
    assert 'edge' in no_edge.reason and no_edge.stamp == START + 2 * NS
    assert 'no profile' in no_profile.reason and no_profile.stamp == START + 4 * NS


def test_most_profiles_of_a_stop_must_show_the_target() -> None:
    for with_target, count in ((12, 1), (6, 0)):
        mixed = [replace(p, points=GOOD if i < with_target else BAD)
                 for i, p in enumerate(profiles(0.1, 0.9))]
        session = played(stops((0, 1)), mixed)
        assert len(session.samples) == count and len(session.rejects) == 1 - count
        if count:
            assert session.samples[0].profile_count == with_target


def test_a_stop_near_an_earlier_one_brings_nothing_new() -> None:
    config, near = Config(), stops((0, 1), (2, 3))
    poses = [replace(p, translation=p.translation * [0.06, 1, 1]) for p in near]  # 6 mm apart
    session = played(poses, profiles(0, 3), config)
    reject, = session.rejects
    assert reject.reason == '6 mm and 0.0 degrees from sample 1: it brings nothing new'
    without = with_values(config, {'samples.exclude': [1]}, 'test')
    assert len(played(poses, profiles(0, 3), without).samples) == 1, 'of the second stop'
    turned = [replace(p, quaternion=pose(0, turn=0.1 * (p.stamp > START + NS)).quaternion)
              for p in poses]
    assert len(played(turned, profiles(0, 3), config).samples) == 2
    manual = with_values(config, {'sampling.mode': 'manual'}, 'test')
    by_hand = played([p for p in poses if p.stamp <= START + NS], profiles(0, 1), manual,
                     finish=False)
    taken(by_hand)
    for item in in_order(poses[51:], profiles(1.01, 3)):
        add(by_hand, item)
    with pytest.raises(DataError, match='6 mm .* from sample 1'):
        taken(by_hand)


def never(data: bytes, config: ProfileConfig) -> Profile:
    raise AssertionError('nothing is read')


def raw(stamp: int, size: int) -> RawProfile:
    return RawProfile(stamp, 'laser', partial(bytes, size), never, ProfileConfig(), size)


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 30), st.integers(0, 30)),
                max_size=60))
def test_no_more_is_kept_than_fits(steps: list[tuple[int, int, int]]) -> None:
    buffer = ProfileBuffer(1000)
    for stamp, (size, behind, ahead) in enumerate(steps):
        items, dropped = [*buffer.items, raw(stamp, size)], buffer.dropped_count
        buffer.add(items[-1:])
        assert sum(p.held_bytes for p in buffer.items) <= 1000
        assert buffer.items == items[buffer.dropped_count - dropped:], 'the oldest go first'
        first, last = stamp - behind, stamp - behind + ahead
        buffer.keep(first, last, stamp)
        assert all(first <= p.stamp <= last or p.stamp > stamp for p in buffer.items)


def test_profiles_that_were_dropped_stay_told() -> None:
    session = Session(CONFIG)
    for k in range(4):
        session.add_profile(raw(START + k * NS, 200_000_000))
    told, = session.warnings
    assert told.startswith('dropped 3 profiles, the oldest')
    session.configure(with_values(CONFIG, {'time_offset': 0.1}, 'test'))
    assert session.warnings == (told,)
    for k in range(8):
        session.add_profile(raw(START - 10 * NS + k * NS, 0))
        session.take_completed()
    assert told in session.warnings


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
    session.evaluate_remaining()
    assert sorted(round(float(s.T_base_flange[0, 3]), 6) for s in session.samples) == [0.0, 0.2]


def test_a_sample_by_hand_is_not_taken_again_by_itself() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    taken(session)
    go_on(session, in_order(stops((0, 1), (2, 3))[52:], profiles(1.02, 3)))
    session.evaluate_remaining()
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.0, 0.1]


@pytest.mark.parametrize(('poses', 'stream', 'words'), [
    ([], [], 'no flange pose'),
    ([pose(t, x=t) for t in np.arange(0, 1, 0.02)], profiles(0, 1), '0.5 s'),
    (stops((0, 1)), [], 'no profile has a stamp'),
    (stops((0, 1)), profiles(0, 1, points=BAD), 'edge'),
    (stops((0, 1)), profiles(0, 1.32), r'no pose has come for 0\.3 s')])
def test_why_no_sample_is_taken(poses: list[TimedPose], stream: list[Profile], words: str) -> None:
    with pytest.raises(DataError, match=words):
        taken(played(poses, stream, MANUAL, finish=False))


def test_the_last_sample_can_be_removed() -> None:
    session = played(stops((0, 1), (2, 3)), profiles(0, 3))
    first, second = session.stops
    session.remove(second)
    assert session.samples == (first.sample,)
    session.remove(first)
    session.require_any_stop()  # they were stops
