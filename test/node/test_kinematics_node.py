# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from the session of a running node: its stops hold the joint values."""
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('pinocchio', reason='needs pinocchio')

from command import handeye, ROOT  # noqa: E402, I100
from handeye_ros.results.calibration_file import read_calibration  # noqa: E402
from handeye_ros.robot.urdf import read_arm  # noqa: E402
from ros_helpers import Client, replay, running_node  # noqa: E402

pytestmark = pytest.mark.ros
BAG = ROOT / 'bags' / 'arm'


def test_the_arm_is_corrected_from_the_stops_of_a_session(tmp_path: Path, client: Client) -> None:
    with running_node(tmp_path, '-p', 'target.type:=sphere'):
        client.connect()
        replay(BAG)
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        assert client.call('save_calibration').success
    session, = (path for path in (tmp_path / 'sphere').iterdir() if path.is_dir())
    arms = {}
    for source in (session, BAG):
        out = tmp_path / 'arm' / source.name
        run = handeye('kinematics', source, '--urdf', BAG / 'robot.urdf', '--out', out,
                      *(['--set', 'target.type=sphere'] if source == BAG else []), cwd=tmp_path)
        assert run.returncode == 0, run.stderr
        arms[source] = read_arm(out / 'kinematics.yaml')
        assert read_calibration(out / 'calibration.yaml').quality.holdout_rms < 6e-5
    assert arms[session].values == pytest.approx(arms[BAG].values, abs=1e-7)
