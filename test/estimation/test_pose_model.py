# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the poses depend on is found with the transform: blocks with priors that move them."""
from __future__ import annotations

from cells import cell, solved
from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.problem import PoseModel, Problem
from handeye_ros.estimation.solve import map_solution
import numpy as np
import pytest

TRUE = np.array([3e-4, -2e-4])  # by so much (rad), times what differs from pose to pose, it turns


def reported(true: Array) -> PoseModel:
    """Return a robot that turns about its base by joints; it has the true poses at TRUE."""
    angles = 3.0 * np.arange(len(true))
    about = [np.outer(np.cos(angles), [1, 0, 0]), np.outer(np.sin(angles), [0, 0, 1])]

    def evaluate(values: Array) -> tuple[Array, Array]:
        x, z = TRUE - values
        R = se3.exp_rotation(about[0] * x + about[1] * z)
        poses = se3.transform(R @ true[:, :3, :3], (R @ true[:, :3, 3, None])[..., 0])
        return poses, -np.stack([np.concatenate([np.cross(turn, poses[:, :3, 3]), turn], axis=1)
                                 for turn in about], axis=2)
    return PoseModel(evaluate, ('first', 'second'), (1, 1), (1e-3, 1e-3))


@pytest.mark.parametrize('scenario', ['plate', 'eye_on_base', 'sphere'])
def test_what_poses_depend_on_is_found_and_the_poses_are_moved(scenario: str) -> None:
    made = cell(scenario, 1)
    first = solved(made.problem)
    true, start = first.problem, first.estimate  # each edge point of its edge
    model = reported(true.robot_poses)
    wrong = model.at(np.zeros(2))[0]
    problem = Problem(true.target, wrong if true.in_hand else se3.inverse(wrong),
                      true.observations, true.config, model)
    found = map_solution(problem, start)
    off = found.problem.pose_values - TRUE
    assert [b.name for b in found.blocks[-2:]] == ['first', 'second']
    std = 1e-3 * np.sqrt(np.diag(found.covariance)[-2:])
    assert (np.abs(off) < 4 * std).all() and std.max() < 2e-4
    now, _ = model.at(found.problem.pose_values)
    assert np.allclose(found.problem.robot_poses, now)
    assert np.allclose(found.corrected_poses(), found.problem.poses)
    assert made.error(found.estimate.X) < made.error(map_solution(true, start).estimate.X) + 1e-5
    half = problem.with_pose_values(TRUE).subset(np.arange(0, len(wrong), 2))
    assert np.allclose(half.poses, true.poses[::2])
    assert np.allclose(half.with_pose_values(np.zeros(2)).poses, problem.poses[::2])
