# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm from the session of a running node: its stops hold the joint values."""
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('pinocchio', reason='needs pinocchio')

from command import handeye, ROOT  # noqa: E402, I100
from handeye_ros.arm import read_arm  # noqa: E402
from handeye_ros.results.calibration_file import read_calibration  # noqa: E402
from handeye_ros.results.truth_file import true_transform  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import Client, replay, running_node  # noqa: E402

pytestmark = pytest.mark.ros
BAG = ROOT / 'bags' / 'arm'


@pytest.mark.thorough
def test_the_arm_is_corrected_from_the_stops_of_a_session(tmp_path: Path, client: Client) -> None:
    with running_node(tmp_path, '-p', 'target.type:=sphere'):
        client.connect()
        replay(BAG)
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        assert client.call('save_calibration').success
    session, = (path for path in (tmp_path / 'sphere').iterdir() if path.is_dir())
    out = tmp_path / 'arm'
    run = handeye('kinematics', session, '--urdf', BAG / 'robot.urdf', '--out', out, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    calibration = read_calibration(out / 'calibration.yaml')
    assert calibration.quality.holdout_rms < 6e-5, 'a fifth of that with the arm as stated'
    X, sigma = calibration.T_flange_sensor, np.sqrt(np.diag(calibration.covariance))[:3]
    assert (np.abs(X - true_transform(BAG))[:3, 3] < 4 * sigma).all()
    assert len(read_arm(out / 'kinematics.yaml').values) == 30
