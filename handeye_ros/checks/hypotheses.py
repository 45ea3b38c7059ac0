# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The engine of most named causes: the same stops, fitted again under one changed assumption.

An `Explanation` is how well one set of assumptions explains some stops. A `Hypothesis` is one with
the refusal that names what was changed. `refuse_by_best` compares hypotheses with the explanation
as configured, and raises the refusal of the best one if it is decisively better.

The score is the left-out square of each stop, which pays for unknowns by itself (Geisser and Eddy
1979, JASA 74:153). With left_out_i the one of stop i, (12), mean the mean of those
explained (0.01 to 64) and m conditions a stop, the deviance of a fit is, (13),

    m sum_i min(log mean + left_out_i / mean, log 64 + 1)

A stop that a fit leaves out, or whose edge it leaves out, or that alone determines one of its
unknowns, counts as one that is off by 8 sigma. A difference of 23 is odds of 10^5 (Kass and
Raftery 1995, J. Am. Stat. Assoc. 90:773).

The sigmas are those of the features, which each fit reads for itself: the edge of another object
is uncertain, and fits for that reason. So the same must also hold in metres, in one unit for both.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

from handeye_ros.checks.refusals import MAX_DROPPED_SHARE
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample, SEED
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import CONVINCING_SQUARE, quick_solution, robust_solution
from handeye_ros.estimation.solution import Solution
from handeye_ros.sampling.edge_shapes import with_common_edge_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.sweep import with_estimated_clocks
from handeye_ros.targets import problem_of_known_poses, target_for
from handeye_ros.words import mm
import numpy as np

FALSE_CAUSE_PROBABILITY = 1e-5  # probability of naming a wrong cause
# twice the log of a Bayes factor of these odds
DECISIVE_EVIDENCE = -2 * math.log(FALSE_CAUSE_PROBABILITY)
MANY_TRIED = 40  # assumptions that may be tried in all where nothing fits
# left-out squares: of a stop that is not explained (8 sigma), and the least mean of those that
# are: a closer fit is no more evidence
UNEXPLAINED_SQUARE, LEAST_SQUARE = 64.0, 0.01
MIN_REDUNDANCY = 6  # smallest redundancy of a fit that is believed,
MAX_POSITION_STD = 1.0  # m: and largest 1 sigma of its sensor
# smallest number of explained stops, as a share of those explained as configured: fewer may fit by
# chance
MIN_EXPLAINED_SHARE = 0.9


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    How well one set of assumptions explains some stops.

    stamps: of the samples of all stops that are to be explained; of a sweep, of profiles
    solutions: one of all stops, or one for each of two parts of the recording; none where nothing
        fits
    left_out_squares: (2,), (12), in sigmas and in m^2, of each explained stop by its stamp
    """

    stamps: Sequence[int]
    solutions: tuple[Solution, ...] = ()
    left_out_squares: Mapping[int, Array] = field(default_factory=dict)

    @classmethod
    def of_solutions(cls, stamps: Sequence[int], *solutions: Solution) -> Explanation:
        """Return the explanation by solutions; their stations, in this order, are the stops."""
        squares = np.vstack([_left_out_squares(solution) for solution in solutions])
        return cls(stamps, solutions, {stamp: both for stamp, both in zip(
            stamps, squares, strict=True) if np.isfinite(both[0])})

    @property
    def reduced_chi_squared(self) -> float:
        """Return the reduced chi-squared of all solutions together."""
        freedom = sum(solution.posterior.degrees_of_freedom for solution in self.solutions)
        return sum(each.posterior.sum_of_squares for each in self.solutions) / max(freedom, 1)

    @property
    def redundancy(self) -> int:
        """Return the number of independent conditions in excess of the unknowns."""
        return sum(solution.posterior.redundancy for solution in self.solutions)

    @property
    def agrees(self) -> bool:
        """Return whether most stops fit, about as well as the configured noise predicts."""
        most = (1 - MAX_DROPPED_SHARE) * len(self.stamps)
        return bool(self.redundancy > 0 and self.reduced_chi_squared < CONVINCING_SQUARE
                    and len(self.left_out_squares) > most)

    @property
    def believable(self) -> bool:
        """Return whether the stops agree, not by chance, nor by a sensor that may be anywhere."""
        return self.agrees and self.redundancy >= MIN_REDUNDANCY and all(
            np.linalg.eigvalsh(solution.posterior.covariance[:3, :3])[-1] < MAX_POSITION_STD ** 2
            for solution in self.solutions)

    @property
    def within_noise(self) -> bool:
        """
        Return whether stops that were read anew fit as well as the noise predicts, in metres.

        Edges of another object, such as the floor beside the target, are uncertain: they fit in
        sigmas.
        """
        return bool(self.solutions) and all(
            solution.posterior.residual_rms <= solution.posterior.expected_rms
            for solution in self.solutions)

    def evidence_over(self, baseline: Explanation) -> float:
        """
        Return twice the log of the odds, for this explanation of its stops against another.

        It is the smaller of those by left-out squares in sigmas and in metres, and -inf where
        fewer than MIN_EXPLAINED_SHARE of the stops explained by the other are explained.
        """
        explained_before = len(baseline.left_out_squares.keys() & self.stamps)
        if not self.solutions or (len(self.left_out_squares)
                                  < MIN_EXPLAINED_SHARE * explained_before):
            return -math.inf
        fitted = [each.solutions for each in (self, baseline) if each.solutions]
        conditions = min(int(np.median(np.concatenate(
            [solution.posterior.ranks for solution in solutions]))) for solutions in fitted)
        noise = min(solutions[0].posterior.expected_rms for solutions in fitted)  # m
        unexplained = np.full(2, np.inf)
        before, after = (
            np.array([each.left_out_squares.get(stamp, unexplained) for stamp in self.stamps])
            / [1.0, noise ** 2] for each in (baseline, self))
        return min(stops_deviance(before[:, unit], conditions)
                   - stops_deviance(after[:, unit], conditions) for unit in range(2))

    def comparison_in_words(self, baseline: Explanation, change: str) -> str:
        """Return in words what fits as configured, and what with a change."""
        return (f'as set, {baseline._in_words(self.stamps)}; '
                f'with {change}, {self._in_words(self.stamps)}')

    def _in_words(self, stamps: Sequence[int]) -> str:
        if not self.solutions:
            return 'no sample fits'
        rms = math.sqrt(np.mean([each.posterior.residual_rms ** 2 for each in self.solutions]))
        explained = len(self.left_out_squares.keys() & stamps)
        return f'{explained} of {len(stamps)} samples fit ({mm(rms)} RMS)'


def _left_out_squares(solution: Solution) -> Array:
    """
    Return the left-out squares (n, 2) of all stations of a solution, inf where it explains none.

    In sigmas, (12), and in m^2.
    """
    posterior, n = solution.posterior, len(solution.used_stations)
    station = posterior.problem.observations.station
    whitened, metres = (np.bincount(station, residuals ** 2, minlength=n) for residuals in (
        posterior.postfit_residuals, posterior.linear.residuals))
    left_out = np.full((len(solution.full_problem.poses), 2), np.inf)
    left_out[solution.used_stations] = posterior.left_out_squares()[0][:, None] * np.column_stack(
        [np.ones(n), metres / np.maximum(whitened, 1e-300)])
    left_out[[*solution.stations_with_unused_edges, *solution.indispensable_stations]] = np.inf
    return left_out


def stops_to_explain(session: Session) -> list[Stop]:
    """Return the stops of a session that may show the target, without excluded ones."""
    return [stop for stop in session.stops
            if not stop.final_reason and not session.excludes(stop)]


def explain_problem(problem: Problem, stamps: Sequence[int], all_starts: bool = False
                    ) -> Explanation:
    """
    Return the explanation by a problem whose stations are the stops.

    all_starts: as in a solve, not only the first two.
    """
    solution = (robust_solution(problem, np.random.default_rng(SEED), subsets=True)
                if all_starts else quick_solution(problem))
    return Explanation.of_solutions(stamps, solution) if solution else Explanation(stamps)


def explain_samples(samples: Sequence[Sample], config: Config, stamps: Sequence[int] = (),
                    all_starts: bool = False, clocks: bool = False) -> Explanation:
    """
    Return the explanation by the samples of some of the stops; see explain_problem.

    stamps: of all stops that are to be explained, () for those of the samples; clocks: of a sweep,
    search them anew, as these samples show them.
    """
    samples = with_common_edge_shape(samples)
    stamps = stamps or [sample.stamp for sample in samples]
    if len(samples) < target_for(config).min_samples:
        return Explanation(stamps)
    if clocks:
        try:
            samples = with_estimated_clocks(samples, config).samples
        except DataError:  # the poses are of other times
            return Explanation(stamps)
    explanation = explain_problem(problem_of_known_poses(samples, config),
                                  [sample.stamp for sample in samples], all_starts)
    return replace(explanation, stamps=stamps)


def stops_deviance(left_out: Array, conditions: int) -> float:
    """Return the deviance of a fit, (13), by left-out squares (n,), inf: not explained."""
    explained = left_out[np.isfinite(left_out)]
    mean = float(np.clip(explained.mean() if len(explained) else UNEXPLAINED_SQUARE,
                         LEAST_SQUARE, UNEXPLAINED_SQUARE))
    return float(conditions * np.minimum(
        math.log(mean) + left_out / mean, math.log(UNEXPLAINED_SQUARE) + 1).sum())


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """
    One changed assumption, or several that belong together.

    explanation: of the same stops with this change
    refusal: the error that names this change
    changes: how many assumptions it changes
    """

    explanation: Explanation
    refusal: DataError
    changes: int = 1


def refuse_by_best(baseline: Explanation, hypotheses: Iterable[Hypothesis], tried: int = MANY_TRIED
                   ) -> None:
    """
    Raise the refusal of the hypothesis that explains the stops best, if it is decisively better.

    baseline: the explanation of all stops as configured. Each change of an assumption needs odds
    of 1 to FALSE_CAUSE_PROBABILITY, shared by all that are tried.
    """
    needed = DECISIVE_EVIDENCE + 2 * math.log(tried)
    gains = [(each.explanation.evidence_over(baseline) - each.changes * needed, each.refusal)
             for each in hypotheses if each.explanation.believable]
    gain, refusal = max(gains, key=lambda pair: pair[0], default=(0.0, None))
    if refusal and gain > 0:
        raise refusal
