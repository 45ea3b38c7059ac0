# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The part of the reported covariance for the errors of a corrected arm, which gave the poses."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.arm import Arm
from handeye_ros.estimation.solution import Solution

CORRECTED_ARM = 'corrected arm'  # its part in a budget


def with_arm_errors(solution: Solution, arm: Arm) -> Solution:
    """
    Return a solution whose reported covariance includes that of the errors of the arm.

    arm: the corrected one that gave the poses. The covariance of X given the arm, plus G C G^T
    with G the change of X by the errors and C their covariance, is that of X and the arm together,
    whether or not the arm was found from the same samples.
    """
    posterior = solution.posterior
    twists = arm.error_jacobian(arm.inverse(solution.problem.robot_poses))[..., arm.is_estimated]
    wrt_arm = posterior.whitening(posterior.linear.wrt_twists(twists))
    G = posterior.covariance[:6] @ posterior.jacobian.T @ wrt_arm
    return replace(solution, added_covariances={
        **solution.added_covariances, CORRECTED_ARM: G @ arm.covariance @ G.T})
