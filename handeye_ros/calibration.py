# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From a solution to its Calibration: transform, target, quality, residual of each sample."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.config import Config, flatten
from handeye_ros.data import (
    Array,
    Calibration,
    ClockEstimate,
    Quality,
    Reject,
    rms,
    Sample,
    SampleReport,
    TIME_OFFSET,
)
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_frame, name_direction, sensor_axes
from handeye_ros.notes import notes_of, reported_parameters, time_offset_of
import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 200_000
MOST_FOLDS = 20  # of the left-out check
ONLY_FACE = ('only its face was used: its edge point lies on no edge of the target, or the laser '
             'crosses the edge at too small an angle')


def calibration_of(samples: Sequence[Sample], rejects: Sequence[Reject], solution: Solution,
                   config: Config, frame_id: str, warnings: Sequence[str] = ()) -> Calibration:
    """
    Return the calibration of a solution.

    samples: in the order of its stations; rejects: stops that gave none; frame_id: of the
    profiles; warnings: in words.
    """
    problem = solution.problem
    used = [samples[i] for i in solution.used]
    measured, residuals, predicted = tested_points(used, solution)
    reports = [*_used_reports(used, problem, rms_by(measured.station, residuals, len(used))),
               *_dropped_reports(samples, solution),
               *(SampleReport(r.stamp, False, reason=r.reason) for r in rejects)]
    return assemble_calibration(
        config, problem.target.name, frame_id or 'laser',
        solution.estimate.X @ se3.inverse(sensor_axes(config)), solution.transform_covariance,
        rms(residuals), rms(predicted), _described_target(solution, config),
        sorted(reports, key=lambda report: report.stamp),
        {'warnings': list(warnings)} if warnings else {}, time_offset_of(solution))


def assemble_calibration(config: Config, method: str, sensor_frame: str, T_flange_sensor: Array,
                         covariance: Array, residual_rms: float, holdout_rms: float,
                         target: Mapping[str, Any], reports: Sequence[SampleReport],
                         provenance: Mapping[str, Any], time_offset: ClockEstimate | None = None
                         ) -> Calibration:
    """
    Return a calibration with its quality, by its statistics and the reports of all samples.

    residual_rms, holdout_rms: of the residuals, and of those left out (m); provenance: beside
    version and config.
    """
    parent, used = mount_frame(config), sum(report.used for report in reports)
    std, direction = se3.worst_translation(covariance)
    quality = Quality(used, len(reports) - used, residual_rms, holdout_rms,
                      f'position along {name_direction(direction, parent)} (m)', std)
    return Calibration(
        config.name or config.target.type, method, parent, sensor_frame, T_flange_sensor,
        covariance, target, quality, tuple(reports),
        {'version': __version__, **provenance, 'config': flatten(config)}, time_offset)


def report_of_row(number: int, kind: str, used: bool, off: float) -> SampleReport:
    """Return the report of a sample of a table; number: of its row, or its stamp."""
    return SampleReport(int(number), bool(used), kind, float(off),
                        '' if used else 'contradicts the others')


def _described_target(solution: Solution, config: Config) -> dict[str, Any]:
    """Return the estimates of the target and of all nuisance parameters."""
    described = solution.problem.target.describe(solution.estimate.state, solution.target_std)
    described |= reported_parameters(solution) | {'joint': _joint(solution)}
    described = {key: value for key, value in described.items() if not key.startswith(TIME_OFFSET)}
    notes = [*notes_of(solution, config), *filter(None, [_other_surfaces(solution)])]
    return described | ({'note': '; '.join(notes)} if notes else {})


def _other_surfaces(solution: Solution) -> str:
    """Return in words which of several visible surfaces is the target, '' with one surface."""
    observed, problem = solution.full_problem.subset(solution.used), solution.problem
    several = len(observed.observations) > len(problem.observations)
    if problem.target.essential or not several:
        return ''
    estimate, obs = solution.estimate, observed.observations
    unused = ~np.isin(obs.error_source, problem.observations.error_source)
    sensors = problem.poses[obs.station[unused]] @ estimate.X[:, 3]
    height, of_sensor = (problem.target.conditions(
        p, obs.kind[unused], estimate.state, problem.config).g
        for p in (observed.points_in_base(estimate.X)[unused], sensors[:, :3]))
    nearer = height * np.sign(of_sensor) > 0
    side = 'nearer and farther' if 0 < nearer.sum() < len(nearer) else (
        'nearer' if nearer.any() else 'farther')
    stations = len(np.unique(obs.station[unused]))
    return (f'{stations} of {len(solution.used)} samples show other surfaces too, {side} than the '
            f'{problem.target.name} that was used in all of them')


def _joint(solution: Solution) -> dict[str, Any]:
    """
    Return the values for a later check: target state, joint covariance, variance factor.

    The covariance (6 + k, 6 + k) is of the errors of the transform and of the target's parameters
    as the data show them, so that errors in common cancel.
    """
    problem = solution.problem
    size = 6 + len(problem.target.labels)
    C, rows = np.zeros((size, size)), problem.free_columns
    C[np.ix_(rows, rows)] = solution.covariance[:solution.unknowns, :solution.unknowns]
    return {'state': solution.estimate.state.tolist(), 'covariance': C.ravel().tolist(),
            'variance_factor': solution.variance_factor}


def _used_reports(used: Sequence[Sample], problem: Problem, own: Array) -> list[SampleReport]:
    """Return the reports of used samples; own: (n,) RMS residual of each."""
    return [SampleReport(sample.stamp, True, edges, float(residual),
                         ONLY_FACE if problem.target.essential and not edges else '')
            for sample, edges, residual in zip(used, edges_used(problem), own, strict=True)]


def edges_used(problem: Problem) -> list[str]:
    """Return for each station the edges of the target that it shows, in words."""
    obs, target = problem.observations, problem.target
    bounds = np.searchsorted(obs.station, np.arange(len(problem.poses) + 1))
    if not target.essential:
        return [''] * len(problem.poses)
    return [', '.join(target.kinds[k] for k in dict.fromkeys(obs.kind[first:last].tolist())
                      if target.kinds[k] in target.essential)
            for first, last in zip(bounds[:-1], bounds[1:], strict=True)]


def _dropped_reports(samples: Sequence[Sample], solution: Solution) -> list[SampleReport]:
    return [SampleReport(samples[i].stamp, False, reason='contradicts the other samples: its '
                         f'residual is {square ** 0.5:.1f} times what its noise explains')
            for i, square in solution.dropped_squares.items()]


def tested_points(used: Sequence[Sample], solution: Solution, fold: NDArray[np.intp] | None = None
                  ) -> tuple[MeasuredPoints, Array, Array]:
    """
    Return the measured points of used samples, their residuals (k,) and those left out (k,).

    The latter are against what the other folds of stations predict. fold: (n,) of each station,
    counted from 0; by default each station is one, of many stations some share one.
    """
    problem, n = solution.problem, len(used)
    measured = measured_points(used, problem)
    if fold is None:
        fold = np.arange(n) % min(n, MOST_FOLDS)
    estimates, poses = solution.predictions(fold)
    p = measured.mapped(poses @ np.array([estimate.X for estimate in estimates])[fold])
    of_point, left_out = fold[measured.station], np.empty(len(p))
    for k, estimate in enumerate(estimates):
        own = np.flatnonzero(of_point == k)
        left_out[own] = problem.target.conditions(
            p[own], measured.kind[own], estimate.state, problem.config).g
    return measured, measured.residuals(
        problem, solution.estimate, solution.corrected_poses()), left_out


def rms_by(number: NDArray[np.intp], residuals: Array, n: int) -> Array:
    """Return the RMS (n,) of the residuals (k,) of each number (k,), NaN for one without any."""
    count = np.bincount(number, minlength=n)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.asarray(np.sqrt(np.bincount(number, residuals ** 2, minlength=n) / count))


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """
    All measured points of the used samples, represented by the target's observations.

    points: (k, 2) of the sensor plane
    kind: (k,)
    station: (k,) the problem's
    """

    points: Array
    kind: NDArray[np.intp]
    station: NDArray[np.intp]

    def select(self, keep: NDArray[np.bool_]) -> MeasuredPoints:
        """Return the points where keep (k,) is true."""
        return MeasuredPoints(self.points[keep], self.kind[keep], self.station[keep])

    def residuals(self, problem: Problem, estimate: Estimate, poses: Array | None = None
                  ) -> Array:
        """
        Return the residuals before whitening, (k,) in metres, at an estimate.

        poses: (n, 4, 4) instead of the reported ones, such as without the robot's smooth error.
        """
        p = self.mapped((problem.poses if poses is None else poses) @ estimate.X)
        return problem.target.conditions(p, self.kind, estimate.state, problem.config).g

    def mapped(self, T: Array) -> Array:
        """Return the points (k, 3) mapped by T (n, 4, 4) of their stations."""
        x, z = self.points.T[:, :, None]
        by_x, by_z, origin = np.moveaxis(T[:, :3, [0, 2, 3]], 2, 0)[:, self.station]
        return np.asarray(by_x * x + by_z * z + origin)


def measured_points(used: Sequence[Sample], problem: Problem) -> MeasuredPoints:
    """
    Return all measured points of samples, in the order of the problem's stations.

    Of more than MOST_POINTS every second, third, ... is taken: their RMS is the same.
    """
    obs = problem.observations
    bounds = np.searchsorted(obs.station, np.arange(len(used) + 1))
    parts = [problem.target.measured(sample, obs.points[first:last], obs.kind[first:last])
             for sample, first, last in zip(used, bounds[:-1], bounds[1:], strict=True)]
    station = np.repeat(np.arange(len(used)), [len(kind) for _, kind in parts])
    points, kind = map(np.concatenate, zip(*parts, strict=True))
    step = max(-(-len(kind) // MOST_POINTS), 1)
    return MeasuredPoints(points[::step], kind[::step], station[::step])
