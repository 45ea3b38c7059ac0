"""
Finds the stations that agree, and the probability that one of them is wrong.

The first guess that explains nearly all stations is taken. Otherwise further guesses, and those of
random subsets, compete by how well all stations are explained. Then stations are dropped one by
one, worst first.

With few stations, a wrong one may not show in the residuals, (10) of estimator.md. The hypotheses
that one station has a small pose error and that all are right are compared by their odds (Box and
Tiao 1968, Biometrika 55:119). Noise and blocks stay as configured: if they could grow with the
misfit, a wrong station would be hidden.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from operator import attrgetter

from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.linearise import MANY, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.outliers import chi2_sf, GROSS, outliers, shared_scale
from handeye_ros.estimation.posterior import evaluated, map_solution
from handeye_ros.estimation.search import (
    evaluate,
    far,
    fit,
    LARGEST_SQUARE,
    Refined,
    refined,
)
from handeye_ros.estimation.solution import Solution, station_statistic
import numpy as np
from numpy.typing import NDArray

SUBSETS = 20  # of six stations: if a third are wrong, one subset has no wrong one with p 0.84
POSE_ERROR = np.repeat([1e-3, 3e-3], 3)  # 1 sigma of a wrong station's pose error (m, rad)
WRONG = 0.05  # prior odds of a station being wrong against all being right
SURE = 100.0  # posterior odds of one station being wrong, from which it is dropped
EXPLAINED = 0.2  # p-value of the other squares below which more than one is wrong


@dataclass(frozen=True, eq=False)
class Consensus:
    """
    A solution from the stations used (ascending), and the squared residuals of those dropped.

    whole: the problem with all stations and observations; contaminated: the probability that one
    of few used stations is wrong.
    """

    whole: Problem
    solution: Solution
    used: NDArray[np.intp]
    dropped: dict[int, float]
    contaminated: float = 0.0

    @property
    def unused(self) -> NDArray[np.intp]:
        """Return the used stations that show essential observations, but of which none is used."""
        labelled = self.solution.problem
        whole = self.whole.subset(self.used)
        return self.used[whole.shows_essential & ~labelled.shows_essential]

    @property
    def explained(self) -> int:
        """Return the number of used stations with their essential observations used."""
        return len(self.used) - len(self.unused)

    @property
    def unused_share(self) -> float:
        """Return the share of stations that are dropped or lack their essential observations."""
        return 1 - self.explained / len(self.whole.poses)

    @classmethod
    def of(cls, problem: Problem, rng: np.random.Generator, subsets: bool = False,
           start: Estimate | None = None) -> Consensus:
        """
        Return the solution of the stations that agree, from several starts.

        subsets: also start from random subsets of the stations if all together do not fit. start:
        the only start to use, if given.
        Raises DataError when there is no start.
        """
        if start is not None:
            return without_outliers(refined(problem, start))
        starts = chain(problem.guesses(rng), subset_starts(problem, SUBSETS * subsets, rng))
        best = refined(problem, next(starts))
        while not best.accepted and (other := next(starts, None)):
            if not far(problem, other):
                best = min(best, refined(problem, other), key=attrgetter('loss'))
        return without_outliers(best)

    @classmethod
    def of_first_guesses(cls, problem: Problem) -> Consensus | None:
        """Return the consensus from the first two starts, None if neither fits."""
        try:
            for start in islice(problem.guesses(np.random.default_rng(0)), 2):
                if far(problem, start):
                    continue
                trial = refined(problem, start)
                if trial.misfit < LARGEST_SQUARE:
                    return without_outliers(trial)
        except (HandeyeError, np.linalg.LinAlgError):
            pass
        return None

    def refined(self) -> Consensus:
        """
        Return the consensus with all nuisance blocks in its solution, outliers dropped.

        With few stations, each may be wrong without being detected; the reported covariance
        includes this.
        """
        used, dropped, part = self.used, dict(self.dropped), self.solution.problem
        total, estimate, noise = len(used) + len(dropped), self.solution.estimate, None
        while True:
            solution = map_solution(part, estimate, noise)
            mean_square, freedom = _mean_squares(solution.conservative or solution)
            spare = len(used) - self.whole.method.minimum
            worst = outliers(mean_square, freedom, total, spare)
            wrong = None if len(worst) else contamination(solution, len(dropped))
            if wrong and spare > 0 and wrong.worst is not None:
                worst = np.array([wrong.worst], dtype=np.intp)
            if not len(worst):
                if wrong:
                    solution = replace(solution, contamination=wrong.covariance)
                return replace(self, solution=solution, used=used, dropped=dropped,
                               contaminated=wrong.of_any if wrong else 0.0)
            dropped |= {int(used[k]): float(mean_square[k]) for k in worst}
            used = np.delete(used, worst)
            part = part.subset(np.delete(np.arange(len(part.poses)), worst))
            if len(used) > MANY:  # a few of very many hardly move the solution
                found = solution.conservative or solution
                if part.pose_model:
                    part = part.with_pose_values(found.problem.pose_values)
                estimate, noise = found.estimate, found.noise


def subset_starts(problem: Problem, count: int, rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the first start of each of count random subsets of the stations."""
    n, size = len(problem.poses), max(6, problem.method.minimum)
    for _ in range(count if n > size else 0):
        chosen = np.sort(rng.permutation(n)[:size])
        yield next(problem.subset(chosen).guesses(rng))


def without_outliers(trial: Refined) -> Consensus:
    """Return the consensus after dropping stations that do not fit, one by one."""
    n, minimum = len(trial.problem.poses), trial.problem.method.minimum
    # least squares could move to a fit between the target and another surface
    limit = LARGEST_SQUARE if trial.whole.ambiguous else GROSS
    good = trial.squares <= limit * max(1.0, trial.spread)
    good[np.argsort(trial.squares, kind='stable')[:minimum]] = True
    used = np.flatnonzero(good)
    dropped = {int(i): float(trial.squares[i]) for i in np.setdiff1d(np.arange(n), used)}
    estimate = trial.estimate
    while True:
        part = trial.problem.subset(used)
        estimate = fit(part, estimate, Noise())
        solution = evaluate(part, estimate, Noise())
        mean_square, freedom = _mean_squares(solution)
        scaled = mean_square / shared_scale(mean_square, freedom)
        worst = outliers(scaled, freedom, n, len(used) - minimum)[:1]
        if not len(worst):
            return Consensus(trial.whole, solution, used, dropped)
        dropped |= {int(used[k]): float(mean_square[k]) for k in worst}
        used = np.delete(used, worst)


def _mean_squares(solution: Solution) -> tuple[Array, NDArray[np.intp]]:
    """
    Return per station the mean squared leave-one-out residual and its degrees of freedom.

    All points of a station share one pose, which has 6 degrees of freedom.
    """
    statistic, count = station_statistic(solution)
    return statistic / np.maximum(count, 1), np.clip(count, 1, 6)


@dataclass(frozen=True, eq=False)
class Contamination:
    """
    The probability that each station is wrong, and the change of the transform if it is.

    Of (10), probability: (n,) p_i; shifts: (n, 6) h_i; covariances: (n, 6, 6) Sigma_i. rest: (n,)
    p-value of the squared residuals without the error of this station.
    """

    probability: Array
    shifts: Array
    covariances: Array
    rest: Array

    @property
    def worst(self) -> int | None:
        """Return the station that is almost surely the only wrong one, or None."""
        worst = int(np.argmax(self.probability))
        conclusive = self.probability[worst] > SURE * (1 - self.probability[worst])
        return worst if conclusive and self.rest[worst] > EXPLAINED else None

    @property
    def of_any(self) -> float:
        """Return the probability that one of the stations is wrong."""
        return float(self.probability.sum())

    @property
    def covariance(self) -> Array:
        """Return the term (6, 6) added to the covariance of the transform, (10)."""
        moved = self.covariances + self.shifts[:, :, None] * self.shifts[:, None, :]
        return np.asarray(np.tensordot(self.probability, moved, 1))


def contamination(solution: Solution, dropped: int) -> Contamination | None:
    """
    Return the contamination of a solution, None with very many stations.

    Between MANY and twice as many stations the probabilities fade to 0. dropped: number of
    stations dropped as wrong, which make another wrong one likelier.
    """
    n = len(solution.problem.poses)
    weight = min(1.0, 2 - n / MANY)
    if weight <= 0:
        return None
    configured = evaluated(solution.problem, solution.estimate, Noise())
    white = whitening(configured.linear, configured.noise)
    wrong = white(configured.linear.by_pose * POSE_ERROR)
    log_odds, explained = np.empty((2, n))
    shifts, covariances = np.empty((n, 6)), np.empty((n, 6, 6))
    for at in configured.problem.stations:
        i = configured.problem.observations.station[at.rows[:, 0]]
        K, J = wrong[at.rows], configured.jacobian[at.rows]
        across = np.swapaxes(J, 1, 2) @ K
        moved = configured.covariance @ across
        inside = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(across, 1, 2) @ moved
        slope = np.einsum('sci,sc->si', K, configured.white[at.rows])
        size = np.linalg.solve(inside, slope[..., None])
        explained[i] = (slope * size[..., 0]).sum(axis=1)
        log_odds[i] = (explained[i] - np.linalg.slogdet(inside)[1]) / 2
        to_transform = moved[:, :6]
        shifts[i] = (to_transform @ size)[..., 0]
        covariances[i] = to_transform @ np.linalg.solve(inside, np.swapaxes(to_transform, 1, 2))
    log_odds += np.log(WRONG + dropped / (n + dropped))
    freedom = max(configured.degrees_of_freedom - len(POSE_ERROR), 1)
    return Contamination(weight * _probabilities(log_odds), shifts, covariances,
                         chi2_sf(np.maximum(configured.squares - explained, 0.0), freedom))


def _probabilities(log_odds: Array) -> Array:
    """Return probabilities (n,) of exclusive cases; log_odds (n,): against none of them."""
    most = max(0.0, float(log_odds.max()))
    odds = np.exp(log_odds - most)
    return np.asarray(odds / (np.exp(-most) + odds.sum()))
