# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Small recordings, and bags of every form made of them."""
from __future__ import annotations

from handeye_ros.bags import writer
from handeye_ros.bags.messages import DATATYPES, field_view
from handeye_ros.bags.storage import CLOUD_TYPE, Reader
from handeye_ros.config import Config
from handeye_ros.data import Profile, TimedPose
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from rosbags.rosbag2 import CompressionFormat
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import get_typestore, Stores

START = 1_700_000_000_000_000_001
PROFILES_PERIOD, POSES_PERIOD = 33_333_333, 10_000_000


RANGES = 0.17 + np.random.default_rng(1).normal(0, 3e-5, (30, 200))
PROFILES = [Profile(START + i * PROFILES_PERIOD, 'laser',
                    np.column_stack([np.linspace(-0.02, 0.02, 200), z]))
            for i, z in enumerate(RANGES)]
POSES = [TimedPose(START + i * POSES_PERIOD, place, np.array([0.0, 0.6, 0.0, 0.8]), 'base')
         for i, place in enumerate(np.random.default_rng(2).normal(size=(100, 3)))]


def scan(bag):
    """Return the types of a bag's topics, and its messages."""
    reader = Reader(bag)
    messages = list(reader.messages())
    return reader.types, messages


def rewrite(bag, path, messages=None, types=None, encoding='cdr', **options):
    """
    Write messages (default: those of the bag) into an .mcap file as mcap.writer.Writer can.

    Yields nothing of the definitions of the types: readers know the standard ones.
    """
    own_types, own_messages = scan(bag)
    messages = own_messages if messages is None else messages
    types = own_types | (types or {})
    options = {'chunk_size': 4096, 'compression': CompressionType.NONE} | options
    with path.open('wb') as stream:
        writer = Writer(stream, **options)
        writer.start('ros2')
        channels = {}
        for topic, _, log_time, data, *_ in messages:
            if topic not in channels:
                schema = writer.register_schema(types[topic], 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return path


LAYOUTS_OF_MCAP = {  # options of rewrite
    'plain': {},
    'lz4': {'compression': CompressionType.LZ4},
    'zstd': {'compression': CompressionType.ZSTD},
    'without index': {'index_types': IndexType.NONE, 'use_statistics': False,
                      'repeat_channels': False, 'repeat_schemas': False,
                      'use_summary_offsets': False},
    'without chunks': {'use_chunking': False},
}


# of points, by drivers
POINTS = {
    'double': np.dtype([('x', '<f8'), ('y', '<f8'), ('z', '<f8')]),
    'big_endian': np.dtype([('x', '>f4'), ('y', '>f4'), ('z', '>f4')]),
    'padded': np.dtype({'names': ['x', 'y', 'z', 'intensity'], 'formats': ['<f4'] * 4,
                        'offsets': [0, 4, 8, 16], 'itemsize': 32}),
    'scancontrol': np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('intensity', '<u2'),
                             ('reflection_width', '<u2'), ('threshold', '<u2'),
                             ('moment0', '<u4'), ('moment1', '<u4')]),
}


CONFIG = Config()
TYPES = get_typestore(Stores.ROS2_JAZZY)


def written(folder, profiles=PROFILES, poses=POSES, config=CONFIG, name='bag'):
    writer.write(folder / name, profiles, poses, config)
    return folder / name


def assert_equal_recordings(recording, profiles=PROFILES, poses=POSES):
    assert [p.stamp for p in recording.profiles] == [p.stamp for p in profiles]
    assert [p.stamp for p in recording.poses] == [p.stamp for p in poses]
    for raw, expected in zip(recording.profiles, profiles, strict=True):
        stored = raw.read()
        assert (raw.stamp, raw.frame_id) == (stored.stamp, stored.frame_id)
        assert (stored.frame_id, stored.axes) == (expected.frame_id, expected.axes)
        np.testing.assert_allclose(stored.points, expected.points, rtol=1e-6)
    for stored, expected in zip(recording.poses, poses, strict=True):
        assert stored.parent_frame == expected.parent_frame
        np.testing.assert_allclose(stored.translation, expected.translation, rtol=1e-15)
        np.testing.assert_allclose(stored.quaternion, expected.quaternion, rtol=1e-15)


def split(folder, target):
    """Split a bag into eleven files, so that _10 comes behind _9."""
    target.mkdir()
    _, messages = scan(folder)
    for i in range(11):
        rewrite(folder, target / f'split_{i}.mcap', messages[i * 12:(i + 1) * 12])
    return target


def rosbags_copy(folder, target, plugin, mode):
    """Copy a bag with another storage and compression."""
    types, messages = scan(folder)
    writer = BagWriter(target, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=TYPES)
                       for topic, kind in types.items()}
        for raw in messages:
            writer.write(connections[raw.topic], raw.log_time, raw.data)
    return target


def with_messages(folder, tmp_path, change):
    """Return a copy of a bag whose messages went through change(raw) -> raw or None."""
    changed = [change(raw) for raw in scan(folder)[1]]
    return rewrite(folder, tmp_path / 'changed.mcap', [raw for raw in changed if raw])


def with_layout(folder, tmp_path, layout):
    """Return a copy of a bag with another layout of the points, of which xyz are kept."""
    codes = {name: code for code, name in DATATYPES.items()}

    def change(raw):
        if raw.message_type != CLOUD_TYPE:
            return raw
        cloud = TYPES.deserialize_cdr(raw.data, CLOUD_TYPE)
        points = np.zeros(cloud.width, layout)
        for axis in 'xyz':
            points[axis] = field_view(cloud, axis)
        cloud.fields = [new('sensor_msgs/msg/PointField', name, offset, codes[kind.str[1:]], 1)
                        for name, (kind, offset, *_) in layout.fields.items()]
        cloud.is_bigendian = layout['x'].byteorder == '>'
        cloud.point_step, cloud.row_step = layout.itemsize, points.nbytes
        cloud.data = points.view(np.uint8).ravel()
        return raw._replace(data=bytes(TYPES.serialize_cdr(cloud, CLOUD_TYPE)))

    return with_messages(folder, tmp_path, change)


def new(kind, *values):
    """Return a message of a type of the typestore."""
    return TYPES.types[kind](*values)


def header(stamp, frame_id):
    time = new('builtin_interfaces/msg/Time', *divmod(stamp, 1_000_000_000))
    return new('std_msgs/msg/Header', time, frame_id)


def transform(stamp, parent, child, translation, quaternion=(0.0, 0.0, 0.0, 1.0)):
    return new('geometry_msgs/msg/TransformStamped', header(stamp, parent), child,
               new('geometry_msgs/msg/Transform',
                   new('geometry_msgs/msg/Vector3', *map(float, translation)),
                   new('geometry_msgs/msg/Quaternion', *quaternion)))


def cloud_message(source, stamp, frame_id='laser'):
    """Return a cloud of ros_clouds as a message that can be serialised."""
    fields = [new('sensor_msgs/msg/PointField', *vars(f).values()) for f in source.fields]
    return new('sensor_msgs/msg/PointCloud2', header(stamp, frame_id), source.height, source.width,
               fields, False, source.point_step, source.row_step, source.data, True)
