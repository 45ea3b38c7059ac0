# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points beside one plane are a light plane that is tilted: refused, also live."""
from __future__ import annotations

from dataclasses import replace
import math
from pathlib import Path

from command import ROOT
from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.bags.messages import field_view
from handeye_ros.bags.recording import read_bag
from handeye_ros.bags.storage import CLOUD_TYPE, RecordedMessage
from handeye_ros.errors import HandeyeError
from live_sessions import computed, fed, new
import numpy as np
import pytest
from recordings import scan, TYPES, with_messages


def tilted(raw: RecordedMessage, types: dict[str, str], degrees: float, each: bool = True
           ) -> RecordedMessage:
    """Return a message whose points (x, 0, z) are turned about x; each: or all by the same y."""
    if types[raw.topic] != CLOUD_TYPE:
        return raw
    cloud = TYPES.deserialize_cdr(raw.data, CLOUD_TYPE)
    cloud.data = cloud.data.copy()
    z = np.array(field_view(cloud, 'z'))
    y = z if each or np.isnan(z).all() else np.nanmean(z)
    field_view(cloud, 'y')[...] = y * math.sin(math.radians(degrees))
    field_view(cloud, 'z')[...] = z * math.cos(math.radians(degrees))
    return raw._replace(data=bytes(TYPES.serialize_cdr(cloud, CLOUD_TYPE)))


@pytest.mark.parametrize(('name', 'degrees'), [('plate', 3.0), ('sphere', 12.0)])
def test_a_tilted_light_plane_is_refused(name: str, degrees: float, tmp_path: Path) -> None:
    types, _ = scan(ROOT / 'bags' / name)
    bag = with_messages(ROOT / 'bags' / name, tmp_path, lambda raw: tilted(raw, types, degrees))
    config = configs.load(ROOT / 'config' / f'{name}.yaml')
    with pytest.raises(HandeyeError, match='frame of the light plane') as refused:
        recording = read_bag(bag, config)
        pipeline.calibrate(recording.profiles, recording.poses, config)
    assert 'static transform' in str(refused.value)


def test_a_tilted_light_plane_is_told_again_by_a_session_that_continues(tmp_path: Path) -> None:
    types, _ = scan(ROOT / 'bags' / 'plate')
    bag = with_messages(ROOT / 'bags' / 'plate', tmp_path,
                        lambda raw: tilted(raw, types, 3.0, False))
    config = replace(configs.load(ROOT / 'config' / 'plate.yaml'), output_dir=str(tmp_path))
    live = fed(config, read_bag(bag, config))
    live.files.close()
    for session in (live, new(replace(live.config, session='last'))):
        with pytest.raises(HandeyeError, match='light plane that is tilted'):
            computed(session)
