"""The node tells what to do next, in words and as a pose."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import config as configuration
from handeye_ros.ros.bags.bag import read
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from geometry_msgs.msg import PoseStamped  # noqa: E402, I100
from ros_helpers import Client, LATCHED, replay, ROOT, running_node  # noqa: E402
from std_msgs.msg import String  # noqa: E402

pytestmark = pytest.mark.ros

PLATE = ROOT / 'config' / 'plate.yaml'


def test_the_next_pose_and_the_words_for_it(tmp_path: Path, client: Client) -> None:
    poses: list[PoseStamped] = []
    texts: list[String] = []
    client.node.create_subscription(PoseStamped, '/handeye/next_pose', poses.append, LATCHED)
    client.node.create_subscription(String, '/handeye/guidance', texts.append, LATCHED)
    recording = read(ROOT / 'bags' / 'plate', configuration.load(PLATE))
    first = next(iter(recording.poses))
    with running_node(tmp_path, '--params-file', str(PLATE), '-p', 'guidance.accuracy:=1e-5'):
        client.connect()
        client.until(lambda: texts, 'there is advice before the first sample')
        assert texts[0].data.startswith('Take the first sample: hold the sensor square')
        replay(ROOT / 'bags' / 'plate')
        client.until(lambda: poses, 'a pose is proposed')
        client.until(lambda: 'points in view are known to' in texts[-1].data.lower(),
                     'the words say how well it is known')
        told = poses[-1]
        p = told.pose.position
        away = np.linalg.norm(np.array([p.x, p.y, p.z]) - first.translation)
        assert away <= configuration.Config().guidance.reach + 1e-3
        assert told.header.frame_id == 'base'
        assert client.call('clear_samples').success
        client.until(lambda: texts[-1].data.startswith('Take the first sample'),
                     'it starts again')
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()
