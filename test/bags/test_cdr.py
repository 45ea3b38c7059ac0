# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages: read like other readers do, and no bytes break it."""
from __future__ import annotations

from handeye_ros.bags.messages import (
    pose_from_cdr,
    PROBE,
    profile_from_cdr,
    ProfileReader,
    transforms_from_cdr,
)
from handeye_ros.config import ProfileConfig
from handeye_ros.data import Profile
from handeye_ros.errors import UnusableMessageError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from ros_clouds import cloud, expected
from rosbags.typesys import get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)
CLOUD, POSE = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseStamped'
TF = 'tf2_msgs/msg/TFMessage'
X = np.linspace(-0.02, 0.02, 50)
LAYOUT = {'x': (0, 7), 'a long name': (4, 2), 'z': (8, 7)}
METRES = ProfileConfig()


def new(kind: str, *values: object) -> object:
    return STORE.types[kind](*values)


def header(stamp: int = 3_000_000_005, frame_id: str = 'laser') -> object:
    time = new('builtin_interfaces/msg/Time', *divmod(stamp, 1_000_000_000))
    return new('std_msgs/msg/Header', time, frame_id)


def message(z: object = 0.17, stamp: int = 3_000_000_005, frame_id: str = 'laser') -> object:
    made = cloud({'x': X, 'a long name': 0 * X, 'z': z + 0 * X}, LAYOUT, 12)
    fields = [new('sensor_msgs/msg/PointField', *vars(f).values()) for f in made.fields]
    return new(CLOUD, header(stamp, frame_id), 1, len(X), fields, False, 12, 12 * len(X),
               made.data, True)


def serialised(msg: object, kind: str = CLOUD, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(msg, kind, little_endian=little_endian))


def pose(position: object = (1.0, -2.0, 3.0), quaternion: object = (0.0, 0.6, 0.0, -0.8),
         frame_id: str = 'base') -> object:
    geometry = 'geometry_msgs/msg/'
    return new(POSE, header(frame_id=frame_id), new(
        f'{geometry}Pose', new(f'{geometry}Point', *position),
        new(f'{geometry}Quaternion', *quaternion)))


def transform(child: str, quaternion: object = (0.0, 0.6, 0.0, -0.8)) -> object:
    geometry = 'geometry_msgs/msg/'
    return new(f'{geometry}TransformStamped', header(frame_id='/base'), child, new(
        f'{geometry}Transform', new(f'{geometry}Vector3', 1.0, -2.0, 3.0),
        new(f'{geometry}Quaternion', *quaternion)))


@pytest.mark.parametrize('little_endian', [True, False])
@pytest.mark.parametrize('frame_id', ['', 'a', 'ab', 'abc', '/abcd', 'frame/é'])
def test_what_others_write_is_read(little_endian: bool, frame_id: str) -> None:
    got = profile_from_cdr(serialised(message(frame_id=frame_id), CLOUD, little_endian), METRES)
    assert (got.stamp, got.frame_id) == (3_000_000_005, frame_id.lstrip('/'))
    np.testing.assert_allclose(got.points, expected(X, 0.17 + 0 * X), rtol=1e-6)
    posed = pose_from_cdr(serialised(pose(frame_id=frame_id), POSE, little_endian))
    both = [new('geometry_msgs/msg/TransformStamped', *vars(transform(child)).values())
            for child in (frame_id, 'other')]
    found = transforms_from_cdr(serialised(new(TF, both), TF, little_endian))
    assert [child for child, _ in found] == [frame_id.lstrip('/'), 'other']
    for one in (posed, *(placed for _, placed in found)):
        assert one.stamp == 3_000_000_005
        np.testing.assert_array_equal(one.translation, [1.0, -2.0, 3.0])
        np.testing.assert_allclose(one.quaternion, [0.0, -0.6, 0.0, 0.8], rtol=1e-15)
    assert posed.parent_frame == frame_id.lstrip('/') and found[0][1].parent_frame == 'base'


@pytest.mark.parametrize(('position', 'quaternion', 'reason'), [
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), 'quaternion of length 0, expected 1'),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5, 1.0), 'quaternion of length 1.118, expected 1'),
    ((0.0, 0.0, 0.0), (0.0, 0.0, np.nan, 1.0), 'not finite'),
    ((0.0, np.inf, 0.0), (0.0, 0.0, 0.0, 1.0), 'not finite'),
    ((0.0, 3e12, 0.0), (0.0, 0.0, 0.0, 1.0), 'the position reaches 3e.12 m'),
])
def test_malformed_poses(position: object, quaternion: object, reason: str) -> None:
    with pytest.raises(UnusableMessageError, match=reason):
        pose_from_cdr(serialised(pose(position, quaternion), POSE))


def test_an_invalid_transform_does_not_affect_the_others() -> None:
    bad = transform('camera', (0.0, 0.0, 0.0, 0.0))
    found = transforms_from_cdr(serialised(new(TF, [bad, transform('flange')]), TF))
    assert [child for child, _ in found] == ['flange']
    with pytest.raises(UnusableMessageError, match='TransformStamped .* quaternion of length 0'):
        transforms_from_cdr(serialised(new(TF, [bad]), TF))


@given(st.lists(st.floats(), min_size=7, max_size=7))
def test_any_pose_is_unit_or_refused(values: list[float]) -> None:
    try:
        got = pose_from_cdr(serialised(pose(values[:3], values[3:]), POSE))
    except UnusableMessageError:
        return
    assert np.isfinite(got.translation).all()
    assert np.linalg.norm(got.quaternion) == pytest.approx(1.0, abs=1e-12)
    assert got.quaternion[3] >= 0


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 300), st.booleans())
def test_any_bytes_are_a_message_or_refused(junk: bytes, keep: int, known: bool) -> None:
    reader, goods = ProfileReader(METRES), [
        serialised(message()), serialised(pose(), POSE), serialised(new(TF, [transform('a')]), TF)]
    if known:
        reader.take(goods[0])
    for good, take in zip(goods, (lambda d: reader.take(d).read(), pose_from_cdr,
                                  transforms_from_cdr), strict=True):
        for data in (good[:keep] + junk + good[keep + len(junk):], good[:keep]):
            try:
                take(data)
            except UnusableMessageError as error:
                assert 'message not used: ' in str(error)


def test_drivers_whose_clouds_change_their_size_and_layout() -> None:
    reader = ProfileReader(METRES)
    for i in range(40):
        msg = message(stamp=10**18 + i)
        if i % 2:
            msg.width -= i
        if i % 3 == 0:
            msg.fields = msg.fields[::2]
        got = reader.take(serialised(msg)).read()
        assert isinstance(got, Profile) and len(got.points) == msg.width
    msg.point_step = 11
    with pytest.raises(UnusableMessageError, match='1 x .* points of 11 bytes, .* do not fit'):
        reader.take(serialised(msg)).read()


def test_the_points_of_most_profiles_are_not_looked_at() -> None:
    reader, step = ProfileReader(METRES), PROBE // 100
    for i in range(5):  # profiles without returns tell nothing of the unit
        reader.take(serialised(message(np.nan, stamp=10**18 - 5 + i)))
    refused = []
    for i in range(700):
        wrong = i % 7 == 3 or 300 <= i < 500
        try:
            reader.take(serialised(message(170.0 if wrong else 0.17, stamp=10**18 + i * step)))
        except UnusableMessageError as error:
            assert 'set profile.unit to mm' in str(error)
            refused.append(i)
    assert refused == [*range(300, 501)], 'once in PROBE, and all after a wrong one'
