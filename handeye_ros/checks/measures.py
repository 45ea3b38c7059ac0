# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Checks of single nuisance parameters against their priors, and of edges that are not used.

Measures of the target, scales of robot and sensor, time offset, and the notes on them.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
from typing import Any

from handeye_ros.checks.hypotheses import Fit, RARE
from handeye_ros.checks.moved import moved_slightly
from handeye_ros.checks.refusals import lost_edges
from handeye_ros.config import Config
from handeye_ros.data import Array, CLOCK_DRIFT, ROTATION_LAG, TIME_OFFSET, TimeOffset
from handeye_ros.errors import DataError
from handeye_ros.estimation.blocks import LINE_BEND, ParameterBlock
from handeye_ros.estimation.noise import whitening
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.search import CONVINCING, robust_solution, with_blocks
from handeye_ros.estimation.solve import Solution
import numpy as np
from scipy.special import fdtrc

VERY_STRONG = 10.0  # twice the log of a Bayes factor (Kass and Raftery)
CONTRADICTION, NOTED_CONTRADICTION = 4.0, 3.0  # sigmas: to refuse an answer, to note a measure
LARGE_DRIFT = 3e-5  # of clocks: cheap quartzes do not differ by more
FREED_SIZE = 3e-3  # m: 1 sigma of a length of the plate that is stated wrongly
FREED_FROM = 2.5  # sigmas: an estimated length is used; it costs little where the stated is right
SMALLEST_BEND = 3e-5  # m, told
SMALLEST_SCALE_ERROR, LARGEST_SCALE_ERROR = 2e-3, 5e-2  # named; more is another unit


@dataclass(frozen=True)
class Shape:
    """A measure of the target: stated, estimated, and its 1 sigma."""

    label: str
    stated: float
    estimated: float
    std: float

    @property
    def note(self) -> str:
        """Return the note on a target that differs from the configuration."""
        unit, scale = ('degrees', math.degrees(1)) if 'angle' in self.label else ('mm', 1e3)
        return (f'the {self.label.replace("_", " ")} of the target is '
                f'{self.estimated * scale:.3f} +- {self.std * scale:.3f} {unit}, not the '
                f'configured {self.stated * scale:.3f}: the answer uses the estimate')


def believable_shape(problem: Problem, agreed: Solution, rng: np.random.Generator) -> Solution:
    """Return the consensus, with free target measures if only these make the stations agree."""
    config = problem.method.relax(problem.config)
    poor = (agreed.dropped or len(agreed.unused)
            or agreed.variance_factor > CONVINCING)
    if config is None or not poor:
        return agreed
    try:
        other = robust_solution(replace(problem, config=config), rng)
    except DataError:
        return agreed
    stated = float(problem.method.configured(problem.config)[-1])
    if abs(other.estimate.target[-1] - stated) > 0.5 * stated:
        return agreed  # another target
    # if a free shape explains more stations, the refinement can decide about the shape
    fit, stated_fit = Fit.of_all(other), Fit.of_all(agreed)
    complete = fit.believable and other.explained - agreed.explained > 0.1 * len(problem.poses)
    return other if complete or fit.evidence_against(stated_fit) > VERY_STRONG else agreed


def believable_size(agreed: Solution) -> Solution:
    """
    Return the refined consensus with the lengths of a plate estimated, if the stated are wrong.

    Otherwise the scale of the robot, which is stated less exactly, stands for a wrong length.
    """
    config, problem = agreed.whole.config, agreed.problem
    stated = config.target.size_std
    if not config.target.size or stated >= FREED_SIZE:
        return agreed
    free = replace(config, target=replace(config.target, size_std=FREED_SIZE))
    other = with_blocks(replace(agreed, whole=replace(agreed.whole, config=free), linear=replace(
        agreed.linear, problem=replace(problem, config=free))))
    wrong = any(abs(value) > max(FREED_FROM * std, 2 * stated)
                for block, value, std, _ in single_parameters(other)
                if block.name in ('size_p', 'size_q'))
    return other if wrong else agreed


def contradictions(solution: Solution, config: Config) -> Iterator[Shape]:
    """Yield the measures of the target that contradict the configuration."""
    stated = replace(solution.problem, config=config).tolerances
    method, target = solution.problem.method, solution.estimate.target
    labels = method.labels
    used = {block.name: value for block, value, _, _ in single_parameters(
        replace(solution, conservative=None))}
    for block, _, std, z in single_parameters(solution):
        if block.parameter is None:
            continue
        freed = solution.problem.tolerances[block.parameter] > stated[block.parameter]
        if freed or abs(z) > NOTED_CONTRADICTION:
            estimated = float(target[block.parameter - len(labels)])
            first = min(config.target.size, key=lambda size: abs(size - estimated)) if (
                freed) else estimated - used[block.name]
            yield Shape(block.name, first, estimated, std)
    given_up = method.free(solution.problem.config) & ~method.free(config)
    for i in np.flatnonzero(given_up).tolist():  # to make the stations agree
        first, std = float(method.configured(config)[i]), float(solution.target_std[i])
        if abs(target[i - len(labels)] - first) > NOTED_CONTRADICTION * math.hypot(std, stated[i]):
            yield Shape(labels[i], first, float(target[i - len(labels)]), std)


def single_parameters(solution: Solution) -> Iterator[tuple[ParameterBlock, float, float, float]]:
    """
    Yield block, value, 1 sigma and contradiction with the prior of single-parameter blocks.

    Contradiction: value from the data alone minus stated value, over 1 sigma of both.
    """
    solution = solution.conservative or solution  # a MAP scale near 0 hides it
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
    """Return the reported nuisance parameters: values of single ones, scales of others."""
    report: dict[str, Any] = {}
    for block, value, std, _ in single_parameters(solution):
        if block.report:
            report |= {block.report: block.origin + value, f'{block.report}_std': std}
    for block in (solution.conservative or solution).blocks:
        if block.report and block.count > 1:
            report[block.report] = math.hypot(report.get(block.report, 0.0), block.std)
    return report


def scale_error(solution: Solution) -> tuple[float, float, float]:
    """
    Return robot scale over sensor scale less 1, its 1 sigma, and the squares without it.

    One more unknown is solved for at the solution, to first order. The target's stated measures
    are unknown too, so that a wrong measure is not taken for a scale error.
    """
    problem = solution.problem
    positions = problem.robot_poses[:, :3, 3]
    moved = (positions - positions.mean(axis=0))[problem.observations.station]
    by_scale = (solution.linear.by_pose[:, :3] * moved).sum(axis=1)
    measures = solution.linear.jacobian[:, 6:][:, problem.tolerances > 0]
    white = whitening(solution.linear, solution.noise)
    column: Array = white(by_scale)
    Q, _ = np.linalg.qr(np.column_stack([solution.columns, white(measures)]))
    free = column - Q @ (Q.T @ column)
    rest = solution.white - Q @ (Q.T @ solution.white)
    information = float(free @ free)
    if information < 1e-12 * float(column @ column):
        return 0.0, math.inf, float(rest @ rest)
    return float(free @ rest) / information, information ** -0.5, float(rest @ rest)


def require_one_scale(agreed: Solution) -> None:
    """
    Raise for a solution in which robot and sensor differ too much in scale.

    Raises DataError: scale, or moved where the evidence for a move is decisive.
    """
    for block, value, std, z in single_parameters(agreed):
        if block.name == 'scale' and abs(z) > CONTRADICTION and abs(value) > max(
                SMALLEST_SCALE_ERROR, CONTRADICTION * std):
            moved_slightly(agreed)
            raise _scales_differ(abs(value), std)


def require_not_only_scale(solution: Solution) -> None:
    """
    Raise DataError where a small scale error explains most of the residuals.

    Uses an F-test. Other nuisance parameters can absorb much of the scale error; the answer is
    then wrong by that fraction of the lever arm.
    """
    scale, std, total = scale_error(solution)
    explained, freedom = (scale / std) ** 2, max(solution.redundancy, 1)
    left = max(total - explained, 0.0)
    if explained < 0.5 * total or not SMALLEST_SCALE_ERROR < abs(scale) < LARGEST_SCALE_ERROR:
        return
    # the probability itself: scipy 1.11 inverts it wrongly where it is small
    if left <= 0.0 or fdtrc(1, freedom, explained * freedom / left) < RARE:
        raise _scales_differ(abs(scale),
                             std * (left / max(solution.degrees_of_freedom, 1)) ** 0.5)


def _scales_differ(scale: float, std: float) -> DataError:
    return DataError(
        f'the lengths of robot and sensor differ by {100 * scale:.2f} +- {100 * std:.2f} %: one '
        'of them has a wrong scale; measure a known length with each, and correct the unit or '
        'the calibration of the wrong one', reason='scale')


def time_offset_of(solution: Solution) -> TimeOffset | None:
    """Return the time offset (s) to add to received stamps, None without samples in motion."""
    offset = _estimate_of(solution, TIME_OFFSET)
    return offset and TimeOffset(solution.problem.config.time_offset + offset.value, offset.std)


def offset_notes(solution: Solution) -> list[str]:
    """Return notes on the time offset and the lag of the rotation."""
    offset, lag = _estimate_of(solution, TIME_OFFSET), _estimate_of(solution, ROTATION_LAG)
    if offset is None:
        return []
    notes = []
    if offset.std > 0.5 * solution.problem.config.time_offset_std:
        notes.append('the motion says nothing of the time offset, which is as time_offset and '
                     'time_offset_std state it: sweep across the target, with changes of speed')
    elif offset.std > 5e-4:  # s
        notes.append(f'sweep faster once: the time offset is known to {offset.std * 1e3:.1f} ms '
                     f'only, that is {offset.std * 100:.2f} mm at 100 mm/s')
    if lag and abs(lag.value) > max(CONTRADICTION * lag.std, 3e-4):
        notes.append(f'the robot reports its rotation {lag.value * 1e3:.2f} ms later than its '
                     'position: a scan with this calibration allows for it')
    drift = _estimate_of(solution, CLOCK_DRIFT)
    if drift and abs(drift.value) > max(CONTRADICTION * drift.std, LARGE_DRIFT):
        notes.append('the clocks of profiles and poses drift apart by '
                     f'{drift.value * 60e3:.1f} ms a minute, which was allowed for; the time '
                     'offset is that of the middle of this recording: synchronise the clocks')
    return notes


def _estimate_of(solution: Solution, name: str) -> TimeOffset | None:
    """Return value and 1 sigma of the single-parameter block of a name, None without one."""
    best, wide = ({block.name: (value, std) for block, value, std, _ in single_parameters(one)}
                  for one in (replace(solution, conservative=None), solution))
    if name not in best:
        return None
    (value, _), (other, std) = best[name], wide[name]
    return TimeOffset(value, math.hypot(std, other - value))


def _bend_notes(solution: Solution) -> list[str]:
    """Return the note on a laser line that is bent out of its plane, if the data show that."""
    solution = solution.conservative or solution
    first = solution.unknowns
    for block in solution.blocks:
        if block.name == LINE_BEND:
            n = float(solution.nuisance[first - solution.unknowns])
            p = min(float(solution.covariance[first, first]), 1 - 1e-9)
            bend, std = n * block.std, p ** 0.5 * block.std
            # the value from the data alone, in sigmas
            if abs(n) > CONTRADICTION * math.sqrt(p * (1 - p)) and abs(bend) > SMALLEST_BEND:
                return [f'the laser line is bent out of its plane by {abs(bend) * 1e3:.2f} +- '
                        f'{std * 1e3:.2f} mm from its middle to the ends of what the samples '
                        'show: the transform is that of the plane which fits it best']
        first += block.count
    return []


def _edge_notes(agreed: Solution) -> list[str]:
    """Return in words the edges that the answer does not use, and those never seen."""
    problem, lost = agreed.problem, lost_edges(agreed)
    used = {problem.method.kinds[k] for k in set(problem.observations.kind)}
    edges = [{name.partition('_')[0] for name in names if name in problem.method.essential}
             for names in (problem.method.essential, used)]
    return [*([lost] if lost else []), *(
        f'no sample shows edge {edge} of the target: cross it too, or set target.type to line if '
        'the target has one edge only' for edge in sorted(edges[0] - edges[1]))]


def notes_of(agreed: Solution, config: Config) -> list[str]:
    """Return the notes on an answer in words: time offset, target, edges."""
    shapes = contradictions(agreed, config)
    return [*offset_notes(agreed), *_bend_notes(agreed),
            *(shape.note for shape in shapes), *_edge_notes(agreed)]
