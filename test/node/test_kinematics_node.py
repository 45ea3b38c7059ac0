"""The corrected arm from a running node: joint states in, files out."""
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('pinocchio', reason='needs pinocchio')

from command import handeye, ROOT  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped  # noqa: E402
from handeye_ros.results.calibration_file import read_calibration  # noqa: E402
from handeye_ros.robot.urdf import read_arm  # noqa: E402
import numpy as np  # noqa: E402
from ros_helpers import BEST_EFFORT, Client, replay, running_node  # noqa: E402

pytestmark = pytest.mark.ros
BAG = ROOT / 'bags/arm'


@pytest.mark.thorough
def test_the_node_corrects_the_arm(tmp_path: Path, client: Client) -> None:
    client.node.create_subscription(PoseStamped, '/flange_pose', lambda pose: None, BEST_EFFORT)
    with running_node(tmp_path, '-p', 'target.type:=sphere', '-p',
                      f'robot_description:={BAG / "robot.urdf"}'):
        client.until(lambda: client.profiles.get_subscription_count(), 'the node subscribes')
        replay(BAG)
        done = client.call('compute_kinematics')
    assert done.success, done.message
    assert 'points that were left out: 0.33 mm RMS before, 0.03 mm after' in done.message
    folder = tmp_path / 'sphere/kinematics'
    assert len(read_arm(folder).parameters) == 30
    assert read_calibration(folder / 'calibration.yaml').quality.holdout_rms < 6e-5
    session = next(path for path in (tmp_path / 'sphere').iterdir() if path.name != 'kinematics')
    out = tmp_path / 'again'
    again = handeye('kinematics', session, '--urdf', BAG / 'robot.urdf', '--out', out,
                    cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    np.testing.assert_allclose(read_arm(out).values, read_arm(folder).values, atol=1e-7)
    with running_node(tmp_path, '-p', 'target.type:=sphere', '-p', f'session:={session}', '-p',
                      f'robot_description:={BAG / "robot.urdf"}'):
        resumed = client.call('compute_kinematics')
    assert resumed.success, resumed.message
    assert resumed.message.split(';')[0] == done.message.split(';')[0]
