# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From starts to the stations that agree, and their solution.

Many starts are iterated independently, and poor ones are given up early, by plain residuals: far
from the solution these say more than whitened ones. One start is then refined robustly: stations
that do not fit lose weight, (11). The first one that explains nearly all stations is taken.
Otherwise further starts, and those of random subsets, compete by how well all stations are
explained. Then stations are dropped one by one, worst first, (12): with the errors that stations
share as noise of each, and again with all nuisance parameters.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain, islice

from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.covariance import with_possibly_wrong_station
from handeye_ros.estimation.least_squares import (
    drop_outliers,
    graduated,
    GROSS_SQUARE,
    many_least_squares,
    Rows,
    shared_variance_factor,
    States,
    System,
    typical_square,
)
from handeye_ros.estimation.noise import BLOCKS_AS_NOISE, Noise, Whitening, whitening
from handeye_ros.estimation.problem import Estimate, Linear, linearise, Problem, UNUSED
from handeye_ros.estimation.solve import (
    estimated_of_part,
    LAST_STEPS,
    map_solution,
    reported_at,
    Solution,
    solution_of_many,
)
import numpy as np
from numpy.typing import NDArray

SUBSET_COUNT = 40  # of six stations: if a third are wrong, one subset has no wrong one with p 0.97
# Limits of squared whitened residuals: of a good estimate, with blocks as noise (4: 2 sigma); of
# one that no other can beat; of a station far from it, over the typical one (16: 4 sigma).
# SMALL_SQUARE is added in the loss: as the robot is seldom as inaccurate as configured, fits to a
# fifth of a sigma are distinguished from fits to a half.
CONVINCING_SQUARE, UNRIVALLED_SQUARE, LARGEST_SQUARE, SMALL_SQUARE = 4.0, 0.1, 16.0, 0.03


def robust_solution(problem: Problem, rng: np.random.Generator, subsets: bool = False,
                    start: Estimate | None = None) -> Solution:
    """
    Return the solution of the stations that agree, from several starts.

    subsets: also start from random subsets of the stations if all together do not fit. start: the
    only start to use, if given.
    """
    if start is not None:
        return without_outliers(refined_robustly(problem, start))
    starts = chain(problem.target.starts(problem, rng),
                   subset_starts(problem, SUBSET_COUNT * subsets, rng))
    best = refined_robustly(problem, next(starts))
    while not is_convincing(best) and (other := next(starts, None)):
        best = min(best, refined_robustly(problem, other), key=loss)
    return without_outliers(best)


def quick_solution(problem: Problem) -> Solution | None:
    """Return the solution from the first two starts, None if neither fits."""
    try:
        for start in islice(problem.target.starts(problem, np.random.default_rng(0)), 2):
            trial = refined_robustly(problem, start)
            if typical_square(station_squares(trial)) < LARGEST_SQUARE:
                return without_outliers(trial)
    except (HandeyeError, np.linalg.LinAlgError):
        pass
    return None


def without_outliers(robust: Solution) -> Solution:
    """Return the solution after dropping stations that do not fit a robust one, one by one."""
    problem = robust.full_problem
    # least squares could move to a fit between the target and another surface
    limit = LARGEST_SQUARE if problem.ambiguous else GROSS_SQUARE
    squares = station_squares(robust)
    good = squares <= limit * max(1.0, typical_square(squares))
    good[np.argsort(squares, kind='stable')[:problem.target.min_samples]] = True
    gross = {int(i): float(squares[i]) for i in np.flatnonzero(~good)}

    def fitted(before: Solution | None, used: NDArray[np.intp]) -> Solution:
        kept = robust.problem.subset(used)
        start = (before or robust).estimate
        return Solution.of_linear(least_squares_fit(kept, start), BLOCKS_AS_NOISE)

    def left_out_squares(solution: Solution) -> tuple[Array, NDArray[np.intp]]:
        squares, freedom = solution.left_out_squares()
        return squares / shared_variance_factor(squares, freedom), freedom

    solution, used, dropped = drop_outliers(np.flatnonzero(good), len(problem.poses),
                                            problem.target.min_samples, fitted, left_out_squares)
    return replace(solution, full_problem=problem, used=used, dropped_squares=gross | dropped)


def with_systematic_errors(agreed: Solution) -> Solution:
    """
    Return the solution with all nuisance blocks, from one without; further outliers dropped.

    With few stations, each may be wrong without being detected; the reported covariance includes
    this.
    """
    problem, many = agreed.full_problem, 2 * agreed.full_problem.many
    # of many a part tells linearisation, noise, and scales for the report, by which outliers drop
    part = (estimated_of_part(agreed.problem, agreed.estimate, Noise())
            if len(agreed.used) >= many else None)

    def fitted(before: Solution | None, used: NDArray[np.intp]) -> Solution:
        nonlocal part
        kept = agreed.problem.subset(np.flatnonzero(np.isin(agreed.used, used)))
        if part and len(used) >= many:
            part = (*part[:2], before.noise) if before else part
            return reported_at(part[0], part[2], kept, 1 if before else LAST_STEPS)
        return with_possibly_wrong_station(map_solution(kept, agreed.estimate, Noise()),
                                           len(problem.poses) - len(used))

    solution, used, dropped = drop_outliers(
        agreed.used, len(problem.poses), problem.target.min_samples, fitted,
        lambda fit: fit.conservative.left_out_squares(), lambda fit: fit.surely_wrong)
    if part and len(used) >= many:
        solution = solution_of_many(*part, solution)
    return replace(solution, full_problem=problem, used=used,
                   dropped_squares={**agreed.dropped_squares, **dropped})


def refined_robustly(problem: Problem, start: Estimate) -> Solution:
    """
    Return the solution that graduated non-convexity reaches from a start, with labels of its own.

    The weights come from residuals with the labels that a fit has, so observations are assigned
    again only after its steps, and the next weights come from the new labels. What the poses
    depend on is found, too.
    """
    def refit(before: Linear, weights: Array) -> Linear:
        # the priors of the pose values keep their weight
        after = _system(before.problem).few_weighted_steps(before, np.append(weights, 1.0))
        every = replace(after.problem, observations=problem.observations)
        labelled = reassigned(every, after.estimate, after.problem)
        return after if labelled is after.problem else linearise(labelled, after.estimate)
    fit = graduated(linearise(reassigned(problem, start), start), mean_squares, refit)
    return replace(Solution.of_linear(fit, BLOCKS_AS_NOISE),
                   full_problem=problem.with_pose_values(fit.problem.pose_values))


def station_squares(solution: Solution) -> Array:
    """Return the mean squares (n,) of stations; large where no essential observation is used."""
    squares = mean_squares(solution.linear)
    unused = solution.full_problem.shows_essential & ~solution.problem.shows_essential
    return np.where(unused, np.maximum(squares, LARGEST_SQUARE), squares)


def loss(solution: Solution) -> float:
    """
    Return a robust mean of the squares of all stations.

    Its logarithm ranks estimates independently of the noise level above SMALL_SQUARE.
    """
    return float(np.log(SMALL_SQUARE + station_squares(solution)).mean())


def is_convincing(solution: Solution) -> bool:
    """
    Return whether nearly all stations fit, within the errors of an inaccurate robot.

    If stations show several surfaces, a better fit is required: a plane partly on one and partly
    on another near surface also fits within such errors.
    """
    squares = station_squares(solution)
    typical = typical_square(squares)
    far = squares > LARGEST_SQUARE * max(1.0, typical)
    unused = solution.full_problem.shows_essential & ~solution.problem.shows_essential
    enough = UNRIVALLED_SQUARE if solution.full_problem.ambiguous else CONVINCING_SQUARE
    return typical <= enough and bool((far | unused).mean() <= 0.1)


def subset_starts(problem: Problem, count: int, rng: np.random.Generator) -> Iterator[Estimate]:
    """Yield the first start of each of count random subsets of the stations."""
    n, size = len(problem.poses), max(6, problem.target.min_samples)
    for _ in range(count if n > size else 0):
        part = problem.subset(np.sort(rng.permutation(n)[:size]))
        yield next(part.target.starts(part, rng))


def reassigned(problem: Problem, estimate: Estimate, before: Problem | None = None) -> Problem:
    """
    Return the problem with its observations assigned again, without those that do not fit.

    before: the problem labelled at another estimate; it is returned itself if the labels are the
    same, to keep its cached properties.
    """
    p = problem.points_in_base(estimate.X)
    labelled = problem.target.reassign(problem.observations, p, estimate.state, problem.config)
    used = labelled.select(labelled.kind != UNUSED)
    for earlier in (before, problem):
        if earlier and used.same(earlier.observations):
            return earlier
    return replace(problem, observations=used)


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
    # iterations, and starts kept after them: two tell the poor ones, 15 in all nearly converge
    for iterations, kept in ((2, 6), (3, 3), (10, 2)):
        kept = max(more * kept, 6 if problem.needs_more_starts else 0)
        states, cost = many_least_squares(linear, retract, states, iterations)
        order = np.argsort(cost, kind='stable')
        # of few stations, many starts lead to the same estimate
        best = (order[distinct(states[0][order])] if problem.needs_more_starts else order)[:kept]
        states = tuple(values[best] for values in states)
    return [Estimate(X, state) for X, state in zip(*states, strict=True)][:20]


def distinct(X: Array) -> list[int]:
    """Return which transforms (k, 4, 4) differ from all earlier ones by 1e-3 (m, rad)."""
    kept: list[int] = []
    for i in range(len(X)):
        if not kept or np.abs(X[kept] - X[i]).max(axis=(1, 2)).min() > 1e-3:
            kept.append(i)
    return kept


@lru_cache(maxsize=4)  # residuals at an estimate, then the step from there
def whitening_at(linear: Linear, noise: Noise = BLOCKS_AS_NOISE) -> Whitening:
    """Return the map that whitens the residuals of a problem."""
    return whitening(linear, noise)


def mean_squares(linear: Linear) -> Array:
    """Return the mean squared whitened residuals (n,) of the stations, blocks as noise."""
    station, n = linear.problem.observations.station, len(linear.problem.poses)
    squares = np.bincount(station, whitening_at(linear)(linear.residuals) ** 2, minlength=n)
    return np.asarray(squares / np.maximum(np.bincount(station, minlength=n), 1))


def _system(problem: Problem, noise: Noise = BLOCKS_AS_NOISE) -> System[Linear]:
    """
    Return the least-squares system of a problem, with the pose values among its unknowns.

    Each station is an item, and the priors of the pose values are the last.
    """
    values = np.flatnonzero(problem.pose_stds)  # the unknown ones
    stds, k, u = problem.pose_stds[values], len(values), len(problem.free_columns)

    def rows(linear: Linear) -> Rows:
        m = len(linear.residuals)

        def jacobian() -> Array:
            J = np.zeros((m + k, u + k))
            J[:m, :u] = linear.jacobian[:, problem.free_columns]
            J[:m, u:] = linear.wrt_twists(linear.problem.pose_twists[:, :, values])
            J[m:, u:] = np.diag(1 / stds)
            return J

        def whiten(rows: Array) -> Array:
            return np.concatenate([whitening_at(linear, noise)(rows[:m]), rows[m:]])
        of_priors = linear.problem.pose_values[values] / stds
        return Rows(np.append(linear.residuals, of_priors), jacobian, lambda: whiten)

    def retracted(linear: Linear, step: Array) -> Linear:
        after = linear.problem.pose_values.copy()
        after[values] += step[u:]
        moved = linear.problem.with_pose_values(after)
        return linearise(moved, moved.retracted(linear.estimate, step[:u]))
    return System(rows, retracted, np.append(
        problem.observations.station, np.full(k, len(problem.poses))))


def least_squares_fit(problem: Problem, start: Estimate, noise: Noise = BLOCKS_AS_NOISE) -> Linear:
    """Return the fit with the least squared whitened residuals."""
    return _system(problem, noise).least_squares(linearise(problem, start))
