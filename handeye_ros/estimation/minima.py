"""
Whether another answer, well apart from the one that was found, explains the samples as well.

Each answer is scored by the squared residuals of all stations, each limited to what makes a
station, or an edge that it shows, count as wrong: the difference of two scores is judged like one
of chi-squared (Wilks 1938, Ann. Math. Statist. 9:60).
"""
from __future__ import annotations

from collections.abc import Iterator

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.consensus import Consensus, subset_starts, without_outliers
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.quantiles import chi2_isf
from handeye_ros.estimation.search import guesses, refined
from handeye_ros.estimation.solution import redundancy, Solution, station_squares
import numpy as np

ENOUGH = 15  # redundant conditions beyond which the first guess is the only answer
LOST_SHARE = 0.1  # of the stations dropped from which the others might be the right ones
SUBSETS = 10
HOPELESS = 16.0  # squared residual, over that of the found answer, of no rival
ENOUGH_IN_VAIN = 8  # hopeless starts, best first, one after the other: so are those after them
WRONG = 1e-4  # chance of a good station's squared residual being limited
APART = 1e-6  # chance of one answer lying so far from another within its uncertainty
AS_GOOD = 1e-3  # chance of the right one of two answers scoring so much worse
SMALLEST_DISTANCE = 1e-4  # m or rad between answers worth parting


def alternative_minimum(problem: Problem, agreed: Consensus, rng: np.random.Generator
                        ) -> Solution | None:
    """Return another answer that explains the samples as well, None where there is none."""
    found, limit, in_vain = agreed.solution, chi2_isf(AS_GOOD, 1), 0
    best = _score(problem, agreed, found)
    for start in _starts(problem, agreed, rng):
        trial, in_vain = refined(problem, start), in_vain + 1
        if in_vain > ENOUGH_IN_VAIN:
            break
        if trial.misfit > HOPELESS * max(1.0, found.variance_factor):
            continue
        other, in_vain = without_outliers(trial), 0
        if _apart(found, other.solution) and _score(problem, other, found) < best + limit:
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


def _score(problem: Problem, agreed: Consensus, scale: Solution) -> float:
    """Return the sum of the limited squared residuals, in variances of the found answer."""
    n = len(problem.poses)
    ranks = agreed.solution.ranks
    squares: Array = station_squares(agreed.solution) / max(1.0, scale.variance_factor)
    limits = chi2_isf(WRONG / n, np.maximum(ranks, 1))
    lost = (float(np.median(limits)) * len(agreed.dropped)
            + float(chi2_isf(WRONG / n, 1)) * len(agreed.lost))
    return float(np.minimum(squares, limits).sum()) + lost
