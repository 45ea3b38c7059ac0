# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The bench of the guidance: it counts as it says, and what it follows is good advice."""
from __future__ import annotations

import importlib.util
from pathlib import Path
import sys

from handeye_ros import targets
from handeye_ros.guidance.view import mapped_points
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location('bench_guidance', ROOT / 'bench' / 'guidance.py')
bench = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = bench  # for its dataclasses
spec.loader.exec_module(bench)

ROBOT = bench.ROBOTS['common']


def test_luck_counts_only_for_the_first_time():
    error = [np.inf, 0.5, 0.05, 0.2, 0.05, 0.05]
    std = [np.inf, 0.5, 0.4, 0.3, 0.2, 0.15]
    assert bench.readings(np.column_stack([error, std]), 0.1) == [3, 5, 6, 6]


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere'])
def test_moves_tell_more_than_poses_at_random(target):
    def sigma(seed, operator):
        """Return how well points in view are known after the stations an answer needs + 1."""
        cell = bench.world(target, ROBOT, seed, bench.KNOWN)
        for _ in range(targets.target_for(cell.config).minimum):
            bench.insist(cell, bench.advised(cell, None) if operator == 'advice'
                         else lambda: bench.anywhere(cell))
        solution = bench.solved(cell)
        return mapped_points(solution.estimate.X, cell.view).std(solution.reported[:6, :6])

    found = np.array([[sigma(seed, operator) for operator in bench.OPERATORS]
                      for seed in range(3)])
    moves, random = np.median(found, axis=0)
    assert moves < 0.7 * random


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere', 'wedge'])
def test_a_node_takes_a_sample_at_every_pose_that_is_proposed(target):
    assert not bench.followed(bench.world(target, ROBOT, 0, {}), 0.0, 16).why
