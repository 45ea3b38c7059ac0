"""
Whether another answer, well apart from the one that was found, explains the samples as well.

It does unless the evidence against it is very strong (see alternatives).
"""
from __future__ import annotations

from collections.abc import Iterator

from handeye_ros import se3
from handeye_ros.checks.alternatives import evidence, VERY_STRONG
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.consensus import Consensus, subset_starts, without_outliers
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.outliers import chi2_isf
from handeye_ros.estimation.search import guesses, refined
from handeye_ros.estimation.solution import redundancy, Solution
import numpy as np

ENOUGH = 15  # redundant conditions beyond which the first guess is the only answer
LOST_SHARE = 0.1  # of the stations dropped from which the others might be the right ones
SUBSETS = 10
HOPELESS = 16.0  # squared residual, over that of the found answer, of no other answer
ENOUGH_IN_VAIN = 8  # hopeless starts, best first, one after the other: so are those after them
APART = 1e-6  # chance of one answer lying so far from another within its uncertainty
SMALLEST_DISTANCE = 1e-4  # m or rad between answers worth parting


def alternative_minimum(problem: Problem, agreed: Consensus, rng: np.random.Generator
                        ) -> Solution | None:
    """Return another answer that explains the samples as well, None where there is none."""
    found, in_vain = agreed.solution, 0
    for start in _starts(problem, agreed, rng):
        trial, in_vain = refined(problem, start), in_vain + 1
        if in_vain > ENOUGH_IN_VAIN:
            break
        if trial.misfit > HOPELESS * max(1.0, found.variance_factor):
            continue
        other, in_vain = without_outliers(trial), 0
        if _apart(found, other.solution) and evidence((other,), (agreed,)) > -VERY_STRONG:
            return other.solution
    return None


def _starts(problem: Problem, agreed: Consensus, rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield starts that may lead elsewhere; few where many conditions agree."""
    lost = len(agreed.dropped) > LOST_SHARE * len(problem.poses)
    try:
        if lost or redundancy(agreed.solution) < ENOUGH:
            yield from guesses(problem, rng)
        if lost:
            yield from subset_starts(problem, SUBSETS, rng)
    except HandeyeError:
        return


def _apart(found: Solution, other: Solution) -> bool:
    """Return whether two answers are further apart than their uncertainty explains."""
    delta = se3.difference(other.estimate.X, found.estimate.X)
    factor = max(1.0, found.variance_factor)
    covariance = (found.reported[:6, :6] + other.reported[:6, :6]) * factor
    return bool(np.abs(delta).max() > SMALLEST_DISTANCE
                and delta @ np.linalg.solve(covariance, delta) > chi2_isf(APART, 6))
