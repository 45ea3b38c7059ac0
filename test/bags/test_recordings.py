# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings in every form: written whole or not at all; what is whole is read, the rest told."""
from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
import shutil
import sqlite3

from handeye_ros import read_bag
from handeye_ros.arm import arm_of
from handeye_ros.bags import writer
from handeye_ros.bags.storage import CLOUD_TYPE, JOINTS_TYPE, RecordedMessage, TF_TYPE
from handeye_ros.config import Config, ProfileConfig
from handeye_ros.errors import DataError, InputError, UnwritableError
from handeye_ros.results.truth import true_transform
from handeye_ros.simulate import FILE_SCENES, robot, SCENARIOS, simulate
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import MAGIC_SIZE
import numpy as np
import pytest
from recordings import (
    assert_equal_recordings,
    CONFIG,
    header,
    LAYOUTS_OF_MCAP,
    new,
    POINTS,
    POSES,
    POSES_PERIOD,
    PROFILES,
    PROFILES_PERIOD,
    rewrite,
    rosbags_copy,
    scan,
    split,
    START,
    transform,
    TYPES,
    with_layout,
    with_messages,
    written,
)
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
import yaml

SQLITE3, NONE = StoragePlugin.SQLITE3, CompressionMode.NONE
BAGS = Path(__file__).parents[2] / 'bags'
NAMES = ('plate', 'plate_sweep', 'sphere', 'one_orientation', 'inverted_poses', 'line', 'plane',
         'tracker')
SECOND = 10**9


def refused(words, path, config=CONFIG, kind=InputError):
    with pytest.raises(kind, match=words):
        read_bag(path, config)


def read_whole(path):
    """Return a recording of which nothing is lost or changed, and nothing told."""
    recording = read_bag(path, CONFIG)
    assert_equal_recordings(recording)
    assert not recording.warnings
    return recording


# -- forms


# sqlite3 has no compression of its own; whole compressed files are refused
@pytest.mark.parametrize(('write', 'form'), [
    *((rewrite, options) for options in LAYOUTS_OF_MCAP.values()),
    *((rosbags_copy, {'plugin': plugin, 'mode': mode}) for plugin in StoragePlugin
      for mode in CompressionMode if mode is not CompressionMode.FILE
      and (plugin, mode) != (SQLITE3, CompressionMode.STORAGE))])
def test_every_layout_storage_and_compression_is_read(good_bag, tmp_path, write, form):
    read_whole(write(good_bag, tmp_path / 'copy.mcap', **form))


def test_whole_compressed_files_are_refused(good_bag, tmp_path):
    folder = rosbags_copy(good_bag, tmp_path / 'copy', SQLITE3, CompressionMode.FILE)
    for path in (folder, folder / 'copy.db3.zstd'):
        refused('zstd -d', path)


def test_a_split_bag_is_read_and_so_is_one_with_a_file_missing(good_bag, tmp_path):
    target = split(good_bag, tmp_path / 'split')
    assert len(read_whole(target).inputs) == 11
    (target / 'split_4.mcap').unlink()
    recording = read_bag(target, CONFIG)
    assert len(recording.profiles) < len(PROFILES) and not recording.warnings


@pytest.mark.parametrize('name', NAMES)
def test_the_bags_beside_the_code_hold_what_they_were_made_from(name):
    truth = yaml.safe_load((BAGS / name / 'truth.yaml').read_text(encoding='utf-8'))
    rng, scenario = np.random.default_rng(truth['seed']), truth['scenario']
    simulated = (FILE_SCENES[scenario](rng) if name == 'tracker'
                 else simulate(SCENARIOS[scenario], rng))
    T_true = simulated.T_flange_sensor if name == 'tracker' else simulated.truth.T_flange_sensor
    assert np.allclose(true_transform(BAGS / name), T_true, atol=1e-9)
    recording = read_bag(BAGS / name, Config())
    assert not recording.warnings
    for raw, expected in zip(recording.profiles, simulated.profiles, strict=True):
        stored, points = raw.read(), expected.points
        if len(stored.points) != len(points):  # a cloud of scattered ones is read along the line
            points = points[np.isfinite(points).all(axis=1)]
            points = points[np.argsort(points[:, 0])]
        assert stored.stamp == expected.stamp
        # single precision; another numpy may round a coordinate to the next step
        assert np.allclose(stored.points, points, rtol=0, atol=2e-6, equal_nan=True)
    for stored, expected in zip(recording.poses, simulated.poses, strict=True):
        assert stored.stamp == expected.stamp
        assert np.allclose(stored.translation, expected.translation, rtol=0, atol=1e-9)
        assert np.allclose(stored.quaternion, expected.quaternion, rtol=0, atol=1e-9)


# -- damage


@pytest.mark.parametrize('layout', LAYOUTS_OF_MCAP)
@pytest.mark.parametrize('share', [0.3, 0.9])
def test_a_cut_mcap_gives_what_lies_before_the_cut(good_bag, tmp_path, layout, share):
    options = LAYOUTS_OF_MCAP[layout] | {'chunk_size': 10_000}
    file = rewrite(good_bag, tmp_path / 'cut.mcap', **options)
    whole = file.read_bytes()
    file.write_bytes(whole[:int(share * len(whole))])
    recording = read_bag(file, CONFIG)
    n, m = len(recording.profiles), len(recording.poses)
    assert_equal_recordings(recording, PROFILES[:n], POSES[:m])
    # all whole chunks before the cut, of up to five profiles
    assert n >= share * len(PROFILES) - (1 if layout == 'without chunks' else 5)
    assert f'cut off or damaged: read {n + m} messages' in recording.warnings[0]


def test_a_damaged_chunk_is_dropped(good_bag, tmp_path, index=15):
    file = rewrite(good_bag, tmp_path / 'damaged.mcap')
    data = bytearray(file.read_bytes())
    raw = next(r for r in scan(good_bag)[1]
               if (r.topic, r.log_time) == ('/profile', PROFILES[index].stamp))
    data[data.index(raw.data) + 1000] ^= 0xff
    file.write_bytes(data)
    recording = read_bag(file, CONFIG)
    assert 0 < len(PROFILES) - len(recording.profiles) <= 2
    assert PROFILES[index].stamp not in [p.stamp for p in recording.profiles]
    warning, = recording.warnings
    assert warning.endswith('messages, dropped 1 damaged chunk(s)')


def test_an_empty_chunk_is_no_damage(good_bag, tmp_path):
    file = rewrite(good_bag, tmp_path / 'x.mcap')
    data, at = file.read_bytes(), MAGIC_SIZE
    while data[at] != Opcode.DATA_END:
        at += 9 + int.from_bytes(data[at + 1:at + 9], 'little')
    builder = RecordBuilder()
    Chunk('', b'', 0, 0, 0, 0).write(builder)
    file.write_bytes(data[:at] + builder.end() + data[at:])
    read_whole(file)


def test_a_file_that_changes_after_it_was_read_is_told(good_bag, tmp_path):
    file = rewrite(good_bag, tmp_path / 'x.mcap')
    recording = read_bag(file, CONFIG)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match='none of the 30 profiles .* can be used'):
        list(recording.profiles_of_returns())


def test_another_recording_at_the_same_place_is_read_anew(tmp_path):
    for factor in (1.0, 2.0):
        profiles = [replace(p, points=p.points * factor) for p in PROFILES]
        writer.write(tmp_path / 'bag', profiles, POSES, force=True)
        assert_equal_recordings(read_bag(tmp_path / 'bag', CONFIG), profiles)


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    """Return a folder of short recordings in all layouts."""
    folder = tmp_path_factory.mktemp('small')
    writer.write(folder / 'good', PROFILES[:4], POSES[:8])
    for layout, options in LAYOUTS_OF_MCAP.items():
        rewrite(folder / 'good', folder / layout, **options)
    return folder


PLACES = st.integers(0, 2 ** 20)


@settings(max_examples=100)
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
        recording = read_bag(file, CONFIG)
    except (InputError, DataError) as error:
        assert str(error)
    else:
        assert recording.profiles and recording.poses


def test_a_folder_is_read_without_its_metadata(good_bag):
    (good_bag / 'metadata.yaml').write_text('a: [b')
    read_whole(good_bag)


def test_a_db3_of_a_killed_recorder_is_read_with_its_write_ahead_log(good_bag, tmp_path):
    file = rosbags_copy(good_bag, tmp_path / 'copy', SQLITE3, NONE) / 'copy.db3'
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('PRAGMA wal_autocheckpoint=0')
        database.execute('INSERT INTO messages SELECT NULL, topic_id, timestamp + 20000000000,'
                         'data FROM messages')
        database.commit()
        killed = tmp_path / 'killed'
        shutil.copytree(file.parent, killed)
    files = {path: path.read_bytes() for path in killed.iterdir() if path.suffix != '.db3-shm'}
    assert len(read_bag(killed / 'copy.db3', CONFIG).poses) == 2 * len(POSES)
    assert all(path.read_bytes() == content for path, content in files.items())


def test_nothing_is_written_beside_a_db3(good_bag, tmp_path):
    file = rosbags_copy(good_bag, tmp_path / 'copy', SQLITE3, NONE) / 'copy.db3'
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode=WAL')
    before = {*file.parent.iterdir()}
    read_whole(file)
    assert {*file.parent.iterdir()} == before


def test_a_db3_that_is_cut_or_without_its_table_is_refused(good_bag, tmp_path):
    file = rosbags_copy(good_bag, tmp_path / 'copy', SQLITE3, NONE) / 'copy.db3'
    whole = file.read_bytes()
    file.write_bytes(whole[:len(whole) * 2 // 3])
    refused('copy.db3 is cut off or damaged', file)
    file.write_bytes(whole)
    with sqlite3.connect(file) as database:
        database.execute('DROP TABLE messages')
    refused('no messages on /profile', file)


@pytest.mark.parametrize(('content', 'reason'), [
    (b'', 'the file is empty'), (b'x: 1\n', 'is not a bag'), (b'#ROSBAG V2.0\n', 'a ROS 1 bag'),
    (b'\x89MCAP0\r\n', 'holds no messages'), (b'\x28\xb5\x2f\xfd12345678', 'is compressed'),
    (b'SQLite format 3\0', 'holds no messages'), (None, 'no such file or folder')])
def test_what_is_no_bag_is_told(tmp_path, content, reason):
    if content is not None:
        (tmp_path / 'x.mcap').write_bytes(content)
    refused(reason, tmp_path / 'x.mcap')
    (tmp_path / 'x.mcap').unlink(missing_ok=True)
    refused('holds no .mcap or .db3 file', tmp_path)


# -- stamps


def restamped_bag(folder, tmp_path, topics, stamp_of):
    """Return a copy whose header stamps are stamp_of(log time) while log times stay."""
    def change(raw):
        if raw.topic not in topics:
            return raw
        stamp = np.array(divmod(stamp_of(raw.log_time), SECOND), '<u4').tobytes()
        return raw._replace(data=raw.data[:4] + stamp + raw.data[12:])

    (tmp_path / 'again').mkdir()
    return with_messages(folder, tmp_path / 'again', change)


def test_slight_disorder_is_sorted(good_bag, tmp_path):
    order = np.arange(len(POSES)).reshape(-1, 2)[:, ::-1].ravel()
    stamps = {POSES[i].stamp: POSES[j].stamp for i, j in enumerate(order)}
    file = restamped_bag(good_bag, tmp_path, ['/flange_pose'], stamps.__getitem__)
    assert [p.stamp for p in read_bag(file, CONFIG).poses] == [p.stamp for p in POSES]


def test_two_runs_of_one_clock_one_after_the_other_are_refused(good_bag, tmp_path):
    messages = scan(good_bag)[1]
    spread = [raw._replace(log_time=START + 60 * (raw.log_time - START)) for raw in messages]
    file = rewrite(good_bag, tmp_path / 'twice.mcap', spread + spread)
    refused('two runs', restamped_bag(file, tmp_path, ['/profile', '/flange_pose'],
                                      lambda log_time: log_time), kind=DataError)


@pytest.mark.parametrize(('stamp_of', 'words'), [
    (lambda t: t - t % 2 * 60 * SECOND, 'two runs'),
    (lambda t: t if t < START + 5 * SECOND else t - 5 * SECOND, 'back by 4.9 s at message 51')])
def test_times_that_start_again_are_refused(tmp_path, stamp_of, words):
    longer = [replace(pose, stamp=START + i * 100_000_000 + i % 2) for i, pose in enumerate(POSES)]
    file = restamped_bag(written(tmp_path, poses=longer), tmp_path, ['/flange_pose'], stamp_of)
    refused(words, file, kind=DataError)


@pytest.mark.parametrize('topic', ['/profile', '/flange_pose'])
@pytest.mark.parametrize('wild', [1, START + 20 * SECOND])
@pytest.mark.parametrize('places', [[0], [3, 4, 20]])
def test_a_few_wild_stamps_are_dropped_and_reported(good_bag, tmp_path, topic, wild, places):
    items = PROFILES if topic == '/profile' else POSES
    stamps = {item.stamp: item.stamp for item in items}
    stamps |= {items[i].stamp: wild + i for i in places}
    recording = read_bag(restamped_bag(good_bag, tmp_path, [topic], stamps.__getitem__), CONFIG)
    kept_messages = recording.profiles if topic == '/profile' else recording.poses
    inside = {p.stamp for p in kept_messages} - {wild + i for i in places}
    assert inside == {item.stamp for i, item in enumerate(items) if i not in places}
    # what is wild at an end of the recording is in order, and far from all stations
    inner = [i for i in places if 0 < i < len(items) - 2]
    assert len(kept_messages) <= len(items) - len(inner)
    if inner:
        warning, = recording.warnings
        assert f'of {len(items)} messages on {topic} were dropped: their stamps' in warning


def test_missing_stamps_are_told_and_clocks_that_share_no_time_refused(good_bag, tmp_path):
    first = PROFILES[0].stamp
    for count, stamp_of in ((30, lambda _: 0), (1, lambda t: 0 if t == first else t)):
        (tmp_path / str(count)).mkdir()
        recording = read_bag(restamped_bag(good_bag, tmp_path / str(count), ['/profile'],
                                           stamp_of), CONFIG)
        assert_equal_recordings(recording)
        assert f'{count} messages on /profile have no stamps' in recording.warnings[0]
    file = restamped_bag(good_bag, tmp_path, ['/profile'], lambda t: t - START + PROFILES_PERIOD)
    refused('share no time.* at most 10 s, set time_offset', file, kind=DataError)


# -- topics


@pytest.mark.parametrize(('config', 'words'), [
    (Config(profile_topic='laser'), r'no topic /laser.*/flange_pose .*profile_topic=/profile$'),
    (Config(pose_topic='profile'), '/profile with .*PoseStamped.*pose_topic=/flange_pose'),
    (Config(pose_source='tf'), 'no topic /tf.*set pose_source')])
def test_a_wrong_topic_lists_what_is_there(good_bag, config, words):
    refused(words, good_bag, config)


def test_other_types_and_encodings_are_refused(good_bag, tmp_path):
    kind = 'nav_msgs/msg/Odometry'
    file = rewrite(good_bag, tmp_path / 'other.mcap', types={'/flange_pose': kind})
    refused(rf'no topic /flange_pose with .*, but /flange_pose \({kind}\).*publish and', file)
    file = rewrite(good_bag, tmp_path / 'old.mcap', encoding='ros1')
    refused(r'/profile \(.*PointCloud2 in ros1\)', file)


def test_messages_that_cannot_be_used_are_counted_and_dropped(good_bag, tmp_path):
    def cut(raw):
        third = raw.topic == '/profile' and raw.log_time == PROFILES[3].stamp
        return raw._replace(data=raw.data[:len(raw.data) // 2]) if third else raw

    recording = read_bag(with_messages(good_bag, tmp_path, cut), CONFIG)
    assert_equal_recordings(recording, PROFILES[:3] + PROFILES[4:])
    assert recording.warnings[0].startswith(
        f'1 of {len(PROFILES)} messages on /profile were dropped; the first: ')
    far = [replace(p, points=p.points * 1e3) if i in (5, 6) else p for i, p in enumerate(PROFILES)]
    recording = read_bag(written(tmp_path, name='far', profiles=far), CONFIG)
    assert [p.stamp for p in recording.profiles_of_returns()] == [
        p.stamp for p in PROFILES[:5] + PROFILES[7:]]
    assert recording.warnings[0].startswith(
        f'2 of {len(PROFILES)} profiles of the recording were dropped; the first: PointCloud2')
    few = [replace(p, points=p.points * np.nan) if i < 5 else p for i, p in enumerate(PROFILES)]
    zero = [replace(p, quaternion=np.zeros(4)) for p in POSES]
    millimetres = Config(profile=ProfileConfig(unit='mm'))
    for name, items, config, words in (
            ('unit', {'profiles': few, 'config': millimetres}, CONFIG, 'only 5 of the 30 messages '
             'on /profile can be used; .*: set profile.unit to mm'),
            ('zero', {'poses': zero}, CONFIG, 'none of the 100 messages on /flange_pose can be '
             'used; the first reason: .*of length 0'),
            ('none', {'poses': []}, CONFIG, 'no topic /flange_pose')):
        refused(words, written(tmp_path, name=name, **items), config)


def test_joint_states_of_another_device_are_no_fault_beside_those_of_the_arm(tmp_path):
    pytest.importorskip('pinocchio', reason='needs pinocchio')
    writer.write(tmp_path / 'bag', PROFILES, (),
                 joints=[(profile.stamp, np.zeros(6)) for profile in PROFILES])
    (_, messages), arm = scan(tmp_path / 'bag'), arm_of(robot.URDF)
    assert [raw.log_time for raw in messages] == sorted(raw.log_time for raw in messages)
    data = writer.to_cdr(new(JOINTS_TYPE, header(START, ''), ['gripper'], np.zeros(1),
                             np.zeros(0), np.zeros(0)))
    clouds = [raw for raw in messages if raw.message_type == CLOUD_TYPE]
    others = [raw._replace(data=data) for raw in messages if raw not in clouds]
    both = read_bag(rewrite(tmp_path / 'bag', tmp_path / 'both.mcap',
                            [*messages, *others, *others]), CONFIG, arm=arm)
    assert (len(both.poses), both.warnings) == (len(PROFILES), [])
    with pytest.raises(InputError, match='none of the 30 .*; the joints with values are gripper'):
        read_bag(rewrite(tmp_path / 'bag', tmp_path / 'others.mcap', [*clouds, *others]), CONFIG,
                 arm=arm)


@pytest.mark.parametrize('kind, frame, items', [
    ('pose', 'parent_frame', POSES), ('profile', 'frame_id', PROFILES * 4)])
def test_messages_of_another_frame_are_strays_and_many_are_refused(tmp_path, kind, frame, items):
    items = [replace(item, stamp=POSES[0].stamp + i * 10 ** 7) for i, item in enumerate(items)]
    first = getattr(items[0], frame)
    for name, others in (('first', [0]), ('last', range(len(items) - 5, len(items))),
                         ('some', range(1, len(items), 10)), ('half', range(1, len(items), 2))):
        mixed = [replace(item, **{frame: 'map'}) if i in others else item
                 for i, item in enumerate(items)]
        path = written(tmp_path, name=name, **{f'{kind}s': mixed})
        if name in ('first', 'last'):
            recording = read_bag(path, CONFIG)
            kept_stamps = [item.stamp for i, item in enumerate(items) if i not in others]
            assert [item.stamp for item in getattr(recording, f'{kind}s')] == kept_stamps
            assert recording.warnings == [
                f'{len(others)} of {len(items)} {kind}s were dropped: their frame is "map", not '
                f'"{first}"']
        else:
            refused(f'two frames, "{first}" and "map"', path)


# -- transforms


def tf_bag(folder, tmp_path, moving, static=()):
    """Return a copy of the bag with lists of transforms on /tf and /tf_static, not poses."""
    raws = [r for r in scan(folder)[1] if r.topic == '/profile']
    for topic, messages in (('/tf', moving), ('/tf_static', static)):
        for stamp, transforms in messages:
            data = TYPES.serialize_cdr(TYPES.types[TF_TYPE](transforms), TF_TYPE)
            raws.append(RecordedMessage(topic, TF_TYPE, stamp, bytes(data)))
    return rewrite(folder, tmp_path / 'tf.mcap', raws,
                   types={'/tf': TF_TYPE, '/tf_static': TF_TYPE})


STAMPS = [START + i * POSES_PERIOD for i in range(1500)]


def test_poses_are_read_from_a_chain_of_transforms(good_bag, tmp_path):
    half = np.sqrt(0.5)
    moving = [(stamp, [transform(stamp, 'base', 'link', (0.01 * i, 0, 0)),
                       transform(stamp, 'link', 'tool', (0, 0, 0.5), (0.0, 0.0, half, half))])
              for i, stamp in enumerate(STAMPS)]
    # sent after the motion, as by a node that starts late
    static = [(STAMPS[-1] + 1, [transform(0, 'tool', 'flange', (0.1, 0, 0))])]
    poses = read_bag(tf_bag(good_bag, tmp_path, moving, static), Config(pose_source='tf')).poses
    assert [p.stamp for p in poses] == STAMPS
    np.testing.assert_allclose([p.translation for p in poses],
                               [[0.01 * i, 0.1, 0.5] for i in range(1500)], atol=1e-12)
    np.testing.assert_allclose([p.quaternion for p in poses], [[0, 0, half, half]] * 1500,
                               atol=1e-12)


def test_two_runs_of_transforms_are_refused(good_bag, tmp_path):
    twice = [(stamp, [transform(stamp, 'base', 'flange', (0, 0, 0))])
             for stamp in [*(stamp + 60 * SECOND for stamp in STAMPS), *STAMPS]]
    refused('two runs', tf_bag(good_bag, tmp_path, twice), Config(pose_source='tf'), DataError)


@pytest.mark.parametrize(('config', 'words'), [
    (Config(pose_source='tf'), 'from "base" to "flange"; frames received: base, tool'),
    (Config(), 'take the poses from /tf, as in --set pose_source=tf')])
def test_transforms_that_give_no_poses_are_refused(good_bag, tmp_path, config, words):
    moving = [(START + i, [transform(START + i, 'base', 'tool', (0, 0, 0))]) for i in range(5)]
    refused(words, tf_bag(good_bag, tmp_path, moving), config)


def test_what_is_written_is_read_by_all(good_bag):
    assert [i['path'] for i in read_whole(good_bag).inputs] == [str(good_bag / 'good.mcap')]
    with Reader(good_bag) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {
            '/profile': len(PROFILES), '/flange_pose': len(POSES)}
        assert len(list(reader.messages())) == reader.message_count == 130
        assert (reader.start_time, reader.end_time) == (
            POSES[0].stamp, max(POSES[-1].stamp, PROFILES[-1].stamp) + 1)


@pytest.mark.parametrize('layout', POINTS)
@pytest.mark.parametrize(('unit', 'axes'), [('m', ('x', 'z')), ('mm', ('x', '-z')),
                                            ('mm', ('-y', 'z'))])
def test_every_layout_unit_and_axes_is_read(tmp_path, layout, unit, axes):
    config = Config(profile=ProfileConfig(unit=unit, axes=axes), profile_topic='/line')
    profiles = [replace(p, axes=axes) for p in PROFILES]
    missing = PROFILES[3].points.copy()
    missing[5:9] = np.nan
    profiles[3] = replace(profiles[3], points=missing)
    file = with_layout(written(tmp_path, profiles, config=config), tmp_path, POINTS[layout])
    assert_equal_recordings(read_bag(file, config), profiles)


def test_an_existing_bag_is_replaced_only_when_asked(good_bag, tmp_path, monkeypatch):
    with pytest.raises(InputError, match='is there already'):
        writer.write(good_bag, PROFILES[:3], POSES)
    with monkeypatch.context() as patch:
        patch.chdir(good_bag)
        with pytest.raises(InputError, match='is the current folder, which is not replaced'):
            writer.write(Path(), PROFILES[:3], POSES, force=True)
    assert_equal_recordings(read_bag(good_bag, CONFIG))
    writer.write(good_bag, PROFILES[:3], POSES, force=True,
                 texts={'truth.yaml': 'seed: 7'})
    assert_equal_recordings(read_bag(good_bag, CONFIG), PROFILES[:3])
    assert yaml.safe_load((good_bag / 'truth.yaml').read_text()) == {'seed': 7}
    assert [p.name for p in tmp_path.iterdir()] == ['good']


def test_what_is_no_bag_is_never_replaced(tmp_path, monkeypatch):
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'thesis.tex').write_text('x')
    (tmp_path / 'mine' / 'file').write_text('')
    monkeypatch.chdir(tmp_path)
    for place, kind, words in (('mine', InputError, 'is no bag, so it is not replaced'),
                               ('', InputError, 'is no bag, so it is not replaced'),
                               ('mine/file/bag', UnwritableError, 'cannot write')):
        with pytest.raises(kind, match=words):
            writer.write(tmp_path / place, PROFILES, POSES, force=True)
    assert [p.name for p in tmp_path.iterdir()] == ['mine']


def test_nothing_is_left_behind_by_a_write_that_fails(tmp_path):
    def breaking():
        yield from PROFILES[:3]
        raise OSError(28, 'No space left on device')

    with pytest.raises(UnwritableError, match='No space left on device; free some space$'):
        writer.write(tmp_path / 'bag', breaking(), POSES)
    assert list(tmp_path.iterdir()) == []
