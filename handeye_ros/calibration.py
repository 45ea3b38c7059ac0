# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From a solution to its Calibration: transform, target, quality, residual of each sample, remarks.

First the figures (`calibration_of`), then the nuisance parameters (`block_estimates`) and the
remarks on them in words (`notes_of`).
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.arithmetic import even_indices, rms
from handeye_ros.config import Config, flatten, UNNAMED_FRAME
from handeye_ros.data import (
    Array,
    Calibration,
    CLOCK_DRIFT,
    ClockEstimate,
    Quality,
    Reject,
    Sample,
    SampleReport,
    TIME_OFFSET,
)
from handeye_ros.estimation.blocks import blocks_with_columns, LINE_BEND, ROBOT_SCALE
from handeye_ros.estimation.least_squares import rms_by
from handeye_ros.estimation.posterior import Posterior
from handeye_ros.estimation.problem import Estimate, mapped, Problem
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_frame, T_sensor_plane, weakest_position
import numpy as np
from numpy.typing import NDArray

MAX_POINTS = 200_000  # measured points of which residuals are computed
MAX_FOLDS = 20  # of the left-out residuals
ONLY_FACE = ('only its face was used: its edge point lies on no edge of the target, or the laser '
             'crosses the edge at too small an angle')
# of a bend or a drift to note it, of a scale to refuse it; of a measure or a scale to note it
SURE_SIGMAS, NOTED_SIGMAS = 4.0, 3.0
MIN_BEND = 3e-5  # m: a smaller bend is not noted
LARGE_DRIFT = 3e-5  # of clocks: cheap quartzes do not differ by more


def calibration_of(samples: Sequence[Sample], rejects: Sequence[Reject], solution: Solution,
                   config: Config, frame_id: str, warnings: Sequence[str] = ()) -> Calibration:
    """
    Return the calibration of a solution, with the residuals of its samples and its remarks.

    samples: in the order of the stations of the solution; rejects: the stops that gave no sample;
    config: the settings as the user stated them; frame_id: of the profiles; warnings: sentences.
    """
    problem, offset = solution.problem, clock_estimate(solution, TIME_OFFSET)
    if offset:  # to add to received stamps
        offset = replace(offset, value=problem.config.time_offset + offset.value)
    used = [samples[i] for i in solution.used_stations]
    measured, residuals, left_out = residuals_and_left_out(used, solution)
    rms_of_samples = rms_by(measured.station, residuals, len(used)).tolist()
    reports = [SampleReport(sample.stamp, True, ', '.join(edges), rms_of_sample,
                            ONLY_FACE if problem.target.edge_kinds and not edges else '')
               for sample, edges, rms_of_sample in zip(
                   used, edges_used(problem), rms_of_samples, strict=True)]
    reports += [SampleReport(samples[i].stamp, False, reason='contradicts the other samples: its '
                             f'residual is {square ** 0.5:.1f} times what its noise explains')
                for i, square in solution.dropped_squares.items()]
    reports += [SampleReport(reject.stamp, False, reason=reject.reason) for reject in rejects]
    return assemble_calibration(
        config, method=problem.target.name, sensor_frame=frame_id or UNNAMED_FRAME,
        T_flange_sensor=solution.estimate.X @ se3.inverse(T_sensor_plane(config)),
        covariance=solution.transform_covariance, residual_rms=rms(residuals),
        holdout_rms=rms(left_out), target=_described_target(solution, config),
        reports=sorted(reports, key=lambda report: report.stamp),
        provenance={'warnings': list(warnings)} if warnings else {}, time_offset=offset)


def assemble_calibration(config: Config, *, method: str, sensor_frame: str, T_flange_sensor: Array,
                         covariance: Array, residual_rms: float, holdout_rms: float,
                         target: Mapping[str, Any], reports: Sequence[SampleReport],
                         provenance: Mapping[str, Any], time_offset: ClockEstimate | None = None
                         ) -> Calibration:
    """
    Return a calibration with its quality, from its parts and the reports of all samples.

    residual_rms, holdout_rms: of the residuals, and of those left out (m); provenance: beside
    version and config.
    """
    parent, used = mount_frame(config), sum(report.used for report in reports)
    quality = Quality(used, len(reports) - used, residual_rms, holdout_rms,
                      *_weakest(covariance, parent))
    return Calibration(
        config.calibration_name, method, parent, sensor_frame, T_flange_sensor,
        covariance, target, quality, tuple(reports),
        {'version': __version__, **provenance, 'config': flatten(config)}, time_offset)


def with_covariance(calibration: Calibration, covariance: Array) -> Calibration:
    """Return a calibration with another covariance (6, 6), which its quality agrees with."""
    direction, std = _weakest(covariance, calibration.parent_frame)
    return replace(calibration, covariance=covariance, quality=replace(
        calibration.quality, weakest_direction=direction, weakest_std=std))


def _weakest(covariance: Array, frame: str) -> tuple[str, float]:
    """Return weakest_direction and weakest_std of the quality."""
    words, std = weakest_position(covariance, frame)
    return f'{words} (m)', std


def report_of_row(number: int, kind: str, used: bool, off: float) -> SampleReport:
    """
    Return the report of a sample of a table.

    number: of its row, or its stamp (ns); kind: what it is, as `arc`; off: its residual (m).
    """
    return SampleReport(int(number), bool(used), kind, float(off),
                        '' if used else 'contradicts the others')


def _described_target(solution: Solution, config: Config) -> dict[str, Any]:
    """Return the estimates of the target and of all nuisance parameters."""
    described = solution.problem.target.describe(solution.estimate.state, solution.target_std)
    # the key is named after the joint covariance in it
    described |= reported_parameters(solution) | {'joint': _values_for_check(solution)}
    described = {key: value for key, value in described.items() if not key.startswith(TIME_OFFSET)}
    notes = '; '.join(notes_of(solution, config))
    return described | ({'note': notes} if notes else {})


def _values_for_check(solution: Solution) -> dict[str, Any]:
    """
    Return the values for a later check: target state, joint covariance, factors of the noise.

    The covariance (6 + k, 6 + k) is of the errors of the transform and of the target's parameters
    as the data show them, so that errors in common cancel: that of the posterior of the estimate,
    not of the report, without nuisance parameters; 0 for stated measures.
    """
    problem, posterior = solution.problem, solution.posterior
    size, free = 6 + len(problem.target.parameter_names), problem.free_columns
    covariance = np.zeros((size, size))
    u = posterior.unknown_count
    covariance[np.ix_(free, free)] = posterior.covariance[:u, :u]
    return {'state': solution.estimate.state.tolist(), 'covariance': covariance.ravel().tolist(),
            'variance_factors': solution.report_posterior.noise.variance_factors.tolist()}


def edges_used(problem: Problem) -> list[tuple[str, ...]]:
    """Return for each station of a problem the names of the edges of the target that it shows."""
    obs, target = problem.observations, problem.target
    return [tuple(dict.fromkeys(  # each once, in the order of the points
        target.kinds[k] for k in obs.kind[obs.station == station] if k in target.edge_kinds))
        for station in range(len(problem.poses))]


def residuals_and_left_out(used: Sequence[Sample], solution: Solution,
                           fold: NDArray[np.intp] | None = None
                           ) -> tuple[MeasuredPoints, Array, Array]:
    """
    Return the measured points of used samples, their residuals (k,) and those left out (k,), in m.

    A left-out residual is the distance from the target as the other folds of stations predict it.
    fold: (n,) the fold of each station, counted from 0; by default each station is a fold of its
    own, and of many stations some share one.
    """
    problem, n = solution.problem, len(used)
    measured = measured_points(used, problem)
    if fold is None:
        fold = np.arange(n) % min(n, MAX_FOLDS)
    estimates, poses = solution.posterior.estimates_without(fold)
    fold_of_point = fold[measured.station]
    left_out = np.empty(len(fold_of_point))
    for k, estimate in enumerate(estimates):
        in_fold = fold_of_point == k
        left_out[in_fold] = measured.select(in_fold).residuals(problem, estimate, poses)
    return measured, measured.residuals(
        problem, solution.estimate, solution.posterior.corrected_poses()), left_out


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """
    All measured points of the used samples, represented by the target's observations.

    points: (k, 2) of the sensor plane (m)
    kind: (k,) index of the condition in the target's kinds
    station: (k,) index of the problem's station
    """

    points: Array
    kind: NDArray[np.intp]
    station: NDArray[np.intp]

    def select(self, keep: NDArray[np.bool_]) -> MeasuredPoints:
        """Return some of the points, by a mask (k,)."""
        return MeasuredPoints(self.points[keep], self.kind[keep], self.station[keep])

    def residuals(self, problem: Problem, estimate: Estimate, poses: Array | None = None
                  ) -> Array:
        """
        Return the residuals before whitening, (k,) in metres, at an estimate.

        poses: (n, 4, 4) instead of the reported ones, such as without the robot's smooth error.
        """
        T = (problem.poses if poses is None else poses) @ estimate.X
        p = mapped(self.points, T[self.station])
        return problem.target.conditions(p, self.kind, estimate.state, problem.config).g


def measured_points(used: Sequence[Sample], problem: Problem) -> MeasuredPoints:
    """
    Return all measured points of samples, in the order of the problem's stations.

    Of more than MAX_POINTS so many are taken, evenly spaced: their RMS is the same.
    """
    obs = problem.observations
    bounds = np.searchsorted(obs.station, np.arange(len(used) + 1))
    parts = [problem.target.raw_points(sample, obs.points[first:last], obs.kind[first:last])
             for sample, first, last in zip(used, bounds[:-1], bounds[1:], strict=True)]
    station = np.repeat(np.arange(len(used)), [len(kind) for _, kind in parts])
    points, kind = map(np.concatenate, zip(*parts, strict=True))
    taken = even_indices(len(kind), MAX_POINTS)
    return MeasuredPoints(points[taken], kind[taken], station[taken])


@dataclass(frozen=True)
class BlockEstimate:
    """
    The first parameter of a block of nuisance parameters: its value and 1 sigma.

    sigmas_off_stated: how far the data alone, without the prior, put the value from the stated
    one, over the root of both variances; significance: the value from the data alone, in sigmas.
    """

    value: float
    std: float
    sigmas_off_stated: float
    significance: float


def block_estimates(posterior: Posterior) -> dict[str, BlockEstimate]:
    """Return value and 1 sigma of the first parameter of each block, by the name of the block."""
    estimates = dict[str, BlockEstimate]()
    variances = np.diag(posterior.covariance)[posterior.unknown_count:]
    for block, columns in blocks_with_columns(posterior.blocks):
        value, variance = float(posterior.nuisance[columns][0]), float(variances[columns][0])
        # share of the information that is not the prior's
        data_share = max(1 - variance / posterior.prior_tau(block) ** 2, 1e-9)
        data_value, data_variance = value / data_share, variance / data_share
        estimates[block.name] = BlockEstimate(value * block.std, variance ** 0.5 * block.std,
                                              data_value / math.sqrt(1 + data_variance),
                                              data_value / math.sqrt(max(data_variance, 1e-300)))
    return estimates


def reported_parameters(solution: Solution) -> dict[str, Any]:
    """
    Return the nuisance parameters that are reported, by key, in SI units.

    Of a block of one parameter that is its value with 1 sigma, of any other the 1 sigma of its
    parameters, as the data show it.
    """
    report_posterior, report = solution.report_posterior, dict[str, Any]()
    estimates = block_estimates(report_posterior)
    for block in sorted(report_posterior.blocks, key=lambda block: block.count > 1):
        if block.reported_as and block.count == 1:
            estimate = estimates[block.name]
            report |= {block.reported_as: block.origin + estimate.value,
                       f'{block.reported_as}_std': estimate.std}
        elif block.reported_as:
            report[block.reported_as] = math.hypot(report.get(block.reported_as, 0.0),
                                                   block.std * report_posterior.prior_tau(block))
    return report


def clock_estimate(solution: Solution, name: str) -> ClockEstimate | None:
    """
    Return a parameter of the clocks (s, or s per second) with 1 sigma, None without it.

    name: TIME_OFFSET, ROTATION_LAG or CLOCK_DRIFT.
    """
    estimate = block_estimates(solution.posterior).get(name)
    if estimate is None:
        return None
    reported = block_estimates(solution.report_posterior)[name]
    return ClockEstimate(estimate.value,
                         math.hypot(reported.std, reported.value - estimate.value))


def notes_of(solution: Solution, config: Config) -> Iterator[str]:
    """Yield the remarks on an answer in words: clocks, laser, lengths, target, edges, surfaces."""
    yield from clock_notes(solution)
    estimates = block_estimates(solution.report_posterior)
    bend, scale = estimates.get(LINE_BEND), estimates.get(ROBOT_SCALE)
    if bend and abs(bend.significance) > SURE_SIGMAS and abs(bend.value) > MIN_BEND:
        yield (f'the laser line is bent out of its plane by {abs(bend.value) * 1e3:.2f} +- '
               f'{bend.std * 1e3:.2f} mm from its middle to the ends of what the samples show: '
               'the transform is that of the plane which fits it best')
    if scale and abs(scale.sigmas_off_stated) > NOTED_SIGMAS:
        yield (f'the lengths of robot and sensor differ by {100 * abs(scale.value):.2f} +- '
               f'{100 * scale.std:.2f} %, more than noise.robot_scale states: measure a known '
               'length with each')
    yield from _measure_notes(solution, config)
    if unused_edges := unused_edges_in_words(solution):
        yield unused_edges
    problem, target = solution.problem, solution.problem.target
    seen = {target.edge_kinds.get(k) for k in problem.observations.kind.tolist()}
    for edge in sorted({*target.edge_kinds.values()} - seen):
        yield (f'no sample shows edge {edge} of the target: cross it too, or set target.type to '
               'line if the target has one edge only')
    n = len(solution.used_stations)
    shown, used = (np.bincount(each.observations.station, minlength=n)
                   for each in (solution.full_problem.subset(solution.used_stations), problem))
    if not target.edge_kinds and (shown > used).any():
        yield (f'{np.count_nonzero(shown > used)} of {n} samples show '
               f'other surfaces too than the {target.name} that was used in all of them')


def clock_notes(solution: Solution) -> Iterator[str]:
    """Yield the notes on the time offset and the drift of the clocks."""
    offset, drift = (clock_estimate(solution, name) for name in (TIME_OFFSET, CLOCK_DRIFT))
    if offset is None:
        return
    stated = block_estimates(solution.report_posterior)[TIME_OFFSET]
    if abs(stated.sigmas_off_stated) > NOTED_SIGMAS:
        yield (f'the time offset is {abs(stated.sigmas_off_stated):.0f} sigmas off what '
               'time_offset and time_offset_std state: correct them')
    elif offset.std > 0.5 * solution.problem.config.time_offset_std:
        yield ('the motion says nothing of the time offset, which is as time_offset and '
               'time_offset_std state it: sweep across the target, with changes of speed')
    elif offset.std > 5e-4:  # s
        yield (f'sweep faster once: the time offset is known to {offset.std * 1e3:.1f} ms '
               f'only, that is {offset.std * 100:.2f} mm at 100 mm/s')
    if drift and abs(drift.value) > max(SURE_SIGMAS * drift.std, LARGE_DRIFT):
        yield (f'the clocks of profiles and poses drift apart by {drift.value * 60e3:.1f} ms a '
               'minute, or one of them jumped a little; the time offset is that of the middle of '
               'this recording: synchronise the clocks')


def _measure_notes(solution: Solution, config: Config) -> Iterator[str]:
    """Yield the notes on measures of the target that contradict the configuration."""
    target = solution.problem.target
    measures, stated_to_solver = map(target.stated_values, (config, solution.problem.config))
    estimates, reported = map(block_estimates, (solution.posterior, solution.report_posterior))
    values = target.measures(solution.estimate.state)
    stds = dict(zip(target.parameter_names, solution.target_std.tolist(), strict=True))
    loosened = sorted((name for name, (_, tolerance) in measures.items()
                       if name in stated_to_solver and stated_to_solver[name][1] > tolerance),
                      key=values.__getitem__)
    # each loosened length may be any of those that are stated: the nearest are in the same order
    nearest = dict(zip(loosened, sorted(measures[name][0] for name in loosened), strict=True))
    for name, (stated, tolerance) in measures.items():
        value, std = values.get(name, stated), stds[name]
        if name not in reported:  # it was left unstated, to make the stations agree
            contradicts = abs(value - stated) > NOTED_SIGMAS * math.hypot(std, tolerance)
        elif name in loosened:  # with the other lengths, so that it may be right
            stated, std = nearest[name], reported[name].std
            contradicts = abs(value - stated) > std
        else:
            stated, std = value - estimates[name].value, reported[name].std
            contradicts = abs(reported[name].sigmas_off_stated) > NOTED_SIGMAS
        if contradicts:
            unit, scale = ('degrees', math.degrees(1)) if 'angle' in name else ('mm', 1e3)
            yield (f'the {name.replace("_", " ")} of the target is {value * scale:.3f} +- '
                   f'{std * scale:.3f} {unit}, not the configured {stated * scale:.3f}: the '
                   'answer uses the estimate')


def unused_edges_in_words(solution: Solution) -> str:
    """Return in words the edges that an answer does not use, '' if it uses all."""
    stations, estimate = solution.stations_with_unused_edges, solution.estimate
    if not len(stations):
        return ''
    shown = int(solution.full_problem.subset(solution.used_stations).shows_edge.sum())
    unused = solution.full_problem.subset(stations)
    where = unused.target.describe_strays(unused.observations, unused.points_in_base(estimate.X),
                                          estimate.state, unused.config)
    return (f'the edges of {len(stations)} of the {shown} samples that show one lie on none of '
            'the target, or the laser crosses them at less than sampling.min_crossing_angle'
            + (f': {where}' if where else ''))
