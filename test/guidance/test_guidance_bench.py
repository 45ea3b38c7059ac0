# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The bench of the guidance: it counts as it says, and the moves it follows are good ones."""
from __future__ import annotations

import importlib.util
from pathlib import Path
import sys

from handeye_ros import se3, targets
from handeye_ros.guidance import rules
from handeye_ros.guidance.score import mapping
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


def sigma(target, seed, operator):
    """Return how well points in view are known after as many stations as an answer needs + 1."""
    cell = bench.world(target, ROBOT, seed, bench.KNOWN)
    for _ in range(targets.method_for(cell.config).minimum):
        bench.insist(cell, bench.advised(cell, None) if operator == 'advice'
                     else lambda: bench.anywhere(cell))
    solution = bench.solved(cell)
    return mapping(solution.estimate.X, cell.view).std(solution.reported[:6, :6])


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere'])
def test_moves_tell_more_than_poses_at_random(target):
    found = np.array([[sigma(target, seed, operator) for operator in bench.OPERATORS]
                      for seed in range(3)])
    moves, random = np.median(found, axis=0)
    assert moves < 0.7 * random


def test_a_ball_is_cut_where_it_is_said():
    cell = bench.world('sphere', ROBOT, 0, bench.KNOWN)
    R = cell.facing(0) @ bench.turned(cell.rng, 10.0)
    place = np.array([0.01, 0.2])
    T = cell.looking(R, cell.beside(R, -0.6, 0.0), place)
    middle = se3.inverse(se3.inverse(cell.T_base_target) @ T @ cell.T_flange_sensor)[:3, 3]
    radius = cell.scenario.target.radius
    np.testing.assert_allclose(middle, [0.01, -0.6 * radius, 0.2 + 0.8 * radius], atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere', 'wedge'])
def test_a_node_takes_a_sample_at_every_pose_that_is_proposed(target):
    assert not bench.followed(bench.world(target, ROBOT, 0, {}), 0.0, 16).why


def test_a_pose_at_which_nothing_was_taken_is_not_proposed_again():
    cell = bench.world('line', ROBOT, 0, {})
    bench.followed(cell, 0.0, 10)
    solution = bench.solved(cell)
    first = bench.advise(cell.samples, cell.config, solution, seen=cell.seen).next
    other = bench.advise(cell.samples, cell.config, solution, seen=cell.seen,
                         refused=[first.T_base_flange]).next
    T = se3.inverse(first.T_base_flange) @ other.T_base_flange
    distance, angle = np.linalg.norm(T[:3, 3]), np.linalg.norm(se3.log_rotation(T[:3, :3]))
    assert distance > rules.REFUSED[0] or angle > rules.REFUSED[1]
