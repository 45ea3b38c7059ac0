# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Saved calibrations on /tf_static, heard by a subscriber in another process."""
from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
TFMessage = pytest.importorskip('tf2_msgs.msg', reason='needs tf2_msgs').TFMessage
from command import PATIENCE, running  # noqa: E402, I100
from handeye_ros import se3  # noqa: E402
from handeye_ros.data import Calibration, Quality  # noqa: E402
from handeye_ros.results import exports  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import Client, LATCHED, ROOT, run_module  # noqa: E402

pytestmark = pytest.mark.ros

LASER = Calibration(
    name='plate', method='plate', parent_frame='flange', child_frame='laser',
    T_flange_sensor=se3.transform(se3.exp_rotation(np.array([0.3, -1.2, 2.0])),
                                  np.array([0.0123, -0.05, 0.1])),
    covariance=np.eye(6) * 1e-10, target={}, quality=Quality(1, 0, 1e-5, 1e-5, 'x (m)', 1e-5),
    samples=())
CAMERA = replace(LASER, name='camera', child_frame='camera', parent_frame='base',
                 T_flange_sensor=se3.inverse(LASER.T_flange_sensor))


def publishing(*arguments: object) -> AbstractContextManager[subprocess.Popen[str]]:
    return running([sys.executable, '-m', 'handeye_ros.node.publish', *map(str, arguments)],
                   cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def heard(client: Client) -> list[TFMessage]:
    messages: list[TFMessage] = []
    client.node.create_subscription(TFMessage, '/tf_static', messages.append, LATCHED)
    client.until(lambda: messages, 'the transforms are published')
    return messages


def test_all_are_heard_by_who_comes_late(tmp_path: Path, client: Client) -> None:
    for calibration in (LASER, CAMERA):
        exports.save_all(calibration, tmp_path / calibration.name)
    with publishing(tmp_path / 'plate', tmp_path / 'camera' / 'calibration.yaml') as process:
        (message,) = heard(client)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    result = {(t.header.frame_id, t.child_frame_id): t.transform for t in message.transforms}
    assert result.keys() == {('flange', 'laser'), ('base', 'camera')}
    for calibration in (LASER, CAMERA):
        t = result[calibration.parent_frame, calibration.child_frame]
        T = se3.from_quaternion(
            np.array([getattr(t.translation, k) for k in 'xyz']),
            np.array([getattr(t.rotation, k) for k in 'xyzw']))
        np.testing.assert_allclose(T, calibration.T_flange_sensor, rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_what_can_be_read_is_published_beside_what_cannot(tmp_path: Path, client: Client) -> None:
    exports.save_all(LASER, tmp_path / 'plate')
    exports.save_all(LASER, tmp_path / 'again')
    (tmp_path / 'bad.yaml').write_text('format: [')
    with publishing(tmp_path / 'bad.yaml', tmp_path / 'plate', tmp_path / 'again',
                    tmp_path / 'none.yaml') as process:
        (message,) = heard(client)
        assert [t.child_frame_id for t in message.transforms] == ['laser']
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2 and 'Traceback' not in err, err
    for words in ('bad.yaml cannot be used: it is not valid YAML', 'none.yaml cannot be used',
                  'gives the pose of laser', '3 of 4 calibrations not published'):
        assert words in err


def test_nothing_to_publish_ends_at_once(tmp_path: Path) -> None:
    run = run_module('publish', str(tmp_path))
    assert run.returncode == 2
    assert f'{tmp_path / "calibration.yaml"} cannot be used' in run.stderr
    assert '1 of 1 calibrations not published' in run.stderr and 'Traceback' not in run.stderr
