# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What a recording or a session shows beside its answer: its stops, and how well each agrees.

Everything here reads the one answer of the pipeline, so that no table contradicts it.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from handeye_ros import pipeline, se3
from handeye_ros.bags.recording import read_bag
from handeye_ros.bags.session_files import is_session, read_session
from handeye_ros.calibration import measured_points, residuals_and_left_out
from handeye_ros.config import Config, SOLVED_FROM_FILES
from handeye_ros.data import Agreement, Array, Calibration, ClockValues, Sample, StopSnapshot
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.estimation.least_squares import rms_by
from handeye_ros.estimation.search import reassigned
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_poses
from handeye_ros.pipeline import Answer
from handeye_ros.results.calibration_file import config_of
from handeye_ros.results.file_values import input_provenance
from handeye_ros.results.printed import figures_table, sample_summary
from handeye_ros.results.report import SolvedRecording
from handeye_ros.sampling.edge_shapes import common_shape, EdgeShape, with_common_edge_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.sweep import ClockedPoses, passes_expanded
from handeye_ros.targets import problem_of_known_poses
import numpy as np
from rich.table import Table


def solved_recording(calibration: Calibration, bag: Path | None, folder: Path = Path()
                     ) -> SolvedRecording:
    """
    Return a recording or session solved again; bag: None for the one named in the calibration.

    folder: that holds the calibration's file. Without a recording, `missing` gives the reason.
    Raises InputError for an unreadable bag, DataError for one without stops.
    """
    config = config_of(calibration)
    if config.target.type in SOLVED_FROM_FILES:
        return SolvedRecording(missing='stops are shown of recordings; this was solved from files')
    if bag is None:
        try:
            bag = recording_of(calibration, folder)
        except InputError as error:
            return SolvedRecording(missing=f'{error}, so its stops are not shown: name the '
                                   'recording with --bag')
    # the stops of a session are stored one by one, not in the order of time
    if is_session(bag):
        session = read_session(bag).session(config)
    else:
        recording = read_bag(bag, config)
        session = pipeline.gather(recording.profiles, recording.poses, config)
    answer = pipeline.answer_session(session, config)
    stops = [stop_snapshot(stop, config) for stop in session.stops]
    if answer.calibration is None:
        return SolvedRecording(tuple(stops), refusal=str(answer.refusal or ''))
    agreement_of_stop = agreements(session, answer)
    reasons = {report.stamp: report.reason for report in answer.calibration.samples
               if not report.used}

    def with_verdict(stop: StopSnapshot) -> StopSnapshot:
        agreement = agreement_of_stop.get(stop.number)
        if agreement and agreement.used:
            return replace(stop, reason='', agreement=agreement)
        reason = reasons.get(stop.stamp, stop.reason)
        return replace(stop, reason=reason or 'the answer uses few of its profiles')
    return SolvedRecording(tuple(map(with_verdict, stops)), answer.calibration)


def recording_of(calibration: Calibration, folder: Path) -> Path:
    """
    Return the recording or session that a calibration names; raises InputError without it.

    folder: of the calibration's file; a relative path is looked for from here, from there and
    from the folders above it.
    """
    absolute, found = folder.absolute(), []
    for item in calibration.provenance.get('inputs', ()):
        if name := item.get('path') or item.get('session'):
            places = (place / str(name) for place in (Path(), absolute, *absolute.parents))
            path = next(filter(Path.exists, places), None)
            if path is None:
                raise InputError(f'{name} is not there')
            if path.is_file() and input_provenance(path)['sha256'] != item.get('sha256'):
                raise InputError(f'{path} has changed since it was solved')
            found.append(path)
    if found:  # of a recording in several files, their folder
        return found[0].parent if found[0].parent in [p.parent for p in found[1:]] else found[0]
    raise InputError('the calibration names no recording')


def stop_snapshot(stop: Stop, config: Config) -> StopSnapshot:
    """Return what was seen at a stop."""
    stop, sample, stamp = stop.load(config), stop.sample, stop.result.stamp
    T = sample.T_base_flange if sample else se3.of_pose(stop.poses[len(stop.poses) // 2])
    points = np.empty((0, 2))
    nearest = min(stop.profiles, key=lambda profile: abs(profile.stamp - stamp), default=None)
    with suppress(UnusableMessageError):
        points = nearest.read(config.profile).points if nearest else points
    return StopSnapshot(stop.number, stamp, mount_poses(T, config), points,
                        sample.features if sample else (), getattr(stop.result, 'reason', ''))


def agreements(session: Session, answer: Answer) -> dict[int, Agreement]:
    """
    Return how each sample of a session agrees with its answer, by the number of the stop.

    Samples that the answer does not use are compared with it too; samples of which no point lies
    on the target are missing, and all where the answer has no solution.
    """
    solution = answer.solution
    if solution is None:
        return {}
    sample_of = {stop.number: stop.sample for stop in session.stops if stop.sample}
    samples, n = [*sample_of.values()], len(sample_of)
    stamps_used = [answer.samples[i].stamp for i in solution.used_stations]
    used = dict.fromkeys([station.stamp for station in answer.samples], False)
    used |= dict.fromkeys(stamps_used, True)
    is_used = np.array([sample.is_used(used) for sample in samples])
    # index of the sample that each used station comes from
    index_of = {station.stamp: k for k, sample in enumerate(samples)
                for station in sample.station_samples}
    sample_of_used = np.array([index_of[stamp] for stamp in stamps_used])
    # each sample is predicted from the others, of a pass with all of its profiles
    fold = np.unique(sample_of_used, return_inverse=True)[1].reshape(-1)
    measured, *residuals_of_points = residuals_and_left_out(
        [answer.samples[i] for i in solution.used_stations], solution, fold)
    residual, left_out = (rms_by(sample_of_used[measured.station], of_points, n)
                          for of_points in residuals_of_points)
    if not fold.any():  # a single one
        left_out = residual.copy()
    unused = np.flatnonzero(~is_used)
    shape = common_shape([station for station in session.samples if station.stamp in used])
    residual[unused] = left_out[unused] = _residuals_of_unused(
        [samples[k] for k in unused], shape, answer.samples[0].clock_values, solution,
        session.config)
    return {number: Agreement(float(residual[k]), float(left_out[k]), bool(is_used[k]))
            for k, number in enumerate(sample_of) if not np.isnan(residual[k])}


def _residuals_of_unused(samples: Sequence[Sample], shape: EdgeShape, clock_values: ClockValues,
                         solution: Solution, config: Config) -> Array:
    """
    Return the RMS residual (n,) of samples that a solution does not use, NaN without points.

    shape: of the edges of those used; clock_values: of a moving robot, as the solution has
    estimated them.
    """
    stations = with_common_edge_shape(passes_expanded(samples), shape)
    sample_of_station = np.repeat(np.arange(len(samples)),
                                  [len(sample.station_samples) for sample in samples])
    if any(station.moving for station in stations):
        flange = ClockedPoses(stations).at(*clock_values)
        stations = [replace(station, T_base_flange=T) for station, T, inside in zip(
            stations, flange.T_base_flange, flange.inside, strict=True) if inside]
        sample_of_station = sample_of_station[flange.inside]
    if not stations:
        return np.full(len(samples), np.nan)
    problem = reassigned(problem_of_known_poses(stations, config), solution.estimate)
    measured = measured_points(stations, problem)
    return rms_by(sample_of_station[measured.station],
                  measured.residuals(problem, solution.estimate), len(samples))


def samples_table(session: Session, answer: Answer) -> Table:
    """Return the table of the stops of a session, the worst left-out residual first."""
    agreement_of_stop, rows = agreements(session, answer), []
    order = {number: -agreement.left_out for number, agreement in agreement_of_stop.items()}
    for stop in sorted(session.stops, key=lambda stop: (order.get(stop.number, 1.0), stop.number)):
        agreement = agreement_of_stop.get(stop.number)
        residuals = [''] * 2 if agreement is None else [
            f'{metres * 1e3:.3f} mm' for metres in (agreement.residual, agreement.left_out)]
        state = ('no sample' if stop.sample is None else 'excluded' if session.excludes(stop) else
                 'not used' if agreement and not agreement.used else '')
        rows.append((str(stop.number), *residuals, state, sample_summary(stop.result)))
    return figures_table('number', 'residual', 'left out', '', '', right=range(3), rows=rows)
