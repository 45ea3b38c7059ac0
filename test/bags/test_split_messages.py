# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Several profiles in one message, as drivers send them."""
from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from handeye_ros import read_bag
from handeye_ros.bags.messages import profile_count, ProfileReader, profiles_of
from handeye_ros.bags.session_files import read_session, SessionFiles
from handeye_ros.bags.storage import CLOUD_TYPE, POSE_TYPE, RecordedMessage
from handeye_ros.bags.writer import pose_cdr
from handeye_ros.config import Config, ProfileConfig, SamplingConfig
from handeye_ros.data import RawProfile, TimedPose
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.sampling.session import Session
import numpy as np
import pytest
from recordings import cloud_message, POSES, rewrite
from recordings import TYPES as STORE
from ros_clouds import cloud, points

LAYOUT = {'x': (0, 7), 'y': (4, 7), 'z': (8, 7)}
START = 1_700_000_000_000_000_000
MS = 1_000_000
X = np.linspace(-0.02, 0.02, 60)


def batch(stamp: int, rows: int, *, first: int = 0, gocator: bool = False) -> bytes:
    """Return a message; the range tells which row it is, y is an encoder's (1 mm a row)."""
    number = np.arange(first, first + rows).repeat(len(X))
    scan = cloud({'x': np.tile(X, rows), 'y': 1e-3 * number, 'z': 0.2 + 1e-5 * number}, LAYOUT,
                 12, height=rows)
    if gocator:
        scan.height, scan.width, scan.row_step = rows * len(X), 1, 12
    return bytes(STORE.serialize_cdr(cloud_message(scan, stamp), CLOUD_TYPE))


def profiles(messages: Sequence[bytes], config: ProfileConfig) -> list[RawProfile]:
    reader, rows, before = ProfileReader(config), [], None
    for data in messages:
        whole = reader.take(data)
        rows += profiles_of(whole, before)
        before = whole.stamp
    return rows


@pytest.mark.parametrize(('stamp', 'begin'), [('first', 0.0), ('middle', -4.5), ('last', -9.0)])
def test_with_a_period_every_row_is_a_message_with_its_stamp(stamp: str, begin: float) -> None:
    config = ProfileConfig(period=1e-3, stamp=stamp)
    rows = profiles([batch(START + i * 10 * MS, 10, first=10 * i) for i in range(3)], config)
    assert [p.stamp for p in rows] == [START + round((begin + i) * MS) for i in range(30)]
    for index, row in enumerate(rows):
        message = STORE.deserialize_cdr(row.fetch(), CLOUD_TYPE)
        assert (message.height, message.width, len(message.data)) == (1, 60, 720)
        again = ProfileReader(config).take(row.fetch())
        assert (again.stamp, again.profile_count, row.time_margins) == (row.stamp, 1, (0, 0))
        for profile in (row.read(), again.read()):
            assert profile.stamp == row.stamp
            np.testing.assert_allclose(profile.points[:, 1], 0.2 + 1e-5 * index, rtol=1e-6)
            np.testing.assert_allclose(profile.points[:, 0], X, rtol=1e-6)
    for other in (batch(START, 4), batch(START, 10)[:-2], b''):  # the file has changed
        message = ProfileReader(config).take(batch(START, 10), partial(bytes, other))
        row = profiles_of(message, None)[-1]
        with pytest.raises(UnusableMessageError, match='damaged message'):
            row.read()


def test_rows_that_part_the_line_are_points() -> None:
    scan = cloud({'x': X, 'y': 0 * X, 'z': 0.2 + 0 * X}, LAYOUT, 12, height=4)
    assert profile_count(scan, ProfileConfig()) == 1
    assert profile_count(scan, ProfileConfig(rows='profiles')) == 4
    assert points(scan, ProfileConfig()).shape == (60, 2)
    one, = profiles([batch(START, 1, gocator=True)], ProfileConfig())
    assert one.read().points.shape == (60, 2)


@pytest.mark.parametrize(('stamp', 'reach'), [('first', (0, 40)), ('middle', (20, 20)),
                                              ('last', (40, 0))])
def test_without_a_period_a_row_has_a_range_of_times(stamp: str, reach: tuple[int, int]) -> None:
    rows = profiles([batch(START + i * 40 * MS, 8) for i in range(3)], ProfileConfig(stamp=stamp))
    assert len(rows) == 16, 'nobody knows how long the first took'
    assert all(p.time_margins == (reach[0] * MS, reach[1] * MS) for p in rows)
    stamps = [p.stamp for p in rows]
    assert stamps == sorted(set(stamps))


@pytest.mark.parametrize(('stamp', 'used'), [
    ('last', {1, 2, 3, 4, 6, 7}),  # that of 2.5 s began at 2 s, when the robot moved
    ('first', {1, 2, 3, 5, 6})])  # that of 2.0 s went on to 2.5 s, the last one is not over
def test_a_batch_during_which_the_robot_moved_is_not_used(stamp: str, used: set[int]) -> None:
    config = Config(profile=ProfileConfig(stamp=stamp), sampling=SamplingConfig(settle_time=0.0))
    session = Session(config)
    for i in range(400):  # stands, moves at 2 s, and stands again
        x = min(max(i / 100 - 2.0, 0.0), 0.2)
        session.add_pose(TimedPose(START + i * 10 * MS, np.array([x, 0, 0]),
                                   np.array([0, 0, 0, 1.0])))
    for profile in profiles([batch(START + i * 500 * MS, 4) for i in range(8)], config.profile):
        session.add_profile(profile)
    assert used == {round((p.stamp - START) / MS) // 500 for stop in session.take_remaining()
                    for p in stop.load(config).profiles}


@pytest.mark.parametrize(('moving', 'words'), [
    (True, 'which a robot that moves needs: set profile.period'),
    (False, 'none lies wholly in the 1.2 s of this stop: set profile.period, or stay longer')])
def test_where_no_batch_can_be_used_the_reason_says_so(
        moving: bool, words: str, tmp_path: Path) -> None:
    config = Config(sampling=SamplingConfig(mode='moving' if moving else 'still'))
    session, period = Session(config), 50 if moving else 1000
    for i in range(400):  # moves all the time, or stands for 1.2 s between two ways
        x = i / 1000 if moving else min(max(abs(i / 100 - 2.0) - 0.6, 0.0), 1.0)
        session.add_pose(TimedPose(START + i * 10 * MS, np.array([x, 0, 0]),
                                   np.array([0, 0, 0, 1.0])))
    batches = [batch(START + i * period * MS, 4) for i in range(4000 // period + 2)]
    for profile in profiles(batches, config.profile):
        session.add_profile(profile)
    session.evaluate_remaining()
    assert session.stops and not any(stop.profiles for stop in session.stops)
    assert all(reject.reason.endswith(words) for reject in session.rejects), session.rejects
    files = SessionFiles(lambda config: tmp_path)
    for stop in session.stops:
        files.add_stop(stop, config)
    assert files.path
    stored = read_session(files.path).session(config)
    assert [reject.reason for reject in stored.rejects] == [
        reject.reason for reject in session.rejects]


def test_a_bag_of_batches_is_read_row_by_row(good_bag, tmp_path) -> None:
    data = [batch(START + i * 50 * MS, 5, first=5 * i) for i in range(20)]
    raws = [RecordedMessage('/profile', CLOUD_TYPE, START + i * 50 * MS, d)
            for i, d in enumerate(data)]
    stands = [TimedPose(START + i * 10 * MS, p.translation, p.quaternion)
              for i, p in enumerate(POSES)]
    raws += [RecordedMessage('/flange_pose', POSE_TYPE, p.stamp, pose_cdr(p)) for p in stands]
    file = rewrite(good_bag, tmp_path / 'batches.mcap', raws)
    config = Config(profile=ProfileConfig(period=0.01))
    recording = read_bag(file, config)
    assert [p.stamp for p in recording.profiles] == [START + i * 10 * MS for i in range(100)]
    np.testing.assert_allclose([p.read().points[0, 1] for p in recording.profiles],
                               0.2 + 1e-5 * np.arange(100), rtol=1e-6)
    assert [p.stamp for p in recording.profiles_of_returns()] == [
        p.stamp for p in recording.profiles]
    with pytest.raises(InputError, match='several profiles, .*: set profile.period'):
        list(read_bag(file, Config()).profiles_of_returns())
    one = rewrite(good_bag, tmp_path / 'one.mcap', [raws[0], *raws[20:]])
    with pytest.raises(InputError, match='several profiles, .*: set profile.period'):
        read_bag(one, Config())
