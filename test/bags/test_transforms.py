# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Flange poses out of the transform tree."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.bags.transforms import FlangeFollower
from handeye_ros.data import TimedPose
import numpy as np
import pytest

RNG = np.random.default_rng(7)
T_1, T_2, T_3 = (se3.transform(se3.exp_rotation(RNG.normal(size=3)), RNG.normal(size=3))
                 for _ in range(3))


def shifted(*xyz):
    return se3.transform(np.eye(3), np.array(xyz))


def added(follower, *links, stamp=0, static=False):
    """Return the poses after a message of links (parent, child, T), as stamps and matrices."""
    return [(pose.stamp, se3.from_quaternion(pose.translation, pose.quaternion))
            for pose in follower.add([
                (child, TimedPose(stamp, T[:3, 3], se3.quaternion(T), parent))
                for parent, child, T in links], static)]


def test_a_chain_of_joints_with_a_static_tool_gives_the_pose():
    follower = FlangeFollower('/base', 'flange', 0.5)
    assert added(follower, ('b', 'flange', T_3), static=True) == []
    (stamp, T), = added(follower, ('a', 'b', T_2), ('base', 'a', T_1), stamp=9)
    assert stamp == 9
    np.testing.assert_allclose(T, T_1 @ T_2 @ T_3, atol=1e-12)


def test_base_and_flange_below_a_common_frame_give_the_pose():
    follower = FlangeFollower('base', 'flange', 0.5)
    added(follower, ('world', 'base', T_1), static=True)
    (_, T), = added(follower, ('world', 'flange', T_2), stamp=1)
    np.testing.assert_allclose(T, se3.inverse(T_1) @ T_2, atol=1e-12)


def test_links_of_other_stamps_are_interpolated_and_never_extrapolated():
    follower, arm = FlangeFollower('base', 'flange', 0.5), shifted(0.0, 0.0, 1.0)
    assert added(follower, ('base', 'carriage', shifted(1.0, 0.0, 0.0)), stamp=100) == []
    assert added(follower, ('carriage', 'flange', arm), stamp=50) == []
    assert added(follower, ('carriage', 'flange', arm), stamp=125) == []
    (stamp, T), = added(follower, ('base', 'carriage', shifted(2.0, 0.0, 0.0)), stamp=200)
    assert stamp == 125
    np.testing.assert_allclose(T[:3, 3], [1.25, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize('slow', ['flange', 'arm'])
def test_a_slow_link_anywhere_in_the_chain_delays_the_poses_of_the_others(slow):
    follower, poses, ms = FlangeFollower('base', 'flange', 0.5), [], 10**6
    links = {'arm': ('base', 'arm', T_1), 'flange': ('arm', 'flange', T_2)}
    (fast,) = links.keys() - {slow}
    for stamp in range(0, 5000 * ms, 10 * ms):
        poses += added(follower, links[fast], stamp=stamp)
        if stamp % (1000 * ms) == 0:
            poses += added(follower, links[slow], stamp=stamp)
    assert [stamp for stamp, _ in poses] == list(range(0, 4001 * ms, 10 * ms))


def test_a_seldom_link_that_moves_gives_no_pose():
    follower, second = FlangeFollower('base', 'flange', 0.5), 10**9
    for moved in (0.0, 1e-3):
        follower.restart()
        poses = [pose for k in range(5) for pose in added(follower, *(
            [('base', 'rail', shifted(0.0, 0.0, moved * k))] if k in (0, 4) else []),
            ('rail', 'flange', T_1), stamp=k * second // 4)]
        assert [stamp * 4 // second for stamp, _ in poses] == (
            [0, 4] if moved else [0, 1, 2, 3, 4])
    assert '3 poses of /tf were dropped' in follower.warnings[0]


def stamps_of(stamps):
    """Return the stamps of the poses of one link that is sent at these stamps."""
    follower = FlangeFollower('base', 'flange', 0.5)
    return [s for stamp in stamps
            for s, _ in added(follower, ('base', 'flange', T_1), stamp=stamp)]


def test_a_clock_that_is_set_back_goes_on():
    second, start = 10**9, 10**18
    stamps = [*range(start, start + second, second // 50),
              *range(start - 60 * second, start - 58 * second, second // 50)]
    pose_stamps = stamps_of(stamps)
    late = [stamp for stamp in pose_stamps if stamp < start]
    assert pose_stamps[0] == start and late[-1] == stamps[-1]
    assert 60 < len(late) < 80, 'half a second is lost'


def test_wild_and_repeated_stamps_give_no_pose():
    assert stamps_of((3, 4, 4, 10**18, 6, 1, 7)) == [3, 4, 6, 7]


def test_static_links_stay_when_times_start_again():
    follower = FlangeFollower('base', 'flange', 0.5)
    added(follower, ('link_6', 'flange', T_1), static=True)
    for _ in range(2):
        (_, T), = added(follower, ('base', 'link_6', np.eye(4)), stamp=5)
        np.testing.assert_allclose(T, T_1, atol=1e-12)
        follower.restart()
