"""
Many starts at once: each goes down its own way, the poor ones are given up early.

Plain residuals decide: far from the solution they say more than whitened ones.
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import many_least_squares, States
from handeye_ros.estimation.method import Estimate
from handeye_ros.estimation.problem import linearise, Problem
from handeye_ros.estimation.solve import move
import numpy as np

COMPETITION = ((2, 6), (3, 3), (10, 2))  # iterations, and how many starts go on after them
SOME_START = 1e-6  # step of the residuals that ends the way of a start among others (m)
FEW_STATIONS, MORE_STARTS = 12, 6  # with few stations there may be several answers


def best_of(problem: Problem, starts: Sequence[Estimate], more: int = 1) -> list[Estimate]:
    """
    Return the estimates that the starts lead to, best first, poor ones given up early.

    more: times as many go on.
    """
    def linear(states: States) -> tuple[Array, Array]:
        there = linearise(problem, Estimate(*states))
        return there.residuals, there.jacobian[..., problem.columns]

    def retract(states: States, steps: Array) -> States:
        moved = move(problem, Estimate(*states), steps)
        return moved.X, moved.target

    few = len(problem.poses) <= FEW_STATIONS
    states: States = (np.array([start.X for start in starts]),
                      np.array([start.target for start in starts]))
    for iterations, kept in COMPETITION:
        kept = more * (max(kept, MORE_STARTS) if few else kept)
        states, cost = many_least_squares(linear, retract, states, iterations, SOME_START)
        best = np.argsort(cost, kind='stable')[:kept]
        states = tuple(values[best] for values in states)
    return [Estimate(X, target) for X, target in zip(*states, strict=True)]
