# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The command line as a user meets it: answers, refusals, exit codes, terminals and pipes."""
from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
import errno
import os
import pty
import re
import signal
import subprocess
import sys

from calibrations import equal
from command import assert_refused, handeye, PATIENCE, PLATE, ROOT, running, succeeds
from handeye_ros import __version__, pipeline, read_bag, se3
from handeye_ros.config import Config, load
from handeye_ros.data import ClockEstimate
from handeye_ros.results import calibration_file
from handeye_ros.results.truth import errors_against, true_transform
from handeye_ros.verification.routines import ROUTINES
import numpy as np
import pytest
import yaml

BAG = ROOT / 'bags' / 'plate'


def test_simulate_writes_the_same_bag_with_its_truth_for_the_same_seed(tmp_path):
    path = tmp_path / 'bags' / 'plate'
    run = handeye('simulate', 'small_plate', 'bags/plate', '--seed', 3, cwd=tmp_path)
    assert (run.returncode, run.stderr) == (0, '')
    assert str(path) in run.stdout
    assert sorted(p.name for p in path.iterdir()) == ['metadata.yaml', 'plate.mcap', 'truth.yaml']
    before = (path / 'truth.yaml').read_bytes()
    truth, first = yaml.safe_load(before), read_bag(path, Config())
    assert (truth['scenario'], truth['seed'], truth['noise']['sensor']) == ('small_plate', 3, 3e-5)
    assert 'simulate small_plate --seed 3' in truth['made_by']
    assert f'{len(first.profiles)} profiles, {len(first.poses)} poses' in run.stdout
    # it is replaced only when forced
    assert_refused(handeye('simulate', 'small_plate', path, '--seed', 4, cwd=tmp_path), 2,
                   'is there already', '--force')
    assert (path / 'truth.yaml').read_bytes() == before
    succeeds('simulate', 'small_plate', path, '--seed', 3, '--force', cwd=tmp_path)
    assert (path / 'truth.yaml').read_bytes() == before
    for one, other in zip(first.profiles, read_bag(path, Config()).profiles, strict=True):
        assert one.stamp == other.stamp
        np.testing.assert_array_equal(one.read().points, other.read().points)


def test_a_table_for_a_target_of_profiles_names_the_targets_it_fits(tmp_path):
    table = tmp_path / 'points.csv'
    table.write_text('camera_x [m]\n1\n')
    for verb in ('solve', 'compare', 'samples'):
        run = handeye(verb, table, cwd=tmp_path)
        assert_refused(run, 2, 'is a table of measured values',
                       'set target.type to points or hand_eye, as in --set target.type=points')
    run = handeye('solve', tmp_path, '--set', 'target.type=hand_eye', cwd=tmp_path)
    assert_refused(run, 2, 'is a folder; give the file in it, or, if it is a recording')


@pytest.mark.parametrize('verb', ['solve', 'compare'])
def test_angles_are_refused_where_there_is_no_table_of_poses(verb, tmp_path):
    run = handeye(verb, BAG, '--config', PLATE, '--angles', 'kuka-abc', cwd=tmp_path)
    assert_refused(run, 2, '--angles is for a table of poses', 'target.type is plate')


def test_solve_writes_what_the_library_answers(tmp_path):
    run = handeye('solve', BAG, '--config', PLATE, '--set', 'name=mine', cwd=tmp_path, before=(
        'import atexit; atexit.register(lambda: print([m for m in sys.modules '
        'if m.split(".")[0] in ("rclpy", "rosidl_parser", "sensor_msgs")]))'))
    assert (run.returncode, run.stderr) == (0, '')
    file = tmp_path / 'out' / 'mine' / 'calibration.yaml'
    assert run.stdout.splitlines()[-2:] == [f'wrote {file}', '[]'], 'without ROS'
    assert [p.name for p in file.parent.iterdir()] == ['calibration.yaml']
    calibration = calibration_file.read_calibration(file)

    config = replace(load(PLATE), name='mine')
    recording = read_bag(BAG, config)
    expected = pipeline.calibrate(recording.profiles, recording.poses, config)
    provenance = calibration.provenance
    assert equal(replace(expected, provenance=provenance), calibration)
    assert provenance['inputs'] == list(recording.inputs)
    assert provenance['config']['name'] == 'mine'
    assert provenance['version'] == __version__

    T, std = calibration.T_flange_sensor, np.sqrt(np.diag(calibration.covariance))
    rows = re.findall(r'\n (?:[xyz]|roll|pitch|yaw) +(-?[\d.]+) +([\d.]+) ', run.stdout)
    shown = np.array(rows, dtype=float).T  # mm and degrees
    assert shown[0] == pytest.approx([*1e3 * T[:3, 3], *np.degrees(se3.rpy(T))], abs=6e-4)
    assert shown[1, :3] == pytest.approx(1e3 * std[:3], abs=6e-4)
    errors = errors_against(T, true_transform(BAG))
    assert f'mapped points {errors.mapped_points * 1e3:.3f} mm' in run.stdout
    assert '\x1b' not in run.stdout


def test_an_answer_from_a_damaged_recording_says_so(tmp_path):
    cut, whole = tmp_path / 'cut.mcap', (ROOT / 'bags/sphere/sphere.mcap').read_bytes()
    cut.write_bytes(whole[:len(whole) * 9 // 10])
    run = handeye('solve', cut, '--config', ROOT / 'config/sphere.yaml', '--out', '.',
                  cwd=tmp_path)
    provenance = calibration_file.read_calibration(tmp_path / 'calibration.yaml').provenance
    assert 'cut off' in provenance['warnings'][0] and run.stderr.count('cut off') == 1


def test_replay_without_ros_says_what_to_do(tmp_path):
    run = handeye('replay', BAG, cwd=tmp_path, before='sys.modules["rclpy"] = None')
    assert_refused(run, 2, 'replay needs ROS 2', 'rclpy', 'source the setup.bash')


def test_version_and_help_do_not_wait_for_numpy(tmp_path):
    run = handeye('--version', cwd=tmp_path)
    assert (run.returncode, run.stdout) == (0, f'handeye_ros {__version__}\n')
    run = handeye('--help', cwd=tmp_path, before=(
        'import atexit; atexit.register(lambda: print("numpy" in sys.modules))'))
    assert run.returncode == 0
    assert all(verb in run.stdout for verb in ('solve', 'replay', 'simulate'))
    assert run.stdout.splitlines()[-1] == 'False'  # help does not wait for it
    run = handeye('verify', '--help', cwd=tmp_path)
    assert all(routine in run.stdout for routine in ROUTINES)


@pytest.mark.parametrize('arguments', [
    ['solv', 'x'], ['solve'], ['solve', 'x', '--rate', '2'],
    ['simulate', 'plate', 'x', '--seed', '-1'], ['seam', 'x.ply', '--travel', 'nan'],
    ['seam', 'x.ply', '--work', '90'],
    ['seam', 'x.ply', '--work', '-90'],
    ['batch', 'x', '--out', 'y', '--verb', 'seam'],
    ['kinematics', 'x', './x', '--urdf', 'y']])
def test_wrong_usage_is_2(arguments, tmp_path):
    run = handeye(*arguments, cwd=tmp_path)
    assert run.returncode == 2
    assert 'Usage: handeye' in run.stderr
    assert 'Error' in run.stderr
    assert 'Traceback' not in run.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_ends_it_quietly(tmp_path):
    os.mkfifo(tmp_path / 'x.mcap')
    with running([sys.executable, '-m', 'handeye_ros', 'solve', tmp_path / 'x.mcap'],
                 cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        descriptor = open_for_a_reader(tmp_path / 'x.mcap', process)
        process.send_signal(signal.SIGINT)
        os.close(descriptor)  # a signal just before it waits for data is heard after the wait
        stdout, stderr = process.communicate(timeout=PATIENCE)
    assert (process.returncode, stdout, stderr) == (130, b'', b'')


def open_for_a_reader(fifo, process):
    """Open a named pipe for writing, which succeeds once the process reads from it."""
    while process.poll() is None:
        try:
            return os.open(fifo, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            assert error.errno == errno.ENXIO
    pytest.fail(f'ended before it read: {process.stderr.read()}')


def test_a_terminal_shows_progress_and_one_without_letters_the_answer(tmp_path):
    terminal, end_of_command = pty.openpty()
    environment = {**os.environ, 'TERM': 'xterm', 'PYTHONIOENCODING': 'ascii:strict'}
    process = subprocess.Popen(
        [sys.executable, '-m', 'handeye_ros', 'solve', BAG, '--out', tmp_path], cwd=ROOT,
        stdout=subprocess.DEVNULL, stderr=end_of_command, env=environment)
    os.close(end_of_command)
    stderr = b''
    with suppress(OSError):  # the other side has ended
        while part := os.read(terminal, 4096):
            stderr += part
    assert process.wait() == 0
    assert (tmp_path / 'calibration.yaml').exists()
    text = re.sub(r'\x1b\[[0-9;?]*[a-zA-Z]', '', stderr.decode())
    assert re.search('reading the recording .* [0-9]+%', text) and 'solving' in text


@pytest.mark.thorough
def test_a_sweep_is_solved_reported_and_checked(tmp_path):
    bag = ROOT / 'bags' / 'plate_sweep'
    run = succeeds('solve', bag, '--config', PLATE, '--set', 'sampling.mode=moving', '--out', 'a',
                   cwd=tmp_path)
    assert 'time offset' in run.stdout
    succeeds('report', 'a/calibration.yaml', '--out', 'a.html', cwd=tmp_path)
    assert 'RMS residual of each stop' in (tmp_path / 'a.html').read_text()
    calibration = calibration_file.read_calibration(tmp_path / 'a' / 'calibration.yaml')
    assert calibration.time_offset is not None
    run = succeeds('check', bag, '--against', 'a/calibration.yaml', cwd=tmp_path)
    assert 'UNCHANGED' in run.stdout and 'time offset is as it was' in run.stdout
    assert 'of those that the calibration was made of' in run.stderr
    other = ClockEstimate(calibration.time_offset.value + 5e-3, calibration.time_offset.std)
    calibration_file.write_calibration(replace(calibration, time_offset=other),
                                       tmp_path / 'b.yaml')
    run = handeye('check', bag, '--against', 'b.yaml', cwd=tmp_path)
    assert run.returncode == 1, run.stderr
    changed = re.search('CLOCK: .* time offset has changed by (-[0-9.]+) ms', run.stdout)
    assert changed and float(changed[1]) == pytest.approx(-5, abs=0.2)


def test_budget_shows_what_each_cause_adds_to_an_answer(tmp_path):
    solve = 'solve', ROOT / 'bags/plate', '--config', PLATE, '--budget', '--out'
    run = succeeds(*solve, tmp_path, cwd=tmp_path)
    table = run.stdout[run.stdout.index('1 sigma by cause'):]
    shares = [float(share) for share in re.findall(r'([\d.]+) %', table)]
    assert shares[-1] == 100.0 and sum(shares[:-1]) == pytest.approx(100.0, abs=1.0)
    assert '18 samples' in table
    uncertain = handeye(*solve, tmp_path / 'none', '--set', 'limits.translation=1e-6',
                        cwd=tmp_path)
    assert uncertain.returncode == 3 and 'limits.translation' in uncertain.stderr
    assert '1 sigma by cause' in uncertain.stdout and not (tmp_path / 'none').exists()
    run = handeye('solve', ROOT / 'bags/tracker', '--config', ROOT / 'config/tracker.yaml',
                  '--budget', '--out', tmp_path, cwd=tmp_path)
    assert_refused(run, 2, '--budget')
