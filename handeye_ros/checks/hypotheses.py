# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The same stops under one changed assumption, and the evidence for it.

Every explanation is scored over the same stops by a measure that all share: the left-out residual
of each stop, which pays for unknowns by itself (Geisser and Eddy 1979, JASA 74:153). With q_i the
mean squared left-out residual of stop i, v the mean of those explained (at least 0.01) and m
conditions a stop, the deviance of an explanation is, (13),

    m sum_i min(log v + q_i / v, log 64 + 1)

A stop that an explanation leaves out, or whose edge it leaves out, counts as one that is off by 8
sigma. A difference of 23 is odds of 10^5 (Kass and Raftery 1995, J. Am. Stat. Assoc. 90:773).

The sigmas are those of the features, which each explanation reads for itself: a stranger's edge is
uncertain, and therefore fits. So the same must also hold in metres, in one unit for both.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math

from handeye_ros.checks.refusals import LARGEST_DROPPED_SHARE
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import CONVINCING, first_guesses, robust_solution
from handeye_ros.estimation.solve import Solution
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.sweep import problem_at_poses
from handeye_ros.targets import target_for
import numpy as np
from numpy.typing import NDArray

RARE = 1e-5  # probability of naming a wrong cause
DECISIVE = -2 * math.log(RARE)  # twice the log of a Bayes factor of these odds
UNEXPLAINED, FLOOR = 64.0, 0.01  # variance factors: of a stop that is not explained, the least


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    What an explanation makes of some stops: one consensus, or those of two parts of them.

    stops: for each part the numbers of its stations among the `total` stops that are compared.
    beside: (total,) stops of which the explanation leaves out what others show, False by default.
    """

    parts: tuple[Solution, ...]
    stops: tuple[NDArray[np.intp], ...]
    total: int
    beside: NDArray[np.bool_] | bool = False

    @classmethod
    def of_all(cls, consensus: Solution) -> Explanation:
        """Return the fit whose stations are all the stops."""
        n = len(consensus.whole.poses)
        return cls((consensus,), (np.arange(n),), n)

    @classmethod
    def of(cls, problem: Problem, all_starts: bool = False) -> Explanation | None:
        """
        Return the fit of a problem whose stations are all the stops, None without one.

        all_starts: not only the first two.
        """
        try:
            found = (robust_solution(problem, np.random.default_rng(0), subsets=True)
                     if all_starts else first_guesses(problem))
        except DataError:
            return None
        return cls.of_all(found) if found else None

    @property
    def solution(self) -> Solution:
        """Return the solution of the first part."""
        return self.parts[0]

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual of all parts per degree of freedom."""
        freedom = sum(part.degrees_of_freedom for part in self.parts)
        return sum(part.squares for part in self.parts) / max(freedom, 1)

    @property
    def believable(self) -> bool:
        """Return whether most stops fit, about as well as the configured noise predicts."""
        missing = 1 - self.explained / self.total
        return bool(self.variance_factor < CONVINCING and missing < LARGEST_DROPPED_SHARE and all(
            part.unused_share < LARGEST_DROPPED_SHARE and part.degrees_of_freedom > 0
            for part in self.parts))

    @property
    def explained(self) -> int:
        """Return the number of stops that fit."""
        return int(np.isfinite(self.squares).sum())

    @cached_property
    def squares(self) -> Array:
        """Return q of (13), (total,); inf for a stop that is not explained."""
        q = np.full(self.total, np.inf)
        for part, stops in zip(self.parts, self.stops, strict=True):
            q[stops[part.used]], _ = part.left_out()
            q[stops[part.unused]] = np.inf
        return np.where(self.beside, np.inf, q)

    @cached_property
    def lengths(self) -> Array:
        """Return as squares does the mean squared residuals in m^2, left out as in (13)."""
        q = np.full(self.total, np.inf)
        for part, stops in zip(self.parts, self.stops, strict=True):
            station, n = part.problem.observations.station, len(part.used)
            inside, metres = (np.bincount(station, r ** 2, minlength=n)
                              for r in (part.white, part.linear.residuals))
            q[stops[part.used]] = self.squares[stops[part.used]] * metres / np.maximum(
                inside, 1e-300)
        return np.where(np.isfinite(self.squares), q, np.inf)

    @property
    def conditions(self) -> int:
        """Return the typical number of independent conditions of a stop."""
        return max(int(np.median(np.concatenate([p.ranks for p in self.parts]))), 1)

    def evidence_against(self, stated: Explanation | None) -> float:
        """Return twice the log of the odds for this fit against the stated one (None: no fit)."""
        if stated is None:
            nothing = np.full(self.total, np.inf)
            return deviance(nothing, self.conditions) - deviance(self.squares, self.conditions)
        if self.explained < 0.9 * stated.explained:  # the stops that stay may fit by chance
            return -math.inf
        m = min(self.conditions, stated.conditions)
        unit = min(fit.solution.expected_rms for fit in (self, stated)) ** 2
        return min(deviance(before, m) - deviance(after, m) for before, after in (
            (stated.squares, self.squares), (stated.lengths / unit, self.lengths / unit)))

    def compared(self, stated: Explanation | None, change: str) -> str:
        """Return in words what fits as set, and what with a change."""
        before = stated._words if stated else 'no stop fits'
        return f'as set, {before}; with {change}, {self._words}'

    @property
    def _words(self) -> str:
        rms = math.sqrt(np.mean([part.residual_rms ** 2 for part in self.parts]))
        return f'{self.explained} of {self.total} stops fit ({mm(rms)} RMS)'


def fit_of(results: Sequence[Sample | Reject | None], config: Config, all_starts: bool = False
           ) -> Explanation | None:
    """
    Return the fit of what stops gave, None if the samples are too few or do not fit.

    results: of each of the stops that are compared; all_starts: see Explanation.of.
    """
    number = {r.stamp: k for k, r in enumerate(results) if isinstance(r, Sample)}
    ordered = with_common_shape([r for r in results if isinstance(r, Sample)])
    if len(ordered) < target_for(config).minimum:
        return None
    fit = Explanation.of(problem_at_poses(ordered, config), all_starts)
    stops = np.array([number[sample.stamp] for sample in ordered])
    return fit and replace(fit, stops=(stops,), total=len(results))


def deviance(q: Array, conditions: int) -> float:
    """Return the deviance of an explanation, (13); q: (n,) of its stops, inf: not explained."""
    good = np.isfinite(q)
    v = float(np.clip(q[good].mean() if good.any() else UNEXPLAINED, FLOOR, UNEXPLAINED))
    return float(conditions * np.minimum(math.log(v) + q / v, math.log(UNEXPLAINED) + 1).sum())


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """
    One changed assumption, or several that belong together.

    refit(): the fit of the same stops with this change, None without a fit; refusal(fit): the
    error that names this change; changes: how many assumptions it changes; simpler: one with
    fewer changes that is named in its place if it explains the stops too.
    """

    refit: Callable[[], Explanation | None]
    refusal: Callable[[Explanation], DataError]
    changes: int = 1
    simpler: Hypothesis | None = None


def require_stated(stated: Explanation | None, hypotheses: Sequence[Hypothesis]) -> None:
    """
    Raise where another assumption explains the same stops better than the stated ones.

    stated: the fit of the stops as it is set, None without one. Raises the refusal of the best
    hypothesis; each change of an assumption needs odds of 1 to RARE, shared by all that are tried.
    """
    def refit(one: Hypothesis) -> tuple[float, DataError | None]:
        fit = one.refit()
        if fit is None or not fit.believable:
            return 0.0, None
        level = one.changes * (DECISIVE + 2 * math.log(len(hypotheses)))
        return fit.evidence_against(stated) - level, one.refusal(fit)

    most, best = 0.0, None
    for one in hypotheses:
        gain, refusal = refit(one)
        if gain > most and one.simpler:
            by_simpler, other = refit(one.simpler)
            if by_simpler > most:
                gain, refusal = by_simpler, other
        if gain > most:
            most, best = gain, refusal
    if best:
        raise best
