"""
Many starts at once: each goes down its own way, the poor ones are given up early.

Plain residuals decide: far from the solution they say more than whitened ones.
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.data import Array
from handeye_ros.estimation.linearise import linearise, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.solution import retracted
from handeye_ros.estimation.solver import many_least_squares, States
import numpy as np

COMPETITION = ((2, 6), (3, 3), (10, 2))  # iterations, and how many starts go on after them
MOST = 20  # answers that are worth looking at
SOME_START = 1e-6  # step of the residuals that ends the way of a start among others (m)
FEW_STATIONS, MORE_STARTS = 12, 6  # with few stations there may be several answers
SAME = 1e-3  # m or rad: starts nearer to each other than this lead to the same answer


def best_of(problem: Problem, starts: Sequence[Estimate], more: int = 1) -> list[Estimate]:
    """
    Return the estimates that the starts lead to, best first, poor ones given up early.

    more: times as many go on.
    """
    def linear(states: States) -> tuple[Array, Array]:
        there = linearise(problem, Estimate(*states))
        return there.residuals, there.jacobian[..., problem.columns]

    def retract(states: States, steps: Array) -> States:
        moved = retracted(problem, Estimate(*states), steps)
        return moved.X, moved.target

    few = len(problem.poses) <= FEW_STATIONS
    states: States = (np.array([start.X for start in starts]),
                      np.array([start.target for start in starts]))
    for iterations, kept in COMPETITION:
        kept = max(more * kept, MORE_STARTS if few else 0)
        states, cost = many_least_squares(linear, retract, states, iterations, SOME_START)
        order = np.argsort(cost, kind='stable')
        # many lead to the same where there are few stations
        best = (order[different(states[0][order])] if few else order)[:kept]
        states = tuple(values[best] for values in states)
    return [Estimate(X, target) for X, target in zip(*states, strict=True)][:MOST]


def different(X: Array) -> list[int]:
    """Return which transforms (k, 4, 4) are next to no earlier one."""
    kept: list[int] = []
    for i in range(len(X)):
        if not kept or np.abs(X[kept] - X[i]).max(axis=(1, 2)).min() > SAME:
            kept.append(i)
    return kept
