# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The stamps of a recording: sorted, wild, missing, and of two runs."""
from __future__ import annotations

from handeye_ros.bags import bag
from handeye_ros.errors import DataError
import numpy as np
import pytest
from recordings import (
    assert_equal_recordings,
    CONFIG,
    POSES,
    PROFILES,
    PROFILES_PERIOD,
    restamped,
    rewrite,
    scan,
    START,
    with_messages,
    written,
)


def rewrite_with_header_stamps(folder, tmp_path, topics, stamp_of):
    """Return a copy whose header stamps are stamp_of(log time) while log times stay."""
    def change(raw):
        if raw.topic not in topics:
            return raw
        sec, nanosec = divmod(stamp_of(raw.log_time), 1_000_000_000)
        stamp = sec.to_bytes(4, 'little') + nanosec.to_bytes(4, 'little')
        return raw._replace(data=raw.data[:4] + stamp + raw.data[12:])

    return with_messages(folder, tmp_path, change)


def test_slight_disorder_is_sorted(tmp_path):
    order = np.arange(len(POSES)).reshape(-1, 2)[:, ::-1].ravel()
    stamps = {POSES[i].stamp: POSES[j].stamp for i, j in enumerate(order)}
    folder = written(tmp_path)
    file = rewrite_with_header_stamps(folder, tmp_path, ['/flange_pose'], stamps.__getitem__)
    recording = bag.read(file, CONFIG)
    assert [p.stamp for p in recording.poses] == [p.stamp for p in POSES]


def test_messages_that_lie_in_any_order_are_sorted_by_their_receipt(good_bag, tmp_path):
    messages = scan(good_bag)[1]
    shuffled = [messages[i] for i in np.random.default_rng(5).permutation(len(messages))]
    times = [raw.log_time for raw in messages]
    spread = [raw._replace(log_time=times[0] + 60 * (raw.log_time - times[0]))
              for raw in shuffled]

    def later(stamp):
        return times[0] + 60 * (stamp - times[0])

    file = rewrite(good_bag, tmp_path / 'shuffled.mcap', spread)
    (tmp_path / 'again').mkdir()
    file = rewrite_with_header_stamps(file, tmp_path / 'again', ['/profile', '/flange_pose'],
                                      lambda log_time: log_time)
    recording = bag.read(file, CONFIG)
    assert [p.stamp for p in recording.profiles] == [later(p.stamp) for p in PROFILES]
    assert [p.stamp for p in recording.poses] == [later(p.stamp) for p in POSES]
    assert all('were sorted' in warning for warning in recording.warnings)
    assert len(recording.warnings) == 2


def test_two_runs_of_one_simulated_clock_are_refused(good_bag, tmp_path):
    messages = scan(good_bag)[1]
    spread = [raw._replace(log_time=START + 9 * (raw.log_time - START)) for raw in messages]
    (tmp_path / 'again').mkdir()
    file = rewrite(good_bag, tmp_path / 'twice.mcap', spread + spread)
    file = rewrite_with_header_stamps(file, tmp_path / 'again', ['/profile', '/flange_pose'],
                                      lambda log_time: log_time)
    with pytest.raises(DataError, match='two runs'):
        bag.read(file, CONFIG)


def test_time_that_starts_again_is_refused(tmp_path):
    longer = restamped(POSES, [START + i * 100_000_000 for i in range(len(POSES))])
    folder = written(tmp_path, poses=longer)
    middle = longer[50].stamp
    file = rewrite_with_header_stamps(
        folder, tmp_path, ['/flange_pose'], lambda t: t if t < middle else t - middle + START)
    with pytest.raises(DataError, match='/flange_pose jump back by 4.9 s at message 51'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('topic', ['/profile', '/flange_pose'])
@pytest.mark.parametrize('wild', [1, START - 10**18, START + 20 * 10**9, 2_100_000_000 * 10**9])
@pytest.mark.parametrize('places', [[0], [15], [28, 29], [3, 4, 20]])
def test_a_few_wild_stamps_are_dropped_and_reported(good_bag, tmp_path, topic, wild, places):
    items = PROFILES if topic == '/profile' else POSES
    stamps = {item.stamp: item.stamp for item in items}
    stamps |= {items[i].stamp: wild + i for i in places}
    file = rewrite_with_header_stamps(good_bag, tmp_path, [topic], stamps.__getitem__)
    recording = bag.read(file, CONFIG)
    kept = recording.profiles if topic == '/profile' else recording.poses
    inside = {p.stamp for p in kept} - {wild + i for i in places}
    assert inside == {item.stamp for i, item in enumerate(items) if i not in places}
    # what is wild at an end of the recording is in order, and far from all stations
    inner = [i for i in places if 0 < i < len(items) - 2]
    assert len(kept) <= len(items) - len(inner)
    if inner:
        warning, = recording.warnings
        assert f'of {len(items)} messages on {topic} were left out: their stamps' in warning


def test_two_interleaved_runs_are_refused(good_bag, tmp_path):
    shift = {p.stamp: p.stamp - i % 2 * 60 * 10**9 for i, p in enumerate(POSES)}
    file = rewrite_with_header_stamps(good_bag, tmp_path, ['/flange_pose'], shift.__getitem__)
    with pytest.raises(DataError, match='two runs'):
        bag.read(file, CONFIG)


def test_a_driver_without_stamps_gets_the_times_of_receipt(good_bag, tmp_path):
    file = rewrite_with_header_stamps(good_bag, tmp_path, ['/profile'], lambda _: 0)
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording)
    assert 'the messages on /profile have no stamps' in recording.warnings[0]


def test_single_messages_without_stamp_are_left_out(good_bag, tmp_path):
    first = PROFILES[0].stamp
    file = rewrite_with_header_stamps(
        good_bag, tmp_path, ['/profile'], lambda t: 0 if t == first else t)
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording, PROFILES[1:])
    assert '1 messages on /profile without a stamp were left out' in recording.warnings[0]


def test_clocks_that_share_no_time(good_bag, tmp_path):
    file = rewrite_with_header_stamps(
        good_bag, tmp_path, ['/profile'], lambda t: t - START + PROFILES_PERIOD)
    with pytest.raises(DataError, match='share no time'):
        bag.read(file, CONFIG)
