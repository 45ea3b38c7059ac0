# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Faults of a cell while the node runs, one by one, and how the node ends."""
from __future__ import annotations

from collections.abc import Callable
from itertools import count
import json
from pathlib import Path
import re
import signal
from unittest.mock import MagicMock

from cells import set_to
from handeye_ros.bags.messages import message_of, stamp_and_frame
from handeye_ros.bags.storage import CLOUD_TYPE
from handeye_ros.config import Config
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import PATIENCE, run_python  # noqa: E402, I100
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from handeye_ros.node.message_counts import new_counts  # noqa: E402
from handeye_ros.node.streams import Streams  # noqa: E402
from rclpy._rclpy_pybind11 import RCLError  # noqa: E402
from ros_clouds import cloud  # noqa: E402
from ros_helpers import (  # noqa: E402
    Client,
    cloud_message,
    LATCHED,
    parameter,
    pose_message,
    RELIABLE,
    running_node,
    set_parameter,
    sphere_profile,
    stand_still,
    XZ,
)
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2  # noqa: E402
from std_msgs.msg import Empty, String  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

pytestmark = pytest.mark.ros

START = 10 ** 18
PERIOD = 50_000_000
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p', 'sampling.mode:=manual')


@pytest.mark.thorough
def test_streams_that_fall_silent_and_two_publishers_with_two_clocks(tmp_path, client):
    words = '2 publishers send profiles on /profile (/client, /client): let only one publish'
    with running_node(tmp_path):
        client.connect()
        for stream, send in (('profiles', lambda t: client.profiles.publish(sphere_profile(t))),
                             ('poses', lambda t: client.poses.publish(pose_message(t)))):
            send(START)
            client.until_counted(**{stream: 1})
            client.until(lambda s=stream: f'no more {s}' in client.state()['message'],
                         f'it tells that the {stream} are silent')
            later = count(1)

            def heard_again(send=send, stream=stream, later=later) -> bool:
                send(START + next(later))
                return f'no more {stream}' not in client.state()['message']

            client.until(heard_again, f'the {stream} are no longer silent')
        assert client.call('clear_samples').success
        other = client.node.create_publisher(PointCloud2, '/profile', RELIABLE)
        client.until(lambda: words in client.state()['message'], 'it names them')
        client.connect()
        assert words in client.call('take_sample').message
        for i in range(4):
            client.poses.publish(pose_message(START + i * PERIOD))
            client.profiles.publish(sphere_profile(START + i * PERIOD))
            client.until_counted(profiles=2 * i + 1, poses=i + 1)  # two writers have no order
            other.publish(sphere_profile(START + i * PERIOD - 60 * 10**9))
            state = client.until_counted(profiles=2 * i + 2, poses=i + 1)
        # of each two one is dropped: the first, or once poses vouch for it the other
        assert sum(map(int, re.findall(r'\((\d+) times\)', state['warnings']))) == 4
        answer = client.call('take_sample')
        cause, _, consequence = answer.message.partition(words)
        assert not answer.success
        assert 'stamps are older than those before' not in cause
        assert 'stamps are older than those before' in consequence
        assert 'clock' not in answer.message, 'which is not the cause'
        client.node.destroy_publisher(other)
        client.until(lambda: words not in client.state()['message'], 'one publisher is left')


def test_topics_are_read_on_after_a_fault(client, monkeypatch):
    receiver, faults = MagicMock(config=Config(), message_counts=new_counts()), []
    look = client.node.get_publishers_info_by_topic

    def fails_once(*args: object) -> object:
        if not faults:
            faults.append(True)
            raise RCLError('no memory')
        return look(*args)
    monkeypatch.setattr(client.node, 'get_publishers_info_by_topic', fails_once)
    streams = Streams(client.node, receiver)
    client.until(lambda: faults, 'it looks for publishers')
    client.until(lambda: client.poses.get_subscription_count(), 'it subscribes')

    def heard() -> bool:
        client.poses.publish(pose_message(START))
        return receiver.add_poses.called
    client.until(heard, 'it reads a pose')
    streams.stop()


def test_messages_keep_their_stamps_and_those_without_get_the_time_of_receipt(client):
    config = set_to(Config(), time_offset=0.5, profile__rows='profiles', profile__period=0.01)
    receiver, joints = MagicMock(config=config), client.node.create_publisher(
        JointState, '/joint_states', RELIABLE)
    streams = Streams(client.node, receiver, receiver.add_joints)
    client.until(lambda: client.profiles.get_subscription_count()
                 and joints.get_subscription_count(), 'it subscribes')
    two_rows = cloud({axis: np.linspace(0.01, 0.02, 100) for axis in 'xz'}, XZ, 8, height=2)
    client.profiles.publish(cloud_message(two_rows, START))
    joints.publish(JointState())
    client.until(lambda: receiver.add_profile.call_count == 2 and receiver.add_joints.called,
                 'it reads both')
    streams.stop()
    for place, call in enumerate(receiver.add_profile.call_args_list):
        profile, = call.args
        assert profile.stamp == START + place * 10**7 + 5 * 10**8
        assert stamp_and_frame(message_of(CLOUD_TYPE, profile.fetch()))[0] == START + place * 10**7
    assert receiver.add_joints.call_args.args[0] > START


@pytest.mark.thorough
def test_a_simulated_clock_that_jumps_forth_and_back(tmp_path: Path, client: Client) -> None:
    clock = client.node.create_publisher(Clock, '/clock', 10)
    result: list[int] = []
    client.node.create_subscription(DiagnosticArray, '/diagnostics',
                                    lambda msg: result.append(msg.header.stamp.sec), 10)
    with running_node(tmp_path, '-p', 'use_sim_time:=true', *SPHERE):
        client.connect()
        for number, second in enumerate((10**9, 2 * 10**9, 10**9 - 1000, 10**9), 1):
            def taken(second=second) -> bool:
                msg = Clock()
                msg.clock.sec = second
                clock.publish(msg)
                return bool(result and result[-1] == second)

            client.until(taken, 'the node goes by the clock, and tells its state')
            # stamped by the system's clock, as a real sensor does
            stand_still(client, START + number * 10**9, x=0.1 * number)
            client.until_counted(profiles=20 * number, poses=20 * number)
            answer = client.call('take_sample')
            assert answer.message.startswith(f'sample {number} taken: '), answer.message
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()


@pytest.mark.thorough
def test_two_nodes_of_one_name_are_reported_and_keep_apart(tmp_path: Path, client: Client) -> None:
    first, second = tmp_path / 'first', tmp_path / 'second'
    shared = ('-p', f'output_dir:={tmp_path}', *SPHERE, '-p', 'sampling.mode:=still')
    words = 'there are two nodes /handeye: both publish, and either may answer; end one'
    for folder in (first, second):
        folder.mkdir()
    with running_node(first, *shared):
        client.connect()
        assert words not in client.state()['message']
        with running_node(second, *shared):
            client.until(lambda: words in client.state()['message'], 'it is told')
            client.until(lambda: all(words in (folder / 'node.log').read_text()
                                     for folder in (first, second)), 'both say so')
            client.until(lambda: client.profiles.get_subscription_count() == 2
                         == client.poses.get_subscription_count(), 'both hear the client')
            stand_still(client, START, 2.5)
            stand_still(client, START + 26 * 10**8, 0.2, x=0.1)
            client.until(lambda: len(list(tmp_path.glob('sphere/*/metadata.yaml'))) == 2,
                         'each keeps its own session')
        client.until(lambda: words not in client.state()['message'], 'it is over')


@pytest.mark.thorough
def test_a_button_a_kill_and_a_restart(tmp_path, client, monkeypatch):
    texts: list[String] = []
    client.node.create_subscription(String, '/handeye/samples', texts.append, LATCHED)

    def until(condition: Callable[[dict], bool], what: str) -> dict:
        client.until(lambda: texts and condition(json.loads(texts[-1].data)), what)
        return json.loads(texts[-1].data)

    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    button = client.node.create_publisher(Empty, '/handeye/take', 10)
    no_folder = ('-p', 'output_dir:=""')
    with running_node(tmp_path, *SPHERE, *no_folder) as process:
        client.connect()
        client.until(button.get_subscription_count, 'the node hears the button')
        button.publish(Empty())
        report = until(lambda report: report['attempt'], 'the attempt is answered')
        assert not report['attempt']['accepted'] and 'no flange pose' in report['attempt']['text']
        for number in (1, 2):
            stand_still(client, START + 5 * number * 10**9, x=0.1 * number)
            client.until_counted(profiles=20 * number, poses=20 * number)
            button.publish(Empty())
            report = until(lambda report, n=number: len(report['samples']) == n, 'it is taken')
            assert report['attempt']['text'].startswith(f'sample {number} taken: 1 arc from ')
        process.send_signal(signal.SIGKILL)
        process.wait()
    folder = Path(report['session'])
    assert folder.parent == tmp_path / 'home' / 'handeye_ros' / 'sphere'
    with running_node(tmp_path, '-p', 'session:=last', *no_folder):
        report = until(lambda report: report['session'] == str(folder), 'it goes on')
        client.connect()
        assert [s['number'] for s in report['samples']] == [1, 2]
        assert report['mode'] == 'manual', 'as it was in the session'
        assert set_parameter(client, 'samples.exclude', [2]).successful
        until(lambda report: [s['excluded'] for s in report['samples']] == [False, True],
              'a sample is excluded')


# -- the end


@pytest.mark.thorough
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_it_ends_at_once_while_streams_run(tmp_path: Path, client: Client, number: int) -> None:
    stamps = count(START, PERIOD)

    def send() -> bool:
        stamp = next(stamps)
        client.poses.publish(pose_message(stamp))
        client.profiles.publish(sphere_profile(stamp))
        return True

    with running_node(tmp_path) as process:
        client.connect()
        client.until(lambda: send() and client.state()['profiles'] != '0', 'streams run')
        process.send_signal(number)
        client.until(lambda: send() and process.poll() is not None, 'it ends')
        assert process.returncode == (-9 if number == signal.SIGKILL else 0)
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()


SLOW = """
import sys, threading
from handeye_ros import pipeline

def answer(samples, rejects, config, frame_id='', session=None):
    if not session:  # a review, which nobody asked for
        return whole(samples, rejects, config, frame_id)
    print('solving', flush=True)
    threading.Event().wait()

whole, pipeline.answer_samples = pipeline.answer_samples, answer
if __name__ == '__main__':
    from handeye_ros.node.calibrate import main
    sys.exit(main())
"""


@pytest.mark.thorough
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_other_services_answer_while_it_solves_and_it_ends_cleanly(tmp_path, client, number):
    log, script = tmp_path / 'node.log', tmp_path / 'slow.py'
    script.write_text(SLOW)
    with running_node(tmp_path, *SPHERE, program=script) as process:
        client.connect()
        stand_still(client, START)
        client.until_counted(profiles=20, poses=20)
        assert client.call('take_sample').success
        service = client.node.create_client(Trigger, '/handeye/compute_calibration')
        client.until(service.service_is_ready, 'the service is there')
        future = service.call_async(Trigger.Request())
        client.until(lambda: 'solving' in log.read_text(), 'it solves')
        result = client.call('take_sample')
        assert result.success and result.message.startswith('sample 1 taken again'), result.message
        for name, word in (('save_calibration', 'there is no calibration to save'),
                           ('verify_start', 'verify.routine is not set'),
                           ('verify_result', 'no verification was started')):
            result = client.call(name)
            assert (result.success, word in result.message) == (False, True), result.message
        assert set_parameter(client, 'limits.translation', 0.004).successful
        assert client.call('auto_sample', SetBool.Request(data=False)).success
        assert client.call('remove_last_sample').message.startswith('removed sample 1')
        assert client.call('clear_samples').success
        assert not future.done(), 'it solves still'
        process.send_signal(number)
        assert process.wait(PATIENCE) == 0
    lines = log.read_text().splitlines()
    assert [line for line in lines if '[INFO]' not in line and '[WARN]' not in line] == ['solving']


BROKEN = """
from handeye_ros.node import calibrate, live, verification

def broken(*_):
    raise ZeroDivisionError('in a service')

live.sample_summary = verification.looked_up = live.LiveSession.configure = broken
if __name__ == '__main__':
    calibrate.main()
"""


@pytest.mark.thorough
def test_a_node_goes_on_after_an_exception_and_the_log_shows_where(tmp_path, client):
    log, script = tmp_path / 'node.log', tmp_path / 'broken.py'
    script.write_text(BROKEN)
    with running_node(tmp_path, *SPHERE, '-p', 'verify.routine:=sphere',
                      program=script) as process:
        client.connect()
        stand_still(client, START)
        client.until_counted(profiles=20, poses=20)
        for name in ('take_sample', 'verify_start', 'take_sample'):
            answer = client.call(name)
            assert not answer.success and answer.message.endswith(  # silence may come first
                f"{name} failed: ZeroDivisionError('in a service'); the log shows where")
        answer = client.call('auto_sample', SetBool.Request(data=True))
        assert (answer.success, answer.message) == (
            False, "the change failed: ZeroDivisionError('in a service'); the log shows where")
        assert parameter(client, 'sampling.mode') == 'manual', 'ROS shows what the node does'
        assert client.call('clear_samples').success
        stand_still(client, START + 10**10)
        state = client.until_counted(profiles=40, poses=40)
        assert state['samples'] == '0', 'it counts as before'
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    assert log.read_text().count('in broken') >= 3


AT_IMPORT = """
class Finder:
    def find_spec(self, name, *_):
        try:
            if name == '{0}':
                os.kill(os.getpid(), {1})
        except KeyboardInterrupt as error:
            raise ImportError('initialization failed') from error  # as extensions do

sys.meta_path.insert(0, Finder())
"""
AT_CALL = """
from rclpy.node import Node
whole = Node.{0}

def interrupted(*args, **options):
    os.kill(os.getpid(), {1})
    return whole(*args, **options)

Node.{0} = interrupted
"""


@pytest.mark.thorough
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(('before', 'what'), [
    (AT_IMPORT, 'numpy'), (AT_IMPORT, 'std_srvs.srv'), (AT_CALL, 'create_timer')])
def test_a_signal_while_it_starts_ends_it_cleanly(before: str, what: str, number: int) -> None:
    block = (f'import os, sys\n{before.format(what, number)}\n'
             'from handeye_ros.node.calibrate import main; sys.exit(main())')
    run = run_python('-c', block)
    assert (run.returncode, 'Traceback' in run.stderr) == (0, False), run.stderr
