# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each cause contributes to the reported covariance of the transform."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array, BudgetTerm
from handeye_ros.estimation.basis import grid_over
from handeye_ros.estimation.blocks import blocks_with_columns
from handeye_ros.estimation.noise import covariance_parts, POSE_INDEX
from handeye_ros.estimation.posterior import Posterior
from handeye_ros.estimation.solution import Solution
import numpy as np


def budget(solution: Solution, levers: Array | None = None) -> list[BudgetTerm]:
    """
    Return what each cause contributes to the reported covariance of the transform, and the total.

    White noise of sensor and poses, and each block by its name, are the exact parts of C in (5) at
    the taus for the report: whitened noise of covariance V gives (C A')V(C A')', and the
    parameters of a block, with the prior information 1/tau^2, give C_xn C_nx / tau^2. Then what
    (8), (10), a corrected arm and a possible move add to it. `best-fit transform` is the
    remainder, what (9) changes. A part without a positive variance of mapped points is left out.

    levers: (k, 3) from the sensor's origin to the mapped points, in the mount (m); None: those of
    nine over the points that were seen.
    """
    if levers is None:
        points = grid_over(solution.problem.observations.points, (-1, 0, 1))
        levers = points @ solution.estimate.X[:3, [0, 2]].T
    reported = solution.report_posterior
    parts = _parts_of_noise(reported)
    for block, columns in blocks_with_columns(reported.blocks, reported.unknown_count):
        C_xn = reported.covariance[:6, columns]
        parts[block.name] = C_xn * reported.prior_information[columns] @ C_xn.T
    shift = np.outer(solution.shift_for_report, solution.shift_for_report)
    parts |= {'prior widths': shift, **solution.added_covariances}
    parts['best-fit transform'] = (
        solution.transform_covariance - reported.covariance[:6, :6] - shift
        - sum(solution.added_covariances.values()))
    terms = [_term(name, part, levers) for name, part in parts.items()]
    return [*sorted((term for term in terms if term.mapped > 0), key=lambda term: -term.mapped),
            _term('all', solution.transform_covariance, levers)]


def _parts_of_noise(reported: Posterior) -> dict[str, Array]:
    """Return the parts (6, 6) of C that come from the white errors of sensor and poses, (3)."""
    parts = {'sensor, white': np.zeros((6, 6)), 'poses, white': np.zeros((6, 6))}
    groups = reported.problem.observations.station_groups
    for group, root in zip(groups, reported.whitening.roots, strict=True):
        V = covariance_parts(reported.linear, group)
        V = V * reported.noise.variance_factors[:len(V), None, None, None]
        A = reported.jacobian[group.rows]
        gain = (A @ reported.covariance[:, :6]).swapaxes(1, 2) @ root  # of residuals in m
        for name, V_parts in zip(parts, np.split(V, [POSE_INDEX]), strict=True):
            parts[name] += (gain @ V_parts.sum(axis=0) @ gain.swapaxes(1, 2)).sum(axis=0)
    return parts


def _term(name: str, part: Array, levers: Array) -> BudgetTerm:
    """Return the sigmas of a part (6, 6) of the covariance."""
    mapped = np.trace(se3.mapped_covariance(levers, part))
    squares = (np.trace(part[:3, :3]) / 3, np.trace(part[3:, 3:]) / 3, mapped)
    return BudgetTerm(name, *(float(max(square, 0.0) ** 0.5) for square in squares))
