# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags that are cut off, damaged or none at all: what is whole is read, the rest is told."""
from __future__ import annotations

from contextlib import closing
import sqlite3

from handeye_ros.bags import bag, bag_write
from handeye_ros.errors import BagError, DataError, InputError
from hypothesis import example, given, settings
from hypothesis import strategies as st
import pytest
from recordings import (
    assert_equal_recordings,
    CONFIG,
    LAYOUTS_OF_MCAP,
    POSES,
    PROFILES,
    rewrite,
    rosbags_copy,
    scan,
    split,
    with_messages,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin


@pytest.mark.parametrize('layout', LAYOUTS_OF_MCAP)
@pytest.mark.parametrize('share', [0.3, 0.6, 0.9])
def test_a_cut_mcap_gives_what_lies_before_the_cut(good_bag, tmp_path, layout, share):
    options = LAYOUTS_OF_MCAP[layout] | {'chunk_size': 10_000}
    file = rewrite(good_bag, tmp_path / 'cut.mcap', **options)
    whole = file.read_bytes()
    data = whole[:int(share * len(whole))]
    file.write_bytes(data)
    recording = bag.read(file, CONFIG)
    n, m = len(recording.profiles), len(recording.poses)
    assert_equal_recordings(recording, PROFILES[:n], POSES[:m])
    assert 0 < n + m < len(PROFILES) + len(POSES)
    # all that is stored before the cut, but for a message and what a packer holds back
    assert n >= share * len(PROFILES) - (2 if 'compression' not in options else 5)
    assert f'cut.mcap is cut off or damaged: read {n + m} messages' in recording.warnings[0]


def test_a_recorder_that_was_killed_leaves_no_end(good_bag, tmp_path):
    file = rewrite(good_bag, tmp_path / 'killed.mcap', finish=False)
    recording = bag.read(file, CONFIG)
    assert len(recording.profiles) > len(PROFILES) - 5
    assert 'cut off' in recording.warnings[0]


@pytest.mark.parametrize('index', [0, 15])
def test_a_damaged_chunk_is_left_out(good_bag, tmp_path, index):
    # the first defines the channels too
    file = rewrite(good_bag, tmp_path / 'damaged.mcap')
    data = bytearray(file.read_bytes())
    raw = next(r for r in scan(good_bag)[1]
               if (r.topic, r.log_time) == ('/profile', PROFILES[index].stamp))
    data[data.index(raw.data) + 1000] ^= 0xff
    file.write_bytes(data)
    recording = bag.read(file, CONFIG)
    assert 0 < len(PROFILES) - len(recording.profiles) <= 2
    assert PROFILES[index].stamp not in [p.stamp for p in recording.profiles]
    assert recording.warnings == ('damaged.mcap is damaged: 1 chunk(s) of it were left out',)


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    """Return a folder of short recordings in all layouts."""
    folder = tmp_path_factory.mktemp('small')
    bag_write.write(folder / 'good', PROFILES[:4], POSES[:8])
    for layout, options in LAYOUTS_OF_MCAP.items():
        rewrite(folder / 'good', folder / layout, **options)
    return folder


PLACES = st.integers(0, 2 ** 20)


@settings(max_examples=150)
@given(st.sampled_from(list(LAYOUTS_OF_MCAP)), PLACES, st.binary(min_size=1, max_size=40), PLACES)
@example('lz4', 8035, b'\x00\x00', 24)  # a channel behind the chunks
@example('plain', 6005, b'\x00\x00\x00\x00\x80', 5)  # a length that no index can have
def test_damage_anywhere_is_an_input_error_or_a_part_of_the_truth(
        small, layout, start, garbage, rest):
    content = bytearray((small / layout).read_bytes())
    start %= len(content)
    content[start:start + len(garbage)] = garbage
    file = small / 'damaged.mcap'
    file.write_bytes(content[:start + rest % (len(content) - start + 1)])
    try:
        recording = bag.read(file, CONFIG)
    except (InputError, DataError) as error:
        assert str(error)
    else:
        assert recording.profiles
        assert recording.poses


@pytest.mark.parametrize('damage', ['missing', 'not YAML', 'other content'])
def test_a_folder_without_usable_metadata(good_bag, damage):
    metadata = good_bag / 'metadata.yaml'
    metadata.unlink()
    if damage != 'missing':
        metadata.write_text('a: [b' if damage == 'not YAML' else 'a: b')
    recording = bag.read(good_bag, CONFIG)
    assert_equal_recordings(recording)
    assert 'metadata.yaml is missing or damaged' in recording.warnings[0]


def test_a_split_bag_with_a_file_missing(good_bag, tmp_path):
    target = split(good_bag, tmp_path / 'split', listed=True)
    (target / 'split_4.mcap').unlink()
    recording = bag.read(target, CONFIG)
    assert len(recording.profiles) < len(PROFILES)
    assert '1 of the 11 files that metadata.yaml lists are missing' in recording.warnings


def test_a_single_db3_and_a_cut_one(good_bag, tmp_path):
    copy = rosbags_copy(good_bag, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
    file = copy / 'copy.db3'
    assert_equal_recordings(bag.read(file, CONFIG))
    whole = file.read_bytes()
    file.write_bytes(whole[:len(whole) * 2 // 3])
    with pytest.raises(BagError, match='copy.db3 is cut off or damaged'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('broken', [False, True])
def test_a_db3_whose_recorder_was_killed_keeps_the_rest_in_its_log(good_bag, tmp_path, broken):
    copy = rosbags_copy(good_bag, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
    killed = tmp_path / 'killed'
    killed.mkdir()
    with closing(sqlite3.connect(copy / 'copy.db3')) as database:
        rows = database.execute('SELECT * FROM messages').fetchall()
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('DELETE FROM messages WHERE id > 60')
        database.commit()
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        database.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', rows[60:])
        database.commit()
        for name in ('copy.db3', 'copy.db3-wal'):
            (killed / name).write_bytes((copy / name).read_bytes())
    if broken:
        (killed / 'copy.db3-wal').write_bytes(b'no log at all' * 100)
    before = sorted((p.name, p.read_bytes()) for p in killed.iterdir())
    recording = bag.read(killed / 'copy.db3', CONFIG)
    count = len(recording.profiles) + len(recording.poses)
    assert count == (60 if broken else len(PROFILES) + len(POSES))
    assert sorted((p.name, p.read_bytes()) for p in killed.iterdir()) == before


def test_not_there(tmp_path):
    with pytest.raises(BagError, match='no such file or folder'):
        bag.read(tmp_path / 'nothing', CONFIG)


@pytest.mark.parametrize(('content', 'reason'), [
    (b'', 'the file is empty'), (b'x: 1\n', 'is not a bag'), (b'#ROSBAG V2.0\n', 'a ROS 1 bag'),
    (b'\x89MCAP0\r\n', 'holds no messages'), (b'\x28\xb5\x2f\xfd12345678', 'is not a bag'),
    (b'SQLite format 3\0', 'holds no messages')])
def test_not_a_bag(tmp_path, content, reason):
    (tmp_path / 'x.mcap').write_bytes(content)
    with pytest.raises(BagError, match=reason):
        bag.read(tmp_path / 'x.mcap', CONFIG)


def test_a_folder_that_is_no_bag(tmp_path):
    with pytest.raises(BagError, match='holds no .mcap or .db3 file'):
        bag.read(tmp_path, CONFIG)


def test_malformed_messages_are_counted_and_left_out(good_bag, tmp_path):
    def cut(raw):
        third = raw.topic == '/profile' and raw.log_time == PROFILES[3].stamp
        return raw._replace(data=raw.data[:len(raw.data) // 2]) if third else raw

    recording = bag.read(with_messages(good_bag, tmp_path, cut), CONFIG)
    assert_equal_recordings(recording, PROFILES[:3] + PROFILES[4:])
    assert recording.warnings[0].startswith(
        f'1 of {len(PROFILES)} messages on /profile were left out; the first: ')


def test_a_damaged_table_of_db3_is_no_crash(good_bag, tmp_path):
    copy = rosbags_copy(good_bag, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
    with sqlite3.connect(copy / 'copy.db3') as database:
        database.execute('DROP TABLE messages')
    with pytest.raises(BagError, match='no messages on /profile'):
        bag.read(copy, CONFIG)
