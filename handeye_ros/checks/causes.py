# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What explains samples that do not fit, in the order in which it is asked.

The sign of the range, a known error in the convention of the poses, the scale of the robot or a
sensor or target that moved, whichever explains more; and, where none of these is certain,
another setting, stops that show another surface, or the clocks. The first that explains the same
stops decisively better is named (hypotheses).
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.conventions import orientations_scatter, require_convention
from handeye_ros.checks.hypotheses import Explanation, refuse_better
from handeye_ros.checks.measures import scale_hypotheses
from handeye_ros.checks.moved import move_hypotheses
from handeye_ros.checks.refusals import (
    contradiction,
    missing_motion,
    require_certain,
    rms_turns_and_axes,
    UnexplainedError,
)
from handeye_ros.checks.settings import require_settings, require_sign
from handeye_ros.checks.surfaces import require_one_surface
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.session import Session

SIGN_TRIED = 0.6  # variance factor, blocks as noise, above which the other range sign is tried
FEW_TURNS = 0.12  # rad RMS about the second axis: less may look like a move
MISFIT_FACTOR = 9.0  # variance factor (3 sigma) above which other causes than noise are tested


def require_agreement(samples: Sequence[Sample], problem: Problem, solution: Solution) -> None:
    """
    Raise DataError for a solution that the samples contradict, or explain better otherwise.

    samples: in the order of the stations of the problem. The first of these is raised; sign and
    conventions, and of stops the scale, also where the samples do not contradict the solution:

    1. the other sign of the range;
    2. another convention of the poses, or orientations without any order;
    3. too little rotation, which can look like a move;
    4. an error of the scale of the robot, or a move, whichever explains more;
    5. the contradiction itself.
    """
    stated, refusal = Explanation.of_solutions(solution), contradiction(solution)
    if refusal or solution.variance_factor > SIGN_TRIED or (
            solution.fully_used < len(problem.poses)):
        require_sign(samples, problem.config, stated, clocks=refusal is not None)
    if refusal or solution.variance_factor >= MISFIT_FACTOR:
        require_convention(samples, problem, stated)
    if refusal:
        _require_ordered_orientations(problem, solution)
        if rms_turns_and_axes(problem.poses)[0][1] < FEW_TURNS:
            require_certain(solution.transform_covariance, problem.config,
                            missing_motion(solution, problem.config))
    moves = move_hypotheses(problem) if refusal else []
    if refusal or not problem.config.sampling.moving:  # a sweep that fits: both are weighed later
        refuse_better(stated, [*scale_hypotheses(solution), *moves])
    if refusal:
        raise refusal


def _require_ordered_orientations(problem: Problem, solution: Solution) -> None:
    """Raise DataError (convention) for poses that are turned in all directions."""
    if orientations_scatter(problem.poses):
        raise DataError(f'samples and poses contradict each other by {mm(solution.residual_rms)} '
                        'RMS, and the orientations of the poses are scattered in all directions, '
                        'as when angles in degrees are read as radians: convert the angles of the '
                        'poses', reason='convention')


def with_known_cause(refusal: DataError, session: Session, config: Config) -> DataError:
    """
    Return a refusal, or the one of the setting, surface or clocks that explain the stops better.

    A refusal whose cause is certain stays. An uncertain answer may come from clocks that differ,
    and what looks like a move from another target, shown part by part, or from another surface.
    Only stops are asked: a pass has many profiles with their own poses, and estimates its clocks.
    """
    if config.sampling.moving:
        return refusal
    unexplained = isinstance(refusal, UnexplainedError)
    try:
        if unexplained or refusal.reason == 'moved':
            require_settings(session, config)
            require_one_surface(session, config, refusal)
        if unexplained or refusal.reason == 'uncertain':
            require_same_clock(session, config)
    except DataError as named:
        return named
    return refusal
