# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A light plane that is tilted in its frame, published with all three coordinates."""
from __future__ import annotations

import math
from pathlib import Path

from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.bags.bag import read
from handeye_ros.bags.messages import cloud_from_cdr
from handeye_ros.bags.reader import CLOUD, Raw
from handeye_ros.errors import HandeyeError
import numpy as np
import pytest
from recordings import scan, with_messages

ROOT = Path(__file__).parents[2]


def tilted(raw: Raw, types: dict[str, str], degrees: float) -> Raw:
    """Return a message whose points (x, 0, z) are turned about x."""
    if types[raw.topic] != CLOUD:
        return raw
    data = bytearray(raw.data)
    cloud = cloud_from_cdr(bytes(data))
    cloud = cloud._replace(data=memoryview(data)[cloud.start:cloud.start + len(cloud.data)])
    z = np.array(cloud.view('z'))
    cloud.view('y')[...] = z * math.sin(math.radians(degrees))
    cloud.view('z')[...] = z * math.cos(math.radians(degrees))
    return raw._replace(data=bytes(data))


@pytest.mark.parametrize(('name', 'degrees'), [('plate', 3.0), ('sphere', 12.0)])
def test_it_is_refused_by_this_cause(name: str, degrees: float, tmp_path: Path) -> None:
    types, _ = scan(ROOT / 'bags' / name)
    bag = with_messages(ROOT / 'bags' / name, tmp_path, lambda raw: tilted(raw, types, degrees))
    config = configs.load(ROOT / 'config' / f'{name}.yaml')
    with pytest.raises(HandeyeError, match='tilted') as refused:
        recording = read(bag, config)
        pipeline.calibrate(recording.profiles, recording.poses, config)
    assert 'static transform' in str(refused.value)
