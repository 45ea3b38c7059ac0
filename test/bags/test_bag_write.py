# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags are written whole or not at all, and replace nothing but bags."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.bags import bag, bag_write
from handeye_ros.config import Config, ProfileConfig
from handeye_ros.errors import InputError, UnwritableError
import numpy as np
import pytest
from recordings import assert_equal_recordings, CONFIG, POINTS, POSES, PROFILES
from rosbags.rosbag2 import Reader
import yaml


def test_what_is_written_is_read_by_all(good_bag):
    recording = bag.read(good_bag, CONFIG)
    assert_equal_recordings(recording)
    assert not recording.warnings
    assert [i['path'] for i in recording.inputs] == [str(good_bag / 'good.mcap')]
    with Reader(good_bag) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {
            '/profile': len(PROFILES), '/flange_pose': len(POSES)}
        assert len(list(reader.messages())) == reader.message_count == 130
        assert (reader.start_time, reader.end_time) == (
            POSES[0].stamp, max(POSES[-1].stamp, PROFILES[-1].stamp) + 1)


@pytest.mark.parametrize('layout', POINTS)
@pytest.mark.parametrize(('unit', 'axes'), [('m', ('x', 'z')), ('mm', ('x', '-z')),
                                            ('mm', ('-y', 'z'))])
def test_every_layout_unit_and_axes(tmp_path, layout, unit, axes):
    config = Config(profile=ProfileConfig(unit=unit, axes=axes), profile_topic='/line')
    made = [replace(p, axes=axes) for p in PROFILES]
    missing = PROFILES[3].points.copy()
    missing[5:9] = np.nan
    made[3] = replace(made[3], points=missing)
    bag_write.write(tmp_path / 'bag', made, POSES, config, layout=POINTS[layout])
    assert_equal_recordings(bag.read(tmp_path / 'bag', config), made)


def test_an_existing_bag_is_replaced_only_when_asked(good_bag, tmp_path):
    with pytest.raises(InputError, match='is there already'):
        bag_write.write(good_bag, PROFILES[:3], POSES)
    assert_equal_recordings(bag.read(good_bag, CONFIG))
    bag_write.write(good_bag, PROFILES[:3], POSES, force=True, truth={'seed': 7})
    assert_equal_recordings(bag.read(good_bag, CONFIG), PROFILES[:3])
    assert yaml.safe_load((good_bag / 'truth.yaml').read_text()) == {'seed': 7}
    assert [p.name for p in tmp_path.iterdir()] == ['good']


def test_what_is_no_bag_is_never_replaced(tmp_path, monkeypatch):
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'thesis.tex').write_text('x')
    (tmp_path / 'mine' / 'file').write_text('')
    monkeypatch.chdir(tmp_path)
    for place, kind, words in (('mine', InputError, 'is no bag, so it is not replaced'),
                               ('', InputError, 'is the current folder'),
                               ('mine/file/bag', UnwritableError, 'cannot write')):
        with pytest.raises(kind, match=words):
            bag_write.write(tmp_path / place, PROFILES, POSES, force=True)
    assert [p.name for p in tmp_path.iterdir()] == ['mine']


def test_nothing_is_left_behind_by_a_write_that_fails(tmp_path):
    def breaking():
        yield from PROFILES[:3]
        raise OSError(28, 'No space left on device')

    with pytest.raises(UnwritableError, match='No space left on device'):
        bag_write.write(tmp_path / 'bag', breaking(), POSES)
    assert list(tmp_path.iterdir()) == []
