# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated scenarios in a size that is quick to render."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Profile
from handeye_ros.simulate import Scenario, SCENARIOS, Simulated, Station
import numpy as np

DOWN = se3.transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.175]))
CLEAN = {'noise': 0.0, 'rim_bias': 0.0, 'mixed': 0.0, 'lost': 0.0, 'lost_at_edge': 0.0,
         'outliers': 0.0}


def scenario(name: str, columns: int = 320, rate: float = 6.0, **sensor: float) -> Scenario:
    """Return a scenario in a size that is quick to render."""
    found = SCENARIOS[name]
    return replace(found, sensor=replace(found.sensor, columns=columns, rate=rate, **sensor),
                   robot=replace(found.robot, rate=20.0))


def seen_at(recording: Simulated, station: Station) -> list[Profile]:
    delay = int(recording.scenario.sensor.delay * 1e9)
    return [p for p in recording.profiles if station.start <= p.stamp - delay < station.end]
