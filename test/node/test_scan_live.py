# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executable `scan`: points in the base over real topics, and refusals."""
from __future__ import annotations

from itertools import islice
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from command import ROOT, running  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped  # noqa: E402
from handeye_ros.results.calibration_file import write_calibration  # noqa: E402
from moving_scan import calibration, moving, plane_profiles  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import run_module  # noqa: E402
from sensor_msgs.msg import PointCloud2, PointField  # noqa: E402

pytestmark = pytest.mark.ros


def stamped(message, stamp, frame):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    message.header.frame_id = frame
    return message


def cloud_message(profiles):
    """Return one message of profiles, a row each, with the stamp of the first."""
    profile, rows = profiles[0], len(profiles)
    fields = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
              for k, name in enumerate('xz')]
    message = PointCloud2(height=rows, width=len(profile.points), point_step=8, fields=fields,
                          row_step=8 * len(profile.points))
    for one in profiles:
        message.data.frombytes(one.points.astype('<f4').tobytes())
    return stamped(message, profile.stamp, 'laser')


def pose_message(pose):
    message = stamped(PoseStamped(), pose.stamp, 'base')
    position, q = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = map(float, pose.translation)
    q.x, q.y, q.z, q.w = map(float, pose.quaternion)
    return message


@pytest.mark.parametrize('rows', [pytest.param(1, marks=pytest.mark.thorough), 5])
def test_points_are_published_in_the_base(tmp_path, client, rows):
    write_calibration(calibration(), tmp_path / 'calibration.yaml')
    got: list[PointCloud2] = []
    client.node.create_subscription(PointCloud2, '/handeye_scan/points', got.append, 100)
    command = [sys.executable, '-m', 'handeye_ros.node.scan', str(tmp_path), '--std',
               '--set', 'profile.period=0.001']
    with running(command, cwd=ROOT):
        client.until(lambda: client.profiles.get_subscription_count()
                     and client.poses.get_subscription_count()
                     and client.node.count_publishers('/handeye_scan/points'), 'it is there')
        poses, profiles = iter(moving(10_000)), iter(plane_profiles(10_000))

        def most_points_came() -> bool:
            # who takes best effort hears what is sent after it knows of the sender
            client.send(client.poses, map(pose_message, islice(poses, 1)), 200.0)
            batches = [list(islice(profiles, rows)) for _ in range(5 // rows)]
            client.send(client.profiles, map(cloud_message, batches), 1000.0 / rows)
            return sum(c.width for c in got) >= 50 * 50

        client.until(most_points_came, 'most points came')
    assert {c.header.frame_id for c in got} == {'base'}
    assert [f.name for f in got[0].fields] == ['x', 'y', 'z', 'std']
    z = np.concatenate([np.frombuffer(bytes(c.data), np.float32).reshape(-1, 4)[:, 2]
                        for c in got])
    np.testing.assert_allclose(z, 0.1, atol=1e-6)


def test_a_calibration_that_is_not_there_is_refused(tmp_path):
    run = run_module('scan', str(tmp_path / 'none.yaml'))
    assert run.returncode == 2
    assert 'none.yaml' in run.stderr and 'Traceback' not in run.stderr
