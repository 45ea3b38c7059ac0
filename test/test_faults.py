"""Faults while the node runs, one by one; docs/reliability.md tells what each row's test is."""
from __future__ import annotations

from itertools import count
from pathlib import Path
import re
import runpy
import subprocess

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from ros_helpers import (  # noqa: E402, I100
    Client,
    pose_message,
    RELIABLE,
    ROOT,
    running_node,
    sphere_profile,
)
from sensor_msgs.msg import PointCloud2  # noqa: E402

pytestmark = pytest.mark.ros

POLICY = runpy.run_path(str(ROOT / 'tools' / 'make_policy.py'))
START = 10 ** 18
PERIOD = 50_000_000


def test_streams_that_fall_silent_are_told_and_heard_again(tmp_path: Path, client: Client
                                                           ) -> None:
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


def test_two_publishers_with_two_clocks_on_one_topic(tmp_path: Path, client: Client) -> None:
    other = client.node.create_publisher(PointCloud2, '/profile', RELIABLE)
    with running_node(tmp_path):
        client.connect()
        client.until(other.get_subscription_count, 'the node hears the other too')
        for i in range(20):
            client.poses.publish(pose_message(START + i * PERIOD))
            client.profiles.publish(sphere_profile(START + i * PERIOD))
            other.publish(sphere_profile(START + i * PERIOD - 60 * 10**9))
        state = client.until_counted(profiles=40, poses=20)
        assert state['dropped'] == ('dropped a profile whose stamp lies far ahead of the next one '
                                    '(20 times)')
        answer = client.call('take_sample')
        assert not answer.success and 'no profile has a stamp' in answer.message


def test_the_policy_allows_what_the_node_does_and_nothing_else(tmp_path: Path, client: Client
                                                               ) -> None:
    text = POLICY['POLICY'].read_text(encoding='utf-8')
    with running_node(tmp_path):
        client.connect()
        client.until(lambda: POLICY['policy'](POLICY['used'](client.node)) == text,
                     'the graph of the node is that of the policy: tools/make_policy.py')


@pytest.mark.parametrize('page', ['reliability.md', 'security.md'])
def test_every_test_that_a_page_names_is_there(page: str) -> None:
    text = (ROOT / 'docs' / page).read_text(encoding='utf-8')
    named = re.findall(r'`(test_\w+)\.py::(test_\w+)`', text)
    assert named
    for module, test in named:
        assert f'def {test}(' in (ROOT / 'test' / f'{module}.py').read_text(encoding='utf-8')


def test_nothing_listens_but_dds(tmp_path: Path, client: Client) -> None:
    with running_node(tmp_path) as process:
        client.connect()
        listening = subprocess.run(['ss', '-Hltnp'], capture_output=True, text=True, check=False)
        if listening.returncode:
            pytest.skip('ss is not there')
        assert f'pid={process.pid},' not in listening.stdout, 'no TCP port is open by default'
