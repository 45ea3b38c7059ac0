# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A message of each driver's layout, read with the settings that docs/sensors.md gives for it."""
from __future__ import annotations

from pathlib import Path
import re

from command import ROOT
from handeye_ros import config as configs
from handeye_ros.bags.messages import rows_of
from handeye_ros.data import EdgePoint
from handeye_ros.profiles.faces import face_features
import numpy as np
import pytest
from ros_clouds import cloud, points, read

PAGE = ROOT / 'docs' / 'sensors.md'
F32, F64, U8, U16, U32 = 7, 8, 2, 4, 6
X = np.linspace(-0.02, 0.02, 640)
FACE = X > 0.004  # what lies left of it is 30 mm deeper
DEPTH = 0.2 + np.where(FACE, 0.1 * X, 0.03)  # from the sensor, metres
LOST = slice(100, 120)


def lost(values: np.ndarray, mark: float) -> np.ndarray:
    marked = values.copy()
    marked[LOST] = mark
    return marked


XYZ = {'x': (0, F32), 'y': (4, F32), 'z': (8, F32)}
Y = 0 * X
MIDDLE = 0.2  # range at which a height of 0 is told

# name of the section -> columns, layout and point_step of its driver's messages
MESSAGES: dict[str, tuple[dict[str, np.ndarray], dict[str, tuple[int, int]], int]] = {
    'scancontrol': ({'x': X, 'y': Y, 'z': lost(DEPTH, np.inf), 'intensity': Y + 1},
                    {**XYZ, 'intensity': (16, F32)}, 32),
    'scancontrol_lls': (
        {'x': X, 'y': Y, 'z': DEPTH, 'm0': Y, 'm1': Y, 'width': Y, 'intensity': Y, 'threshold': Y},
        {**XYZ, 'm0': (12, U32), 'm1': (16, U32), 'width': (20, U16), 'intensity': (22, U16),
         'threshold': (24, U16)}, 26),
    'keyence': ({'x': X, 'y': Y, 'z': lost(MIDDLE - DEPTH, np.inf)}, XYZ, 16),
    'Gocator': ({'x': X * 1e3, 'y': Y, 'z': lost(MIDDLE - DEPTH, np.nan) * 1e3}, XYZ, 12),
    'wenglor wecat3d': ({'x': X, 'y': Y + 0.37, 'z': DEPTH}, XYZ, 16),
    'Mech-Mind': ({'x': X, 'y': Y, 'z': lost(MIDDLE - DEPTH, np.nan), 'intensity': Y + 9},
                  {**XYZ, 'intensity': (12, U8)}, 16),
}


def sections() -> dict[str, str]:
    """Return the parameter file in each section of the page."""
    parts = re.split(r'^## (.+)$', PAGE.read_text(encoding='utf-8'), flags=re.MULTILINE)[1:]
    found = {}
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        blocks = re.findall(r'^```yaml\n(.*?)^```', text, flags=re.MULTILINE | re.DOTALL)
        found |= {name: blocks[0]} if blocks else {}
    return found


@pytest.mark.parametrize('name', MESSAGES)
def test_the_edge_is_found_in_it(name: str, tmp_path: Path) -> None:
    file = tmp_path / 'sensor.yaml'
    file.write_text(sections()[name])
    config = configs.load(file)
    columns, layout, step = MESSAGES[name]
    rng = np.random.default_rng(1)
    size = 1e-5 * (1e3 if config.profile.unit == 'mm' else 1.0)
    noisy = {**columns, 'z': columns['z'] + rng.normal(size=len(X)) * size}
    features = face_features(points(cloud(noisy, layout, step), config.profile), config)
    edges = [f.point[0] for f in features if isinstance(f, EdgePoint)]
    assert min(abs(x - 0.004) for x in edges) < 2e-4


def test_a_batch_of_mech_mind_is_so_many_profiles(tmp_path: Path) -> None:
    file = tmp_path / 'sensor.yaml'
    file.write_text(sections()['Mech-Mind'])
    config = configs.load(file).profile
    columns, layout, step = MESSAGES['Mech-Mind']
    message = cloud({name: np.tile(v, 5) for name, v in columns.items()}, layout, step, height=5)
    assert rows_of(read(message), config) == 5
    assert config.stamp == 'last', 'the driver stamps a batch when it is complete'
