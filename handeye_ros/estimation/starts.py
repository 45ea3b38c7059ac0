"""
Many starts at once: each goes down its own way, the poor ones are given up early.

Levenberg-Marquardt as in least_squares, on plain residuals: far from the solution they say more
than whitened ones.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import (
    damped_steps,
    DAMPING_FACTOR,
    FIRST_DAMPING,
    MAX_DAMPINGS,
    ROUNDING,
    SMALLEST_DAMPING,
    STANDSTILL,
)
from handeye_ros.estimation.method import Estimate
from handeye_ros.estimation.problem import linearise, Problem
from handeye_ros.estimation.solve import move
import numpy as np
from numpy.typing import NDArray

COMPETITION = ((2, 6), (3, 3), (10, 2))  # iterations, and how many starts go on after them
SOME_START = 1e-6  # step of the residuals that ends the way of a start among others (m)
FEW_STATIONS, MORE_STARTS = 12, 6  # with few stations there may be several answers


def best_of(problem: Problem, starts: Sequence[Estimate], more: int = 1) -> list[Estimate]:
    """
    Return the estimates that the starts lead to, best first, poor ones given up early.

    more: times as many go on.
    """
    few = len(problem.poses) <= FEW_STATIONS
    field = _Field.of(problem, Estimate(np.array([start.X for start in starts]),
                                        np.array([start.target for start in starts])))
    for iterations, kept in COMPETITION:
        kept = more * (max(kept, MORE_STARTS) if few else kept)
        field = _descended(problem, field, iterations)
        field = field.select(np.argsort(field.cost, kind='stable')[:kept])
    return [Estimate(X, target) for X, target in zip(field.at.X, field.at.target, strict=True)]


@dataclass(frozen=True, eq=False)
class _Field:
    """Estimates, k in one, with their residuals (k, m) and the derivatives (k, m, u) of these."""

    at: Estimate
    r: Array
    J: Array

    @classmethod
    def of(cls, problem: Problem, at: Estimate) -> _Field:
        linear = linearise(problem, at)
        return cls(at, linear.residuals, linear.jacobian[..., problem.columns])

    @property
    def cost(self) -> Array:
        """Return the sums of squares (k,)."""
        return np.asarray(np.einsum('km,km->k', self.r, self.r))

    def select(self, chosen: NDArray[np.intp]) -> _Field:
        """Return some of them."""
        return _Field(Estimate(self.at.X[chosen], self.at.target[chosen]), self.r[chosen],
                      self.J[chosen])

    def with_parts(self, chosen: NDArray[np.intp], part: _Field) -> _Field:
        """Return all of them, those chosen replaced by the ones of a part."""
        copies = [values.copy() for values in (self.at.X, self.at.target, self.r, self.J)]
        for values, new in zip(copies, (part.at.X, part.at.target, part.r, part.J), strict=True):
            values[chosen] = new
        X, target, r, J = copies
        return _Field(Estimate(X, target), r, J)


def _descended(problem: Problem, field: _Field, iterations: int) -> _Field:
    """Return the estimates after so many steps of each, fewer where they come to an end."""
    count = len(field.r)
    damping, taken = np.full(count, FIRST_DAMPING), np.zeros(count, dtype=int)
    refused, going = np.zeros(count, dtype=int), np.arange(count)
    while len(going):
        now = field.select(going)
        step = damped_steps(now.J, now.r, damping[going])
        moved = _Field.of(problem, move(problem, now.at, step))
        before, after = now.cost, moved.cost
        better = after <= before * (1 + ROUNDING)
        field = field.with_parts(going[better], moved.select(np.flatnonzero(better)))
        damping[going] *= np.where(better, DAMPING_FACTOR ** -2, DAMPING_FACTOR)
        damping = np.maximum(damping, SMALLEST_DAMPING)
        taken[going] += better
        refused[going] = np.where(better, 0, refused[going] + 1)
        length = np.linalg.norm((now.J @ step[..., None])[..., 0], axis=1)
        done = better & ((length < SOME_START * (1 + before ** 0.5))
                         | (after >= before * (1 - STANDSTILL)))
        going = going[~done & (taken[going] < iterations) & (refused[going] < MAX_DAMPINGS)]
    return field
