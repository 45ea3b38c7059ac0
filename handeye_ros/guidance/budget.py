"""
What the uncertainty of mapped points comes from, and what one more sample would make of it.

With the nuisance parameters n and unknowns u of the conservative posterior, the part of a block b
in the covariance of u is C_ub C_bb^-1 C_bu: what would go if b were known.
"""
from __future__ import annotations

from dataclasses import dataclass, fields, replace
import math

from handeye_ros.data import Array
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.model import Observations
from handeye_ros.estimation.posterior import evaluated
from handeye_ros.estimation.solution import Solution
from handeye_ros.guidance.score import Mapping
import numpy as np

# Beginnings of the names of blocks: what they are, and the setting of their prior.
CAUSES = (
    ('robot_', "the robot's accuracy as configured", 'noise.robot_smooth'),
    ('scale', "the scale of the robot's lengths as configured", 'noise.robot_scale'),
    ('distortion', "the sensor's linearity as configured", 'noise.distortion'),
    ('flatness', "the flatness of the target's faces as configured", 'noise.flatness'),
    ('setback', 'how far faces end before their edges', 'target.setback_std'),
    ('incidence', 'how far faces end before their edges', 'target.setback_std'),
    ('shape', 'the rounding of the edges', 'target.setback_std'),
)
SMALLEST = 0.5  # of the variance: a cause of less is not worth telling


@dataclass(frozen=True)
class Cause:
    """The largest cause: in words, its key, and its part of the 1 sigma of mapped points (m)."""

    text: str
    key: str
    std: float


def largest_cause(solution: Solution, known: Mapping) -> Cause | None:
    """Return what most of the reported uncertainty of mapped points comes from, None if noise."""
    source = solution.conservative or solution
    C, first = source.covariance, source.unknowns
    rows: dict[tuple[str, str], list[int]] = {}
    for block in source.blocks:
        for name, text, key in CAUSES:
            if block.name.startswith(name):
                rows.setdefault((text, key), []).extend(range(first, first + block.count))
        first += block.count
    total = float(known.variance(C[:6, :6]))
    parts = {cause: float(known.variance(_explained(C, np.array(at)))) / total
             for cause, at in rows.items()}
    if not parts or max(parts.values()) < SMALLEST:
        return None
    (text, key), share = max(parts.items(), key=lambda item: item[1])
    return Cause(text, key, share ** 0.5 * known.std(solution.reported[:6, :6]))


def _explained(C: Array, at: Array) -> Array:
    across = C[:6][:, at]
    return np.asarray(across @ np.linalg.pinv(C[np.ix_(at, at)], hermitian=True) @ across.T)


def with_sample(solution: Solution, known: Mapping, one: Problem) -> float:
    """
    Return the reported 1 sigma of mapped points (m) that one more sample would lead to.

    one: the problem of the sample alone. All nuisance parameters are shared with the others.
    """
    problem, noise = solution.problem, (solution.conservative or solution).noise
    now, then = (float(known.variance(evaluated(p, solution.estimate, noise).covariance[:6, :6]))
                 for p in (problem, _extended(problem, one)))
    return known.std(solution.reported[:6, :6]) * math.sqrt(min(then / now, 1.0))


def _extended(problem: Problem, one: Problem) -> Problem:
    """Return a problem with the stations of another after its own."""
    more = replace(one.observations, station=one.observations.station + len(problem.poses))
    both = Observations(*(np.concatenate([getattr(problem.observations, item.name),
                                          getattr(more, item.name)])
                          for item in fields(Observations)))
    return replace(problem, poses=np.concatenate([problem.poses, one.poses]), observations=both)
