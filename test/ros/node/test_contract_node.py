"""A running node offers every topic and service that docs/contract.md lists, with their types."""
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from contract import listed, offered  # noqa: E402, I100
from ros_helpers import Client, running_node  # noqa: E402

pytestmark = pytest.mark.ros


def test_topics_and_services(client: Client, tmp_path: Path) -> None:
    with running_node(tmp_path):
        client.until(lambda: client.node.get_node_names().count('handeye'), 'the node is there')
        client.until(lambda: listed() <= offered(client), 'it offers all that the contract lists')
