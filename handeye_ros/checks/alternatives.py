"""
The same samples under one changed assumption, and which of two explanations they favour.

Two explanations are compared by twice the logarithm of the Bayes factor, as the Schwarz criterion
approximates it (Schwarz 1978, Ann. Statist. 6:461; Kass and Raftery 1995, J. Am. Stat. Assoc.
90:773). With m conditions, u unknowns, f = m - u and the variance factor s, an explanation has the
deviance, (13),

    f (log v + s / v) + u log m + sum of the limits of what it leaves out,    v = max(s, SMALLEST)

A station that is left out costs the limit from which a station is an outlier, and so does an edge
that a station shows and the explanation does not use.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from handeye_ros.errors import DataError
from handeye_ros.estimation.consensus import Consensus, fast_consensus
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.outliers import chi2_isf, FALSE_ALARM
from handeye_ros.estimation.search import CONVINCING
import numpy as np

RARE = 1e-5  # probability of naming a wrong cause
# Twice the log of a Bayes factor: very strong by Kass and Raftery; odds of 1 to RARE.
VERY_STRONG, DECISIVE = 10.0, -2 * float(np.log(RARE))
SMALLEST = 1e-2  # of the variance factor, blocks lumped: simulated samples may have no error
LARGEST_DROPPED_SHARE = 0.34  # of the stations, that an explanation may leave out: one third

Fit = tuple[Consensus, ...]  # of all stations, or of the parts of a recording


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """
    One changed assumption.

    refit(): the fit of the same samples under it, None where there is none; refusal(fit): the
    error that names it.
    """

    refit: Callable[[], Fit | None]
    refusal: Callable[[Fit], DataError]


def of_problem(problem: Problem) -> Fit | None:
    """Return the fit of a problem, None where the first starts lead to none."""
    found = fast_consensus(problem)
    return (found,) if found else None


def deviance(fit: Fit) -> float:
    """Return -2 log of the marginal likelihood of an explanation, (13); inf without a fit."""
    if not fit:
        return np.inf
    n = sum(len(part.whole.poses) for part in fit)
    f = max(sum(part.solution.degrees_of_freedom for part in fit), 1)
    u = sum(part.solution.unknowns for part in fit)
    m = max(sum(len(part.solution.white) for part in fit), 2)
    v = max(variance_factor(fit), SMALLEST)
    return f * (float(np.log(v)) + variance_factor(fit) / v) + u * float(np.log(m)) + sum(
        _left_out(part, n) for part in fit)


def variance_factor(fit: Fit) -> float:
    """Return the squared whitened residual of all parts per degree of freedom."""
    freedom = sum(part.solution.degrees_of_freedom for part in fit)
    return sum(part.solution.squares for part in fit) / max(freedom, 1)


def _left_out(part: Consensus, stations: int) -> float:
    """Return what the stations and edges cost that a part leaves out."""
    rank = max(int(np.median(part.solution.ranks)), 1)
    limit, of_edge = chi2_isf(FALSE_ALARM / stations, np.array([rank, 1])).tolist()
    return float(limit * len(part.dropped) + of_edge * len(part.unused))


def believable(fit: Fit) -> bool:
    """Return whether nearly all stations fit, about as well as the configured noise allows."""
    return variance_factor(fit) < CONVINCING and all(
        part.unused_share < LARGEST_DROPPED_SHARE and part.solution.degrees_of_freedom > 0
        for part in fit)


def evidence(other: Fit, stated: Fit) -> float:
    """Return twice the log of the Bayes factor for another explanation against the stated."""
    return deviance(stated) - deviance(other)


def require_stated(stated: Fit, hypotheses: Iterable[Hypothesis], level: float = DECISIVE
                   ) -> None:
    """
    Refuse the stated assumptions where one changed assumption explains the samples better.

    Raises the refusal of the hypothesis that explains them best.
    """
    fits = [(one, fit) for one in hypotheses if (fit := one.refit()) and believable(fit)
            and evidence(fit, stated) > level]
    if fits:
        best, fit = min(fits, key=lambda pair: deviance(pair[1]))
        raise best.refusal(fit)
