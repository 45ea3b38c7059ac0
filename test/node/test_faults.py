# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Faults while the node runs, one by one."""
from __future__ import annotations

from itertools import count
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402, I100
from ros_helpers import (  # noqa: E402
    Client,
    pose_message,
    RELIABLE,
    ROOT,
    running_node,
    sphere_profile,
)
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

pytestmark = pytest.mark.ros

START = 10 ** 18
PERIOD = 50_000_000
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'sampling.mode:=manual')


@pytest.mark.thorough
def test_streams_that_fall_silent_are_reported_and_heard_again(
        tmp_path: Path, client: Client) -> None:
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
                send(START + next(later) * PERIOD)
                return f'no more {stream}' not in client.state()['message']

            client.until(heard_again, f'the {stream} are no longer silent')


@pytest.mark.thorough
def test_two_publishers_with_two_clocks_on_one_topic(tmp_path: Path, client: Client) -> None:
    other = client.node.create_publisher(PointCloud2, '/profile', RELIABLE)
    words = '2 publishers send profiles on /profile (/client, /client): let only one publish'
    with running_node(tmp_path):
        client.connect()
        client.until(other.get_subscription_count, 'the node hears the other too')
        client.until(lambda: words in client.state()['message'], 'it names them')
        assert words in client.call('take_sample').message
        for i in range(4):
            client.poses.publish(pose_message(START + i * PERIOD))
            client.profiles.publish(sphere_profile(START + i * PERIOD))
            client.until_counted(profiles=2 * i + 1, poses=i + 1)  # two writers have no order
            other.publish(sphere_profile(START + i * PERIOD - 60 * 10**9))
            state = client.until_counted(profiles=2 * i + 2, poses=i + 1)
        # of each two one is dropped: the first, or once poses vouch for it the other
        assert sum(map(int, re.findall(r'\((\d+) times\)', state['dropped']))) == 4
        answer = client.call('take_sample')
        assert not answer.success and 'stamps are older than those before' in answer.message
        client.node.destroy_publisher(other)
        client.until(lambda: words not in client.state()['message'], 'one publisher is left')


@pytest.mark.thorough
def test_the_network_goes_and_comes_back(tmp_path: Path) -> None:
    alone = ['unshare', '--net']
    up = [*alone, 'ip', 'link', 'set', 'lo', 'up']
    if not shutil.which('unshare') or subprocess.run(
            up, capture_output=True, check=False).returncode:
        pytest.skip('no network of its own may be made here')
    run = subprocess.run(
        [*alone, sys.executable, 'lost_network.py', str(tmp_path)], cwd=ROOT / 'test' / 'support',
        capture_output=True, text=True, check=False, timeout=180,
        env={**os.environ, 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
             'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'})
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.thorough
def test_a_simulated_clock_that_jumps_forth_and_back(tmp_path: Path, client: Client) -> None:
    clock = client.node.create_publisher(Clock, '/clock', 10)
    result: list[int] = []
    client.node.create_subscription(DiagnosticArray, '/diagnostics',
                                    lambda msg: result.append(msg.header.stamp.sec), 10)
    with running_node(tmp_path, '-p', 'use_sim_time:=true', *SPHERE):
        client.connect()
        for number, now in enumerate((10**9, 2 * 10**9, 10**9 - 1000, 10**9), 1):
            def taken(now=now) -> bool:
                msg = Clock()
                msg.clock.sec = now
                clock.publish(msg)
                return bool(result and result[-1] == now)

            client.until(taken, 'the node goes by the clock, and tells its state')
            for i in range(20):
                # stamped by the system's clock, as a real sensor does
                client.poses.publish(pose_message(START + number * 10**9 + i * PERIOD,
                                                  (0.1 * number, 0.0, 0.0)))
                client.profiles.publish(sphere_profile(START + number * 10**9 + i * PERIOD + 1))
            client.until_counted(profiles=20 * number, poses=20 * number)
            answer = client.call('take_sample')
            assert answer.message.startswith(f'sample {number} taken: '), answer.message
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()


@pytest.mark.thorough
def test_two_nodes_of_one_name_are_reported_and_keep_apart(tmp_path: Path, client: Client) -> None:
    first, second = tmp_path / 'first', tmp_path / 'second'
    for folder in (first, second):
        folder.mkdir()
    shared = ('-p', f'output_dir:={tmp_path}', '-p', 'target.type:=sphere')
    words = 'there are two nodes /handeye: both take samples, and either may answer; end one'
    with running_node(first, *shared):
        client.connect()
        assert words not in client.state()['message']
        with running_node(second, *shared):
            client.until(lambda: words in client.state()['message'], 'it is told')
            client.until(lambda: all(words in (folder / 'node.log').read_text()
                                     for folder in (first, second)), 'both say so')
            client.until(lambda: client.profiles.get_subscription_count() == 2
                         == client.poses.get_subscription_count(), 'both hear the client')
            for i in range(50):
                away = (0.1 if i > 45 else 0.0, 0.0, 0.0)
                client.send(client.poses, [pose_message(START + i * PERIOD, away)], rate=200)
                client.send(client.profiles, [sphere_profile(START + i * PERIOD + 1)], rate=200)
            client.until(lambda: len(list(tmp_path.glob('sphere/*/metadata.yaml'))) == 2,
                         'each keeps its own session')
        client.until(lambda: words not in client.state()['message'], 'it is over')


@pytest.mark.parametrize('number', [
    signal.SIGINT, *(pytest.param(number, marks=pytest.mark.thorough)
                     for number in (signal.SIGTERM, signal.SIGKILL))])
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
