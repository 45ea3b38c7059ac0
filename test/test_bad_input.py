# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every bad input: the exit code, a sentence that says what to do, and nothing written."""
from __future__ import annotations

from dataclasses import replace

from command import assert_refused, handeye, PLATE
from handeye_ros import simulate
from handeye_ros.bags import bag_write
from handeye_ros.results.calibration_file import read_calibration
import numpy as np
import pytest
from recordings import rewrite, scan

pytestmark = pytest.mark.once

BASE = replace(simulate.SCENARIOS['plate'], stations=(6, 6))
# as short as it gets with the default sampling
BASE = replace(BASE, robot=replace(BASE.robot, dwell=0.8, move=0.4, rate=50.0),
               sensor=replace(BASE.sensor, columns=640, rate=15.0))


def made(path, scenario=BASE, change=lambda profiles, poses: (profiles, poses)):
    recording = simulate.simulate(scenario, np.random.default_rng(11))
    bag_write.write(path, *change(recording.profiles, recording.poses))
    return path


@pytest.fixture(scope='module')
def good(tmp_path_factory):
    return made(tmp_path_factory.mktemp('good') / 'bag')


@pytest.fixture
def solve(tmp_path):
    """Return a function that runs `handeye solve`, and checks that a refusal writes nothing."""
    def run(bag, *arguments):
        folder = tmp_path / 'work'
        folder.mkdir()
        done = handeye('solve', bag, '--config', PLATE, *arguments, cwd=folder)
        if done.returncode != 0:
            assert list(folder.iterdir()) == []
        return done
    return run


def test_the_good_recording_is_good(good, solve):
    run = solve(good)
    assert (run.returncode, run.stderr) == (0, '')


def test_missing_file(tmp_path, solve):
    assert_refused(solve(tmp_path / 'nothing.mcap'), 2, 'nothing.mcap', 'no such file or folder')


@pytest.mark.parametrize('content', [b'', b'key: value\n', b'\x89MCAP0\r\n'])
def test_not_a_bag(tmp_path, solve, content):
    (tmp_path / 'x.mcap').write_bytes(content)
    assert_refused(solve(tmp_path / 'x.mcap'), 2, 'x.mcap')


def test_a_folder_that_is_no_bag(tmp_path, solve):
    (tmp_path / 'photos').mkdir()
    assert_refused(solve(tmp_path / 'photos'), 2, 'photos', 'no .mcap or .db3 file')


def test_a_cut_mcap_answers_and_says_so(good, tmp_path, solve):
    file = rewrite(good, tmp_path / 'cut.mcap', chunk_size=1 << 16)
    whole = file.read_bytes()
    file.write_bytes(whole[:len(whole) * 4 // 5])
    run = solve(file, '--out', 'out')
    assert run.returncode == 0, run.stderr
    assert 'warning: cut.mcap is cut off or damaged: read ' in run.stderr
    calibration = read_calibration(tmp_path / 'work' / 'out' / 'calibration.yaml')
    assert 8 <= calibration.quality.samples_used <= 10


def test_wrong_topic_lists_the_topics(good, solve):
    assert_refused(solve(good, '--set', 'profile_topic=/scan'), 2, '/scan',
                   '/profile (sensor_msgs/msg/PointCloud2)',
                   '/flange_pose (geometry_msgs/msg/PoseStamped)', '--set profile_topic=/profile')


def test_wrong_type_on_the_topic(good, solve):
    assert_refused(solve(good, '--set', 'pose_topic=/profile'), 2, 'set pose_topic')


def test_no_poses(tmp_path, solve):
    bag = made(tmp_path / 'bag', change=lambda profiles, poses: (profiles, ()))
    assert_refused(solve(bag), 2, 'no messages on /flange_pose', 'set pose_topic')


def test_no_profiles(tmp_path, solve):
    bag = made(tmp_path / 'bag', change=lambda profiles, poses: ((), poses))
    assert_refused(solve(bag), 2, 'no messages on /profile', 'set profile_topic')


def test_no_target_in_sight(tmp_path, solve):
    assert_refused(solve(made(tmp_path / 'bag', replace(BASE, empty=True))), 3,
                   'no edge of a face in the profile', 'with the laser across the target')


def test_one_orientation_only(tmp_path, solve):
    bag = made(tmp_path / 'bag', replace(BASE, motion='one_orientation'))
    assert_refused(solve(bag), 3, 'one orientation', 'tilt the tool')


@pytest.mark.thorough
@pytest.mark.parametrize('motion', ['tilt_only', 'yaw_only'])
def test_one_rotation_axis_only(tmp_path, solve, motion):
    bag = made(tmp_path / 'bag', replace(BASE, motion=motion))
    assert_refused(solve(bag), 3, 'one rotation axis', 'tilt the tool')


@pytest.mark.thorough
@pytest.mark.parametrize(('error', 'word'), [
    ('inverted', 'inverse poses'), ('wxyz', 'w x y z'), ('millimetres', 'in mm')])
def test_poses_in_another_convention_are_named(tmp_path, solve, error, word):
    run = solve(made(tmp_path / 'bag', replace(BASE, convention_errors=(error,))))
    assert_refused(run, 3, word)


def test_quaternions_of_no_length(tmp_path, solve):
    def zero(profiles, poses):
        return profiles, [replace(p, quaternion=np.zeros(4)) for p in poses]

    assert_refused(solve(made(tmp_path / 'bag', change=zero)), 2, 'quaternion of length 0')


def test_time_going_backwards(good, tmp_path, solve):
    _, messages = scan(good)
    duration = messages[-1].log_time - messages[0].log_time + 1_000_000_000
    again = [m._replace(log_time=m.log_time + duration) for m in messages]
    looped = rewrite(good, tmp_path / 'looped.mcap', messages + again)
    assert_refused(solve(looped), 3, 'jump back', 'record one run')


def test_two_frames_on_one_topic(tmp_path, solve):
    def two(profiles, poses):
        return [replace(p, frame_id=f'laser_{i % 2}') for i, p in enumerate(profiles)], poses

    assert_refused(solve(made(tmp_path / 'bag', change=two)), 2, '"laser_0" and "laser_1"')


def test_clocks_that_differ(tmp_path, solve):
    def since_boot(profiles, poses):
        first = profiles[0].stamp
        return [replace(p, stamp=p.stamp - first + 1) for p in profiles], poses

    assert_refused(solve(made(tmp_path / 'bag', change=since_boot)), 3, 'clocks')


def test_unknown_key(good, solve):
    assert_refused(solve(good, '--set', 'target.tipe=plate'), 2,
                   'unknown key "target.tipe"', 'did you mean "target.type"?')


def test_unknown_key_in_a_file(good, tmp_path, solve):
    file = tmp_path / 'mine.yaml'
    file.write_text('/**: {ros__parameters: {profile_topik: /profile}}')
    assert_refused(solve(good, '--config', file), 2, 'mine.yaml', '"profile_topic"?')


@pytest.mark.parametrize('content', ['a: [b', 'a: b', '', '\x00'])
def test_a_configuration_that_is_none(good, tmp_path, solve, content):
    file = tmp_path / 'mine.yaml'
    file.write_text(content)
    assert_refused(solve(good, '--config', file), 2, 'mine.yaml')


@pytest.mark.parametrize(('assignment', 'word'), [
    ('noise.sensor', 'key=value'), ('noise.sensor=-1', 'from'), ('name=a/b', 'folder'),
    ('method=magic', 'magic'), ('target.type=cone', 'cone')])
def test_bad_values(good, solve, assignment, word):
    assert_refused(solve(good, '--set', assignment), 2, word)


def test_unwritable_output(good, tmp_path, solve):
    (tmp_path / 'file').write_text('')
    assert_refused(solve(good, '--out', tmp_path / 'file' / 'out'), 2, 'cannot write',
                   'choose another place')
    assert (tmp_path / 'file').read_text() == ''


def test_output_to_a_folder_of_the_kernel(good, solve):
    assert_refused(solve(good, '--out', '/proc/handeye'), 2, 'cannot write')


def test_a_simulation_that_cannot_be_written(tmp_path):
    run = handeye('simulate', 'plate', '/proc/bag', cwd=tmp_path)
    assert_refused(run, 2, 'cannot write', '/proc/bag')


def test_damaged_truth(good, tmp_path, solve):
    bag = made(tmp_path / 'bag')
    (bag / 'truth.yaml').write_text('T_flange_sensor: 7')
    assert_refused(solve(bag), 2, 'truth.yaml')
