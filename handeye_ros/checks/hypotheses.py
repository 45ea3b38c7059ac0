# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The same stops under one changed assumption, and the evidence for it.

Every explanation is scored over the same stops by a measure that all share: the left-out residual
of each stop, which pays for unknowns by itself (Geisser and Eddy 1979, JASA 74:153). With q_i the
mean squared left-out residual of stop i, v the mean of those explained (0.01 to 64) and m
conditions a stop, the deviance of an explanation is, (13),

    m sum_i min(log v + q_i / v, log 64 + 1)

A stop that an explanation leaves out, or whose edge it leaves out, or that alone determines one of
its unknowns, counts as one that is off by 8 sigma. A difference of 23 is odds of 10^5 (Kass and
Raftery 1995, J. Am. Stat. Assoc. 90:773).

The sigmas are those of the features, which each explanation reads for itself: the edge of another
object is uncertain, and fits for that reason. So the same must also hold in metres, in one unit
for both.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

from handeye_ros.checks.refusals import LARGEST_DROPPED_SHARE
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import CONVINCING_SQUARE, quick_solution, robust_solution
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.sweep import problem_of_known_poses, with_estimated_clocks
from handeye_ros.targets import target_for
import numpy as np

FALSE_CAUSE_PROBABILITY = 1e-5  # probability of naming a wrong cause
# twice the log of a Bayes factor of these odds
DECISIVE_EVIDENCE = -2 * math.log(FALSE_CAUSE_PROBABILITY)
MANY_TRIED = 40  # assumptions that may be tried in all where nothing fits
# variance factors: of a stop that is not explained, the least
UNEXPLAINED_FACTOR, SMALLEST_FACTOR = 64.0, 0.01
FEWEST_CONDITIONS = 6  # smallest redundancy of a fit that is believed
LEAST_KEPT = 0.9  # smallest share of the stops that fit as set: fewer may fit by chance


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    What an explanation makes of some stops: one consensus, or those of two parts of them.

    stamps: of the samples of all stops that it should explain; of a sweep, of profiles
    parts: none where nothing fits
    squares: (2,) q of (13), in sigmas and in metres, of those that it explains, by their stamps
    """

    stamps: Sequence[int]
    parts: tuple[Solution, ...] = ()
    squares: Mapping[int, Array] = field(default_factory=dict)

    @classmethod
    def of_solutions(cls, stamps: Sequence[int], *parts: Solution) -> Explanation:
        """Return the explanation by solutions whose stations, of each in turn, are the stops."""
        q = np.vstack([_squares(part) for part in parts])
        return cls(stamps, parts, {stamp: of_stop for stamp, of_stop in zip(stamps, q, strict=True)
                                   if np.isfinite(of_stop[0])})

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual of all parts per degree of freedom."""
        freedom = sum(part.degrees_of_freedom for part in self.parts)
        return sum(part.sum_of_squares for part in self.parts) / max(freedom, 1)

    @property
    def redundancy(self) -> int:
        """Return the number of independent conditions in excess of the unknowns, of all parts."""
        return sum(part.redundancy for part in self.parts)

    @property
    def agrees(self) -> bool:
        """Return whether most stops fit, about as well as the configured noise predicts."""
        return bool(self.redundancy > 0 and self.variance_factor < CONVINCING_SQUARE
                    and len(self.squares) > (1 - LARGEST_DROPPED_SHARE) * len(self.stamps))

    @property
    def believable(self) -> bool:
        """Return whether the stops agree, and not by chance."""
        return self.agrees and self.redundancy >= FEWEST_CONDITIONS

    @property
    def within_noise(self) -> bool:
        """
        Return whether stops that were read anew fit as well as the noise predicts, in metres.

        Edges of another object, such as the floor beside the target, are uncertain: they fit in
        sigmas.
        """
        return all(part.residual_rms <= part.expected_rms for part in self.parts)

    def evidence_over(self, stated: Explanation) -> float:
        """Return twice the log of the odds, by its own stops, for this fit against another."""
        kept = len(stated.squares.keys() & self.stamps)
        if not self.parts or len(self.squares) < LEAST_KEPT * kept:
            return -math.inf
        fits = [fit for fit in (self, stated) if fit.parts]
        # the fewer conditions of a stop, typically
        m = min(int(np.median(np.concatenate([p.ranks for p in fit.parts]))) for fit in fits)
        unit = min(fit.parts[0].expected_rms for fit in fits) ** 2
        before, after = (np.array([fit.squares.get(stamp, np.full(2, np.inf))
                                   for stamp in self.stamps]).T for fit in (stated, self))
        return min(stops_deviance(before[k] / scale, m) - stops_deviance(after[k] / scale, m)
                   for k, scale in enumerate((1.0, unit)))

    def in_words_beside(self, stated: Explanation, change: str) -> str:
        """Return in words what fits as set, and what with a change."""
        return f'as set, {stated._words(self.stamps)}; with {change}, {self._words(self.stamps)}'

    def _words(self, stamps: Sequence[int]) -> str:
        if not self.parts:
            return 'no stop fits'
        rms = math.sqrt(np.mean([part.residual_rms ** 2 for part in self.parts]))
        what = 'profiles' if self.parts[0].full_problem.config.sampling.moving else 'stops'
        fitting = len(self.squares.keys() & stamps)
        return f'{fitting} of {len(stamps)} {what} fit ({mm(rms)} RMS)'


def _squares(found: Solution) -> Array:
    """Return q of (13), (n, 2), of all stations of a solution, inf where it explains none."""
    station, n = found.problem.observations.station, len(found.used)
    white, metres = (np.bincount(station, r ** 2, minlength=n)
                     for r in (found.postfit_residuals, found.linear.residuals))
    q = np.full((len(found.full_problem.poses), 2), np.inf)
    q[found.used] = found.left_out_squares()[0][:, None] * np.column_stack(
        [np.ones(n), metres / np.maximum(white, 1e-300)])
    q[found.stations_without_edges] = q[found.indispensable_stations] = np.inf
    return q


def explanation_of_problem(problem: Problem, stamps: Sequence[int], all_starts: bool = False
                           ) -> Explanation:
    """
    Return the fit of a problem whose stations are the stops.

    all_starts: as in a solve, not only the first two.
    """
    fit = (robust_solution(problem, np.random.default_rng(0), subsets=True)
           if all_starts else quick_solution(problem))
    return Explanation.of_solutions(stamps, fit) if fit else Explanation(stamps)


def explanation_of_samples(samples: Sequence[Sample], config: Config, stamps: Sequence[int],
                           all_starts: bool = False, clocks: bool = False) -> Explanation:
    """
    Return the fit of samples of some of the stops; see explanation_of_problem.

    clocks: of a sweep, search them anew, as these samples show them.
    """
    if len(samples) < target_for(config).min_samples:
        return Explanation(stamps)
    if clocks:
        try:
            samples = with_estimated_clocks(samples, config).samples
        except DataError:  # the poses are of other times
            return Explanation(stamps)
    fit = explanation_of_problem(problem_of_known_poses(samples, config),
                                 [sample.stamp for sample in samples], all_starts)
    return replace(fit, stamps=stamps)


def stops_deviance(q: Array, conditions: int) -> float:
    """Return the deviance of an explanation, (13); q: (n,) of its stops, inf: not explained."""
    good = np.isfinite(q)
    v = float(np.clip(q[good].mean() if good.any() else UNEXPLAINED_FACTOR,
                      SMALLEST_FACTOR, UNEXPLAINED_FACTOR))
    return float(
        conditions * np.minimum(math.log(v) + q / v, math.log(UNEXPLAINED_FACTOR) + 1).sum())


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """
    One changed assumption, or several that belong together.

    fit: of the same stops with this change
    refusal: the error that names this change
    changes: how many assumptions it changes
    """

    fit: Explanation
    refusal: DataError
    changes: int = 1


def refuse_better(stated: Explanation, hypotheses: Iterable[Hypothesis], tried: int = MANY_TRIED
                  ) -> None:
    """
    Raise where another assumption explains the same stops better than the stated ones.

    stated: the fit of all stops as it is set. Raises the refusal of the best hypothesis; each
    change of an assumption needs odds of 1 to FALSE_CAUSE_PROBABILITY, shared by all that are
    tried.
    """
    most, best = 0.0, None
    for hypothesis in hypotheses:
        fit = hypothesis.fit
        level = hypothesis.changes * (DECISIVE_EVIDENCE + 2 * math.log(tried))
        if fit.believable and (gain := fit.evidence_over(stated) - level) > most:
            most, best = gain, hypothesis.refusal
    if best:
        raise best
