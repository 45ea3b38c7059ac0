# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Flange poses out of the transform tree."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.bags.transforms import FlangeTracker, MOST_FRAMES
from handeye_ros.data import TimedPose
from handeye_ros.errors import UnusableMessageError
import numpy as np
import pytest

RNG = np.random.default_rng(7)


def random_transform():
    return se3.transform(se3.exp_rotation(RNG.normal(size=3)), RNG.normal(size=3))


def message(parent, child, T, stamp=0):
    """Return a transform as it comes out of a message."""
    return child, TimedPose(stamp, T[:3, 3], se3.quaternion(T), parent)


def matrix(pose):
    return se3.from_quaternion(pose.translation, pose.quaternion)


def test_chain_of_joints_and_a_static_tool_flange():
    tracker = FlangeTracker('base', 'flange')
    T_base_a, T_a_b, T_b_flange = (random_transform() for _ in range(3))
    assert tracker.add([message('b', 'flange', T_b_flange)], static=True) == []
    (pose,) = tracker.add([message('a', 'b', T_a_b, 9), message('base', 'a', T_base_a, 9)],
                          static=False)
    assert pose.stamp == 9
    np.testing.assert_allclose(matrix(pose), T_base_a @ T_a_b @ T_b_flange, atol=1e-12)


def test_base_below_a_common_frame():
    tracker = FlangeTracker('base', 'flange')
    T_world_base, T_world_flange = random_transform(), random_transform()
    tracker.add([message('world', 'base', T_world_base)], static=True)
    (pose,) = tracker.add([message('world', 'flange', T_world_flange, 1)], static=False)
    np.testing.assert_allclose(matrix(pose), se3.inverse(T_world_base) @ T_world_flange,
                               atol=1e-12)


def test_links_of_other_stamps_are_interpolated_and_never_extrapolated():
    tracker = FlangeTracker('base', 'flange')
    rail = [se3.transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (1.0, 2.0)]
    arm = se3.transform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert tracker.add([message('base', 'carriage', rail[0], 100)], static=False) == []
    assert tracker.add([message('carriage', 'flange', arm, 50)], static=False) == []
    assert tracker.add([message('carriage', 'flange', arm, 125)], static=False) == []
    (pose,) = tracker.add([message('base', 'carriage', rail[1], 200)], static=False)
    assert pose.stamp == 125
    np.testing.assert_allclose(pose.translation, [1.25, 0.0, 1.0], atol=1e-12)


def test_a_clock_that_is_set_back_goes_on():
    tracker, T = FlangeTracker('base', 'flange'), random_transform()
    second, start = 10**9, 10**18
    stamps = [*range(start, start + second, second // 50),
              *range(start - 60 * second, start - 58 * second, second // 50)]
    found = [pose.stamp for stamp in stamps
             for pose in tracker.add([message('base', 'flange', T, stamp)], static=False)]
    late = [stamp for stamp in found if stamp < start]
    assert found[0] == start and late[-1] == stamps[-1]
    assert 60 < len(late) < 80, 'half a second is lost'


def test_a_wild_stamp_makes_no_other_late():
    tracker, T = FlangeTracker('/base', 'flange'), random_transform()
    stamps = [p.stamp for s in (3, 4, 4, 10**18, 6, 1, 7)
              for p in tracker.add([message('base', 'flange', T, s)], static=False)]
    assert stamps == [3, 4, 6, 7]


def test_times_may_start_again_and_static_links_stay():
    tracker, T = FlangeTracker('base', 'flange'), random_transform()
    tracker.add([message('link_6', 'flange', T)], static=True)
    for _ in range(2):
        (pose,) = tracker.add([message('base', 'link_6', np.eye(4), 5)], static=False)
        np.testing.assert_allclose(matrix(pose), T, atol=1e-12)
        tracker.restart()


def test_missing_says_what_was_received():
    tracker = FlangeTracker('base', 'flange')
    assert tracker.missing().endswith('frames received: none')
    tracker.add([message('base_link', 'tool0', random_transform(), 1)], static=False)
    assert 'from "base" to "flange"; frames received: base_link, tool0' in tracker.missing()
    tracker.add([message('base', 'flange', random_transform())], static=True)
    assert tracker.missing() == 'all transforms between "base" and "flange" are static'
    tracker.add([message('base', 'flange', random_transform(), 1)], static=False)
    assert tracker.missing() == ''
    loop = [message('a', 'flange', np.eye(4), 1), message('flange', 'a', np.eye(4), 1)]
    assert FlangeTracker('base', 'flange').add(loop, static=False) == []


def test_frames_without_end_are_refused_and_those_known_go_on():
    tracker = FlangeTracker('base', 'flange')
    tracker.add([message('base', 'flange', np.eye(4), 1)], static=False)
    for number in range(MOST_FRAMES - 1):
        tracker.add([message('base', f'f{number}', np.eye(4), 1)], static=False)
    with pytest.raises(UnusableMessageError, match='one more than the 1000 that are followed'):
        tracker.add([message('base', 'more', np.eye(4), 1)], static=False)
    assert len(tracker.add([message('base', 'flange', np.eye(4), 2)], static=False)) == 1
