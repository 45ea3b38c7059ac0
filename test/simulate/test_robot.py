# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The errors of the robot's poses are as stated."""
from __future__ import annotations

import math

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate import SCENARIOS, simulate_samples
import numpy as np
import pytest


def pose_errors(name: str, seed: int) -> Array:
    _, truth = simulate_samples(SCENARIOS[name], np.random.default_rng(seed))
    return np.array([se3.difference(s.T_base_flange_reported, s.T_base_flange)
                     for s in truth.stops])


@pytest.mark.thorough
def test_the_robot_errs_as_stated() -> None:
    errors = np.concatenate([pose_errors('plate', seed) for seed in range(60)])
    sigma = np.repeat(SCENARIOS['plate'].robot.repeatability, 3)
    assert np.allclose(errors.std(axis=0) / sigma, 1, atol=0.1)
    assert np.allclose(errors.mean(axis=0) / sigma, 0, atol=0.15)
    recordings = [pose_errors('plate_real_robot', seed) for seed in range(100)]
    errors = np.concatenate(recordings).reshape(-1, 2, 3)
    rms = np.sqrt((errors**2).sum(axis=2).mean(axis=0))
    assert rms == pytest.approx([1.5e-4, math.radians(0.02)], rel=0.15)
    # each direction of the error is shared by the stops of a recording, in part
    shared = [np.linalg.norm(recording_errors.mean(axis=0)[:3]) for recording_errors in recordings]
    assert np.mean(shared) > 4e-5
    assert (np.linalg.norm(pose_errors('bumped', 12)[:, :3], axis=1) > 1e-3).sum() == 1
