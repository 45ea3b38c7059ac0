# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A person at the cell: a button, a node that dies, a late joiner, and what does not fit."""
from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import ROOT  # noqa: E402, I100
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from ros_helpers import (  # noqa: E402
    Client,
    LATCHED,
    pose_message,
    running_node,
    sphere_profile,
)
from std_msgs.msg import Empty, String  # noqa: E402

pytestmark = pytest.mark.ros

NS = 1_000_000_000
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'sampling.mode:=manual')


def stand_still(client: Client, start: int, x: float = 0.0) -> None:
    """Publish a robot that stands still for a second, and what its sensor sees."""
    for stamp in range(start, start + NS, NS // 20):
        client.poses.publish(pose_message(stamp, (x, 0.0, 0.0)))
        client.profiles.publish(sphere_profile(stamp + 1))


class Reports:
    """The JSON that a latched topic carries."""

    def __init__(self, client: Client, topic: str) -> None:
        self._client, self._texts = client, []
        client.node.create_subscription(String, topic, self._texts.append, LATCHED)

    def until(self, condition, what: str) -> dict:
        self._client.until(lambda: self._texts and condition(json.loads(self._texts[-1].data)),
                           what)
        return json.loads(self._texts[-1].data)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    yield tmp_path / 'home'


@pytest.mark.thorough
def test_a_button_a_kill_and_a_restart(tmp_path: Path, client: Client, home: Path) -> None:
    samples = Reports(client, '/handeye/samples')
    button = client.node.create_publisher(Empty, '/handeye/take', 10)
    here = ('-p', 'output_dir:=""')
    with running_node(tmp_path, *SPHERE, *here) as process:
        client.connect()
        client.until(button.get_subscription_count, 'the node hears the button')
        button.publish(Empty())
        report = samples.until(lambda report: report['attempt'], 'the attempt is answered')
        assert not report['attempt']['accepted'] and 'no flange pose' in report['attempt']['text']
        for number, start in enumerate((10**18, 10**18 + 5 * NS), 1):
            stand_still(client, start, 0.1 * number)
            client.until_counted(profiles=20 * number, poses=20 * number)
            button.publish(Empty())
            report = samples.until(lambda report, n=number: len(report['samples']) == n,
                                   'it is taken')
            assert report['attempt']['text'].startswith(f'sample {number} taken: 1 arc from ')
        process.send_signal(signal.SIGKILL)
        process.wait()
    folder = Path(report['session'])
    assert folder.parent == home / 'handeye_ros' / 'sphere'
    assert (folder / 'metadata.yaml').exists()
    with running_node(tmp_path, '-p', 'session:=last', *here):
        report = samples.until(lambda report: report['session'] == str(folder), 'it goes on')
        client.connect()
        assert [s['number'] for s in report['samples']] == [1, 2]
        assert report['mode'] == 'manual', 'as it was in the session'
        excluded = SetParameters.Request(parameters=[
            Parameter('samples.exclude', value=[2]).to_parameter_msg()])
        assert client.request(SetParameters, 'set_parameters', excluded).results[0].successful
        samples.until(lambda report: [s['excluded'] for s in report['samples']] == [False, True],
                      'a sample is left out')


# -- the executable


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
AT_EXECUTOR = """
import time
""" + AT_CALL.replace('rclpy.node import Node', 'rclpy.executors import Executor as Node').replace(
    '    return', '    time.sleep(0.5)\n    return')


@pytest.mark.thorough
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(('before', 'what'), [
    (AT_IMPORT, 'numpy'), (AT_IMPORT, 'rclpy._rclpy_pybind11'), (AT_IMPORT, 'std_srvs.srv'),
    (AT_CALL, 'declare_parameters'), (AT_CALL, 'create_timer'), (AT_EXECUTOR, '__init__')])
def test_a_signal_while_it_starts_ends_it_cleanly(before: str, what: str, number: int) -> None:
    block = (f'import os, sys\n{before.format(what, number)}\n'
             'from handeye_ros.node.main import main; sys.exit(main())')
    run = subprocess.run([sys.executable, '-c', block], cwd=ROOT, capture_output=True, text=True,
                         check=False)
    # rclpy complains of the executor that it did not make
    ours = run.stderr.partition('Exception ignored in: <function Executor.__del__')[0]
    assert (run.returncode, 'Traceback' in ours) == (0, False), run.stderr
