"""Whether the target has the shape that it is configured to have."""
from __future__ import annotations

from dataclasses import dataclass, replace
import math

from handeye_ros.checks.errors import ScaleError
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.robust import Consensus, consensus
from handeye_ros.estimation.solve import evaluate, least_squares, Solution
from handeye_ros.estimation.systematic import with_systematic_error
from handeye_ros.estimation.variance import with_estimated_noise
from handeye_ros.estimation.weights import whitening
import numpy as np

CONTRADICTION = 4.0  # sigmas
DOUBTFUL = 4.0  # variance factor from which another shape is tried from the start
LARGEST_SCALE_ERROR = 2e-3  # between robot and sensor, of an answer that can be used
CONVINCING = 4.0  # by which it must lower it
ROUNDING = 1e-12  # of the squared effect of a scale: less is none


@dataclass(frozen=True)
class Shape:
    """A measure of the target: configured and estimated, with 1 sigma."""

    label: str
    configured: float
    estimated: float
    std: float

    @property
    def contradicts(self) -> bool:
        """Return whether the target is not as configured."""
        return abs(self.estimated - self.configured) > CONTRADICTION * self.std

    @property
    def note(self) -> str:
        """Return what to tell a person of a target that is not as configured."""
        unit, scale = ('degrees', 57.29577951) if 'angle' in self.label else ('mm', 1e3)
        return (f'the {self.label.replace("_", " ")} of the target is '
                f'{self.estimated * scale:.3f} +- {self.std * scale:.3f} {unit}, not the '
                f'configured {self.configured * scale:.3f}: the answer uses the estimate')


def believable_shape(problem: Problem, agreed: Consensus, rng: np.random.Generator) -> Consensus:
    """Return the consensus with the target's shape free if only that makes the stations agree."""
    free = freed(problem)
    doubtful = agreed.dropped or agreed.solution.variance_factor > DOUBTFUL
    if free is None or not doubtful:
        return agreed
    try:
        other = consensus(free, rng)
    except DataError:
        return agreed
    gain = agreed.solution.variance_factor / max(other.solution.variance_factor, 1.0)
    more = len(other.used) - len(agreed.used)
    better = (gain > CONVINCING and more >= 0) or (more > 0.1 * len(problem.poses) and gain > 0.5)
    return other if better else agreed


def with_shape_checked(solution: Solution) -> Solution:
    """Return the solution with its noise estimated, the shape free where it contradicts."""
    noisy = with_systematic_error(with_estimated_noise(solution))
    relaxed = relax(noisy)
    if relaxed is None or not measured_shape(relaxed, noisy.problem).contradicts:
        return noisy
    return with_systematic_error(with_estimated_noise(relaxed))


def shape_of(solution: Solution, configured: Problem) -> Shape | None:
    """Return what the solution says of the target's shape, None where nothing was configured."""
    if freed(configured) is None:
        return None
    relaxed = relax(solution) or solution
    return measured_shape(relaxed, configured)


def freed(problem: Problem) -> Problem | None:
    """Return the problem with the target's shape unknown, None where it is already."""
    config = problem.method.relax(problem.config)
    return None if config is None else replace(problem, config=config)


def relax(solution: Solution) -> Solution | None:
    """Return the solution with the target's shape unknown, None where it is already."""
    problem = freed(solution.problem)
    if problem is None:
        return None
    estimate = least_squares(problem, solution.estimate, solution.noise, iterations=10)
    return with_systematic_error(evaluate(problem, estimate, solution.noise))


def measured_shape(relaxed: Solution, configured: Problem) -> Shape:
    """Return the shape parameter, which is the target's last, beside what was configured."""
    return Shape(configured.method.labels[-1], configured.method.configured(configured.config),
                 float(relaxed.estimate.target[-1]), float(relaxed.target_std[-1]))


def scale_error(solution: Solution) -> tuple[float, float]:
    """
    Return by how much the robot's lengths exceed the sensor's, relative, and its 1 sigma.

    The step that one more unknown, a scale of the robot's positions, would take from the
    solution, to first order.
    """
    problem = solution.problem
    positions = problem.poses[:, :3, 3]
    moved = (positions - positions.mean(axis=0))[problem.observations.station]
    by_scale = (solution.linear.by_pose[:, :3] * moved).sum(axis=1)
    column = whitening(problem, solution.linear, solution.noise)(by_scale)
    Q, _ = np.linalg.qr(solution.jacobian)
    free = column - Q @ (Q.T @ column)
    information = float(free @ free)
    if information < ROUNDING * float(column @ column):
        return 0.0, math.inf
    return float(free @ solution.white) / information, information ** -0.5


def require_one_scale(solution: Solution) -> None:
    """
    Refuse a solution whose robot and sensor disagree about lengths.

    Raises ScaleError.
    """
    scale, std = scale_error(solution)
    if abs(scale) > max(CONTRADICTION * std, LARGEST_SCALE_ERROR):
        raise ScaleError(abs(scale), std)


def require_not_only_scale(solution: Solution) -> None:
    """
    Refuse a solution most of whose residuals one scale error explains.

    Raises ScaleError.
    """
    scale, std = scale_error(solution)
    explained = (scale / std) ** 2 > 0.5 * float(solution.white @ solution.white)
    std *= solution.variance_factor ** 0.5
    if explained and abs(scale) > max(CONTRADICTION * std, LARGEST_SCALE_ERROR):
        raise ScaleError(abs(scale), std)
