# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every bad input: the exit code, a sentence that says what to do, and nothing written."""
from __future__ import annotations

from dataclasses import replace

from calibrations import CALIBRATION
from command import assert_refused, handeye, PLATE
import handeye_ros
from handeye_ros import simulate
from handeye_ros.bags import writer
from handeye_ros.config import Config
from handeye_ros.errors import InputError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

pytestmark = pytest.mark.once

BASE = replace(simulate.SCENARIOS['plate'], stops=(6, 6))
# as short as it gets with the default sampling
BASE = replace(BASE, robot=replace(BASE.robot, dwell=0.8, move=0.4, rate=50.0),
               sensor=replace(BASE.sensor, columns=640, rate=15.0))


def bag_of(path, change=lambda profiles, poses: (profiles, poses), **differs):
    recording = simulate.simulate(replace(BASE, **differs), np.random.default_rng(11))
    writer.write(path, *change(recording.profiles, recording.poses))
    return path


@pytest.fixture(scope='module')
def good_bag(tmp_path_factory):
    return bag_of(tmp_path_factory.mktemp('good') / 'bag')


@pytest.fixture
def solve(tmp_path):
    """Return a function that runs `handeye solve`, and checks that a refusal writes nothing."""
    def run(bag, *arguments):
        folder = tmp_path / 'work'
        folder.mkdir()
        process = handeye('solve', bag, '--config', PLATE, *arguments, cwd=folder)
        if process.returncode != 0:
            assert list(folder.iterdir()) == []
        return process
    return run


def stamps_since_boot(profiles, poses):
    first = profiles[0].stamp
    return [replace(p, stamp=p.stamp - first + 1) for p in profiles], poses


@pytest.mark.parametrize(('how', 'code', 'words'), [
    ({'change': lambda profiles, poses: (profiles, ())}, 2,
     ('no topic /flange_pose', 'set pose_topic')),
    ({'change': stamps_since_boot}, 3, ('clocks',)),
    ({'empty': True}, 3, ('no edge of a face in the profile', 'the laser crosses the target')),
    ({'motion': 'one_orientation'}, 3, ('one orientation', 'tilt the tool'))])
def test_recordings_without_an_answer_are_refused(tmp_path, solve, how, code, words):
    assert_refused(solve(bag_of(tmp_path / 'bag', **how)), code, *words)


def test_places_that_cannot_be_written_are_named(good_bag, tmp_path, solve):
    (tmp_path / 'file').write_text('')
    place = tmp_path / 'file' / 'out'
    run = handeye('solve', good_bag, '--config', PLATE, '--out', place, cwd=tmp_path)
    assert_refused(run, 2, 'cannot write', 'choose another place')
    assert_refused(handeye('simulate', 'plate', '/proc/bag', cwd=tmp_path), 2, 'cannot write')
    assert [path.name for path in tmp_path.iterdir()] == ['file']


def test_a_damaged_truth_is_named(tmp_path, solve):
    bag = bag_of(tmp_path / 'bag')
    (bag / 'truth.yaml').write_text('T_flange_sensor: 7')
    assert_refused(solve(bag), 2, 'truth.yaml')


GOOD = {
    'calibrate': {'profiles': (), 'poses': (), 'config': Config()},
    'gather': {'profiles': (), 'poses': (), 'config': Config()},
    'solve': {'samples': (), 'rejects': (), 'config': Config(), 'frame_id': 'laser'},
    'read_bag': {'path': 'nowhere', 'config': Config(), 'progress': print},
    'load_config': {'path': 'nowhere'}, 'with_values': {'config': Config(), 'values': {}},
    'read_calibration': {'path': 'nowhere'},
    'write_calibration': {'calibration': CALIBRATION, 'path': 'nowhere'}}


@given(st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.complex_numbers(),
    st.binary(min_size=1), st.lists(st.integers() | st.none(), min_size=1),
    st.dictionaries(st.integers(), st.text(), min_size=1),
    st.sampled_from([object(), np.zeros(3), np.zeros((4, 4)), np.array(['a']), Config])))
def test_an_argument_of_another_type_is_named(wrong):
    for name, arguments in GOOD.items():
        for argument in arguments:
            if argument == 'progress' and callable(wrong):
                continue
            with pytest.raises(InputError, match=f'({argument}|a key of the values): an? '):
                getattr(handeye_ros, name)(**{**arguments, argument: wrong})


@given(st.text().map(lambda text: f'{text}\0'))
def test_a_text_that_names_no_file_is_named(path):
    for name in ('read_bag', 'load_config', 'read_calibration', 'write_calibration'):
        with pytest.raises(InputError, match='path: .*expected the name of a file'):
            getattr(handeye_ros, name)(**{**GOOD[name], 'path': path})
