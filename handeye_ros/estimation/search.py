"""
From starts to a robustly refined estimate.

Many starts are iterated independently, and poor ones are given up early, by plain residuals: far
from the solution these say more than whitened ones. One start is then refined robustly: stations
that do not fit lose weight.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    believed,
    BELIEVED_SHARE,
    graduated,
    many_least_squares,
    Rows,
    States,
    System,
)
from handeye_ros.estimation.linalg import covariance_of
from handeye_ros.estimation.linearise import Linear, linearise, Problem
from handeye_ros.estimation.model import Estimate, UNUSED
from handeye_ros.estimation.noise import Noise, Whitening, whitening
from handeye_ros.estimation.solution import columns_of, Solution
import numpy as np

# Limits of squared whitened residuals: of a good estimate, with lumped blocks (4: 2 sigma); of one
# that no other can beat; of a station far from it, over the believed quantile (16: 4 sigma).
# SMALL_SQUARE is added in the loss: as the robot is seldom as inaccurate as configured, fits to a
# fifth of a sigma are distinguished from fits to a half.
CONVINCING, UNRIVALLED, LARGEST_SQUARE, SMALL_SQUARE = 4.0, 0.1, 16.0, 0.03


@dataclass(frozen=True, eq=False)
class Refined:
    """
    A robust estimate and the mean squared whitened residuals (n,) of all stations.

    problem: whole with labelled observations, without those that do not fit. free: whether
    observations were left out and the others leave a direction undetermined.
    """

    whole: Problem
    problem: Problem
    estimate: Estimate
    squares: Array
    free: bool

    @property
    def spread(self) -> float:
        """Return the BELIEVED_SHARE quantile of the squared residuals."""
        return believed(self.squares)

    @property
    def misfit(self) -> float:
        """Return the spread, penalised if the used observations leave a direction undetermined."""
        return max(self.spread, 2 * LARGEST_SQUARE) if self.free else self.spread

    @property
    def loss(self) -> float:
        """
        Return a robust mean of all squares, penalised if a direction is undetermined.

        Its logarithm ranks estimates independently of the noise level above SMALL_SQUARE.
        """
        loss = float(np.log(SMALL_SQUARE + self.squares).mean())
        return max(loss, float(np.log(2 * LARGEST_SQUARE))) if self.free else loss

    @property
    def accepted(self) -> bool:
        """
        Return whether nearly all stations fit, within the errors of an inaccurate robot.

        If stations show several surfaces, a better fit is required: a plane partly on one and
        partly on another near surface also fits within such errors.
        """
        enough = UNRIVALLED if self.whole.ambiguous else CONVINCING
        return self.misfit <= enough and self.far_share <= 0.1

    @property
    def far_share(self) -> float:
        """Return the share of stations far from the estimate or without essential observations."""
        far_off = self.squares > LARGEST_SQUARE * max(1.0, self.spread)
        unused = self.whole.shows_essential & ~self.problem.shows_essential
        return float((far_off | unused).mean())


def refined(problem: Problem, estimate: Estimate) -> Refined:
    """Return the robust estimate that graduated non-convexity reaches from a start."""
    def refit(at: Weighed, weights: Array) -> Weighed:
        before = at.linear.problem
        at = system(before, at.noise).reweighted(at, weights)
        labelled = relabelled(problem, at.linear.estimate, before)
        return at if labelled is before else weighed(labelled, at.linear.estimate, at.noise)

    start = weighed(relabelled(problem, estimate), estimate, Noise())
    at = graduated(start, _mean_squares, refit)
    labelled, estimate, squares = at.linear.problem, at.linear.estimate, _mean_squares(at)
    unused = problem.shows_essential & ~labelled.shows_essential
    squares = np.where(unused, np.maximum(squares, LARGEST_SQUARE), squares)
    fewer = len(labelled.observations) < len(problem.observations)
    free = fewer and np.linalg.eigvalsh(  # a variance of more than (1 m or 1 rad)^2
        evaluate(labelled, estimate, Noise()).covariance)[-1] > 1.0
    return Refined(problem, labelled, estimate, squares, bool(free))


def relabelled(problem: Problem, estimate: Estimate, before: Problem | None = None) -> Problem:
    """
    Return the problem with its observations assigned again, without those that do not fit.

    before: the problem labelled at another estimate; it is returned itself if the labels are the
    same, to keep its cached properties.
    """
    p = problem.points_in_base(estimate.X)
    labelled = problem.method.geometry.relabel(problem.observations, p, estimate.target,
                                               problem.config)
    used = labelled.select(labelled.kind != UNUSED)
    for earlier in (problem, before):
        if earlier and used.same(earlier.observations):
            return earlier
    return replace(problem, observations=used)


def _mean_squares(at: Weighed) -> Array:
    problem, r = at.linear.problem, at.white(at.linear.residuals)
    station, n = problem.observations.station, len(problem.poses)
    count = np.bincount(station, minlength=n)
    return np.bincount(station, r ** 2, minlength=n) / np.maximum(count, 1)


def far(problem: Problem, estimate: Estimate) -> bool:
    """Return whether an estimate is too far from most stations to be refined."""
    labelled = relabelled(problem, estimate)
    station, n = labelled.observations.station, len(problem.poses)
    count = np.bincount(station, minlength=n)
    squares = np.bincount(station, linearise(labelled, estimate).residuals ** 2, minlength=n)
    typical = np.quantile((squares / np.maximum(count, 1))[count > 0], BELIEVED_SHARE)
    return bool(np.sqrt(typical) > max(5e-3, 5 * problem.config.limits.residual))  # m


def best_of(problem: Problem, starts: Sequence[Estimate], more: int = 1) -> list[Estimate]:
    """
    Return the estimates reached from the starts, best first; poor ones are given up early.

    more: factor on the number of starts that continue.
    """
    def linear(states: States) -> tuple[Array, Array]:
        at = linearise(problem, Estimate(*states))
        return at.residuals, at.jacobian[..., problem.columns]

    def retract(states: States, steps: Array) -> States:
        moved = problem.retracted(Estimate(*states), steps)
        return moved.X, moved.target

    states: States = (np.array([start.X for start in starts]),
                      np.array([start.target for start in starts]))
    for iterations, kept in ((2, 6), (3, 3), (10, 2)):  # iterations, and starts kept after them
        kept = max(more * kept, 6 if problem.few else 0)
        states, cost = many_least_squares(linear, retract, states, iterations, 1e-6)
        order = np.argsort(cost, kind='stable')
        # of few stations, many starts lead to the same estimate
        best = (order[different(states[0][order])] if problem.few else order)[:kept]
        states = tuple(values[best] for values in states)
    return [Estimate(X, target) for X, target in zip(*states, strict=True)][:20]


def different(X: Array) -> list[int]:
    """Return which transforms (k, 4, 4) differ from all earlier ones by 1e-3 (m, rad)."""
    kept: list[int] = []
    for i in range(len(X)):
        if not kept or np.abs(X[kept] - X[i]).max(axis=(1, 2)).min() > 1e-3:
            kept.append(i)
    return kept


@dataclass(frozen=True, eq=False)
class Weighed:
    """A problem linearised at an estimate, with a whitening computed on demand."""

    linear: Linear
    noise: Noise

    @cached_property
    def white(self) -> Whitening:
        """Return the map to residuals of unit covariance."""
        return whitening(self.linear, self.noise)


def weighed(problem: Problem, estimate: Estimate, noise: Noise) -> Weighed:
    """Return a problem linearised at an estimate, with its noise."""
    return Weighed(linearise(problem, estimate), noise)


def system(problem: Problem, noise: Noise) -> System[Weighed]:
    """Return the least-squares system of a problem; each station is a block."""
    def rows(at: Weighed) -> Rows:
        return Rows(at.linear.residuals, lambda: at.linear.jacobian[:, problem.columns],
                    lambda: at.white)

    def retracted(at: Weighed, step: Array) -> Weighed:
        return weighed(problem, problem.retracted(at.linear.estimate, step), noise)
    return System(rows, retracted, problem.observations.station)


def fit(problem: Problem, start: Estimate, noise: Noise) -> Estimate:
    """Return the estimate with the least squared whitened residuals."""
    start_at = weighed(problem, start, noise)
    return system(problem, noise).least_squares(start_at).linear.estimate


def evaluate(problem: Problem, estimate: Estimate, noise: Noise) -> Solution:
    """Return the solution at an estimate, with its covariance."""
    linear = linearise(problem, estimate)
    white = whitening(linear, noise)
    r, J = white(linear.residuals), white(linear.jacobian[:, problem.columns])
    return Solution(problem, estimate, noise, linear, r, columns_of(problem, J, 0),
                    covariance_of(J))
