# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How the node ends, idle and while it solves; what destroyed publishers do to its executor."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import PATIENCE, running  # noqa: E402, I100
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.task import Future  # noqa: E402
from ros_helpers import (  # noqa: E402
    Client,
    pose_message,
    ROOT,
    sphere_profile,
)
from std_srvs.srv import SetBool, Trigger  # noqa: E402

pytestmark = pytest.mark.ros

SLOW = """
import sys, threading
from handeye_ros import pipeline

def answer(samples, rejects, config, frame_id='', session=None):
    if not session:  # a review, which nobody asked for
        return whole(samples, rejects, config, frame_id)
    print('solving', flush=True)
    threading.Event().wait()

whole, pipeline.answer = pipeline.answer, answer
if __name__ == '__main__':
    from handeye_ros.node.main import main
    sys.exit(main())
"""

@contextmanager
def solving(tmp_path: Path, client: Client) -> Iterator[tuple[subprocess.Popen[bytes], Future]]:
    """Run a node that solves and never ends to; give it, and what will have its answer."""
    log = tmp_path / 'node.log'
    script = tmp_path / 'slow.py'
    script.write_text(SLOW)
    command = [sys.executable, str(script), '--ros-args', '-p', 'target.type:=sphere', '-p',
               'target.radius:=0.04', '-p', f'output_dir:={tmp_path}']
    with log.open('w') as stream, running(command, cwd=ROOT, stdout=stream,
                                          stderr=stream) as process:
        client.connect()
        for stamp in range(10**18, 10**18 + 10**9, 10**9 // 20):
            client.poses.publish(pose_message(stamp))
            client.profiles.publish(sphere_profile(stamp + 1))
        client.until_counted(profiles=20, poses=20)
        service = client.node.create_client(Trigger, '/handeye/compute_calibration')
        client.until(service.service_is_ready, 'the service is there')
        future = service.call_async(Trigger.Request())
        client.until(lambda: 'solving' in log.read_text(), 'it solves')
        yield process, future


def test_all_other_services_answer_while_it_solves(tmp_path: Path, client: Client) -> None:
    with solving(tmp_path, client) as (_, future):
        result = client.call('take_sample')
        assert result.success and result.message.startswith('sample 1 taken again'), result.message
        words = {'save_calibration': 'there is no calibration to save',
                 'verify_start': 'verify.routine is not set',
                 'verify_result': 'no verification was started'}
        for name, word in words.items():
            result = client.call(name)
            assert (result.success, word in result.message) == (False, True), result.message
        request = SetParameters.Request(parameters=[
            Parameter('limits.translation', value=0.004).to_parameter_msg()])
        assert client.request(SetParameters, 'set_parameters', request).results[0].successful
        assert client.call('auto_sample', SetBool.Request(data=False)).success
        assert client.call('remove_last_sample').message.startswith('removed sample 1')
        assert client.call('clear_samples').success
        assert not future.done(), 'it solves still'


@pytest.mark.thorough
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_node_ends_cleanly_while_it_solves(
        tmp_path: Path, client: Client, number: int) -> None:
    with solving(tmp_path, client) as (process, _):
        log = tmp_path / 'node.log'
        process.send_signal(number)
        assert process.wait(PATIENCE) == 0
    said = log.read_text().splitlines()
    assert [line for line in said if '[INFO]' not in line and '[WARN]' not in line] == ['solving']
