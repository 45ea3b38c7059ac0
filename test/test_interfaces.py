# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""tools/build_interfaces.py: what it builds is what a ROS install has."""
from __future__ import annotations

import json
import os
from pathlib import Path
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not built: make tf2_msgs')
import ament_index_python  # noqa: E402, I100
from rosbags.typesys import get_typestore, Stores  # noqa: E402

pytestmark = pytest.mark.ros

TYPE = 'tf2_msgs/msg/TFMessage'
# as in the metadata.yaml of bags recorded on Jazzy
JAZZY = 'RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087'


@pytest.fixture(autouse=True)
def _prefix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the virtual environment the ROS prefix where no ROS is sourced."""
    if not os.environ.get('AMENT_PREFIX_PATH'):
        monkeypatch.setenv('AMENT_PREFIX_PATH', sys.prefix)


def test_type_hash_is_that_of_jazzy() -> None:
    share = Path(ament_index_python.get_package_share_directory('tf2_msgs'))
    description = json.loads((share / 'msg' / 'TFMessage.json').read_text(encoding='utf-8'))
    hashes = {item['type_name']: item['hash_string'] for item in description['type_hashes']}
    assert hashes[TYPE] == JAZZY
    assert get_typestore(Stores.ROS2_JAZZY).hash_rihs01(TYPE) == JAZZY
