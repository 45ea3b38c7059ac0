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

from handeye_ros import pipeline, se3, tabulated
from handeye_ros.bags.bag import read
from handeye_ros.bags.session_files import is_session, read_session
from handeye_ros.calibration import measured_points, residuals_and_left_out, rms_by
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.estimation.search import reassigned
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_poses
from handeye_ros.pipeline import Answer
from handeye_ros.results.calibration_file import config_of, input_values
from handeye_ros.results.report import SolvedRecording
from handeye_ros.results.scene import Agreement, StopSnapshot
from handeye_ros.results.table import figures_table, sample_summary
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.sweep import ClockedPoses, passes_expanded, problem_of_known_poses
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
    if tabulated.is_solved_from_files(config):
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
        recording = read(bag, config)
        session = pipeline.gather(recording.profiles, recording.poses, config)
    answer = pipeline.answer_session(session, config)
    stops = [stop_snapshot(stop, config) for stop in session.stops]
    if answer.calibration is None:
        return SolvedRecording(tuple(stops), refusal=str(answer.refusal or ''))
    agreement_of = agreements(session, answer, config)
    reasons = {report.stamp: report.reason for report in answer.calibration.samples
               if not report.used}

    def judged(stop: StopSnapshot) -> StopSnapshot:
        agreement = agreement_of.get(stop.number)
        if agreement and agreement.used:
            return replace(stop, reason='', agreement=agreement)
        reason = reasons.get(stop.stamp, stop.reason)
        return replace(stop, reason=reason or 'the answer uses few of its profiles')
    return SolvedRecording(tuple(map(judged, stops)), answer.calibration)


def recording_of(calibration: Calibration, folder: Path) -> Path:
    """
    Return the recording or session that a calibration names; raises InputError without it.

    folder: of the calibration's file; a relative path is looked for from here, from there and
    from the folders above it.
    """
    for item in calibration.provenance.get('inputs', ()):
        if name := item.get('path') or item.get('session'):
            absolute = folder.absolute()
            places = (place / str(name) for place in (Path(), absolute, *absolute.parents))
            path = next(filter(Path.exists, places), None)
            if path is None:
                raise InputError(f'{name} is not there')
            if path.is_file() and input_values(path)['sha256'] != item.get('sha256'):
                raise InputError(f'{path} has changed since it was solved')
            return path
    raise InputError('the calibration names no recording')


def stop_snapshot(stop: Stop, config: Config) -> StopSnapshot:
    """Return what was seen at a stop."""
    stop, sample, stamp = stop.load(config), stop.sample, stop.result.stamp
    if sample:
        T = sample.T_base_flange
    else:
        T = se3.of_pose(stop.poses[len(stop.poses) // 2])
    points = np.empty((0, 2))
    profile = min(stop.profiles, key=lambda p: abs(p.stamp - stamp), default=None)
    with suppress(UnusableMessageError):
        points = profile.read(config.profile).points if profile else points
    return StopSnapshot(stop.number, stamp, mount_poses(T, config), points,
                        sample.features if sample else (), getattr(stop.result, 'reason', ''))


def agreements(session: Session, answer: Answer, config: Config) -> dict[int, Agreement]:
    """
    Return how each sample of a session agrees with its answer, by the number of the stop.

    Also of samples that are left out of the answer. Without one that shows nothing of the target;
    none where the answer has no solution.
    """
    solution = answer.solution
    if solution is None:
        return {}
    sample_of = {stop.number: stop.sample for stop in session.stops if stop.sample}
    samples, n = [*sample_of.values()], len(sample_of)
    owner = {part.stamp: k for k, sample in enumerate(samples) for part in sample.station_samples}
    stations = np.array([owner[part.stamp] for part in answer.samples])
    of_used = stations[solution.used]
    # a pass is used if the answer uses most of its profiles
    by_answer = 2 * np.bincount(of_used, minlength=n) >= np.maximum(
        np.bincount(stations, minlength=n), 1)
    fold = np.unique(of_used, return_inverse=True)[1].reshape(-1)
    measured, *both = residuals_and_left_out(
        [answer.samples[i] for i in solution.used], solution, fold)
    residual, predicted = (rms_by(of_used[measured.station], r, n) for r in both)
    if not fold.any():
        predicted = residual.copy()
    others = np.flatnonzero(~by_answer)
    residual[others] = predicted[others] = _of_others(
        [samples[k] for k in others], answer.samples[0].clock_values, solution, config)
    return {number: Agreement(float(residual[k]), float(predicted[k]), bool(by_answer[k]))
            for k, number in enumerate(sample_of) if not np.isnan(residual[k])}


def _of_others(samples: Sequence[Sample], clock_values: Sequence[float], solution: Solution,
               config: Config) -> Array:
    """Return the RMS residual (n,) of samples that a solution does not use, NaN without points."""
    ones = list(passes_expanded(samples))
    number = np.repeat(np.arange(len(samples)), [len(s.station_samples) for s in samples])
    if any(sample.moving for sample in ones):
        instants = ClockedPoses.of(ones).at(*clock_values)
        ones = [replace(sample, T_base_flange=T) for sample, T, inside in zip(
            ones, instants.T_base_flange, instants.inside, strict=True) if inside]
        number = number[instants.inside]
    if not ones:
        return np.full(len(samples), np.nan)
    problem = reassigned(problem_of_known_poses(ones, config), solution.estimate)
    measured = measured_points(ones, problem)
    return rms_by(number[measured.station], measured.residuals(problem, solution.estimate),
                  len(samples))


def samples_table(session: Session, answer: Answer, config: Config) -> Table:
    """Return the table of the stops of a session, the worst left-out residual first."""
    agreement_of, rows = agreements(session, answer, config), []
    worst = {number: -agreement.left_out for number, agreement in agreement_of.items()}
    for stop in sorted(session.stops, key=lambda stop: (worst.get(stop.number, 1.0), stop.number)):
        agreement = agreement_of.get(stop.number)
        residuals = [''] * 2 if agreement is None else [
            f'{r * 1e3:.3f} mm' for r in (agreement.residual, agreement.left_out)]
        state = ('no sample' if stop.sample is None else 'excluded' if session.excludes(stop) else
                 'not believed' if agreement and not agreement.used else '')
        rows.append((str(stop.number), *residuals, state, sample_summary(stop.result)))
    return figures_table('number', 'residual', 'left out', '', '', right=range(3), rows=rows)
