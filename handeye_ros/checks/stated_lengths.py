# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whether stated measures are wrong: those of the target, and the scales of robot and sensor."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from handeye_ros.calibration import block_estimates, NOTED_SIGMAS
from handeye_ros.checks.hypotheses import Explanation, explanation_of_problem, Hypothesis
from handeye_ros.checks.moved import with_possible_move
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import scale_twists
from handeye_ros.estimation.least_squares import covariance_of
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import (
    CONVINCING_SQUARE,
    robust_solution,
    with_systematic_errors,
)
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_poses
import numpy as np

VERY_STRONG_EVIDENCE = 10.0  # twice the log of a Bayes factor (Kass and Raftery)
FREED_FROM_SIGMAS = 2.5  # an estimated length is used; it costs little where the stated is right
SMALLEST_SCALE_ERROR, LARGEST_SCALE_ERROR = 2e-3, 5e-2  # named; more is another unit


def with_free_shape_if_needed(problem: Problem, agreed: Solution, rng: np.random.Generator,
                              start: Estimate | None = None) -> Solution:
    """
    Return the consensus, with free target measures if only these make the stations agree.

    start: the only one to use, if given.
    """
    target, stated_config = problem.target, problem.config
    config = replace(stated_config, target=replace(stated_config.target, **target.free_shape))
    poor = (agreed.dropped_squares or len(agreed.stations_without_edges)
            or agreed.variance_factor > CONVINCING_SQUARE)
    if config == stated_config or not poor:
        return agreed
    other = robust_solution(replace(problem, config=config), rng, start=start)
    stated, _ = target.stated_values(stated_config)[target.parameter_names[-1]]
    if abs(other.estimate.state[-1] - stated) > 0.5 * stated:
        return agreed  # another target
    # if a free shape explains more stations, the refinement can decide about the shape
    free, as_stated = (Explanation.of_solutions(range(len(problem.poses)), one)
                       for one in (other, agreed))
    complete = free.believable and other.fully_used - agreed.fully_used > 0.1 * len(problem.poses)
    return other if complete or free.evidence_over(as_stated) > VERY_STRONG_EVIDENCE else agreed


def with_free_size_if_needed(agreed: Solution) -> Solution:
    """
    Return the refined consensus with the target's lengths estimated, if the stated are wrong.

    Otherwise the scale of the robot, which is stated less exactly, stands for a wrong length: they
    are estimated too where such a scale is seen with the stated lengths alone.
    """
    config, problem = agreed.full_problem.config, agreed.problem
    free = replace(config, target=replace(config.target, **problem.target.loose_lengths))
    stated, loose = (problem.target.stated_values(settings) for settings in (config, free))
    lengths = [name for name, (_, std) in loose.items() if std > stated[name][1]]
    if not lengths:
        return agreed
    # solved anew from the observations and the estimate; what is linearised here is not used
    other = with_systematic_errors(replace(
        agreed, full_problem=replace(agreed.full_problem, config=free),
        linear=replace(agreed.linear, problem=replace(problem, config=free))))
    freed, before = (block_estimates(one.conservative) for one in (other, agreed))
    wrong = any(
        abs(freed[name].value) > max(FREED_FROM_SIGMAS * freed[name].std, 2 * stated[name][1])
        for name in lengths if name in freed)
    scales = [each['scale'] for each in (before, freed) if 'scale' in each]
    seen = [abs(one.value) > FREED_FROM_SIGMAS * one.std for one in scales]
    return other if wrong or seen == [True, False] else agreed


def scale_hypothesis(agreed: Solution, stamps: Sequence[int]) -> Iterator[Hypothesis]:
    """
    Yield the hypothesis that robot and sensor differ in scale, if they may.

    The scale is solved for to first order, with the stated measures of the target, so that a wrong
    measure is not taken for a scale. stamps: of the stations.
    """
    problem, linear = agreed.full_problem, agreed.linear
    measures = linear.jacobian[:, 6:][:, problem.tolerances > 0]
    by_scale = -linear.wrt_twists(scale_twists(agreed.problem))
    J = np.hstack([agreed.whitening(np.hstack([by_scale, measures])), agreed.jacobian])
    covariance = covariance_of(J)
    scale = float(covariance[0] @ (J.T @ agreed.postfit_residuals))
    if SMALLEST_SCALE_ERROR < abs(scale) < LARGEST_SCALE_ERROR:
        T = problem.robot_poses.copy()
        T[:, :3, 3] /= 1 + scale
        fit = explanation_of_problem(
            replace(problem, poses=mount_poses(T, problem.config)), stamps)
        std = float(covariance[0, 0] * fit.variance_factor) ** 0.5
        yield Hypothesis(fit, _scales_differ(abs(scale), std))


def require_one_scale(agreed: Solution) -> None:
    """
    Raise for a solution in which robot and sensor differ too much in scale.

    Raises DataError: scale, or moved where the evidence for a move is decisive.
    """
    scale = block_estimates(agreed.conservative).get('scale')
    if scale and abs(scale.contradiction) > NOTED_SIGMAS and abs(scale.value) > max(
            SMALLEST_SCALE_ERROR, NOTED_SIGMAS * scale.std):
        with_possible_move(agreed)  # raises where something surely moved
        raise _scales_differ(abs(scale.value), scale.std)


def _scales_differ(scale: float, std: float) -> DataError:
    return DataError(
        f'the lengths of robot and sensor differ by {100 * scale:.2f} +- {100 * std:.2f} %: one '
        'of them has a wrong scale; measure a known length with each, and correct the unit or '
        'the calibration of the wrong one', reason='scale')
