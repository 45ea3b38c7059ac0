"""A running node offers every topic and service that docs/contract.md lists, with their types."""
from __future__ import annotations

from pathlib import Path
import re

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import ROOT  # noqa: E402, I100
from handeye_ros.ros.node.intake import TFMessage  # noqa: E402
from ros_helpers import Client, running_node  # noqa: E402

pytestmark = pytest.mark.ros

ROW = re.compile(r'^\| (subscribes|publishes|service) \| `([^`]+)`[^|]*\| ([\w/]+)[^|]*\|', re.M)


def listed() -> set[tuple[str, str, str]]:
    """Return (what, full name, type) of the rows of the contract."""
    rows = ROW.findall((ROOT / 'docs' / 'contract.md').read_text(encoding='utf-8'))
    assert len(rows) > 10
    return {(what, '/handeye/' + name[2:] if name[0] == '~' else '/' + name.lstrip('/'), kind)
            for what, name, kind in rows if TFMessage or name != '/tf_static'}


def offered(client: Client) -> set[tuple[str, str, str]]:
    node = client.node
    found = {'publishes': node.get_publisher_names_and_types_by_node,
             'subscribes': node.get_subscriber_names_and_types_by_node,
             'service': node.get_service_names_and_types_by_node}
    return {(what, name, kind) for what, ask in found.items()
            for name, kinds in ask('handeye', '/') for kind in kinds}


def test_topics_and_services(client: Client, tmp_path: Path) -> None:
    with running_node(tmp_path):
        client.until(lambda: client.node.get_node_names().count('handeye'), 'the node is there')
        client.until(lambda: listed() <= offered(client), 'it offers all that the contract lists')
