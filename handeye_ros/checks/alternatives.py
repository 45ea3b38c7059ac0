"""
The same samples under one changed assumption, and the evidence for it.

profile.range_sign is also tested without a solution. A face ends where the surface turns away from
the sensor or drops. With the wrong sign, a corner that turns away appears in front of the face, so
no edge is found.

Two explanations are compared by twice the logarithm of the Bayes factor, as the Schwarz criterion
approximates it (Schwarz 1978, Ann. Statist. 6:461; Kass and Raftery 1995, J. Am. Stat. Assoc.
90:773). With m conditions, u unknowns, f = m - u and the variance factor s, an explanation has the
deviance, (13),

    f (log v + s / v) + u log m + sum of the limits of what it leaves out,    v = max(s, 0.01)

Each dropped station adds the limit from which a station is an outlier, a quantile of chi-squared.
Each used station with edges that are not used adds this limit for 1 degree of freedom.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from handeye_ros.checks.errors import CountedWrongWayError
from handeye_ros.config import Config
from handeye_ros.data import EdgePoint, Feature, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.outliers import chi2_isf, FALSE_ALARM
from handeye_ros.estimation.search import CONVINCING
from handeye_ros.estimation.solution import Solution
import numpy as np

RARE = 1e-5  # probability of naming a wrong cause
# Twice the log of a Bayes factor: very strong by Kass and Raftery; odds of 1 to RARE.
VERY_STRONG, DECISIVE = 10.0, -2 * float(np.log(RARE))
LARGEST_DROPPED_SHARE = 0.34  # largest share of the stations that an explanation may leave out


@dataclass(frozen=True, eq=False)
class Fit:
    """The consensus under an explanation: of all stations, or of parts of a recording."""

    parts: tuple[Consensus, ...]

    @classmethod
    def of(cls, problem: Problem, all_starts: bool = False) -> Fit | None:
        """Return the fit of a problem, None without one; all_starts: not only the first two."""
        consensus: Consensus | None
        if all_starts:
            try:
                consensus = Consensus.of(problem, np.random.default_rng(0), subsets=True)
            except DataError:
                consensus = None
        else:
            consensus = Consensus.of_first_guesses(problem)
        return cls((consensus,)) if consensus else None

    @property
    def solution(self) -> Solution:
        """Return the solution of the first part."""
        return self.parts[0].solution

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual of all parts per degree of freedom."""
        freedom = sum(part.solution.degrees_of_freedom for part in self.parts)
        return sum(part.solution.squares for part in self.parts) / max(freedom, 1)

    @property
    def believable(self) -> bool:
        """Return whether nearly all stations fit, about as well as configured noise predicts."""
        return self.variance_factor < CONVINCING and all(
            part.unused_share < LARGEST_DROPPED_SHARE and part.solution.degrees_of_freedom > 0
            for part in self.parts)

    @property
    def deviance(self) -> float:
        """Return -2 log of the marginal likelihood, (13); inf without parts."""
        if not self.parts:
            return np.inf
        n = sum(len(part.whole.poses) for part in self.parts)
        f = max(sum(part.solution.degrees_of_freedom for part in self.parts), 1)
        u = sum(part.solution.unknowns for part in self.parts)
        m = max(sum(len(part.solution.white) for part in self.parts), 2)
        v = max(self.variance_factor, 0.01)  # simulated samples may have no error
        return f * (float(np.log(v)) + self.variance_factor / v) + u * float(np.log(m)) + sum(
            _left_out(part, n) for part in self.parts)

    def evidence_against(self, stated: Fit) -> float:
        """Return twice the log Bayes factor for this fit against the stated one."""
        return stated.deviance - self.deviance


def _left_out(part: Consensus, stations: int) -> float:
    """Return the deviance of the stations and edges that a part does not use."""
    rank = max(int(np.median(part.solution.ranks)), 1)
    limit, of_edge = chi2_isf(FALSE_ALARM / stations, np.array([rank, 1])).tolist()
    return float(limit * len(part.dropped) + of_edge * len(part.unused))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """
    One changed assumption.

    refit(): the fit of the same samples with this change, None without a fit; refusal(fit): the
    error that names this change.
    """

    refit: Callable[[], Fit | None]
    refusal: Callable[[Fit], DataError]


def require_stated(stated: Fit, hypotheses: Iterable[Hypothesis], level: float = DECISIVE
                   ) -> None:
    """
    Raise where one changed assumption explains the samples better than the stated ones.

    Raises the refusal of the best one. level: 2 log Bayes factor that it has to exceed.
    """
    fits = [(one, fit) for one in hypotheses if (fit := one.refit()) and fit.believable
            and fit.evidence_against(stated) > level]
    if fits:
        best, fit = min(fits, key=lambda pair: pair[1].deviance)
        raise best.refusal(fit)


def require_range_sign(stations: Sequence[Sample | Reject], config: Config) -> None:
    """Raise CountedWrongWayError where the profiles alone contradict profile.range_sign."""
    hint = range_sign_evidence(stations).hint(config)
    if hint:
        raise CountedWrongWayError(hint)


EDGES = ('roof', 'step', 'shadow', 'gap')
TURNED_EDGES = ('roof', 'step', 'shadow')  # that depend on the sign of the range


@dataclass(frozen=True)
class RangeSignEvidence:
    """
    The number of stations that show an edge, by the sign of the range.

    as_set: with profile.range_sign; flipped: with the other sign; both: with either; total: of
    all stations.
    """

    as_set: int
    flipped: int
    both: int
    total: int

    @property
    def against(self) -> bool:
        """
        Return whether the stations contradict profile.range_sign (a sign test at 0.01).

        False if over half show an edge as set, or under 0.8 of all show one with the other sign.
        """
        if not self.total or self.as_set > 0.5 * self.total:
            return False
        only_as_set, only_flipped = self.as_set - self.both, self.flipped - self.both
        return (self.flipped >= 0.8 * self.total
                and 2.0 ** -(only_flipped - 4 * only_as_set) < 0.01)

    def hint(self, config: Config) -> str:
        """Return the sentence added to a refusal, empty without a contradiction."""
        if not self.against:
            return ''
        sign = config.profile.range_sign
        return (f'with profile.range_sign {sign}, {self.as_set} of {self.total} stations show an '
                f'edge; counted the other way {self.flipped} of {self.total} do: set '
                f'profile.range_sign to {-sign} (or, if it is right, remove what is higher '
                'beside the target)')


def range_sign_evidence(stations: Iterable[Sample | Reject]) -> RangeSignEvidence:
    """
    Return the evidence on profile.range_sign from all stations, also those without a sample.

    The caller removes ends of faces at the border of the field of view. For targets without edges
    `against` is False.
    """
    seen = [(isinstance(s, Sample) and _has_edge(s.features, EDGES),
             _has_edge(s.flipped, TURNED_EDGES)) for s in stations]
    return RangeSignEvidence(sum(a for a, _ in seen), sum(b for _, b in seen),
                             sum(a and b for a, b in seen), len(seen))


def _has_edge(features: Iterable[Feature], kinds: Sequence[str]) -> bool:
    return any(isinstance(f, EdgePoint) and f.kind in kinds for f in features)
