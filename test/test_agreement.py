# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The evidence of a calibration: from a recording, and from a session in any order."""
from __future__ import annotations

from dataclasses import replace

from cells import cell, solved
from handeye_ros import se3
from handeye_ros.agreement import flat_crossing
from handeye_ros.config import with_values
from handeye_ros.estimation.solve import evaluated
import numpy as np
import pytest


@pytest.mark.parametrize('turned', [0.0, 0.7, 1.6])
def test_the_crossing_angle_does_not_depend_on_the_axes_across_a_line(turned: float) -> None:
    found = cell('line', 1)
    solution = solved(found.problem)
    T = solution.estimate.state.reshape(4, 4)
    about_line = se3.transform(se3.exp_rotation(np.array([turned, 0.0, 0.0])), np.zeros(3))
    elsewhere = evaluated(solution.problem, replace(
        solution.estimate, state=(T @ about_line).reshape(-1)))
    config = with_values(found.config, {'sampling.min_crossing_angle': 1.5}, 'test')
    for sample in found.samples[:5]:  # whose laser lines are not square to it
        laser = sample.T_base_flange[:3, :3] @ solution.estimate.X[:3, 0]
        angle = np.degrees(np.arccos(abs(laser @ T[:3, 0])))
        assert f'crosses edge at {angle:.0f} degrees' in flat_crossing(sample, elsewhere, config)
