# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags in every form that recorders leave them in."""
from __future__ import annotations

from handeye_ros.bags import bag
from handeye_ros.errors import InputError
import pytest
from recordings import (
    assert_equal_recordings,
    CONFIG,
    LAYOUTS_OF_MCAP,
    rewrite,
    rosbags_copy,
    split,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin


@pytest.mark.parametrize('layout', LAYOUTS_OF_MCAP)
def test_every_layout_of_mcap(good_bag, tmp_path, layout):
    file = rewrite(good_bag, tmp_path / 'other.mcap', **LAYOUTS_OF_MCAP[layout])
    recording = bag.read(file, CONFIG)
    assert_equal_recordings(recording)
    assert recording.warnings == ()


@pytest.mark.parametrize('listed', [True, False])
def test_a_split_bag(good_bag, tmp_path, listed):
    recording = bag.read(split(good_bag, tmp_path / 'split', listed), CONFIG)
    assert_equal_recordings(recording)
    assert len(recording.inputs) == 11


def test_types_named_in_the_short_form(good_bag, tmp_path):
    short = {'/profile': 'sensor_msgs/PointCloud2', '/flange_pose': 'geometry_msgs/PoseStamped'}
    assert_equal_recordings(bag.read(rewrite(good_bag, tmp_path / 's.mcap', types=short), CONFIG))


def test_messages_that_are_not_of_ros_2_are_named(good_bag, tmp_path):
    file = rewrite(good_bag, tmp_path / 'old.mcap', encoding='ros1')
    with pytest.raises(InputError, match='/flange_pose carries geometry_msgs/msg/PoseStamped in '
                                         'ros1|/profile carries .*PointCloud2 in ros1'):
        bag.read(file, CONFIG)


def test_a_packed_file_beside_the_unpacked_one_is_the_same(good_bag, tmp_path):
    copy = rosbags_copy(good_bag, tmp_path / 'copy', StoragePlugin.MCAP, CompressionMode.FILE)
    (copy / 'metadata.yaml').unlink()
    (copy / 'copy.mcap').write_bytes((good_bag / 'good.mcap').read_bytes())
    assert (copy / 'copy.mcap.zstd').exists()
    assert_equal_recordings(bag.read(copy, CONFIG))


# sqlite3 has no compression of its own
@pytest.mark.parametrize(('plugin', 'mode'), [
    (plugin, mode) for plugin in StoragePlugin for mode in CompressionMode
    if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)])
def test_every_storage_and_compression_of_rosbag2(good_bag, tmp_path, plugin, mode):
    copy = rosbags_copy(good_bag, tmp_path / 'copy', plugin, mode)
    recording = bag.read(copy, CONFIG)
    assert_equal_recordings(recording)
    assert recording.warnings == ()
