"""Profiles and poses from messages: the layouts of real drivers, and of none."""
from __future__ import annotations

import array
from types import SimpleNamespace

from handeye_ros.bags.messages import DATATYPES, pose_from_stamped, profile_from_cloud
from handeye_ros.config import ProfileConfig
from handeye_ros.node.errors import MessageError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from ros_clouds import cloud, expected, field, header, METRES, points, pose

MILLIMETRES = ProfileConfig(unit='mm')
X = np.array([-0.02, -0.01, 0.0, 0.01, 0.02, 0.03])
Z = np.array([0.171, 0.172, np.nan, 0.174, np.inf, -np.inf])
XZ = {'x': (0, 7), 'z': (8, 7)}


def test_stamp_and_frame():
    profile = profile_from_cloud(cloud({'x': X, 'z': Z}, XZ, 12), METRES)
    assert profile.stamp == 1_700_000_000_000_000_001
    assert (profile.frame_id, profile.axes) == ('laser', ('x', 'z'))


def test_scancontrol_26_bytes_with_fields_between():
    layout = {'x': (0, 7), 'y': (4, 7), 'z': (8, 7), 'intensity': (12, 4), 'width': (14, 4),
              'threshold': (16, 4), 'moment': (18, 6), 'number': (22, 6)}
    columns = {name: np.arange(6) for name in layout} | {'x': X, 'y': 0 * X, 'z': Z}
    got = points(cloud(columns, layout, 26))
    np.testing.assert_allclose(got, expected(X, Z), rtol=1e-6)


def test_keyence_infinity_is_no_return_whatever_is_dense_says():
    x = np.linspace(-0.1, 0.1, 800)
    z = np.where(np.arange(800) % 7 == 0, np.inf, 0.3)
    got = points(cloud({'x': x, 'y': 0 * x, 'z': z}, {**XZ, 'y': (4, 7)}, 16))
    assert np.isnan(got).all(axis=1).sum() == len(range(0, 800, 7))
    assert not np.isinf(got).any()


def test_gocator_millimetres_with_z_up():
    config = ProfileConfig(unit='mm', axes=('x', '-z'), range_sign=1)
    profile = profile_from_cloud(cloud({'x': X * 1e3, 'z': -Z * 1e3}, XZ, 12), config)
    np.testing.assert_allclose(profile.points, expected(X, Z), rtol=1e-6)
    assert profile.axes == ('x', '-z')


def test_int16_raw_values_in_millimetres():
    z = np.array([-7, 5, 120, 32767, -32768, 0])
    got = points(cloud({'x': np.arange(6), 'z': z}, {'x': (0, 3), 'z': (2, 3)}, 4), MILLIMETRES)
    far = np.abs(z) > 10_000  # over ten metres: no line profiler's return
    np.testing.assert_array_equal(got[:, 1], np.where(far, np.nan, z * 1e-3))


def test_missing_fields_matter_only_for_the_two_axes():
    msg = cloud({'y': X, 'z': Z}, {'y': (0, 7), 'z': (8, 7)}, 12)
    np.testing.assert_allclose(points(msg, ProfileConfig(axes=('-y', 'z'))), expected(-X, Z),
                               rtol=1e-6)
    with pytest.raises(MessageError, match=r'no fields are named "x" \(fields: y, z\)'):
        points(msg)


def test_empty_cloud_is_a_profile_without_returns():
    msg = SimpleNamespace(header=header(), height=1, width=0, fields=[], is_bigendian=False,
                          point_step=0, row_step=0, data=array.array('B'), is_dense=True)
    assert points(msg).shape == (0, 2)


def test_all_points_without_return():
    assert np.isnan(points(cloud({'x': X, 'z': X * np.nan}, XZ, 12))).all()


@pytest.mark.filterwarnings('error')
def test_signalling_nan_is_no_return():
    msg = cloud({'x': X, 'z': X}, XZ, 12)
    msg.data.view('<u4')[2::3] = 0x7f800001
    assert np.isnan(points(msg)).all()


def test_a_message_is_not_changed():
    msg = cloud({'x': X, 'z': Z}, XZ, 12)
    before = msg.data.copy()
    profile_from_cloud(msg, METRES).points[:] = 7.0
    np.testing.assert_array_equal(msg.data, before)


@pytest.mark.parametrize('kind', [bytes, bytearray, lambda b: array.array('B', b), list])
def test_every_kind_of_buffer(kind):
    msg = cloud({'x': X, 'z': Z}, XZ, 12)
    msg.data = kind(msg.data.tobytes())
    np.testing.assert_allclose(points(msg), expected(X, Z), rtol=1e-6)


@pytest.mark.parametrize('height', [1, 2])
def test_a_row_step_that_was_left_unset(height):
    msg = cloud({'x': X, 'z': Z}, XZ, 12, height=height)
    msg.row_step = 0
    np.testing.assert_allclose(points(msg), expected(X, Z), rtol=1e-6)


def test_a_slash_before_the_frame_is_that_of_ros_1():
    msg = cloud({'x': X, 'z': Z}, XZ, 12)
    msg.header.frame_id = '/laser'
    assert profile_from_cloud(msg, METRES).frame_id == 'laser'
    assert pose_from_stamped(pose(frame_id='/base')).parent_frame == 'base'


@pytest.mark.parametrize(('changes', 'reason'), [
    ({'data': np.zeros(71, np.uint8)}, 'take 72 bytes, but data holds 71'),
    ({'width': 2**31}, '1 x 2147483648 points of 12 bytes take'),
    ({'width': 2**32 - 1, 'height': 2**32 - 1, 'row_step': 2**32 - 1}, 'row_step is 4294967295'),
    ({'height': 2**32 - 1, 'row_step': 2**32 - 1}, 'but data holds 72'),
    ({'height': 2, 'width': 3, 'row_step': 35}, 'row_step is 35, but a row of 3 points'),
    ({'point_step': 0}, 'point_step is 0'),
    ({'point_step': 11, 'width': 2}, 'ends at byte 12 of points that are 11 bytes long'),
    ({'fields': []}, r'no fields are named "x" \(fields: none\)'),
    ({'fields': [field('x', 0, 9), field('z', 8)]}, 'datatype 9, which does not exist'),
    ({'fields': [field('x', 0, 0), field('z', 8)]}, 'datatype 0, which does not exist'),
    ({'fields': [field('x', 0, 7, 3), field('z', 8)]}, 'holds 3 values for each point'),
    ({'fields': [field('x', 2**32 - 1), field('z', 8)]}, 'ends at byte 4294967299'),
    ({'fields': [field('x', 0), field('x', 4), field('z', 8)]}, '2 fields are named "x"'),
])
def test_malformed_clouds(changes, reason):
    msg = cloud({'x': X, 'z': Z}, XZ, 12)
    vars(msg).update(changes)
    with pytest.raises(MessageError, match=reason):
        points(msg)


def test_millimetres_taken_for_metres_are_named():
    msg = cloud({'x': X * 1e3, 'z': 172 + X}, XZ, 12)
    with pytest.raises(MessageError, match='coordinates reach 172 m: set profile.unit to mm'):
        points(msg)


def test_micrometres_are_not_known():
    msg = cloud({'x': X * 1e6, 'z': 172e3 + X}, XZ, 12)
    with pytest.raises(MessageError, match='172 m, but profile.unit is m or mm'):
        points(msg, MILLIMETRES)


def test_metres_taken_for_millimetres_are_named():
    with pytest.raises(MessageError, match='larger than 0.174 mm: set profile.unit to m'):
        points(cloud({'x': X, 'z': Z}, XZ, 12), MILLIMETRES)


layouts = st.fixed_dictionaries({
    'datatypes': st.lists(st.sampled_from(sorted(DATATYPES)), min_size=3, max_size=3),
    'order': st.permutations(['x', 'z', 'intensity']),
    'gaps': st.lists(st.integers(0, 9), min_size=4, max_size=4),
    'height': st.integers(1, 4),
    'width': st.integers(1, 20),
    'row_padding': st.integers(0, 30),
    'bigendian': st.booleans(),
    'seed': st.integers(0, 2**31),
})


def values_of(datatype, n, rng):
    """Return n values that the datatype can hold, within the reach of a profiler in mm."""
    kind = np.dtype(DATATYPES[datatype])
    if kind.kind == 'f':
        values = rng.uniform(-500.0, 500.0, n).astype(kind)
        lost = rng.random(n) < 0.2
        return np.where(lost, rng.choice([np.nan, np.inf, -np.inf], n), values).astype(kind)
    limits = np.iinfo(kind)
    return rng.integers(max(limits.min, -900), min(limits.max, 900), n).astype(kind)


@given(layouts, st.sampled_from([('x', 'z'), ('-x', 'z'), ('z', '-x'), ('-z', '-x')]))
def test_any_layout_round_trips(what, axes):
    rng = np.random.default_rng(what['seed'])
    n, position, layout, columns = what['height'] * what['width'], 0, {}, {}
    for name, datatype, gap in zip(what['order'], what['datatypes'], what['gaps'], strict=False):
        layout[name] = (position + gap, datatype)
        position += gap + np.dtype(DATATYPES[datatype]).itemsize
        columns[name] = values_of(datatype, n, rng)
    for name in 'xz':  # integers too small to be millimetres are another test's
        columns[name][0] = 100
    columns[axes[0][-1]].sort()  # other orders, and the origin itself, are other tests'
    columns[axes[1][-1]][columns[axes[1][-1]] == 0] = 1
    msg = cloud(columns, layout, position + what['gaps'][3], height=what['height'],
                row_padding=what['row_padding'], bigendian=what['bigendian'])
    signed = [columns[a[-1]].astype(float) * (-1 if a[0] == '-' else 1) for a in axes]
    got = points(msg, ProfileConfig(unit='mm', axes=axes))
    np.testing.assert_allclose(got, expected(*signed) * 1e-3, rtol=1e-12)


sizes = st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1))
garbage_fields = st.builds(field, st.sampled_from(['x', 'y', 'z', '', 'X']), sizes,
                           st.integers(0, 255), sizes)


@given(fields=st.lists(garbage_fields, max_size=4), height=sizes, width=sizes, point_step=sizes,
       row_step=sizes, data=st.binary(max_size=300), bigendian=st.booleans(),
       unit=st.sampled_from(['m', 'mm']))
def test_garbage_raises_message_error_and_nothing_else(fields, height, width, point_step,
                                                       row_step, data, bigendian, unit):
    msg = SimpleNamespace(header=header(), fields=fields, height=height, width=width,
                          point_step=point_step, row_step=row_step, data=data,
                          is_bigendian=bigendian, is_dense=False)
    try:
        got = points(msg, ProfileConfig(unit=unit))
    except MessageError as error:
        assert str(error).startswith('PointCloud2 message not used: ')
    else:
        assert got.shape == (height * width, 2)
        assert (np.isfinite(got).all(axis=1) | np.isnan(got).all(axis=1)).all()


@given(data=st.binary(min_size=96, max_size=96), kind=st.sampled_from([7, 8]),
       bigendian=st.booleans(), unit=st.sampled_from(['m', 'mm']))
def test_garbage_values_become_returns_or_no_returns(data, kind, bigendian, unit):
    msg = cloud({'x': np.zeros(6), 'z': np.zeros(6)}, {'x': (0, kind), 'z': (8, kind)}, 16,
                bigendian=bigendian)
    msg.data = data
    try:
        got = points(msg, ProfileConfig(unit=unit))
    except MessageError as error:
        assert 'set profile.unit' in str(error) or 'coordinates reach' in str(error)
    else:
        assert np.isnan(got).any() or np.abs(got).max() <= 10.0


def test_messages_of_rosbags():
    stores = pytest.importorskip('rosbags.typesys')
    store = stores.get_typestore(stores.Stores.ROS2_JAZZY)
    made = cloud({'x': X, 'z': Z}, XZ, 12)
    types = store.types
    stamp = types['builtin_interfaces/msg/Time'](sec=3, nanosec=5)
    msg = types['sensor_msgs/msg/PointCloud2'](
        header=types['std_msgs/msg/Header'](stamp=stamp, frame_id='laser'), height=1, width=6,
        fields=[types['sensor_msgs/msg/PointField'](**vars(f)) for f in made.fields],
        is_bigendian=False, point_step=12, row_step=72, data=made.data, is_dense=True)
    kind = 'sensor_msgs/msg/PointCloud2'
    profile = profile_from_cloud(
        store.deserialize_cdr(store.serialize_cdr(msg, kind), kind), METRES)
    assert profile.stamp == 3_000_000_005
    np.testing.assert_allclose(profile.points, expected(X, Z), rtol=1e-6)


@pytest.mark.ros
def test_messages_of_rclpy():
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import PointCloud2, PointField
    made = cloud({'x': X, 'z': Z}, XZ, 12)
    msg = PointCloud2(height=1, width=6, point_step=12, row_step=72, data=made.data.tobytes())
    msg.fields = [PointField(**vars(f)) for f in made.fields]
    msg.header.frame_id = 'laser'
    received = deserialize_message(serialize_message(msg), PointCloud2)
    np.testing.assert_allclose(points(received), expected(X, Z), rtol=1e-6)
