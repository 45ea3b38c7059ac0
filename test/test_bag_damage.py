"""Bags in every form that recorders leave them in."""
from __future__ import annotations

from contextlib import closing
from dataclasses import replace
import sqlite3

from handeye_ros.config import Config, ProfileConfig
from handeye_ros.errors import BagError, DataError, InputError, UnwritableError
from handeye_ros.ros.bags import bag, bag_write, contents, storage
from handeye_ros.ros.bags.held import Poses
from handeye_ros.ros.bags.topic import Topic
from handeye_ros.ros.errors import AllMalformedError, NoTopicError, TopicTypeError
from handeye_ros.sampling.errors import ClocksApartError, TimeBackwardsError, TwoFramesError
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from recordings import (
    LAYOUTS_OF_MCAP,
    poses,
    POSES_PERIOD,
    profiles,
    PROFILES_PERIOD,
    restamped,
    rewrite,
    START,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
import yaml

PROFILES, POSES = profiles(), poses()
CONFIG = Config()
POSE = 'geometry_msgs/msg/PoseStamped'
TYPES = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def folder(tmp_path):
    """Return a good bag."""
    bag_write.write(tmp_path / 'good', PROFILES, POSES)
    return tmp_path / 'good'


def written(tmp_path, profiles=PROFILES, poses=POSES, config=CONFIG):
    bag_write.write(tmp_path / 'bag', profiles, poses, config)
    return tmp_path / 'bag'


def assert_equal_recordings(recording, profiles=PROFILES, poses=POSES):
    assert [p.stamp for p in recording.profiles] == [p.stamp for p in profiles]
    assert [p.stamp for p in recording.poses] == [p.stamp for p in poses]
    for raw, expected in zip(recording.profiles, profiles, strict=True):
        got = raw.read()
        assert (raw.stamp, raw.frame_id) == (got.stamp, got.frame_id)
        assert (got.frame_id, got.axes) == (expected.frame_id, expected.axes)
        np.testing.assert_allclose(got.points, expected.points, rtol=1e-6)
    for got, expected in zip(recording.poses, poses, strict=True):
        assert got.parent_frame == expected.parent_frame
        np.testing.assert_allclose(got.translation, expected.translation, rtol=1e-15)
        np.testing.assert_allclose(got.quaternion, expected.quaternion, rtol=1e-15)


def test_what_is_written_is_read(folder):
    recording = bag.read(folder, CONFIG)
    assert_equal_recordings(recording)
    assert recording.warnings == ()
    assert [i['path'] for i in recording.inputs] == [str(folder / 'good.mcap')]
    assert len(recording.inputs[0]['sha256']) == 64


def test_other_readers_read_it(folder):
    with Reader(folder) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {
            '/profile': len(PROFILES), '/flange_pose': len(POSES)}
        assert len(list(reader.messages())) == len(PROFILES) + len(POSES)


@pytest.mark.parametrize('layout', bag_write.LAYOUTS)
@pytest.mark.parametrize(('unit', 'axes'), [('m', ('x', 'z')), ('mm', ('x', '-z')),
                                            ('mm', ('-y', 'z'))])
def test_every_layout_unit_and_axes(tmp_path, layout, unit, axes):
    config = Config(profile=ProfileConfig(unit=unit, axes=axes), profile_topic='/line')
    missing = PROFILES[3].points.copy()
    missing[5:9] = np.nan
    made = [replace(p, axes=axes) for p in PROFILES]
    made[3] = replace(made[3], points=missing)
    bag_write.write(tmp_path / 'bag', made, POSES, config, layout=layout)
    assert_equal_recordings(bag.read(tmp_path / 'bag', config), made)


def test_topic_names_with_and_without_slash(folder):
    config = Config(profile_topic='/profile', pose_topic='/flange_pose')
    assert_equal_recordings(bag.read(folder, config))


@pytest.mark.parametrize('layout', LAYOUTS_OF_MCAP)
def test_every_layout_of_mcap(folder, tmp_path, layout):
    file = rewrite(folder, tmp_path / 'other.mcap', **LAYOUTS_OF_MCAP[layout])
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording)
    assert recording.warnings == ()


@pytest.mark.parametrize('layout', LAYOUTS_OF_MCAP)
@pytest.mark.parametrize('share', [0.3, 0.6, 0.9])
def test_a_cut_mcap_gives_what_lies_before_the_cut(folder, tmp_path, layout, share):
    options = LAYOUTS_OF_MCAP[layout] | {'chunk_size': 10_000}
    file = rewrite(folder, tmp_path / 'cut.mcap', **options)
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


def test_a_recorder_that_was_killed_leaves_no_end(folder, tmp_path):
    file = rewrite(folder, tmp_path / 'killed.mcap', finish=False)
    recording = bag.read(file, CONFIG)
    assert len(recording.profiles) > len(PROFILES) - 5
    assert 'cut off' in recording.warnings[0]


@pytest.mark.parametrize('index', [0, 15])
def test_a_damaged_chunk_is_left_out(folder, tmp_path, index):
    # the first defines the channels too
    file = rewrite(folder, tmp_path / 'damaged.mcap')
    data = bytearray(file.read_bytes())
    raw = next(r for r in storage.scan(folder).messages
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
def test_a_folder_without_usable_metadata(folder, damage):
    metadata = folder / 'metadata.yaml'
    metadata.unlink()
    if damage != 'missing':
        metadata.write_text('a: [b' if damage == 'not YAML' else 'a: b')
    recording = bag.read(folder, CONFIG)
    assert_equal_recordings(recording)
    assert 'metadata.yaml is missing or damaged' in recording.warnings[0]


def split(folder, target, listed):
    """Split a bag into eleven files, so that _10 comes behind _9."""
    target.mkdir()
    messages = storage.scan(folder).messages
    names = [f'split_{i}.mcap' for i in range(11)]
    for i, name in enumerate(names):
        rewrite(folder, target / name, messages[i * 12:(i + 1) * 12])
    if listed:
        (target / 'metadata.yaml').write_text(yaml.safe_dump(
            {'rosbag2_bagfile_information': {'relative_file_paths': names}}))
    return target


@pytest.mark.parametrize('listed', [True, False])
def test_a_split_bag(folder, tmp_path, listed):
    recording = bag.read(split(folder, tmp_path / 'split', listed), CONFIG)
    assert_equal_recordings(recording)
    assert len(recording.inputs) == 11


def test_types_named_in_the_short_form(folder, tmp_path):
    short = {'/profile': 'sensor_msgs/PointCloud2', '/flange_pose': 'geometry_msgs/PoseStamped'}
    assert_equal_recordings(bag.read(rewrite(folder, tmp_path / 's.mcap', types=short), CONFIG))


def test_messages_that_are_not_of_ros_2_are_named():
    assert contents.type_of('sensor_msgs/PointCloud2', 'ros1') == (
        'sensor_msgs/msg/PointCloud2 in ros1')


def test_a_packed_file_beside_the_unpacked_one_is_the_same(folder, tmp_path):
    copy = rosbags_copy(folder, tmp_path / 'copy', StoragePlugin.MCAP, CompressionMode.FILE)
    (copy / 'metadata.yaml').unlink()
    (copy / 'copy.mcap').write_bytes((folder / 'good.mcap').read_bytes())
    assert (copy / 'copy.mcap.zstd').exists()
    assert_equal_recordings(bag.read(copy, CONFIG))


def test_a_split_bag_with_a_file_missing(folder, tmp_path):
    target = split(folder, tmp_path / 'split', listed=True)
    (target / 'split_4.mcap').unlink()
    recording = bag.read(target, CONFIG)
    assert len(recording.profiles) < len(PROFILES)
    assert '1 of the 11 files that metadata.yaml lists are missing' in recording.warnings


def rosbags_copy(folder, target, plugin, mode):
    """Copy a bag with another storage and compression."""
    messages = storage.scan(folder)
    writer = Writer(target, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=TYPES)
                       for topic, kind in messages.topics.items()}
        for raw in messages.messages:
            writer.write(connections[raw.topic], raw.log_time, raw.data)
    return target


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize('mode', CompressionMode)
def test_every_storage_and_compression_of_rosbag2(folder, tmp_path, plugin, mode):
    if (plugin, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
        pytest.skip('sqlite3 has no compression of its own')
    copy = rosbags_copy(folder, tmp_path / 'copy', plugin, mode)
    recording = bag.read(copy, CONFIG)
    assert_equal_recordings(recording)
    assert recording.warnings == ()


def test_a_single_db3_and_a_cut_one(folder, tmp_path):
    copy = rosbags_copy(folder, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
    file = copy / 'copy.db3'
    assert_equal_recordings(bag.read(file, CONFIG))
    whole = file.read_bytes()
    file.write_bytes(whole[:len(whole) * 2 // 3])
    with pytest.raises(BagError, match='copy.db3 is cut off or damaged'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('broken', [False, True])
def test_a_db3_whose_recorder_was_killed_keeps_the_rest_in_its_log(folder, tmp_path, broken):
    copy = rosbags_copy(folder, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
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


def test_wrong_topic_lists_what_is_there(folder):
    with pytest.raises(NoTopicError) as caught:
        bag.read(folder, Config(profile_topic='laser'))
    text = str(caught.value)
    assert '/laser' in text
    assert '/profile (sensor_msgs/msg/PointCloud2)' in text
    assert '/flange_pose (geometry_msgs/msg/PoseStamped)' in text
    assert text.endswith('--set profile_topic=/profile')


def test_wrong_type(folder):
    with pytest.raises(TopicTypeError, match='/profile carries sensor_msgs/msg/PointCloud2, but '
                       'only geometry_msgs/msg/PoseStamped can be read there. It holds '
                       '/flange_pose .*--set pose_topic=/flange_pose'):
        bag.read(folder, Config(pose_topic='profile'))


@pytest.mark.parametrize(('kind', 'advice'), [
    ('nav_msgs/msg/Odometry', 'none of them is a geometry_msgs/msg/PoseStamped'),
    ('geometry_msgs/msg/PoseWithCovarianceStamped', 'none of them is a geometry_msgs/msg/Pose'),
    ('geometry_msgs/msg/TransformStamped', 'none of them is a geometry_msgs/msg/PoseStamped')])
def test_poses_of_other_types(folder, tmp_path, kind, advice):
    file = rewrite(folder, tmp_path / 'other.mcap', types={'/flange_pose': kind})
    with pytest.raises(TopicTypeError, match=rf'/flange_pose carries {kind}, but only.*{advice}'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('topic', ['flange_pose', 'tf'])
def test_transforms_where_poses_are_expected(folder, tmp_path, topic):
    file = tf_bag(folder, tmp_path, [(START, [transform(START, 'base', 'flange', (0, 0, 0))])], [])
    with pytest.raises(InputError, match='take the poses from /tf, as in --set pose_source=tf'):
        bag.read(file, Config(pose_topic=topic))


def test_no_transforms_where_they_are_expected(folder):
    with pytest.raises(NoTopicError, match='has no topic /tf. .*record /tf, or set pose_source'):
        bag.read(folder, Config(pose_source='tf'))


def test_no_poses(tmp_path):
    with pytest.raises(BagError, match='no messages on /flange_pose'):
        bag.read(written(tmp_path, poses=[]), CONFIG)


def test_two_frames_on_one_topic(tmp_path):
    path = written(tmp_path, profiles=PROFILES[:5] + profiles(9, frame_id='other')[5:])
    with pytest.raises(TwoFramesError, match='"laser" and "other"'):
        bag.read(path, CONFIG)


def with_messages(folder, tmp_path, change, types=None):
    """Return a copy of a bag whose messages went through change(raw) -> raw or None."""
    changed = [change(raw) for raw in storage.scan(folder).messages]
    return rewrite(folder, tmp_path / 'changed.mcap', [raw for raw in changed if raw],
                   types=types)


def test_malformed_messages_are_counted_and_left_out(folder, tmp_path):
    def cut(raw):
        third = raw.topic == '/profile' and raw.log_time == PROFILES[3].stamp
        return raw._replace(data=raw.data[:len(raw.data) // 2]) if third else raw

    recording = bag.read(with_messages(folder, tmp_path, cut), CONFIG)
    assert_equal_recordings(recording, PROFILES[:3] + PROFILES[4:])
    assert recording.warnings[0].startswith(
        f'1 of {len(PROFILES)} messages on /profile were left out; the first: ')


def test_quaternions_of_no_length_are_refused(tmp_path):
    zero = [replace(p, quaternion=np.zeros(4)) for p in POSES]
    with pytest.raises(AllMalformedError, match='none of the 100 messages on /flange_pose can be '
                                                'used; the first reason: .*of length 0'):
        bag.read(written(tmp_path, poses=zero), CONFIG)


def test_a_unit_that_most_messages_contradict_is_named(tmp_path):
    few = [replace(p, points=p.points * np.nan) if i < 5 else p for i, p in enumerate(PROFILES)]
    path = written(tmp_path, few, config=Config(profile=ProfileConfig(unit='mm')))
    with pytest.raises(AllMalformedError, match='only 5 of the 30 messages on /profile can be '
                                                'used; .*: set profile.unit to mm'):
        bag.read(path, CONFIG)


@settings(max_examples=200, deadline=None)
@given(junk=st.binary(max_size=80), keep=st.integers(0, 60))
def test_any_bytes_as_a_message_are_counted(junk, keep):
    message = TYPES.serialize_cdr(bag_write._pose_stamped(TYPES, POSES[0]), POSE)
    topic = Topic('pose_topic', 'flange_pose', POSE, Poses())
    for data in (bytes(message[:keep]) + junk, bytes(message), bytes(message)):
        topic.take((contents.Raw('/flange_pose', 1, data), lambda: b''))
    bag_contents = contents.Contents({'/flange_pose': POSE})
    decoded = topic.items('x', bag_contents)
    assert len(decoded) + len(bag_contents.warnings) >= 3


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


def test_messages_that_lie_in_any_order_are_sorted_by_their_receipt(folder, tmp_path):
    messages = storage.scan(folder).messages
    shuffled = [messages[i] for i in np.random.default_rng(5).permutation(len(messages))]
    times = [raw.log_time for raw in messages]
    spread = [raw._replace(log_time=times[0] + 60 * (raw.log_time - times[0]))
              for raw in shuffled]

    def later(stamp):
        return times[0] + 60 * (stamp - times[0])

    file = rewrite(folder, tmp_path / 'shuffled.mcap', spread)
    (tmp_path / 'again').mkdir()
    file = rewrite_with_header_stamps(file, tmp_path / 'again', ['/profile', '/flange_pose'],
                                      lambda log_time: log_time)
    recording = bag.read(file, CONFIG)
    assert [p.stamp for p in recording.profiles] == [later(p.stamp) for p in PROFILES]
    assert [p.stamp for p in recording.poses] == [later(p.stamp) for p in POSES]
    assert all('were sorted' in warning for warning in recording.warnings)
    assert len(recording.warnings) == 2


def test_two_runs_of_one_simulated_clock_are_refused(folder, tmp_path):
    messages = storage.scan(folder).messages
    spread = [raw._replace(log_time=START + 9 * (raw.log_time - START)) for raw in messages]
    (tmp_path / 'again').mkdir()
    file = rewrite(folder, tmp_path / 'twice.mcap', spread + spread)
    file = rewrite_with_header_stamps(file, tmp_path / 'again', ['/profile', '/flange_pose'],
                                      lambda log_time: log_time)
    with pytest.raises(TimeBackwardsError, match='two runs'):
        bag.read(file, CONFIG)


def test_time_that_starts_again_is_refused(tmp_path):
    longer = restamped(POSES, [START + i * 100_000_000 for i in range(len(POSES))])
    folder = written(tmp_path, poses=longer)
    middle = longer[50].stamp
    file = rewrite_with_header_stamps(
        folder, tmp_path, ['/flange_pose'], lambda t: t if t < middle else t - middle + START)
    with pytest.raises(TimeBackwardsError, match='/flange_pose jump back by 4.9 s at message 51'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('topic', ['/profile', '/flange_pose'])
@pytest.mark.parametrize('wild', [1, START - 10**18, START + 20 * 10**9, 2_100_000_000 * 10**9])
@pytest.mark.parametrize('places', [[0], [15], [28, 29], [3, 4, 20]])
def test_a_few_wild_stamps_are_dropped_and_told(folder, tmp_path, topic, wild, places):
    items = PROFILES if topic == '/profile' else POSES
    stamps = {item.stamp: item.stamp for item in items}
    stamps |= {items[i].stamp: wild + i for i in places}
    file = rewrite_with_header_stamps(folder, tmp_path, [topic], stamps.__getitem__)
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


def test_two_interleaved_runs_are_refused(folder, tmp_path):
    shift = {p.stamp: p.stamp - i % 2 * 60 * 10**9 for i, p in enumerate(POSES)}
    file = rewrite_with_header_stamps(folder, tmp_path, ['/flange_pose'], shift.__getitem__)
    with pytest.raises(TimeBackwardsError, match='two runs'):
        bag.read(file, CONFIG)


def test_a_driver_without_stamps_gets_the_times_of_receipt(folder, tmp_path):
    file = rewrite_with_header_stamps(folder, tmp_path, ['/profile'], lambda _: 0)
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording)
    assert 'the messages on /profile have no stamps' in recording.warnings[0]


def test_single_messages_without_stamp_are_left_out(folder, tmp_path):
    first = PROFILES[0].stamp
    file = rewrite_with_header_stamps(
        folder, tmp_path, ['/profile'], lambda t: 0 if t == first else t)
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording, PROFILES[1:])
    assert '1 messages on /profile without a stamp were left out' in recording.warnings[0]


def test_clocks_that_share_no_time(folder, tmp_path):
    file = rewrite_with_header_stamps(
        folder, tmp_path, ['/profile'], lambda t: t - START + PROFILES_PERIOD)
    with pytest.raises(ClocksApartError, match='share no time'):
        bag.read(file, CONFIG)


def transform(stamp, parent, child, translation, quaternion=(0.0, 0.0, 0.0, 1.0)):
    types = TYPES.types
    return types['geometry_msgs/msg/TransformStamped'](
        bag_write._header(TYPES, stamp, parent), child,
        types['geometry_msgs/msg/Transform'](types['geometry_msgs/msg/Vector3'](*translation),
                                             types['geometry_msgs/msg/Quaternion'](*quaternion)))


def tf_bag(folder, tmp_path, moving, static):
    """Return a copy of the bag with lists of transforms on /tf and /tf_static, not poses."""
    raws = [r for r in storage.scan(folder).messages if r.topic == '/profile']
    for topic, messages in (('/tf', moving), ('/tf_static', static)):
        for stamp, transforms in messages:
            data = TYPES.serialize_cdr(TYPES.types[contents.TF](transforms), contents.TF)
            raws.append(contents.Raw(topic, stamp, bytes(data)))
    types = {'/tf': contents.TF, '/tf_static': contents.TF}
    return rewrite(folder, tmp_path / 'tf.mcap', raws, types=types)


def test_poses_from_a_chain_of_transforms(folder, tmp_path):
    half = np.sqrt(0.5)
    moving = [(START + i * POSES_PERIOD, [
        transform(START + i * POSES_PERIOD, 'base', 'link', (0.01 * i, 0.0, 0.0)),
        transform(START + i * POSES_PERIOD, 'link', 'tool', (0.0, 0.0, 0.5),
                  (0.0, 0.0, half, half))]) for i in range(100)]
    # sent after the motion, as by a node that starts late
    static = [(START + 100 * POSES_PERIOD, [transform(0, 'tool', 'flange', (0.1, 0.0, 0.0))])]
    file = tf_bag(folder, tmp_path, moving, static)
    recording = bag.read(file, Config(pose_source='tf'))
    assert [p.stamp for p in recording.poses] == [stamp for stamp, _ in moving]
    for i, pose in enumerate(recording.poses):
        np.testing.assert_allclose(pose.translation, [0.01 * i, 0.1, 0.5], atol=1e-12)
        np.testing.assert_allclose(pose.quaternion, [0, 0, half, half], atol=1e-12)


def test_a_wild_stamp_in_the_transforms_is_dropped(folder, tmp_path):
    moving = [(START + i * POSES_PERIOD, [transform(
        START + i * POSES_PERIOD if i != 50 else 1, 'base', 'flange', (0.01 * i, 0.0, 0.0))])
        for i in range(100)]
    recording = bag.read(tf_bag(folder, tmp_path, moving, []), Config(pose_source='tf'))
    assert len(recording.poses) == 99
    assert '1 of 100 messages on /tf (frame flange) were left out' in recording.warnings[0]


def test_a_chain_with_a_link_missing_names_the_frames(folder, tmp_path):
    moving = [(START + i, [transform(START + i, 'base', 'tool', (0.0, 0.0, 0.0))])
              for i in range(5)]
    with pytest.raises(BagError, match='no chain of transforms leads from "base" to "flange"; '
                                       'frames received: base, tool'):
        bag.read(tf_bag(folder, tmp_path, moving, []), Config(pose_source='tf'))


def test_an_existing_bag_is_replaced_only_when_asked(folder, tmp_path):
    with pytest.raises(BagError, match='is there already'):
        bag_write.write(folder, PROFILES[:3], POSES)
    assert_equal_recordings(bag.read(folder, CONFIG))
    bag_write.write(folder, PROFILES[:3], POSES, force=True, truth={'seed': 7})
    assert_equal_recordings(bag.read(folder, CONFIG), PROFILES[:3])
    assert yaml.safe_load((folder / 'truth.yaml').read_text()) == {'seed': 7}
    assert [p.name for p in tmp_path.iterdir()] == ['good']


def test_a_folder_that_is_no_bag_is_never_replaced(tmp_path):
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'thesis.tex').write_text('x')
    with pytest.raises(BagError, match='is no bag, so it is not replaced'):
        bag_write.write(tmp_path / 'mine', PROFILES, POSES, force=True)


def test_nothing_is_left_behind_by_a_write_that_fails(tmp_path):
    def breaking():
        yield from PROFILES[:3]
        raise OSError(28, 'No space left on device')

    with pytest.raises(UnwritableError, match='No space left on device'):
        bag_write.write(tmp_path / 'bag', breaking(), POSES)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(UnwritableError, match='cannot write'):
        bag_write.write(tmp_path / 'file' / 'bag', PROFILES, POSES)


def test_a_damaged_table_of_db3_is_no_crash(folder, tmp_path):
    copy = rosbags_copy(folder, tmp_path / 'copy', StoragePlugin.SQLITE3, CompressionMode.NONE)
    with sqlite3.connect(copy / 'copy.db3') as database:
        database.execute('DROP TABLE messages')
    with pytest.raises(BagError, match='no messages on /profile'):
        bag.read(copy, CONFIG)
