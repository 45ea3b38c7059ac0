# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Calibrations for tests, and the comparison of two."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

from handeye_ros import config, se3
from handeye_ros.data import Array, Calibration, Quality, SampleReport
from handeye_ros.results.calibration_file import text
import numpy as np

ROUNDING = 1e-12  # of a rotation that goes through a quaternion and back
ROOT = np.random.default_rng(5).normal(size=(6, 6)) * 1e-4

CALIBRATION = Calibration(
    name='plate', method='plate', parent_frame='flange', child_frame='laser',
    T_flange_sensor=se3.transform(se3.exp_rotation(np.array([0.3, -1.2, 2.0])),
                                  np.array([0.0123, -0.05, 0.1])),
    covariance=ROOT @ ROOT.T,
    target={'pose': se3.transform_values(np.eye(4)), 'edge_angle': 1.5708, 'edge_angle_std': 1e-4,
            'radius': 0.04, 'radius_std': 0.0, 'note': 'x'},
    quality=Quality(2, 1, 2.1e-5, 2.6e-5, 'position along z of flange (m)', 4e-5),
    samples=(SampleReport(1700000000500000001, True, 'p', 1.9e-5),
             SampleReport(1700000002500000001, True, 'p, q', 2.0e-5),
             SampleReport(1700000004500000001, False, reason='no edge in sight')),
    provenance={'version': '0.1.0', 'created': '2026-01-01T00:00:00+00:00',
                'inputs': [{'path': 'bags/plate/plate.mcap', 'sha256': 64 * '0'}],
                'config': config.flatten(config.Config())})


def calibration_at(T: Array, **changes: Any) -> Calibration:
    """Return a calibration of laser on flange of which only the transform is known, exactly."""
    unknown = {'target': {}, 'samples': (), 'provenance': {'config': {}}}
    return replace(CALIBRATION, T_flange_sensor=T,
                   **{'covariance': np.zeros((6, 6)), **unknown, **changes})


def equal(a: Calibration, b: Calibration) -> bool:
    """Return whether two calibrations are equal, except for the rounding of a quaternion."""
    return np.allclose(a.T_flange_sensor, b.T_flange_sensor, rtol=0, atol=ROUNDING) and (
        text(replace(a, T_flange_sensor=np.eye(4))) == text(replace(b, T_flange_sensor=np.eye(4))))
