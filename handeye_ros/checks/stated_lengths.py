# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether stated lengths are wrong: those of the target, and the scales of robot and sensor.

A stated measure of the target that is wrong is estimated instead; scales that differ are refused.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from handeye_ros.calibration import block_estimates, BlockEstimate, SURE_SIGMAS
from handeye_ros.checks.hypotheses import explain_problem, Explanation, Hypothesis
from handeye_ros.checks.moved import possible_move, require_no_sure_move
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import ROBOT_SCALE, scale_twists
from handeye_ros.estimation.least_squares import covariance_from_jacobian
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import (
    CONVINCING_SQUARE,
    refined_solution,
    robust_solution,
)
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_poses
import numpy as np

VERY_STRONG_EVIDENCE = 10.0  # twice the log of a Bayes factor (Kass and Raftery)
LOOSE_FROM_SIGMAS = 2.5  # an estimated length is used: it costs little where the stated is right
MIN_SCALE_ERROR, MAX_SCALE_ERROR = 2e-3, 5e-2  # named; more is another unit


def with_unstated_measure_if_needed(solution: Solution, problem: Problem,
                                    rng: np.random.Generator,
                                    start: Estimate | None = None) -> Solution:
    """
    Return the solution with a stated measure free, if only that makes the stations agree.

    solution: of the problem, with the measure as stated; it is returned where that is good enough.
    start: the only one to use, if given.
    """
    target, config = problem.target, problem.config
    free_config = replace(config, target=replace(config.target, **target.unstated_measure))
    fits = not (solution.dropped_squares or len(solution.stations_with_unused_edges)
                or solution.posterior.reduced_chi_squared > CONVINCING_SQUARE)
    if fits or free_config == config:
        return solution
    free = robust_solution(replace(problem, config=free_config), rng, start=start)
    measure = target.parameter_names[-1]
    stated, _ = target.stated_values(config)[measure]
    if abs(target.measures(free.estimate.state)[measure] - stated) > 0.5 * stated:
        return solution  # another target
    n = len(problem.poses)
    with_free, as_stated = (Explanation.of_solutions(range(n), each) for each in (free, solution))
    # if a free measure explains more stations, the refinement can decide about it
    more = free.fully_used_count - solution.fully_used_count
    explains_more = with_free.believable and more > 0.1 * n
    better = explains_more or with_free.evidence_over(as_stated) > VERY_STRONG_EVIDENCE
    return free if better else solution


def with_loosened_lengths_if_needed(solution: Solution) -> Solution:
    """
    Return the refined solution with the target's lengths estimated, if the stated are wrong.

    Otherwise the scale of the robot, which is stated less exactly, stands for a wrong length: they
    are estimated too where such a scale is seen with the stated lengths alone.
    """
    target, config = solution.problem.target, solution.full_problem.config
    loose_config = replace(config, target=replace(config.target, **target.loosened_lengths))
    stated, loose = map(target.stated_values, (config, loose_config))
    lengths = [name for name, (_, std) in loose.items() if std > stated[name][1]]
    if not lengths:
        return solution
    loosened = refined_solution(solution, loose_config)
    of_stated, of_loose = (block_estimates(each.report_posterior) for each in (solution, loosened))
    wrong = any(abs(of_loose[name].value)
                > max(LOOSE_FROM_SIGMAS * of_loose[name].std, 2 * stated[name][1])
                for name in lengths if name in of_loose)
    scale_vanishes = _shows_scale(of_stated) and not _shows_scale(of_loose)
    return loosened if wrong or scale_vanishes else solution


def _shows_scale(estimates: Mapping[str, BlockEstimate]) -> bool:
    """Return whether a scale error of the robot is seen; estimates: by the names of blocks."""
    scale = estimates.get(ROBOT_SCALE)
    return scale is not None and abs(scale.value) > LOOSE_FROM_SIGMAS * scale.std


def scale_hypotheses(solution: Solution, stamps: Sequence[int]) -> Iterator[Hypothesis]:
    """
    Yield the hypothesis that robot and sensor differ in scale, if they surely do.

    The scale is solved for to first order, together with the stated measures of the target, so
    that a wrong measure is not taken for a scale. stamps: of the stations.
    """
    problem, posterior = solution.full_problem, solution.posterior
    stated = problem.target.stated_values(problem.config)
    is_stated = [name in stated and stated[name][1] > 0 for name in problem.target.parameter_names]
    wrt_measures = posterior.linear.jacobian[:, 6:][:, is_stated]
    wrt_scale = -posterior.linear.wrt_twists(scale_twists(posterior.problem))
    J = np.hstack([posterior.whitening(np.hstack([wrt_scale, wrt_measures])), posterior.jacobian])
    covariance = covariance_from_jacobian(J)
    scale = float(covariance[0] @ (J.T @ posterior.postfit_residuals))
    if MIN_SCALE_ERROR < abs(scale) < MAX_SCALE_ERROR:
        T = problem.robot_poses.copy()
        T[:, :3, 3] /= 1 + scale
        rescaled = explain_problem(replace(problem, poses=mount_poses(T, problem.config)), stamps)
        std = float(covariance[0, 0] * rescaled.reduced_chi_squared) ** 0.5
        if abs(scale) > SURE_SIGMAS * std:
            yield Hypothesis(rescaled, _scale_refusal(abs(scale), std))


def require_one_scale(solution: Solution) -> None:
    """
    Raise for a refined solution in which robot and sensor differ too much in scale.

    Raises DataError: scale, or moved where the evidence for a move is decisive.
    """
    scale = block_estimates(solution.report_posterior).get(ROBOT_SCALE)
    if scale and abs(scale.sigmas_off_stated) > SURE_SIGMAS and abs(scale.value) > max(
            MIN_SCALE_ERROR, SURE_SIGMAS * scale.std):
        require_no_sure_move(possible_move(solution))
        raise _scale_refusal(abs(scale.value), scale.std)


def _scale_refusal(scale: float, std: float) -> DataError:
    return DataError(
        f'the lengths of robot and sensor differ by {100 * scale:.2f} +- {100 * std:.2f} %: one '
        'of them has a wrong scale; measure a known length with each, and correct the unit or '
        'the calibration of the wrong one', code='scale')
