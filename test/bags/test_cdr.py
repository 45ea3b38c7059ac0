"""Serialised messages: read like other readers do, and no bytes break it."""
from __future__ import annotations

from types import SimpleNamespace

from handeye_ros.bags import messages
from handeye_ros.bags.messages import (
    deserialised,
    pose_from_cdr,
    pose_from_stamped,
    profile_from_cdr,
    profile_from_cloud,
    stamp_of,
)
from handeye_ros.bags.points import returns
from handeye_ros.bags.profile_reader import PROBE, ProfileReader
from handeye_ros.config import ProfileConfig
from handeye_ros.node.errors import MessageError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from ros_clouds import cloud
from rosbags.typesys import get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
CLOUD, POSE = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseStamped'
X = np.linspace(-0.02, 0.02, 50)
LAYOUT = {'x': (0, 7), 'a long name': (4, 2), 'z': (8, 7)}
METRES = ProfileConfig()


def header(stamp: int = 3_000_000_005, frame_id: str = 'laser') -> object:
    time = TYPES['builtin_interfaces/msg/Time'](*divmod(stamp, 1_000_000_000))
    return TYPES['std_msgs/msg/Header'](time, frame_id)


def message(z: object = 0.17, stamp: int = 3_000_000_005, frame_id: str = 'laser') -> object:
    made = cloud({'x': X, 'a long name': 0 * X, 'z': z + 0 * X}, LAYOUT, 12)
    fields = [TYPES['sensor_msgs/msg/PointField'](**vars(f)) for f in made.fields]
    return TYPES[CLOUD](header(stamp, frame_id), 1, len(X), fields, False, 12, 12 * len(X),
                        made.data, True)


def serialised(msg: object, kind: str = CLOUD, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(msg, kind, little_endian=little_endian))


@pytest.mark.parametrize('little_endian', [True, False])
@pytest.mark.parametrize('frame_id', ['', 'a', 'ab', 'abc', 'abcd', 'frame/é'])
def test_what_others_write_is_read(little_endian: bool, frame_id: str) -> None:
    msg = message(frame_id=frame_id)
    data = serialised(msg, little_endian=little_endian)
    got, same = profile_from_cdr(data, METRES), profile_from_cloud(msg, METRES)
    assert (got.stamp, got.frame_id) == (same.stamp, same.frame_id) == (3_000_000_005, frame_id)
    np.testing.assert_array_equal(got.points, same.points)
    geometry = SimpleNamespace(**{name: TYPES[f'geometry_msgs/msg/{name}']
                                  for name in ('Point', 'Quaternion', 'Pose', 'PoseStamped')})
    stamped = geometry.PoseStamped(header(frame_id=frame_id), geometry.Pose(
        geometry.Point(1.0, 2.0, 3.0), geometry.Quaternion(0.0, 0.6, 0.0, 0.8)))
    pose = pose_from_cdr(serialised(stamped, POSE, little_endian))
    expected = pose_from_stamped(stamped)
    assert (pose.stamp, pose.parent_frame) == (expected.stamp, expected.parent_frame)
    np.testing.assert_array_equal(pose.translation, expected.translation)
    np.testing.assert_array_equal(pose.quaternion, expected.quaternion)


@pytest.mark.parametrize('size', range(0, 196, 3))
def test_a_message_that_is_cut_is_refused_at_once(size: int) -> None:
    data = serialised(message())
    reader = ProfileReader(METRES)
    for _ in range(2):  # with the layout unknown, and known
        with pytest.raises(MessageError, match='PointCloud2 message not used'):
            reader.take(data[:size])
        reader.take(data)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 300), st.booleans())
def test_any_bytes_are_a_message_or_refused(junk: bytes, keep: int, known: bool) -> None:
    good = serialised(message())
    data = good[:keep] + junk + good[keep + len(junk):]
    reader = ProfileReader(METRES)
    if known:
        reader.take(good)
    for take in (lambda d: reader.take(d).read(), pose_from_cdr, lambda d: deserialised(d, CLOUD)):
        try:
            take(data)
        except MessageError as error:
            assert 'message not used: ' in str(error)


def test_most_profiles_are_not_read_until_they_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, read = ProfileReader(METRES), []
    monkeypatch.setattr(messages, 'returns', lambda points: read.append(1) or returns(points))
    stamps = [10**18 + i * 1_000_000 for i in range(1000)]
    raws = [reader.take(serialised(message(stamp=stamp))) for stamp in stamps]
    assert [raw.stamp for raw in raws] == stamps
    assert len(read) == 10**9 // PROBE
    assert raws[7].read().points.shape == (50, 2)
    assert len(read) == 10**9 // PROBE + 1


def test_from_one_that_cannot_be_used_to_the_next_that_can_all_are_read() -> None:
    reader, refused = ProfileReader(METRES), []
    start = 10**18
    for i in range(700):
        data = serialised(message(z=170.0 if 100 <= i < 400 else 0.17, stamp=start + i * 10**6))
        try:
            reader.take(data)
        except MessageError as error:
            assert 'set profile.unit to mm' in str(error)
            refused.append(i)
    assert refused == list(range(200, 400)), 'from the first that is looked into'


def test_profiles_without_returns_tell_nothing_of_the_unit() -> None:
    reader = ProfileReader(METRES)
    for i in range(5):
        reader.take(serialised(message(z=np.nan, stamp=10**18 + i)))
    with pytest.raises(MessageError, match='set profile.unit to mm'):
        reader.take(serialised(message(z=170.0, stamp=10**18 + 6)))


def test_drivers_whose_clouds_change_their_size_and_layout() -> None:
    reader = ProfileReader(METRES)
    for i in range(40):
        msg = message(stamp=10**18 + i)
        if i % 2:
            msg.width -= i
        if i % 3 == 0:
            msg.fields = msg.fields[::2]
        got = reader.take(serialised(msg)).read()
        assert len(got.points) == msg.width
    msg.point_step = 11
    with pytest.raises(MessageError, match='ends at byte 12 of points that are 11 bytes long'):
        reader.take(serialised(msg))


@given(place=st.integers(0, 900), byte=st.integers(0, 255), keep=st.integers(0, 900),
       little_endian=st.booleans())
def test_what_is_like_the_last_message_is_one(place: int, byte: int, keep: int,
                                              little_endian: bool) -> None:
    reader, good = ProfileReader(METRES), serialised(message(), little_endian=little_endian)
    for _ in range(3):
        assert reader.take(good).stamp == 3_000_000_005
    changed = bytearray(good)
    changed[place % len(good)] = byte
    data = bytes(changed[:keep]) if keep < 300 else bytes(changed)
    try:
        raw = reader.take(data)
    except MessageError:
        return
    head = deserialised(data, CLOUD).header  # which damaged bytes would not give
    assert (raw.stamp, raw.frame_id, raw.rows) == (stamp_of(head), head.frame_id, 1)
