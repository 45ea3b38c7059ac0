# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compares calibrations."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Calibration
from handeye_ros.results.calibration_file import text
import numpy as np

ROUNDING = 1e-12  # of a rotation that goes through a quaternion and back


def equal(a: Calibration, b: Calibration) -> bool:
    """Return whether two calibrations are equal, except for the rounding of a quaternion."""
    return np.allclose(a.T_flange_sensor, b.T_flange_sensor, rtol=0, atol=ROUNDING) and (
        text(replace(a, T_flange_sensor=np.eye(4))) == text(replace(b, T_flange_sensor=np.eye(4))))
