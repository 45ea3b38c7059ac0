"""
Which stations can be believed.

The robust start is a graduated non-convexity (Yang et al. 2020, RA-L 5:1127) over whole
stations; where that leaves doubt, guesses from random subsets compete by the residual that
65 % of the stations stay below. Then stations are dropped one by one, worst first.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from handeye_ros.data import Array
from handeye_ros.estimation.method import Estimate, UNUSED
from handeye_ros.estimation.mixed import settled
from handeye_ros.estimation.problem import linearise, points_in_base, Problem
from handeye_ros.estimation.solve import evaluate, least_squares, Solution, station_statistic
from handeye_ros.estimation.weights import Noise, whitening
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

BELIEVED_SHARE = 0.65  # of the stations that a good answer must explain
SUBSETS = 60
SUBSET_SIZE = 6
CONVINCING = 4.0  # squared residual of the believed share that ends the search of subsets
MAX_ANNEALINGS = 40
SMALLEST_SCALE = 9.0  # squared residual, in variances, at which a station begins to be doubted
LOST_EDGE = 8.0  # squared residual of a station that shows an edge which lies on none of ours
SCALE = 3.0  # the same, in squared residuals that the believed share stays below
DOUBTFUL = 16.0  # squared residual, in variances, that a clean recording stays below
MOST_FREEDOM = 6  # of a station's residuals: a pose has no more
BATCH = 50  # one of so many stations is dropped at a time
FALSE_ALARM = 1e-3  # of a good recording losing one station
LARGEST_VARIANCE = 1.0  # m^2 or rad^2: more is no answer at all
NEAR = 1e-3  # step length in sigmas that ends a round of annealing


@dataclass(frozen=True, eq=False)
class Consensus:
    """
    A solution from the stations used (ascending), and the squared residual of the rest.

    doubtful: whether most stations are far from it.
    """

    solution: Solution
    used: NDArray[np.intp]
    dropped: dict[int, float]
    doubtful: bool = False


def consensus(problem: Problem, rng: np.random.Generator, subsets: int = 0) -> Consensus:
    """
    Return the solution of the stations that agree.

    subsets: how many random subsets of stations to start from when all together are in doubt.

    Raises DataError when no estimate can be started at all.
    """
    starts = guesses(problem, rng)
    best = refined(problem, next(starts))
    if best.misfit > DOUBTFUL or best.doubtful_share > 1 - BELIEVED_SHARE / 2:
        for other in starts:
            best = min(best, refined(problem, other), key=lambda trial: trial.misfit)
        best = _best_of_subsets(problem, best, subsets, rng)
    return replace(without_outliers(best), doubtful=best.misfit > DOUBTFUL)


def _best_of_subsets(problem: Problem, best: Trial, subsets: int, rng: np.random.Generator
                     ) -> Trial:
    """Return the best trial that a few stations lead to, until one convinces."""
    for start in subset_starts(problem, subsets, rng):
        if best.misfit < CONVINCING:
            break
        best = min(best, refined(problem, start), key=lambda trial: trial.misfit)
    return best


def subset_starts(problem: Problem, count: int, rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the first guess of each of so many random subsets of the stations."""
    n, size = len(problem.poses), max(SUBSET_SIZE, problem.method.minimum)
    for _ in range(count if n > size else 0):
        chosen = np.sort(rng.permutation(n)[:size])
        yield next(guesses(problem.subset(chosen), rng))


@dataclass(frozen=True, eq=False)
class Trial:
    """
    A robustly refined estimate and the squared residuals (n,) of all stations.

    problem: with its observations labelled as they fit. hollow: whether it has no use for
    some observations, and the rest leave a direction free.
    """

    problem: Problem
    estimate: Estimate
    squares: Array
    hollow: bool

    @property
    def spread(self) -> float:
        """Return the squared residual that the believed share of stations stays below."""
        return float(np.quantile(self.squares, BELIEVED_SHARE))

    @property
    def misfit(self) -> float:
        """Return the spread, large where too much was thrown away: less always fits better."""
        return max(self.spread, 2 * DOUBTFUL) if self.hollow else self.spread

    @property
    def doubtful_share(self) -> float:
        """Return the share of stations far from the estimate."""
        return float((self.squares > DOUBTFUL * max(1.0, self.spread)).mean())


def guesses(problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
    """Return estimates to start from, best first, made when they are asked for."""
    return iter(problem.method.guess(problem.observations, problem.poses, problem.config, rng))


def refined(problem: Problem, estimate: Estimate) -> Trial:
    """Return the trial that graduated non-convexity leads to from an estimate."""
    whole, problem = problem, _relabelled(problem, estimate)
    squares = _squares(problem, estimate)
    control, before = float(squares.max()), np.inf
    for _ in range(MAX_ANNEALINGS):
        spread = float(np.quantile(squares, BELIEVED_SHARE))
        scale = max(SMALLEST_SCALE, SCALE * spread)
        if control <= scale and spread > 0.99 * before:
            break
        width = max(control, scale)
        weights = (width / (width + squares)) ** 2
        estimate = least_squares(problem, estimate, Noise(), weights, iterations=4,
                                 converged=NEAR)
        problem = _relabelled(whole, estimate)
        squares, before, control = _squares(problem, estimate), spread, control / 2
    squares = _with_lost_edges(whole, problem, squares)
    return Trial(problem, estimate, squares, _hollow(whole, problem, estimate))


def _hollow(whole: Problem, labelled: Problem, estimate: Estimate) -> bool:
    """Return whether observations were lost in labelling, and with them a direction."""
    if len(labelled.observations.kind) == len(whole.observations.kind):
        return False
    solution = evaluate(labelled, estimate, Noise())
    return float(np.linalg.eigvalsh(solution.covariance)[-1]) > LARGEST_VARIANCE


def _relabelled(problem: Problem, estimate: Estimate) -> Problem:
    """Return the problem with its observations as they fit an estimate, the unfit left out."""
    p = points_in_base(problem, estimate.X)
    labelled = problem.method.relabel(problem.observations, p, estimate.target, problem.config)
    return replace(problem, observations=labelled.select(labelled.kind != UNUSED))


def _squares(problem: Problem, estimate: Estimate) -> Array:
    """Return the mean squared whitened residual (n,) of each station."""
    linear = linearise(problem, estimate)
    r = whitening(problem, linear, Noise())(linear.residuals)
    station, n = problem.observations.station, len(problem.poses)
    count = np.bincount(station, minlength=n)
    return np.bincount(station, r ** 2, minlength=n) / np.maximum(count, 1)


def _with_lost_edges(whole: Problem, labelled: Problem, squares: Array) -> Array:
    """Return squares (n,) in which an edge that a station shows and that is not used counts."""
    names = [i for i, name in enumerate(whole.method.kinds) if name in whole.method.edges]
    shows, uses = (np.zeros(len(squares), dtype=bool) for _ in range(2))
    for problem, has in ((whole, shows), (labelled, uses)):
        obs = problem.observations
        has[obs.station[np.isin(obs.kind, names)]] = True
    return np.where(shows & ~uses, np.maximum(squares, LOST_EDGE), squares)


def without_outliers(trial: Trial) -> Consensus:
    """Return the consensus after dropping, one by one, the stations that do not fit."""
    n, minimum = len(trial.problem.poses), trial.problem.method.minimum
    good = trial.squares <= DOUBTFUL * 4 * max(1.0, trial.spread)
    good[np.argsort(trial.squares, kind='stable')[:minimum]] = True
    used = np.flatnonzero(good)
    dropped = {int(i): float(trial.squares[i]) for i in np.setdiff1d(np.arange(n), used)}
    estimate = trial.estimate
    while True:
        part = trial.problem.subset(used)
        estimate = least_squares(part, estimate, Noise())
        solution = evaluate(part, estimate, Noise())
        mean_square, freedom = _mean_squares(solution)
        scaled = mean_square / _scale(mean_square, freedom)
        probability = chi2_distribution.sf(scaled * freedom, freedom)
        worst = int(np.argmin(probability))
        enough = len(used) > minimum
        if probability[worst] > FALSE_ALARM / n or not enough:
            return Consensus(solution, used, dropped)
        dropped[int(used[worst])] = float(mean_square[worst])
        used = np.delete(used, worst)


def settle(agreed: Consensus, minimum: int) -> Consensus:
    """Return the consensus with all doubts in its solution; what then does not fit is dropped."""
    used, dropped, part = agreed.used, dict(agreed.dropped), agreed.solution.problem
    total, estimate = len(used) + len(dropped), agreed.solution.estimate
    while True:
        solution = settled(part, estimate)
        mean_square, freedom = _mean_squares(solution)
        probability = chi2_distribution.sf(mean_square * freedom, freedom)
        worst = np.argsort(probability)[:max(1, min(len(used) // BATCH, len(used) - minimum))]
        worst = worst[probability[worst] < FALSE_ALARM / total]
        if not len(worst) or len(used) <= minimum:
            return replace(agreed, solution=solution, used=used, dropped=dropped)
        dropped |= {int(used[k]): float(mean_square[k]) for k in worst}
        used = np.delete(used, worst)
        part = part.subset(np.delete(np.arange(len(part.poses)), worst))


def _mean_squares(solution: Solution) -> tuple[Array, NDArray[np.intp]]:
    """
    Return per station the mean squared deleted residual and its degrees of freedom.

    Many points of one profile share one pose and one distortion: they count as a few.
    """
    statistic, count = station_statistic(solution)
    return statistic / np.maximum(count, 1), np.clip(count, 1, MOST_FREEDOM)


def _scale(mean_square: Array, freedom: NDArray[np.intp]) -> float:
    """Return the variance factor that most stations share, 1 where they fit as they should."""
    typical = chi2_distribution.median(freedom) / freedom
    return max(1.0, float(np.median(mean_square / typical)))
