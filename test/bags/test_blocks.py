"""Many messages at once say what each of them says."""
from __future__ import annotations

from handeye_ros.bags.bag_write import LAYOUTS, serialised
from handeye_ros.bags.contents import block_of
from handeye_ros.bags.messages import pose_from_cdr
from handeye_ros.bags.poses import Poses
from handeye_ros.bags.topic import Profiles
from handeye_ros.config import ProfileConfig
from handeye_ros.data import Profile, TimedPose
from handeye_ros.node.errors import MessageError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import zstandard

STAMP = 1_700_000_000_123_456_789
GOOD = serialised(TimedPose(STAMP, np.array([0.1, -0.2, 0.3]), np.array([0, 0.6, 0, -0.8]),
                            'robot'), LAYOUTS['xyz'], 'm')
OTHER = serialised(TimedPose(STAMP + 1, np.ones(3), np.array([0.6, 0, 0, 0.8])), LAYOUTS['xyz'],
                   'm')
BIG = b'\0\0' + GOOD[2:]
NAN = GOOD[:-8] + np.array([np.nan]).tobytes()
FAR = GOOD[:-56] + np.array([1e7]).tobytes() + GOOD[-48:]
LONG = GOOD[:-56] + (3.0 * np.frombuffer(GOOD[-56:])).tobytes()
KINDS = (GOOD, OTHER, BIG, NAN, FAR, LONG, GOOD + b'\0', GOOD[:-1], b'')


def single(data: bytes) -> TimedPose | None:
    try:
        return pose_from_cdr(data)
    except MessageError:
        return None


@settings(max_examples=150, deadline=None)
@given(kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=8))
def test_poses_of_a_block_are_those_of_its_messages(kinds: list[bytes]) -> None:
    block = block_of('/pose', range(len(kinds)), kinds, kinds, bytes)
    expected = {i: pose for i, data in enumerate(kinds) if (pose := single(data))}
    poses = Poses()
    added = poses.add(block)
    assert list(added.used) == list(expected)
    assert added.stamps == [pose.stamp for pose in expected.values()]
    assert bool(added.reason) == (len(expected) < len(kinds))
    assert set(poses.frames) == {pose.parent_frame for pose in expected.values()}
    if expected:
        table = poses.chosen(range(len(expected)), added.stamps)
        for pose, other in zip(table, expected.values(), strict=True):
            assert pose.stamp == other.stamp
            np.testing.assert_array_equal(pose.translation, other.translation)
            np.testing.assert_array_equal(pose.quaternion, other.quaternion)


def test_messages_that_are_packed_each_are_unpacked() -> None:
    pack = zstandard.ZstdCompressor().compress
    packed = [pack(GOOD), OTHER, b'', pack(b''), pack(GOOD)[:-5]]
    block = block_of('/pose', range(5), packed, 'abcde', str.encode)
    assert [block.message(i) for i in range(5)][:4] == [GOOD, OTHER, b'', b'']
    assert Poses().add(block).used == [0, 1]


def test_profiles_of_a_block_are_read_again_from_their_positions() -> None:
    x = np.linspace(-0.02, 0.02, 50)
    cloud = serialised(Profile(STAMP, 'laser', np.column_stack([x, 0.2 + x])), LAYOUTS['xyz'],
                       'm')
    profiles = Profiles(ProfileConfig())
    added = profiles.add(block_of('/profile', [1, 2, 3], [GOOD, cloud, b''],
                                  [b'lost', cloud, b'lost'], bytes))
    assert added.used == [1] and 'PointCloud2' in added.reason
    profile, = profiles.chosen([0], added.stamps)
    np.testing.assert_allclose(profile.read().points[:, 0], x, rtol=1e-6)
