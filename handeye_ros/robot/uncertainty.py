# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the uncertainty of a corrected arm does to a hand-eye transform that is found with it."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from handeye_ros.errors import InputError
from handeye_ros.estimation.noise import whitening
from handeye_ros.estimation.solve import Solution
from handeye_ros.robot.urdf import read_arm
import numpy as np


def with_arm_errors(solution: Solution, kinematics: Path) -> Solution:
    """
    Return a solution whose reported covariance includes that of the parameters of the arm.

    kinematics: the file of the arm that gave the poses. The covariance of X given the arm, plus
    G C G^T with G the change of X by the parameters, is that of X and the arm together, whether
    or not the arm was found from the same samples. Raises InputError for a file without C.
    """
    arm = read_arm(kinematics)
    if arm.covariance is None or arm.configurations is None:
        raise InputError(f'{kinematics} does not state how certain the arm is, so that the '
                         'certainty of the transform is unknown: write it again, with "handeye '
                         'kinematics"')
    _, twists = arm.with_twists(arm.joints_near(solution.problem.robot_poses))
    by_arm = whitening(solution.linear, solution.noise)(solution.linear.by_twists(twists))
    G = solution.covariance[:6] @ solution.columns.T @ by_arm
    before = np.zeros((6, 6)) if solution.contamination is None else solution.contamination
    return replace(solution, contamination=before + G @ arm.covariance @ G.T)
