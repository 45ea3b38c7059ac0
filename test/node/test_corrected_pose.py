# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executable `corrected_pose`: joint values in, poses of the corrected arm out."""
from __future__ import annotations

from pathlib import Path
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from command import ROOT, running  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped  # noqa: E402
from handeye_ros.arm import arm_of  # noqa: E402
from handeye_ros.simulate import robot  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import BEST_EFFORT, Client, run_module  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

pytestmark = pytest.mark.ros
Q = [0.1, -0.2, 0.3, 0.4, 0.5, -0.6]


def test_a_pose_follows_every_joint_state(tmp_path: Path, client: Client) -> None:
    pytest.importorskip('pinocchio', reason='needs pinocchio')
    urdf = robot.urdf().replace('0 0 0.75', '0.002 0 0.75')
    (tmp_path / 'arm.urdf').write_text(urdf)
    got: list[PoseStamped] = []
    client.node.create_subscription(PoseStamped, '/corrected_pose', got.append, BEST_EFFORT)
    joints = client.node.create_publisher(JointState, '/joint_states', BEST_EFFORT)
    command = [sys.executable, '-m', 'handeye_ros.node.corrected_pose', '--urdf',
               str(tmp_path / 'arm.urdf')]
    state = JointState(name=[f'joint_{k}' for k in range(6, 0, -1)], position=Q[::-1])
    state.header.stamp.sec = 7

    def heard() -> bool:
        joints.publish(JointState(name=['gripper'], position=[0.0]))
        joints.publish(state)
        return bool(got)
    with running(command, cwd=ROOT):
        client.until(heard, 'a pose comes')
    T = arm_of(urdf).forward(np.array([Q]))[0]
    p = got[0].pose.position
    np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3], atol=1e-12)
    assert (got[0].header.stamp.sec, got[0].header.frame_id) == (7, 'base')


def test_a_file_that_is_none_is_refused_in_a_sentence() -> None:
    run = run_module('corrected_pose', '--kinematics', 'nowhere.yaml')
    assert run.returncode == 2 and 'nowhere.yaml cannot be used' in run.stderr
