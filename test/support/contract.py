# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What docs/contract.md lists of a node, and what a running one offers."""
from __future__ import annotations

import re

from command import ROOT
from handeye_ros.node.streams import TFMessage
from ros_helpers import Client

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
