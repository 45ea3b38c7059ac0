# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What an answer says beside the transform: nuisance parameters, and remarks in words."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import CLOCK_DRIFT, ClockEstimate, ROTATION_LAG, TIME_OFFSET
from handeye_ros.estimation.blocks import LINE_BEND, ParameterBlock, slices
from handeye_ros.estimation.solve import Solution
import numpy as np

CONTRADICTION_SIGMAS, NOTED_SIGMAS = 4.0, 3.0  # sigmas: to refuse an answer, to note a measure
PLATE_LENGTHS = 'size_p', 'size_q'  # of a plate
SMALLEST_BEND = 3e-5  # m, told
LARGE_DRIFT = 3e-5  # of clocks: cheap quartzes do not differ by more
PARTED_P = 0.01  # largest probability that random stations are the first, or the last, ones


@dataclass(frozen=True)
class BlockEstimate:
    """
    The first parameter of a block of nuisance parameters: its value and 1 sigma.

    contradiction: of the value from the data alone with the stated one, in sigmas of both;
    significance: of the value from the data alone, in its sigmas.
    """

    block: ParameterBlock
    value: float
    std: float
    contradiction: float
    significance: float


def block_estimates(solution: Solution) -> dict[str, BlockEstimate]:
    """Return the first parameter of each block of a solution, by the name of the block."""
    estimates = dict[str, BlockEstimate]()
    variances = np.diag(solution.covariance)[solution.unknowns:]
    for block, columns in slices(solution.blocks):
        n = float(solution.nuisance[columns][0])
        p = min(float(variances[columns][0]), 1 - 1e-9)  # of a prior variance of 1
        alone, variance = n / (1 - p), p / (1 - p)
        stated = 1 / solution.noise.block_variances.get(block.name, 1.0)
        estimates[block.name] = BlockEstimate(block, n * block.std, p ** 0.5 * block.std,
                                              alone / math.sqrt(stated + variance),
                                              alone / math.sqrt(max(variance, 1e-300)))
    return estimates


def reported_parameters(solution: Solution) -> dict[str, Any]:
    """Return the reported nuisance parameters: values of single ones, scales of others."""
    report: dict[str, Any] = {}
    estimates = block_estimates(solution.conservative).values()
    for estimate in estimates:
        if estimate.block.report and estimate.block.count == 1:
            report |= {estimate.block.report: estimate.block.origin + estimate.value,
                       f'{estimate.block.report}_std': estimate.std}
    for block in (estimate.block for estimate in estimates):
        if block.report and block.count > 1:
            report[block.report] = math.hypot(report.get(block.report, 0.0), block.std)
    return report


def time_offset_of(solution: Solution) -> ClockEstimate | None:
    """Return the time offset (s) to add to received stamps, None without samples in motion."""
    offset = clock_estimate(solution, TIME_OFFSET)
    return offset and ClockEstimate(solution.problem.config.time_offset + offset.value, offset.std)


def clock_estimate(solution: Solution, name: str) -> ClockEstimate | None:
    """Return value and 1 sigma of a parameter of the clocks, None without it."""
    best = block_estimates(solution).get(name)
    if best is None:
        return None
    conservative = block_estimates(solution.conservative)[name]
    return ClockEstimate(best.value, math.hypot(conservative.std, conservative.value - best.value))


def notes_of(solution: Solution, config: Config) -> list[str]:
    """Return the remarks on an answer in words: clocks, laser line, target, edges."""
    return [*offset_notes(solution), *_bend_notes(solution), *_measure_notes(solution, config),
            *_edge_notes(solution)]


def offset_notes(solution: Solution) -> list[str]:
    """Return notes on the time offset and the lag of the rotation."""
    offset, lag = (clock_estimate(solution, name) for name in (TIME_OFFSET, ROTATION_LAG))
    if offset is None:
        return []
    notes = []
    if offset.std > 0.5 * solution.problem.config.time_offset_std:
        notes.append('the motion says nothing of the time offset, which is as time_offset and '
                     'time_offset_std state it: sweep across the target, with changes of speed')
    elif offset.std > 5e-4:  # s
        notes.append(f'sweep faster once: the time offset is known to {offset.std * 1e3:.1f} ms '
                     f'only, that is {offset.std * 100:.2f} mm at 100 mm/s')
    if lag and abs(lag.value) > max(CONTRADICTION_SIGMAS * lag.std, 3e-4):
        notes.append(f'the robot reports its rotation {lag.value * 1e3:.2f} ms later than its '
                     'position: a scan with this calibration allows for it')
    drift = clock_estimate(solution, CLOCK_DRIFT)
    if drift and abs(drift.value) > max(CONTRADICTION_SIGMAS * drift.std, LARGE_DRIFT):
        notes.append('the clocks of profiles and poses drift apart by '
                     f'{drift.value * 60e3:.1f} ms a minute, which was allowed for; the time '
                     'offset is that of the middle of this recording: synchronise the clocks')
    return notes


def _bend_notes(solution: Solution) -> Iterator[str]:
    """Yield the note on a laser line that is bent out of its plane, if the data show that."""
    bend = block_estimates(solution.conservative).get(LINE_BEND)
    if bend and abs(bend.significance) > CONTRADICTION_SIGMAS and abs(bend.value) > SMALLEST_BEND:
        yield (f'the laser line is bent out of its plane by {abs(bend.value) * 1e3:.2f} +- '
               f'{bend.std * 1e3:.2f} mm from its middle to the ends of what the samples show: '
               'the transform is that of the plane which fits it best')


def _measure_notes(solution: Solution, config: Config) -> Iterator[str]:
    """Yield the notes on measures of the target that contradict the configuration."""
    target, state = solution.problem.target, solution.estimate.state
    stated, used = target.stated_values(config), target.stated_values(solution.problem.config)
    best = block_estimates(solution)
    values = dict(zip(target.labels, state[-len(target.labels):].tolist(), strict=True))
    # edge p may be either of the two stated lengths
    lengths = min((config.target.size, config.target.size[::-1]), key=lambda sizes: sum(
        abs(size - values[name]) for name, size in zip(PLATE_LENGTHS, sizes, strict=False)))
    for name, estimate in block_estimates(solution.conservative).items():
        if estimate.block.parameter is None or estimate.block.count > 1:
            continue
        first = values[name] - best[name].value
        noted = abs(estimate.contradiction) > NOTED_SIGMAS
        if used[name][1] > stated[name][1]:  # both lengths were freed, though one may be right
            first = lengths[PLATE_LENGTHS.index(name)]
            noted = abs(values[name] - first) > estimate.std
        if noted:
            yield _measure_note(name, first, values[name], estimate.std)
    for label, (first, tolerance) in stated.items():
        if label in used:
            continue  # others were given up, to make the stations agree
        k = target.labels.index(label) - len(target.labels)
        estimated, std = float(state[k]), float(solution.target_std[k])
        if abs(estimated - first) > NOTED_SIGMAS * math.hypot(std, tolerance):
            yield _measure_note(label, first, estimated, std)


def _measure_note(label: str, stated: float, estimated: float, std: float) -> str:
    unit, scale = ('degrees', math.degrees(1)) if 'angle' in label else ('mm', 1e3)
    return (f'the {label.replace("_", " ")} of the target is {estimated * scale:.3f} +- '
            f'{std * scale:.3f} {unit}, not the configured {stated * scale:.3f}: the answer uses '
            'the estimate')


def _edge_notes(solution: Solution) -> Iterator[str]:
    """Yield the edges that the answer does not use, and those never seen."""
    target, lost = solution.problem.target, lost_edges(solution)
    if lost:
        yield lost
    used = {target.kinds[k] for k in set(solution.problem.observations.kind)}
    known, seen = ({name.partition('_')[0] for name in names if name in target.essential}
                   for names in (target.essential, used))
    for edge in sorted(known - seen):
        yield (f'no sample shows edge {edge} of the target: cross it too, or set target.type to '
               'line if the target has one edge only')


def parted_by_outliers(solution: Solution) -> str:
    """
    Return in words that all stations that were dropped are the first, or the last, ones.

    '' if they are not, or if wrong stations in a random order are so too with PARTED_P.
    """
    n, used = len(solution.full_problem.poses), solution.used
    k = n - len(used)
    if solution.problem.pose_model is not None or 2 > PARTED_P * math.comb(n, k):
        return ''
    which, side = {0: ('last', 'before'), k: ('first', 'after')}.get(int(used[0]), ('', ''))
    if not which or np.ptp(used) >= n - k:
        return ''
    return (f'the {which} {k} of {n} samples contradict the {n - k} {side} them: the target or '
            'the sensor seems to have moved in between, or the tool or base of the robot was '
            'switched: check that both are fixed firmly, and take all samples again')


def lost_edges(solution: Solution) -> str:
    """Return in words the edges that an answer does not use, '' if it uses all."""
    if not len(solution.without_edges):
        return ''
    shown = int(solution.full_problem.subset(solution.used).shows_essential.sum())
    lost, estimate = solution.full_problem.subset(solution.without_edges), solution.estimate
    where = lost.target.describe_strays(lost.observations, lost.points_in_base(estimate.X),
                                        estimate.state, lost.config)
    return (f'the edges of {len(solution.without_edges)} of the {shown} samples that show one lie '
            'on none of the target' + (f': {where}' if where else ''))
