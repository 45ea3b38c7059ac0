"""Nuisance parameters of one number against their priors: target, robot, sensor, clock."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
from typing import Any

from handeye_ros.checks.alternatives import believable, evidence, RARE, VERY_STRONG
from handeye_ros.checks.change_point import moved_slightly
from handeye_ros.checks.errors import ScaleError
from handeye_ros.config import Config
from handeye_ros.data import Array, TimeOffset
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import ParameterBlock
from handeye_ros.estimation.consensus import Consensus, consensus
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.noise import whitening
from handeye_ros.estimation.outliers import f_isf
from handeye_ros.estimation.search import CONVINCING
from handeye_ros.estimation.solution import Solution
import numpy as np

CONTRADICTION = 4.0  # sigmas that make an answer wrong
NOTED_CONTRADICTION = 3.0  # sigmas of a measure of the target that is noted in the answer
MORE_EXPLAINED = 0.1  # of the stations, with which a shape is tried to the end
LARGEST_CHANGE = 0.5  # of a stated measure, relative: more is no tolerance but another target
LARGEST_SCALE_ERROR = 5e-2  # of the robot's lengths: more is another unit, or a wrong answer
MOST = 0.5  # of the squared residuals
SMALLEST_SCALE_ERROR = 2e-3  # that is named as what is wrong
TIME_OFFSET, ROTATION_LAG = 'time_offset', 'rotation_lag'  # blocks
UNKNOWN = 0.5  # of the prior sigma of the time offset: the motion says nothing of it
POOR = 5e-4  # s, 1 sigma
FAST = 0.1  # m/s, for which an offset is given as a length
LARGE_LAG = 3e-4  # s
ROUNDING = 1e-12  # of the squared effect of a scale: less is none


@dataclass(frozen=True)
class Shape:
    """A measure of the target: stated and estimated, with 1 sigma."""

    label: str
    stated: float
    estimated: float
    std: float

    @property
    def note(self) -> str:
        """Return what to tell a person of a target that is not as configured."""
        unit, scale = ('degrees', math.degrees(1)) if 'angle' in self.label else ('mm', 1e3)
        return (f'the {self.label.replace("_", " ")} of the target is '
                f'{self.estimated * scale:.3f} +- {self.std * scale:.3f} {unit}, not the '
                f'configured {self.stated * scale:.3f}: the answer uses the estimate')


def believable_shape(problem: Problem, agreed: Consensus, rng: np.random.Generator) -> Consensus:
    """Return the consensus with the target's shape free if only that makes the stations agree."""
    config = problem.method.measures.relax(problem.config)
    poor = (agreed.dropped or len(agreed.unused)
            or agreed.solution.variance_factor > CONVINCING)
    if config is None or not poor:
        return agreed
    try:
        other = consensus(replace(problem, config=config), rng)
    except DataError:
        return agreed
    stated = float(problem.method.measures.configured(problem.config)[-1])
    if abs(other.solution.estimate.target[-1] - stated) > LARGEST_CHANGE * stated:
        return agreed
    # what is left out as the target is not as stated may yet show how it is, once all is refined
    complete = believable((other,)) and (
        other.explained - agreed.explained > MORE_EXPLAINED * len(problem.poses))
    return other if complete or evidence((other,), (agreed,)) > VERY_STRONG else agreed


def contradictions(solution: Solution, config: Config) -> Iterator[Shape]:
    """Yield the measures of the target that are not as the configuration states them."""
    stated = replace(solution.problem, config=config).tolerances
    method, target = solution.problem.method, solution.estimate.target
    labels = method.labels
    used = {d.name: value for d, value, _, _ in sizes(replace(solution, conservative=None))}
    for block, _, std, z in sizes(solution):
        if block.parameter is not None and abs(z) > NOTED_CONTRADICTION:
            estimated = float(target[block.parameter - len(labels)])
            yield Shape(block.name, estimated - used[block.name], estimated, std)
    given_up = method.geometry.free(solution.problem.config) & ~method.geometry.free(config)
    for i in np.flatnonzero(given_up).tolist():  # to make the stations agree
        first, std = float(method.measures.configured(config)[i]), float(solution.target_std[i])
        if abs(target[i - len(labels)] - first) > NOTED_CONTRADICTION * math.hypot(std, stated[i]):
            yield Shape(labels[i], first, float(target[i - len(labels)]), std)


def sizes(solution: Solution) -> Iterator[tuple[ParameterBlock, float, float, float]]:
    """
    Yield each block of one parameter with its value, 1 sigma, and how it contradicts its prior.

    The last is the distance of what the data alone say from what was stated, in sigmas of both.
    """
    solution = solution.conservative or solution  # a size kept small contradicts nothing
    first = solution.unknowns
    for block in solution.blocks:
        if block.count == 1:
            n = float(solution.nuisance[first - solution.unknowns])
            p = min(float(solution.covariance[first, first]), 1 - 1e-9)
            size = solution.noise.scales.get(block.name, 1.0)
            alone, variance = n / (1 - p), p / (1 - p)
            z = alone / math.sqrt(1 / size + variance)
            yield block, n * block.std, p ** 0.5 * block.std, z
        first += block.count


def reported_blocks(solution: Solution) -> dict[str, Any]:
    """Return what is reported of nuisance parameters: values of single ones, scales of others."""
    report: dict[str, Any] = {}
    for block, value, std, _ in sizes(solution):
        if block.report:
            report |= {block.report: block.origin + value, f'{block.report}_std': std}
    for block in (solution.conservative or solution).blocks:
        if block.report and block.count > 1:
            report[block.report] = math.hypot(report.get(block.report, 0.0), block.std)
    return report


def scale_error(solution: Solution) -> tuple[float, float, float]:
    """
    Return by how much the robot's lengths exceed the sensor's, relative, and its 1 sigma.

    The step that one more unknown, a scale of the robot's positions, would take from the
    solution, to first order, and the squares that are left without it. What the target measures
    is unknown too: a length of it that is not as stated is no scale.
    """
    problem = solution.problem
    positions = problem.robot_poses[:, :3, 3]
    moved = (positions - positions.mean(axis=0))[problem.observations.station]
    by_scale = (solution.linear.by_pose[:, :3] * moved).sum(axis=1)
    measures = solution.linear.jacobian[:, 6:][:, problem.tolerances > 0]
    white = whitening(solution.linear, solution.noise)
    column: Array = white(by_scale)
    Q, _ = np.linalg.qr(np.column_stack([solution.jacobian, white(measures)]))
    free = column - Q @ (Q.T @ column)
    rest = solution.white - Q @ (Q.T @ solution.white)
    information = float(free @ free)
    if information < ROUNDING * float(column @ column):
        return 0.0, math.inf, float(rest @ rest)
    return float(free @ rest) / information, information ** -0.5, float(rest @ rest)


def require_one_scale(agreed: Consensus) -> None:
    """
    Refuse a solution whose robot and sensor disagree too much about lengths.

    Raises ScaleError, or MovedError where that explains it better.
    """
    for block, value, std, z in sizes(agreed.solution):
        if block.name == 'scale' and abs(z) > CONTRADICTION and abs(value) > max(
                SMALLEST_SCALE_ERROR, CONTRADICTION * std):
            moved_slightly(agreed)
            raise ScaleError(abs(value), std)


def require_not_only_scale(solution: Solution) -> None:
    """
    Refuse a solution most of whose residuals one small scale error explains.

    Other nuisance parameters could make much of it up, and the answer
    would be wrong by as much of the lever. By an F-test. Raises ScaleError.
    """
    scale, std, total = scale_error(solution)
    explained, freedom = (scale / std) ** 2, max(solution.redundancy, 1)
    left = max(total - explained, 0.0)
    if explained < MOST * total or not SMALLEST_SCALE_ERROR < abs(scale) < LARGEST_SCALE_ERROR:
        return
    if explained > left * f_isf(RARE, 1, freedom) / freedom:
        raise ScaleError(abs(scale), std * (left / max(solution.degrees_of_freedom, 1)) ** 0.5)


def time_offset_of(solution: Solution) -> TimeOffset | None:
    """Return the time offset of the stamps as received, None where the robot only stood."""
    found = _found(solution, TIME_OFFSET)
    return found and TimeOffset(solution.problem.config.time_offset + found.value, found.std)


def offset_notes(solution: Solution) -> list[str]:
    """Return what is to be said of offset and lag, in words."""
    offset, lag = _found(solution, TIME_OFFSET), _found(solution, ROTATION_LAG)
    if offset is None:
        return []
    notes = []
    if offset.std > UNKNOWN * solution.problem.config.time_offset_std:
        notes.append('the motion says nothing of the time offset, which is as time_offset and '
                     'time_offset_std state it: sweep across the target, with changes of speed')
    elif offset.std > POOR:
        notes.append(f'sweep faster once: the time offset is known to {offset.std * 1e3:.1f} ms '
                     f'only, that is {offset.std * FAST * 1e3:.2f} mm at {FAST * 1e3:.0f} mm/s')
    if lag and abs(lag.value) > max(CONTRADICTION * lag.std, LARGE_LAG):
        notes.append(f'the robot reports its rotation {lag.value * 1e3:.2f} ms later than its '
                     'position: a scan with this calibration allows for it')
    return notes


def _found(solution: Solution, name: str) -> TimeOffset | None:
    """Return the value and 1 sigma of a block of one parameter, None where there is none."""
    best, wide = ({block.name: (value, std) for block, value, std, _ in sizes(one)}
                  for one in (replace(solution, conservative=None), solution))
    if name not in best:
        return None
    (value, _), (other, std) = best[name], wide[name]
    return TimeOffset(value, math.hypot(std, other - value))
