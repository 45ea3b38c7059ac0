"""At which angle the laser line crosses an edge, once the edge is roughly known."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, Sample
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.solution import Solution
from handeye_ros.results.outcome import mounted
import numpy as np

TOO_FAR = 5e-3  # m from every known edge: it is another one, or the fit is still wrong


def flat_crossing(sample: Sample, solution: Solution, config: Config) -> str:
    """Return that the laser crosses an edge at too small an angle to be used, if it does."""
    edges = [f.point for f in sample.features if isinstance(f, EdgePoint)]
    kinds = solution.problem.method.essential
    if not edges or not kinds or not _one_condition_each(solution.problem):
        return ''
    angles = [_crossing([sample], np.array(edges), solution, kind, config) for kind in kinds]
    distance, angle, kind = min(zip(*zip(*angles, strict=True), kinds, strict=True))
    if distance > TOO_FAR or angle >= config.sampling.min_crossing_angle:
        return ''
    return (f'the laser crosses {kind} at {np.degrees(angle):.0f} degrees, less than '
            f'sampling.min_crossing_angle ({np.degrees(config.sampling.min_crossing_angle):.0f} '
            'degrees), so its edge point cannot count: turn the tool about the range axis')


def _one_condition_each(problem: Problem) -> bool:
    """Tell whether an edge point fulfils one condition: its distance from an edge in a face."""
    of_edges = [problem.method.kinds.index(name) for name in problem.method.essential]
    observations = problem.observations
    rows = np.isin(observations.kind, of_edges)
    points = np.column_stack([observations.station, observations.source])[rows]
    return len(np.unique(points, axis=0)) == len(points)


def _crossing(samples: Sequence[Sample], points: Array, solution: Solution, name: str,
              config: Config) -> tuple[float, float]:
    """Return how far the nearest of points (n, 2) is from an edge, and the angle there."""
    method, estimate = solution.problem.method, solution.estimate
    pose = mounted(samples, config)[0] @ estimate.X
    in_base = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]
                              ) @ pose[:3, :3].T + pose[:3, 3]
    kind = np.full(len(points), method.kinds.index(name))
    found = method.geometry.conditions(in_base, kind, estimate.target, config)
    nearest = int(np.argmin(np.abs(found.g)))
    across = found.dg_dp[nearest]
    steepness = abs(across @ pose[:3, 0]) / np.linalg.norm(across)
    return float(abs(found.g[nearest])), float(np.arcsin(min(1.0, steepness)))
