# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From starts to the stations that agree, and their solution.

Many starts are iterated independently, and poor ones are given up early, by plain residuals: far
from the solution these say more than whitened ones. One start is then refined robustly: stations
that do not fit lose weight, (11). The first one that explains nearly all stations is taken.
Otherwise further starts, and those of random subsets, compete by how well all stations are
explained. Then stations far from the fit are dropped at once, and others a few at a time, worst
first, (12): with the errors that stations share as noise of each (`without_outliers`), and again
with all nuisance parameters (`refined_solution`).

A *robust* fit is that of `robust_fit`: all stations, the outliers among them, linearised
there with the kinds as then assigned.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, islice

from handeye_ros.config import Config
from handeye_ros.data import Array, SEED
from handeye_ros.estimation.contamination import with_possibly_wrong_station
from handeye_ros.estimation.least_squares import (
    Evaluation,
    LeastSquares,
    many_least_squares,
    means_by,
    States,
)
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, NoiseModel, whitening
from handeye_ros.estimation.outliers import (
    are_near,
    drop_outliers,
    graduated_fit,
    GROSS_SQUARE,
    over_shared_factor,
    typical_square,
)
from handeye_ros.estimation.posterior import Posterior
from handeye_ros.estimation.problem import (
    Estimate,
    has_unused_edges,
    Linearisation,
    linearise,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.solution import converged_fit, posteriors_of_fit, Solution
import numpy as np
from numpy.typing import NDArray

SUBSET_COUNT = 40  # of six stations: if a third are wrong, one subset has no wrong one with p 0.97
# squared whitened residuals, blocks as noise
CONVINCING_SQUARE = 4.0  # most of a good estimate (2 sigma)
UNRIVALLED_SQUARE = 0.1  # most of one that no other can beat
# 4 sigma: a station from here on does not fit. Over the typical square in is_convincing, and in
# without_outliers where several surfaces are in view; of a station without edges its least square;
# quick_solution gives up a start whose typical square is as large
MISFIT_SQUARE = 16.0
# added in mean_log_square: as the robot is seldom as inaccurate as configured, fits to a fifth of
# a sigma are distinguished from fits to a half
SMALL_SQUARE = 0.03


def robust_solution(problem: Problem, rng: np.random.Generator, subsets: bool = False,
                    start: Estimate | None = None) -> Solution:
    """
    Return the solution of the stations that agree, from several starts.

    subsets: also start from random subsets of the stations if all together do not fit: slow, and
    left out where a poor fit answers the question too. start: the only start to use, if given.
    Stations that are all alike have a solution too, with free directions.
    """
    starts = iter([start]) if start is not None else chain(
        problem.target.starts(problem, rng),
        subset_starts(problem, SUBSET_COUNT if subsets else 0, rng))
    best = robust_fit(problem, next(starts))
    while not is_convincing(problem, best) and (following := next(starts, None)):
        best = min(best, robust_fit(problem, following),
                   key=partial(mean_log_square, problem))
    return without_outliers(problem, best)


def quick_solution(problem: Problem) -> Solution | None:
    """Return the solution from the first two starts, None if neither fits or can be computed."""
    for start in islice(problem.target.starts(problem, np.random.default_rng(SEED)), 2):
        with suppress(np.linalg.LinAlgError):  # from this start
            robust = robust_fit(problem, start)
            if typical_square(station_squares(problem, robust)) < MISFIT_SQUARE:
                return without_outliers(problem, robust)
    return None


def without_outliers(problem: Problem, robust: Linearisation) -> Solution:
    """
    Return the least squares of the stations that agree with a robust fit, and with each other.

    First all far from the robust fit are dropped at once, then, a few at a time, worst first
    (worst_outliers), those that the others do not predict.
    """
    # least squares could move to a fit between the target and another surface
    limit = MISFIT_SQUARE if problem.shows_several else GROSS_SQUARE
    squares, fewest = station_squares(problem, robust), problem.target.min_samples
    near = are_near(squares, limit, fewest)
    far = {int(station): float(squares[station]) for station in np.flatnonzero(~near)}
    full_problem = problem.with_pose_parameters(robust.problem.pose_parameters)

    def fitted(previous: Solution | None, used: NDArray[np.intp], dropped: dict[int, float]
               ) -> Solution:
        linear = least_squares_fit(robust.problem.subset(used), (previous or robust).estimate)
        posterior = Posterior.of_linear(linear, BLOCKS_AS_NOISE, ())
        return Solution(posterior, posterior, full_problem, used, far | dropped)

    return drop_outliers(
        np.flatnonzero(near), len(problem.poses), fewest, fitted,
        lambda solution: over_shared_factor(*solution.posterior.left_out_squares()))


def refined_solution(agreed: Solution, config: Config | None = None) -> Solution:
    """
    Return the solution with all nuisance blocks, from one without; further outliers dropped.

    agreed: whose stations are used, with kinds as assigned there and from its estimate;
    config: other settings than those of its problem.
    With few stations, each may be wrong without being detected; the reported covariance includes
    this. With many, a part of them tells linearisation, noise and taus.
    """
    full_problem, problem = (replace(each, config=config or each.config)
                             for each in (agreed.full_problem, agreed.problem))
    part = converged_fit(problem, agreed.estimate) if problem.is_large else None

    def fitted(previous: Solution | None, used: NDArray[np.intp], dropped: dict[int, float]
               ) -> Solution:
        of_used = problem.subset(np.flatnonzero(np.isin(agreed.used_stations, used)))
        posteriors = posteriors_of_fit(of_used, part or converged_fit(of_used, agreed.estimate),
                                       previous.report_posterior if part and previous else None)
        solution = Solution(*posteriors, full_problem, used, {**agreed.dropped_squares, **dropped})
        return solution if part else with_possibly_wrong_station(solution)

    return drop_outliers(
        agreed.used_stations, len(full_problem.poses), problem.target.min_samples, fitted,
        lambda solution: solution.report_posterior.left_out_squares(),
        lambda solution: solution.surely_wrong_indices)


def robust_fit(problem: Problem, start: Estimate) -> Linearisation:
    """
    Return the fit that graduated non-convexity reaches from a start, (11).

    After each round the observations are assigned again to the parts of the target (`reassigned`),
    and the next weights come from these. The pose parameters are unknowns, too.
    """
    def refit(linear: Linearisation, weights: Array) -> Linearisation:
        # the priors of the pose parameters, the last item, keep their weight
        moved = _least_squares_of(linear.problem).few_weighted_steps(
            linear, np.append(weights, 1.0))
        complete = replace(moved.problem, observations=problem.observations)
        assigned = reassigned(complete, moved.estimate, moved.problem)
        return moved if assigned is moved.problem else linearise(assigned, moved.estimate)
    return graduated_fit(linearise(reassigned(problem, start), start), mean_squares, refit)


def station_squares(problem: Problem, robust: Linearisation) -> Array:
    """Return the mean squares (n,) of stations; of those without edges, MISFIT_SQUARE or more."""
    least = np.where(has_unused_edges(problem, robust.problem), MISFIT_SQUARE, 0.0)
    return np.maximum(mean_squares(robust), least)


def mean_log_square(problem: Problem, robust: Linearisation) -> float:
    """
    Return the mean over all stations of ln(SMALL_SQUARE + q), the least for the best estimate.

    By the logarithm, the order of estimates does not depend on the noise level above SMALL_SQUARE.
    """
    return float(np.log(SMALL_SQUARE + station_squares(problem, robust)).mean())


def is_convincing(problem: Problem, robust: Linearisation) -> bool:
    """
    Return whether nearly all stations fit, within the errors of an inaccurate robot.

    If stations show several surfaces, a better fit is required: a plane partly on one and partly
    on another near surface also fits within such errors.
    """
    squares = station_squares(problem, robust)
    misfits = ~are_near(squares, MISFIT_SQUARE) | has_unused_edges(problem, robust.problem)
    largest = UNRIVALLED_SQUARE if problem.shows_several else CONVINCING_SQUARE
    return typical_square(squares) <= largest and bool(misfits.mean() <= 0.1)


def subset_starts(problem: Problem, count: int, rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the first start of each of count random subsets of the stations."""
    n, size = len(problem.poses), max(6, problem.target.min_samples)
    for _ in range(count if n > size else 0):
        part = problem.subset(np.sort(rng.permutation(n)[:size]))
        yield next(part.target.starts(part, rng))


def reassigned(problem: Problem, estimate: Estimate, previous: Problem | None = None) -> Problem:
    """
    Return the problem with its observations assigned again, without those that do not fit.

    previous: the problem as it is assigned at another estimate, itself by default. It is returned
    if the observations stay the same, to keep its cached properties.
    """
    p = problem.points_in_base(estimate.X)
    assigned = problem.target.reassign(problem.observations, p, estimate.state, problem.config)
    used = assigned.select(assigned.kind != UNUSED)
    unchanged = previous or problem
    return unchanged if used.same(unchanged.observations) else replace(problem, observations=used)


def shortlisted(problem: Problem, starts: Sequence[Estimate], more: int = 1) -> list[Estimate]:
    """
    Return the estimates reached from the starts, best first; poor ones are given up early.

    more: factor on the number of starts that continue; 20 are returned at most.
    """
    def linear(states: States) -> tuple[Array, Array]:
        fit = linearise(problem, Estimate(*states))
        return fit.residuals, fit.jacobian[..., problem.free_columns]

    def retract(states: States, steps: Array) -> States:
        moved = problem.retracted(Estimate(*states), steps)
        return moved.X, moved.state

    states: States = (np.array([start.X for start in starts]),
                      np.array([start.state for start in starts]))
    # iterations, and starts that continue: two tell the poor ones, 15 in all nearly converge
    for iterations, count in ((2, 6), (3, 3), (10, 2)):
        states, cost = many_least_squares(linear, retract, states, iterations)
        order, count = np.argsort(cost, kind='stable'), more * count
        if problem.needs_more_starts:  # of few stations, many starts lead to the same estimate
            order, count = order[distinct(states[0][order])], max(count, 6)
        states = tuple(values[order[:count]] for values in states)
    return [Estimate(X, state) for X, state in zip(*states, strict=True)][:20]


def distinct(X: Array) -> list[int]:
    """Return which transforms (k, 4, 4) differ from all earlier ones by 1e-3 (m, rad)."""
    indices: list[int] = []
    for i in range(len(X)):
        if not indices or np.abs(X[indices] - X[i]).max(axis=(1, 2)).min() > 1e-3:
            indices.append(i)
    return indices


def mean_squares(linear: Linearisation) -> Array:
    """Return the mean squared whitened residuals (n,) of the stations, blocks as noise."""
    station, n = linear.problem.observations.station, len(linear.problem.poses)
    whitened = whitening(linear, BLOCKS_AS_NOISE)(linear.residuals)
    return means_by(station, whitened ** 2, n)


def _least_squares_of(problem: Problem, noise: NoiseModel = BLOCKS_AS_NOISE
                      ) -> LeastSquares[Linearisation]:
    """
    Return the least-squares system of a problem, with the pose parameters among its unknowns.

    Each station is an item; the priors of the k unknown pose parameters are the last item.
    """
    unknown = np.flatnonzero(problem.pose_parameter_stds)
    stds, k, u = problem.pose_parameter_stds[unknown], len(unknown), len(problem.free_columns)

    def evaluate(linear: Linearisation) -> Evaluation:
        m = len(linear.residuals)

        def jacobian() -> Array:
            J = np.zeros((m + k, u + k))
            J[:m, :u] = linear.jacobian[:, problem.free_columns]
            J[:m, u:] = linear.wrt_twists(linear.problem.pose_twists[:, :, unknown])
            J[m:, u:] = np.diag(1 / stds)
            return J

        def whiten(values: Array) -> Array:
            return np.concatenate([whitening(linear, noise)(values[:m]), values[m:]])
        prior_residuals = linear.problem.pose_parameters[unknown] / stds
        return Evaluation(np.append(linear.residuals, prior_residuals), jacobian, lambda: whiten)

    def retract(linear: Linearisation, step: Array) -> Linearisation:
        pose_parameters = linear.problem.pose_parameters.copy()
        pose_parameters[unknown] += step[u:]
        moved = linear.problem.with_pose_parameters(pose_parameters)
        return linearise(moved, moved.retracted(linear.estimate, step[:u]))
    item = np.append(problem.observations.station, np.full(k, len(problem.poses)))
    return LeastSquares(evaluate, retract, item)


def least_squares_fit(problem: Problem, start: Estimate, noise: NoiseModel = BLOCKS_AS_NOISE
                      ) -> Linearisation:
    """Return the fit with the least squared whitened residuals."""
    return _least_squares_of(problem, noise).minimised(linearise(problem, start))
