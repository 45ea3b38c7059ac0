# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A running node is calibrated from some stops of a recording and verified with the others."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.bags import bag_write
from handeye_ros.bags.bag import read
from handeye_ros.config import load
import pytest
from recordings import halves
import yaml

pytest.importorskip('rclpy', reason='needs rclpy')
from rcl_interfaces.srv import SetParameters  # noqa: E402, I100
from rclpy.parameter import Parameter  # noqa: E402
from ros_helpers import Client, ROOT, run_module, running_node  # noqa: E402

pytestmark = pytest.mark.ros

SPHERE = ROOT / 'config' / 'sphere.yaml'
STOPS = 8  # of the calibration


def set_parameter(client: Client, name: str, value: object) -> None:
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    assert client.request(SetParameters, 'set_parameters', request).results[0].successful


@pytest.mark.thorough
def test_start_stops_result(tmp_path: Path, client: Client) -> None:
    counts = {'profiles': 0, 'poses': 0}
    parts = halves(read(ROOT / 'bags' / 'sphere', load(SPHERE)), STOPS)
    for name, (profiles, poses) in zip(('first', 'second'), parts, strict=True):
        bag_write.write(tmp_path / name, [p.read() for p in profiles], poses)

    def replay(name: str, part: int) -> None:
        counts['profiles'] += len(parts[part][0])
        counts['poses'] += len(parts[part][1])
        assert run_module('replay', str(tmp_path / name), '--rate', '10').returncode == 0
        client.until_counted(**counts)

    def refused(service: str, words: str) -> None:
        answer = client.call(service)
        assert (answer.success, words in answer.message) == (False, True), answer.message

    with running_node(tmp_path, '--params-file', str(SPHERE), '-p', 'page.port:=0'):
        client.connect()
        refused('verify_result', 'no verification was started')
        refused('verify_start', 'verify.routine is not set')
        set_parameter(client, 'verify.routine', 'cube')
        refused('verify_start', 'no routine "cube"')
        set_parameter(client, 'verify.routine', 'sphere')
        set_parameter(client, 'verify.radius', 0.04)
        refused('verify_start', 'there is no calibration to verify')
        replay('first', 0)
        assert client.call('compute_calibration').success
        started = client.call('verify_start')
        assert (started.success, started.message.split(';')[0]) == (
            True, 'sphere: 0 usable stops of 0')
        refused('verify_result', '0 usable stations, fewer than 4')
        replay('second', 1)
        result = client.call('verify_result')
        assert result.success, result.message
        assert result.message.startswith('sphere: PASS, 6 stations; radius '), result.message
        assert ' nominal 40.0000 mm, off by ' in result.message
        assert client.state()['samples'] == str(STOPS)
    written = yaml.safe_load((tmp_path / 'sphere' / 'verification_sphere.yaml').read_text())
    assert written['verdict'] == 'pass'
    radius = written['quantities'][0]
    assert abs(radius['value'] - radius['nominal']) < 3 * radius['std']
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()
