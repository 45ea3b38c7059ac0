# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A light plane that is bent: the truth stays inside what is stated, and the bend is told."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.simulate import FAULTS, settings, simulate
import numpy as np
import pytest
from scipy.stats import chi2

MM = 1e-3


@pytest.mark.parametrize('bend', [0.0, 0.15 * MM, 0.6 * MM])
@pytest.mark.parametrize('target', ['plate', 'wedge'])
def test_the_truth_lies_inside_and_a_bend_is_told(target: str, bend: float) -> None:
    scenario = FAULTS[f'{target}, line bent by 0.15 mm']
    scenario = replace(scenario, sensor=replace(scenario.sensor, line_bend=bend))
    recording = simulate(scenario, np.random.default_rng(3))
    config = with_values(Config(), settings(scenario), scenario.name)
    answer = pipeline.calibrate(recording.profiles, recording.poses, config)
    error = se3.difference(recording.truth.T_flange_sensor, answer.T_flange_sensor)
    assert error @ np.linalg.solve(answer.covariance, error) < chi2.ppf(0.999, 6)
    assert ('the laser line is bent' in answer.target.get('note', '')) == (bend > 0)
