# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The replay of a bag, heard by a subscriber in another process."""
from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import running  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from recordings import scan  # noqa: E402
from ros_helpers import Client, RELIABLE, ROOT, run_module  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

pytestmark = pytest.mark.ros

BAG = ROOT / 'bags' / 'one_orientation'


def replaying(*arguments: str) -> AbstractContextManager[subprocess.Popen[str]]:
    return running(
        [sys.executable, '-m', 'handeye_ros.node.replay', *arguments], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_every_message_arrives_as_it_was_recorded(client: Client) -> None:
    _, recorded = scan(BAG)
    types = {'/profile': PointCloud2, '/flange_pose': PoseStamped}
    heard: dict[str, list[object]] = {topic: [] for topic in types}
    for topic, kind in types.items():
        client.node.create_subscription(kind, topic, heard[topic].append, RELIABLE)
    clock: list[Clock] = []
    client.node.create_subscription(Clock, '/clock', clock.append, RELIABLE)
    with replaying(str(BAG), '--rate', '20') as replay:
        client.until(lambda: replay.poll() is not None, 'the replay ends')
        client.until(lambda: sum(map(len, heard.values())) == len(recorded),
                     'all is heard')
        assert (replay.returncode, replay.communicate()) == (0, ('', ''))
    for topic, messages in heard.items():
        assert messages == [deserialize_message(raw.data, types[topic])
                            for raw in recorded if raw.topic == topic]
    times = [msg.clock.sec * 10**9 + msg.clock.nanosec for msg in clock]
    assert times == sorted(times)
    assert times[-1] == max(raw.log_time for raw in recorded)


def test_without_subscribers_it_says_so_and_goes_on(tmp_path: Path) -> None:
    run = run_module('replay', str(BAG), '--rate', '100', '--timeout', '0')
    assert (run.returncode, run.stdout) == (0, '')
    assert run.stderr == 'no subscriber on /profile, /flange_pose; starting anyway\n'


@pytest.mark.thorough
@pytest.mark.parametrize(('arguments', 'reason'), [
    (['no/such/bag'], 'no/such/bag: no such file or folder'),
    (['README.md'], 'README.md: is not a bag'),
    ([str(BAG), '--rate', '0'], 'the rate is 0, expected a number above 0'),
    ([str(BAG), '--rate', 'nan'], 'the rate is nan, expected a number above 0'),
])
def test_wrong_input(arguments: list[str], reason: str) -> None:
    run = run_module('replay', *arguments)
    assert run.returncode == 2
    assert run.stderr.startswith(reason)
    assert run.stderr.count('\n') == 1


def test_interrupted_it_ends_cleanly(client: Client) -> None:
    heard: list[object] = []
    client.node.create_subscription(client.poses.msg_type, '/flange_pose', heard.append, RELIABLE)
    with replaying(str(BAG), '--wait-for', '1') as replay:
        client.until(lambda: heard, 'the replay has begun')
        replay.terminate()
        client.until(lambda: replay.poll() is not None, 'the replay ends')
        assert (replay.returncode, replay.communicate()) == (0, ('', ''))
