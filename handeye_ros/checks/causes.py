# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The order in which causes are tried for samples that do not fit: each function, from top to bottom.

`require_agreement` asks about the samples as they are; `with_known_cause`, where no cause was
certain, reads the messages of the stops anew. Of the hypotheses that are tried together the one
that explains the same stops best is named, if it does so decisively better than what is configured
(hypotheses.py).
"""
from __future__ import annotations

from collections.abc import Sequence
import math

from handeye_ros.checks.clocks import require_same_clock
from handeye_ros.checks.conventions import convention_hypotheses, orientations_scatter
from handeye_ros.checks.hypotheses import (
    Explanation,
    Hypothesis,
    MANY_TRIED,
    refuse_by_best,
)
from handeye_ros.checks.moved import move_hypotheses
from handeye_ros.checks.refusals import (
    misfit_refusal,
    missing_motion,
    require_certain,
    rms_turns_and_axes,
    SMALL_SECOND_TURN,
    UnexplainedError,
)
from handeye_ros.checks.settings import setting_hypotheses, sign_hypothesis
from handeye_ros.checks.stated_lengths import scale_hypotheses
from handeye_ros.checks.surfaces import require_one_surface
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.solution import Solution
from handeye_ros.sampling.session import Session
from handeye_ros.words import mm

# reduced chi-squared, blocks as noise: above the first the other range sign is tried, above the
# second (3 sigma) other conventions, though the samples do not contradict the solution
SIGN_TRIAL_CHI2, CONVENTION_TRIAL_CHI2 = 0.6, 9.0


def require_agreement(samples: Sequence[Sample], solution: Solution, baseline: Explanation
                      ) -> None:
    """
    Raise DataError for a solution that the samples contradict, or another assumption explains.

    samples: of the stations of the problem, in order; baseline: the explanation by the solution.
    """
    problem, refusal = solution.full_problem, misfit_refusal(solution)
    config, poses = problem.config, problem.poses
    doubt = math.inf if refusal else solution.posterior.reduced_chi_squared
    # the opposite sign of the range, and known errors in the conventions of the poses
    hypotheses = list[Hypothesis]()
    if doubt > SIGN_TRIAL_CHI2 or solution.fully_used_count < len(poses):
        hypotheses.append(sign_hypothesis(samples, config, baseline, clocks=refusal is not None))
    if doubt >= CONVENTION_TRIAL_CHI2:
        hypotheses += convention_hypotheses(samples, problem, baseline)
    tried = MANY_TRIED if doubt >= CONVENTION_TRIAL_CHI2 else 1
    refuse_by_best(baseline, hypotheses, tried)
    # orientations or a lack of rotation that would look like a move
    if refusal and orientations_scatter(poses):
        rms = mm(solution.posterior.residual_rms)
        raise DataError(f'samples and poses contradict each other by {rms} RMS, and the '
                        'orientations of the poses are scattered in all directions, as when '
                        'angles in degrees are read as radians: convert the angles of the poses',
                        code='convention')
    if refusal and rms_turns_and_axes(poses)[0][1] < SMALL_SECOND_TURN:
        require_certain(solution.transform_covariance, config, missing_motion(solution, config))
    # the scale of the robot, and a sensor or target that moved
    if refusal:
        refuse_by_best(baseline, [*scale_hypotheses(solution, baseline.stamps),
                                  *move_hypotheses(problem, baseline.stamps)], tried)
        raise refusal
    if not config.sampling.moving:  # of a sweep that fits both are weighed later
        refuse_by_best(baseline, scale_hypotheses(solution, baseline.stamps), tried)


def with_known_cause(refusal: DataError, baseline: Explanation, session: Session, config: Config
                     ) -> DataError:
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
        if unexplained or refusal.code == 'moved':
            refuse_by_best(baseline, setting_hypotheses(session, config, baseline))
            require_one_surface(session, config, refusal)
        if unexplained or refusal.code == 'uncertain':
            require_same_clock(session, config)
    except DataError as named:
        return named
    except InputError:  # the file of a stored stop is gone, and with it what would tell the cause
        pass
    return refusal
