# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From profiles and poses to the hand-eye transform: the whole flow.

`calibrate` takes a recording, `solve` takes samples: both `calibrate` and the node end with it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from handeye_ros import targets
from handeye_ros.checks.consistency import require_answer, require_own_frame, require_solvable
from handeye_ros.checks.conventions import Flipped, require_agreement
from handeye_ros.checks.errors import LeftOutError, TooUncertainError
from handeye_ros.checks.review import stop_snapshots
from handeye_ros.checks.settings import require_same_clock, require_settings
from handeye_ros.checks.shape import (
    believable_shape,
    believable_size,
    notes_of,
    offset_notes,
    reported_blocks,
    require_one_scale,
    time_offset_of,
)
from handeye_ros.config import Config, flipped_range
from handeye_ros.data import AnyProfile, Array, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, NamedCauseError
from handeye_ros.estimation.least_squares import single_threaded
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import robust_solution, with_blocks
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mounted
from handeye_ros.guidance import advice
from handeye_ros.results.evidence import Evidence, evidence_of
from handeye_ros.results.outcome import describe_calibration, NuisanceReport
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import problem_of, single_samples, synchronised
import numpy as np

Solver = Callable[[Sequence[Sample], Sequence[Reject], Config, str], Calibration]

SEED = 0  # of the random searches: the same samples give the same answer


def calibrate(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config
              ) -> Calibration:
    """
    Return the calibration from a recording, its messages in the order of their stamps.

    Raises DataError when the recording cannot carry an answer.
    """
    return calibrate_session(gather(profiles, poses, config), config)


def calibrate_session(session: Session, config: Config) -> Calibration:
    """Return the calibration from the samples of a session; raises DataError without one."""
    calibration = solve_session(session, config)
    return with_warnings(calibration, session.warnings) if session.warnings else calibration


def solve_session(session: Session, config: Config, solver: Solver | None = None) -> Calibration:
    """
    Return the calibration from the samples of a session, as solve does.

    solver: the function that solves, by default solve.
    Raises DataError if there is no answer: WrongSettingError, or reason clocks_differ, if one of
    these explains why the samples do not fit.
    """
    session.require_stations()
    config = session.with_base(config)
    try:
        return (solver or solve)(session.samples, session.rejects, config, session.frame_id)
    except DataError as error:
        if not isinstance(error, NamedCauseError):
            require_settings(session, config)
        if not isinstance(error, NamedCauseError) or isinstance(error, TooUncertainError):
            require_same_clock(session, config)
        raise


@single_threaded
def gather(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config) -> Session:
    """
    Return the samples and rejects of a recording, its messages in the order of their stamps.

    Raises DataError when it holds no stations, InputError for numbers that are no pose.
    """
    session = Session(config)
    for pose in poses:
        pose.require_values()
        session.add_pose(pose)
    for profile in profiles:
        session.add_profile(profile)
    session.finish()
    session.require_stations()
    return session


def solve(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config, frame_id: str
          ) -> Calibration:
    """
    Return the calibration from samples, in any order.

    rejects: stations that gave no sample, for the report; frame_id: of the profiles.
    Raises DataError when the samples cannot carry an answer.
    """
    return solved(samples, rejects, config, frame_id)[0]


@single_threaded
def solved(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config, frame_id: str
           ) -> tuple[Calibration, list[Sample], Solution]:
    """Return the calibration as solve does, the samples it comes from, and the solution."""
    require_own_frame(frame_id, config)
    ordered = with_common_shape(sorted(samples, key=lambda sample: sample.stamp))
    moved = synchronised(ordered, config)
    ordered, rejects = moved.samples, [*rejects, *moved.rejects]
    agreed = estimate(ordered, rejects, config, moved.estimate)
    if config.kinematics:
        from handeye_ros.robot.uncertainty import with_arm_errors
        agreed = with_arm_errors(agreed, Path(config.kinematics))
    warning = require_answer(agreed, config)
    nuisances = NuisanceReport(reported_blocks(agreed), notes_of(agreed, config),
                               time_offset_of(agreed))
    calibration = describe_calibration(ordered, rejects, agreed, nuisances, config, frame_id)
    if warning:
        calibration = with_warnings(calibration, [warning])
    if not calibration.quality.holdout_rms <= config.limits.residual:
        quality = calibration.quality
        raise LeftOutError(quality.holdout_rms, quality.residual_rms, config.limits.residual)
    return calibration, [ordered[i] for i in agreed.used], agreed


def with_warnings(calibration: Calibration, warnings: Sequence[str]) -> Calibration:
    """Return a calibration with further warnings in its provenance."""
    every = [*calibration.provenance.get('warnings', ()), *warnings]
    return replace(calibration, provenance={**calibration.provenance, 'warnings': every})


def evidence(session: Session, config: Config) -> Evidence:
    """
    Return the stops of a session, and its answer or refusal, for the report.

    Raises DataError when it holds no stations; a later refusal is in Evidence.refusal.
    """
    session.require_stations()
    seen = stop_snapshots(session, config)
    try:
        found, used, solution = solved(session.samples, session.rejects,
                                       session.with_base(config), session.frame_id)
    except DataError as error:
        return Evidence(seen, refusal=str(error))
    return evidence_of(seen, used, solution, found)


@single_threaded
def advise(samples: Sequence[Sample], config: Config, seen: Array | None = None,
           refused: Sequence[Array] = ()) -> advice.Advice:
    """
    Return what to do next after samples, in the order of their stamps.

    seen: points (n, 2) of profiles, from which the field of view is learnt; refused: poses of the
    flange (4, 4) at which stops gave no sample.
    """
    solution, trouble = None, ''
    samples = single_samples(samples)
    ordered = with_common_shape(samples)
    if len(ordered) >= targets.method_for(config).minimum:
        try:
            moved = synchronised(ordered, config)
            solution = estimate(moved.samples, (), config, moved.estimate)
        except DataError as error:
            trouble = str(error)
    notes = offset_notes(solution) if solution else ()
    return advice.advise(samples, config, solution, trouble, seen, refused, notes)


def estimate(ordered: Sequence[Sample], rejects: Sequence[Reject], config: Config,
             start: Estimate | None = None) -> Solution:
    """
    Return the consensus: the samples that agree, and their solution, however uncertain.

    start: the only start to use, if it is known.
    Raises DataError when the samples cannot be solved or contradict each other.
    """
    require_solvable(ordered, rejects, config, targets.method_for(config))
    problem = problem_of(ordered, config)
    rng = np.random.default_rng(SEED)
    agreed = believable_shape(problem, robust_solution(problem, rng, True, start), rng)
    require_agreement(problem, agreed, flipped(ordered, problem))
    agreed = believable_size(with_blocks(agreed))
    require_one_scale(agreed)
    return agreed


def flipped(ordered: Sequence[Sample], problem: Problem) -> Flipped | None:
    """Return the problem with the opposite profile.range_sign, None with too few samples."""
    config = flipped_range(problem.config)
    others = with_common_shape([replace(s, features=s.flipped) for s in ordered if s.flipped])
    if len(others) < problem.method.minimum:
        return None
    number = {sample.stamp: k for k, sample in enumerate(ordered)}
    return _at_stops(others, config), np.array([number[sample.stamp] for sample in others])


def at_stops(samples: Sequence[Sample], config: Config) -> tuple[Sequence[Sample], Problem]:
    """Return the samples that solve uses, and their problem with constant poses."""
    ordered = with_common_shape(sorted(samples, key=lambda sample: sample.stamp))
    ordered = synchronised(ordered, config).samples
    return ordered, _at_stops(ordered, config)


def _at_stops(samples: Sequence[Sample], config: Config) -> Problem:
    method = targets.method_for(config)
    return Problem(method, mounted(samples, config), method.observe(samples), config)
