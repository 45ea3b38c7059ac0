# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the topics of a bag carry: wrong ones are named, poses come from transforms too."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.bags import bag, bag_write
from handeye_ros.bags.reader import Raw, TF
from handeye_ros.config import Config, ProfileConfig
from handeye_ros.errors import BagError, InputError
import numpy as np
import pytest
from recordings import (
    assert_equal_recordings,
    CONFIG,
    POSES,
    POSES_PERIOD,
    PROFILES,
    profiles,
    rewrite,
    scan,
    START,
    TYPES,
    written,
)


def test_topic_names_with_and_without_slash(good_bag):
    config = Config(profile_topic='/profile', pose_topic='/flange_pose')
    assert_equal_recordings(bag.read(good_bag, config))


def test_wrong_topic_lists_what_is_there(good_bag):
    with pytest.raises(InputError) as caught:
        bag.read(good_bag, Config(profile_topic='laser'))
    text = str(caught.value)
    assert '/laser' in text
    assert '/profile (sensor_msgs/msg/PointCloud2)' in text
    assert '/flange_pose (geometry_msgs/msg/PoseStamped)' in text
    assert text.endswith('--set profile_topic=/profile')


def test_wrong_type(good_bag):
    with pytest.raises(InputError, match='/profile carries sensor_msgs/msg/PointCloud2, but '
                       'only geometry_msgs/msg/PoseStamped can be read there. It holds '
                       '/flange_pose .*--set pose_topic=/flange_pose'):
        bag.read(good_bag, Config(pose_topic='profile'))


@pytest.mark.parametrize(('kind', 'advice'), [
    ('nav_msgs/msg/Odometry', 'none of them is a geometry_msgs/msg/PoseStamped'),
    ('geometry_msgs/msg/PoseWithCovarianceStamped', 'none of them is a geometry_msgs/msg/Pose'),
    ('geometry_msgs/msg/TransformStamped', 'none of them is a geometry_msgs/msg/PoseStamped')])
def test_poses_of_other_types(good_bag, tmp_path, kind, advice):
    file = rewrite(good_bag, tmp_path / 'other.mcap', types={'/flange_pose': kind})
    with pytest.raises(InputError, match=rf'/flange_pose carries {kind}, but only.*{advice}'):
        bag.read(file, CONFIG)


@pytest.mark.parametrize('topic', ['flange_pose', 'tf'])
def test_transforms_where_poses_are_expected(good_bag, tmp_path, topic):
    moving = [(START, [transform(START, 'base', 'flange', (0, 0, 0))])]
    file = tf_bag(good_bag, tmp_path, moving, [])
    with pytest.raises(InputError, match='take the poses from /tf, as in --set pose_source=tf'):
        bag.read(file, Config(pose_topic=topic))


def test_no_transforms_where_they_are_expected(good_bag):
    with pytest.raises(InputError, match='has no topic /tf. .*record /tf, or set pose_source'):
        bag.read(good_bag, Config(pose_source='tf'))


def test_no_poses(tmp_path):
    with pytest.raises(BagError, match='no messages on /flange_pose'):
        bag.read(written(tmp_path, poses=[]), CONFIG)


def test_two_frames_on_one_topic(tmp_path):
    path = written(tmp_path, profiles=PROFILES[:5] + profiles(9, frame_id='other')[5:])
    with pytest.raises(InputError, match='"laser" and "other"'):
        bag.read(path, CONFIG)


def test_a_stray_of_another_frame_is_left_out(tmp_path):
    stray = replace(PROFILES[3], frame_id='other')
    found = bag.read(written(tmp_path, profiles=[*PROFILES[:3], stray, *PROFILES[4:]]), CONFIG)
    assert {p.frame_id for p in found.profiles} == {'laser'}
    assert len(found.profiles) == len(PROFILES) - 1
    assert found.warnings == ('left out 1 profiles of other frames than "laser"',)


def test_quaternions_of_no_length_are_refused(tmp_path):
    zero = [replace(p, quaternion=np.zeros(4)) for p in POSES]
    with pytest.raises(InputError, match='none of the 100 messages on /flange_pose can be '
                                                'used; the first reason: .*of length 0'):
        bag.read(written(tmp_path, poses=zero), CONFIG)


def test_a_unit_that_most_messages_contradict_is_named(tmp_path):
    few = [replace(p, points=p.points * np.nan) if i < 5 else p for i, p in enumerate(PROFILES)]
    path = written(tmp_path, few, config=Config(profile=ProfileConfig(unit='mm')))
    with pytest.raises(InputError, match='only 5 of the 30 messages on /profile can be '
                                                'used; .*: set profile.unit to mm'):
        bag.read(path, CONFIG)


def transform(stamp, parent, child, translation, quaternion=(0.0, 0.0, 0.0, 1.0)):
    types = TYPES.types
    return types['geometry_msgs/msg/TransformStamped'](
        bag_write._header(stamp, parent), child,
        types['geometry_msgs/msg/Transform'](types['geometry_msgs/msg/Vector3'](*translation),
                                             types['geometry_msgs/msg/Quaternion'](*quaternion)))


def tf_bag(folder, tmp_path, moving, static):
    """Return a copy of the bag with lists of transforms on /tf and /tf_static, not poses."""
    raws = [r for r in scan(folder)[1] if r.topic == '/profile']
    for topic, messages in (('/tf', moving), ('/tf_static', static)):
        for stamp, transforms in messages:
            data = TYPES.serialize_cdr(TYPES.types[TF](transforms), TF)
            raws.append(Raw(topic, stamp, bytes(data)))
    types = {'/tf': TF, '/tf_static': TF}
    return rewrite(folder, tmp_path / 'tf.mcap', raws, types=types)


def test_poses_from_a_chain_of_transforms(good_bag, tmp_path):
    half = np.sqrt(0.5)
    moving = [(START + i * POSES_PERIOD, [
        transform(START + i * POSES_PERIOD, 'base', 'link', (0.01 * i, 0.0, 0.0)),
        transform(START + i * POSES_PERIOD, 'link', 'tool', (0.0, 0.0, 0.5),
                  (0.0, 0.0, half, half))]) for i in range(100)]
    # sent after the motion, as by a node that starts late
    static = [(START + 100 * POSES_PERIOD, [transform(0, 'tool', 'flange', (0.1, 0.0, 0.0))])]
    file = tf_bag(good_bag, tmp_path, moving, static)
    recording = bag.read(file, Config(pose_source='tf'))
    assert [p.stamp for p in recording.poses] == [stamp for stamp, _ in moving]
    for i, pose in enumerate(recording.poses):
        np.testing.assert_allclose(pose.translation, [0.01 * i, 0.1, 0.5], atol=1e-12)
        np.testing.assert_allclose(pose.quaternion, [0, 0, half, half], atol=1e-12)


def test_a_wild_stamp_in_the_transforms_is_dropped(good_bag, tmp_path):
    moving = [(START + i * POSES_PERIOD, [transform(
        START + i * POSES_PERIOD if i != 50 else 1, 'base', 'flange', (0.01 * i, 0.0, 0.0))])
        for i in range(100)]
    recording = bag.read(tf_bag(good_bag, tmp_path, moving, []), Config(pose_source='tf'))
    assert len(recording.poses) == 99
    assert '1 of 100 messages on /tf (frame flange) were left out' in recording.warnings[0]


def test_a_chain_with_a_link_missing_names_the_frames(good_bag, tmp_path):
    moving = [(START + i, [transform(START + i, 'base', 'tool', (0.0, 0.0, 0.0))])
              for i in range(5)]
    with pytest.raises(BagError, match='no chain of transforms leads from "base" to "flange"; '
                                       'frames received: base, tool'):
        bag.read(tf_bag(good_bag, tmp_path, moving, []), Config(pose_source='tf'))
