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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

from handeye_ros.checks.refusals import LARGEST_DROPPED_SHARE
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import CONVINCING_SQUARE, quick_solution, robust_solution
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.sweep import problem_of_known_poses, with_estimated_clocks
from handeye_ros.targets import target_for
import numpy as np

FALSE_CAUSE_PROBABILITY = 1e-5  # probability of naming a wrong cause
# twice the log of a Bayes factor of these odds
DECISIVE_EVIDENCE = -2 * math.log(FALSE_CAUSE_PROBABILITY)
# variance factors: of a stop that is not explained, the least
UNEXPLAINED_FACTOR, SMALLEST_FACTOR = 64.0, 0.01
FEWEST_CONDITIONS = 6  # smallest redundancy of a fit that is believed


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    What an explanation makes of some stops: one consensus, or those of two parts of them.

    parts: none where nothing fits
    squares: (2, n) q of (13), in sigmas and in metres, of the stops that are compared, inf for one
        that is not explained
    with_more_conditions: other believable explanations of these stops, by which more conditions
        agree: a corner of two faces is an edge, and more
    """

    parts: tuple[Solution, ...]
    squares: Array
    with_more_conditions: tuple[Explanation, ...] = ()

    @classmethod
    def of_solutions(cls, *parts: Solution) -> Explanation:
        """Return the explanation whose stations, those of each part in turn, are the stops."""
        return cls(parts, np.hstack([_squares(part) for part in parts]))

    @classmethod
    def nothing(cls, total: int) -> Explanation:
        """Return the explanation that explains none of a number of stops."""
        return cls((), np.full((2, total), np.inf))

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
                    and self.fitting > (1 - LARGEST_DROPPED_SHARE) * self.squares.shape[1])

    @property
    def believable(self) -> bool:
        """Return whether the stops agree, and not by chance."""
        return self.agrees and self.redundancy >= FEWEST_CONDITIONS

    @property
    def is_determined(self) -> bool:
        """Return whether no unknown is free, nor would be without one of the stops."""
        return all(part.is_determined and not len(part.indispensable_stations)
                   for part in self.parts)

    @property
    def fitting(self) -> int:
        """Return the number of stops that fit."""
        return int(np.isfinite(self.squares[0]).sum())

    def evidence_over(self, stated: Explanation) -> float:
        """Return twice the log of the odds for this fit against the stated one."""
        if self.fitting < 0.9 * stated.fitting:  # the stops that stay may fit by chance
            return -math.inf
        fits = [fit for fit in (self, stated) if fit.parts]
        # the fewer conditions of a stop, typically
        m = min(int(np.median(np.concatenate([p.ranks for p in fit.parts]))) for fit in fits)
        unit = min(fit.parts[0].expected_rms for fit in fits) ** 2
        return min(deviance(before / scale, m) - deviance(after / scale, m)
                   for before, after, scale in zip(stated.squares, self.squares, (1.0, unit),
                                                   strict=True))

    def in_words_beside(self, stated: Explanation, change: str) -> str:
        """Return in words what fits as set, and what with a change."""
        return f'as set, {stated._words}; with {change}, {self._words}'

    @property
    def _words(self) -> str:
        if not self.parts:
            return 'no stop fits'
        rms = math.sqrt(np.mean([part.residual_rms ** 2 for part in self.parts]))
        what = 'profiles' if self.parts[0].full_problem.config.sampling.moving else 'stops'
        return f'{self.fitting} of {self.squares.shape[1]} {what} fit ({mm(rms)} RMS)'


def _squares(found: Solution) -> Array:
    """Return q of (13), (2, n), of all stations of a solution."""
    station, n = found.problem.observations.station, len(found.used)
    white, metres = (np.bincount(station, r ** 2, minlength=n)
                     for r in (found.postfit_residuals, found.linear.residuals))
    q = np.full((2, len(found.full_problem.poses)), np.inf)
    q[:, found.used] = found.left_out_squares()[0] * np.stack(
        [np.ones(n), metres / np.maximum(white, 1e-300)])
    q[:, found.stations_without_edges] = q[:, found.indispensable_stations] = np.inf
    return q


def explanation_of_problem(problem: Problem, all_starts: bool = False) -> Explanation:
    """
    Return the fit of a problem whose stations are all the stops.

    all_starts: as in a solve, not only the first two.
    """
    fit = (robust_solution(problem, np.random.default_rng(0), subsets=True)
           if all_starts else quick_solution(problem))
    return Explanation.of_solutions(fit) if fit else Explanation.nothing(len(problem.poses))


def explanation_of_results(results: Sequence[Sample | Reject | None], config: Config,
                           all_starts: bool = False, clocks: bool = True) -> Explanation:
    """
    Return the fit of what stops gave.

    results: of each of the stops that are compared; all_starts: see explanation_of_problem;
    clocks: of a sweep, search them anew, as these results show them.
    """
    number = {r.stamp: k for k, r in enumerate(results) if isinstance(r, Sample)}
    ordered = with_common_shape([r for r in results if isinstance(r, Sample)])
    nothing = Explanation.nothing(len(results))
    if len(ordered) < target_for(config).min_samples:
        return nothing
    if clocks:
        ordered = with_estimated_clocks(ordered, config).samples
    fit = explanation_of_problem(problem_of_known_poses(ordered, config), all_starts)
    squares = nothing.squares.copy()
    squares[:, [number[sample.stamp] for sample in ordered]] = fit.squares
    return Explanation(fit.parts, squares)


def deviance(q: Array, conditions: int) -> float:
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

    refit(): the fit of the same stops with this change
    refusal(fit): the error that names this change
    changes: how many assumptions it changes
    """

    refit: Callable[[], Explanation]
    refusal: Callable[[Explanation], DataError]
    changes: int = 1


def refuse_better(stated: Explanation, hypotheses: Sequence[Hypothesis]) -> None:
    """
    Raise where another assumption explains the same stops better than the stated ones.

    stated: the fit of the stops as it is set. Raises the refusal of the best hypothesis; each
    change of an assumption needs odds of 1 to FALSE_CAUSE_PROBABILITY, shared by all that are
    tried.
    """
    most, best = 0.0, None
    for hypothesis in hypotheses:
        fit = hypothesis.refit()
        level = hypothesis.changes * (DECISIVE_EVIDENCE + 2 * math.log(len(hypotheses)))
        if fit.believable and (gain := fit.evidence_over(stated) - level) > most:
            most, best = gain, hypothesis.refusal(fit)
    if best:
        raise best
