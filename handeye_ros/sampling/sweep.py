# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The samples of a moving robot: one for each profile, with poses that depend on three unknown times.

The pose of a profile with stamp t is that of the time t + offset + drift (t - middle of the
sweep). Its rotation is that of a time later by the lag.

- offset: of the clocks, seconds to add to the stamps of the profiles
- drift: the clock of the profiles is slower by this, seconds a second
- lag: the robot reports its rotation later than its position, in seconds

The way of a sweep: StopFinder (stops.py) cuts it into passes of two seconds. A pass gives a sample
of each of its profiles, and its part of the trajectory (_sample_of_pass in features.py).
passes_expanded takes the passes apart and joins their trajectories. with_estimated_clocks finds
the three unknowns and, with them, the pose of each sample: a station of the solve, as any stop is.

The derivative of a condition by an unknown is its derivative by the pose of the flange times the
twist of the flange: one more column each. They need no start value: some of the samples are fitted
from several offsets until one is good, then all. However long a sweep is, MAX_SAMPLES of its
profiles make the answer.

A sweep differs from stops in these places, found by Sample.moving, sampling.moving and, in the
estimation, Problem.is_sweep:

- profiles: fewer points of a line or arc are kept (lines.py, arcs.py)
- stops.py cuts it by time, into passes, all of which is evaluated, but for profiles of unknown
  times (time_margins); features.py combines no profiles, and reads every eighth with the other
  sign of the range too (FLIPPED_EVERY); passes_expanded (here) takes a pass apart, with one
  trajectory for all
- estimation: problem_with_clocks (here) adds the three unknowns; fewer profiles than stops are
  enough (Problem.enough_stations)
- session.py: a pass is never a duplicate, nor taken early; guidance advises to sweep on
- checks: other settings and clocks, and a scale of an answer that fits, are not tried (causes.py);
  with the other sign of the range or other poses the clocks are searched anew (hypotheses.py,
  conventions.py); a move must be larger than the smooth error of the robot (moved.py); edges may
  scatter (refusals.py, require_edges); profiles dropped at one end tell of no move, and a small
  move is compared with wrong times, tried at the reported noise alone, and with a 40th of the
  profiles on either side of it (moved.py); a pass agrees if most of its profiles do (review.py)
- a calibration of a sweep measures at stops all the same (calibration_file.py); a gauge is
  measured in passes (stations.py); a sweep also checks a calibration (check.py); the arm's
  errors are found at the estimated times (robot/from_recordings.py); the node counts profiles
  (solver.py)
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress, islice

from handeye_ros.arithmetic import even_indices, evenly_spaced
from handeye_ros.config import Config
from handeye_ros.data import (
    Array,
    CLOCK_DRIFT,
    ClockValues,
    Reject,
    ROTATION_LAG,
    Sample,
    SEED,
    TIME_OFFSET,
    TURN_LENGTH,
)
from handeye_ros.errors import DataError
from handeye_ros.estimation.basis import smooth_basis_in_time
from handeye_ros.estimation.blocks import Blocks, ParameterBlock, smooth_errors
from handeye_ros.estimation.outliers import typical_square
from handeye_ros.estimation.problem import Estimate, Linearisation, PoseModel, Problem
from handeye_ros.estimation.search import (
    CONVINCING_SQUARE,
    is_convincing,
    mean_log_square,
    robust_fit,
    station_squares,
)
from handeye_ros.sampling.stream import by_stamp
from handeye_ros.sampling.trajectory import FlangeStates, joined, Trajectory
from handeye_ros.targets import problem_of_known_poses
from handeye_ros.targets.profile_target import out_of_face
import numpy as np
from numpy.typing import NDArray

CLOCK_KEYS = TIME_OFFSET, ROTATION_LAG, CLOCK_DRIFT
MIN_SWEEP = 1.0  # s of a sweep: of less any cause may seem to explain what does not fit
NO_POSES = 'there are no poses of that time'
MAX_SAMPLES = 400  # of a sweep, for its answer
SEARCH_SAMPLES = 60  # enough to start from (here) or to find a wrong convention (conventions.py)


def passes_expanded(samples: Sequence[Sample]) -> tuple[Sample, ...]:
    """Return one sample per profile of passes, with their common trajectory; others unchanged."""
    trajectories = [sample.trajectory for sample in samples
                    if sample.trajectory is not None and sample.profile_samples]
    trajectory = joined(trajectories) if trajectories else None
    return tuple(replace(station, trajectory=trajectory) if sample.profile_samples else station
                 for sample in samples for station in sample.station_samples)


class ClockedPoses:
    """
    Poses of n samples as a function of the clocks; those of stops are constant.

    T_base_flange: (n, 4, 4) with the stamps as they are
    stamps: (n,) of the samples, by the clock of the profiles (ns)
    moving: (n,) whether the robot moved
    trajectory: of the whole sweep
    """

    def __init__(self, samples: Sequence[Sample]) -> None:
        """Take samples, at least one of them of a moving robot."""
        self.T_base_flange = np.array([sample.T_base_flange for sample in samples])
        self.stamps = np.array([sample.stamp for sample in samples])
        self.moving = np.array([sample.moving for sample in samples])
        self.trajectory: Trajectory = next(
            sample.trajectory for sample in samples if sample.trajectory is not None)

    @property
    def since_middle(self) -> Array:
        """Return the time (n,) of each sample since the middle of the recording (s)."""
        first, last = int(self.trajectory.stamps[0]), int(self.trajectory.stamps[-1])
        return np.asarray((self.stamps - (first + (last - first) // 2)) * 1e-9)

    def at(self, offset: float, lag: float = 0.0, drift: float = 0.0) -> FlangeStates:
        """Return the flange at each sample; offset, lag (s), drift: as in the module's text."""
        shift = np.rint((offset + drift * self.since_middle) * 1e9).astype(np.int64)
        n, moving = len(self.stamps), self.moving
        flange = self.trajectory.at((self.stamps + shift)[moving], lag)
        T, twists, inside = self.T_base_flange.copy(), np.zeros((n, 6)), np.ones(n, dtype=bool)
        T[moving], twists[moving] = flange.T_base_flange, flange.twists
        inside[moving] = flange.inside
        return FlangeStates(T, twists, inside)

    def with_derivatives(self, clock_values: Array) -> tuple[Array, Array]:
        """Return poses (n, 4, 4), and their derivatives (n, 6, 3) by offset, lag and drift."""
        flange = self.at(*clock_values)
        derivatives = np.stack([flange.twists] * len(CLOCK_KEYS), axis=2)
        derivatives[:, :3, 1] = 0.0  # a lag is of the rotation alone
        derivatives[:, :, 2] *= self.since_middle[:, None]
        return flange.T_base_flange, derivatives


def problem_with_clocks(samples: Sequence[Sample], config: Config) -> Problem:
    """Return the problem of samples, some of a moving robot, with the clocks as unknowns."""
    problem = problem_of_known_poses(samples, config)
    clocked = ClockedPoses(samples)
    stds = config.time_offset_std, config.rotation_lag_std, config.clock_drift_std
    model = PoseModel(
        clocked.with_derivatives, CLOCK_KEYS, stds, np.arange(len(samples)), least_tau_squared=1.0,
        blocks=partial(errors_in_motion, clocked.stamps),
        jitter=np.array([config.noise.stamps, 0.0, 0.0]))
    clock_values = next(sample.clock_values for sample in samples if sample.moving)
    return replace(problem, pose_model=model).with_pose_parameters(np.array(clock_values))


def errors_in_motion(stamps: NDArray[np.int64], linear: Linearisation) -> Blocks:
    """
    Yield the blocks of errors of a moving robot: smooth in time, and of the exposure.

    stamps: (n,) of all samples (ns), of which those of the problem are some.
    """
    position_std, model = linear.problem.config.noise.robot_smooth, linear.problem.pose_model
    assert model is not None
    basis = smooth_basis_in_time((stamps[model.stations] - stamps[0]) * 1e-9,
                                 linear.problem.long_errors)
    shifts, turns = np.hsplit(np.eye(6), 2)
    for name, axes, std in (('tracking_position', shifts, position_std),
                            ('tracking_rotation', turns, position_std / TURN_LENGTH)):
        yield smooth_errors(name, linear, basis, std, axes, reported_as=f'{name}_error')
    exposure = linear.problem.config.profile.exposure
    if exposure:
        # a profile averages over the exposure, and shows a face only while the face is seen: an
        # end shifts by up to half the exposure times the velocity across it, always inwards
        outwards = np.sign(out_of_face(linear))[:, None]
        velocity = np.abs(linear.wrt_twists(linear.problem.pose_twists[:, :, :1]))
        std = exposure / 2
        yield ParameterBlock('exposure', outwards * velocity * std, std)


@dataclass(frozen=True, eq=False)
class SyncedSamples:
    """
    Samples with the poses at the most likely times.

    rejects: samples without poses at their time; problem, estimate: of a sweep, near its solution.
    """

    samples: list[Sample]
    rejects: list[Reject]
    problem: Problem | None = None
    estimate: Estimate | None = None


def with_estimated_clocks(samples: Sequence[Sample], config: Config) -> SyncedSamples:
    """
    Return samples of a moving robot with the poses at the most likely times.

    Of more than MAX_SAMPLES profiles of sweeps only so many remain, evenly chosen: the others are
    neither samples of the answer nor rejects. Samples of stops keep their poses, and without
    a moving robot all remain as they are. Raises DataError for profiles of less than MIN_SWEEP, or
    where too few have poses.
    """
    if not any(sample.moving for sample in samples):
        return SyncedSamples(list(samples), [])
    samples = sorted([*(sample for sample in samples if not sample.moving),
                      *evenly_spaced([sample for sample in samples if sample.moving],
                                     MAX_SAMPLES)], key=by_stamp)
    if (seconds := (samples[-1].stamp - samples[0].stamp) * 1e-9) < MIN_SWEEP:
        raise DataError(f'the profiles that show the target are of {seconds:.1f} s, in which a '
                        'robot hardly turns: record a longer sweep', code='few')
    clocked, problem = ClockedPoses(samples), problem_with_clocks(samples, config)
    fit = _fit_with_clocks(clocked, problem)
    clock_values = ClockValues(*fit.problem.pose_parameters.tolist())
    flange = _flange_at(clock_values, clocked, problem)
    timed = [replace(sample, T_base_flange=T, clock_values=clock_values)
             for sample, T, inside in zip(
                 samples, flange.T_base_flange, flange.inside, strict=True) if inside]
    rejects = [Reject(sample.stamp, NO_POSES) for sample in compress(samples, ~flange.inside)]
    problem = problem.subset(np.flatnonzero(flange.inside))
    return SyncedSamples(timed, rejects, problem.with_pose_parameters(fit.problem.pose_parameters),
                         fit.estimate)


def _fit_with_clocks(clocked: ClockedPoses, problem: Problem) -> Linearisation:
    """Return the fit of the samples that have poses, from the clocks that some of them give."""
    start = _best_over_offsets(problem.subset(even_indices(len(clocked.stamps), SEARCH_SAMPLES)),
                               np.random.default_rng(SEED))
    clock_values = start.problem.pose_parameters
    # profiles in gaps between the poses would pull the offset
    with_poses = np.flatnonzero(_flange_at(clock_values, clocked, problem).inside)
    return robust_fit(problem.subset(with_poses).with_pose_parameters(clock_values),
                      start.estimate)


def _flange_at(clock_values: Iterable[float], clocked: ClockedPoses, problem: Problem
               ) -> FlangeStates:
    """Return the flange at each sample; raises DataError where few have poses at their time."""
    flange, least = clocked.at(*clock_values), problem.target.min_samples
    if (count := flange.inside.sum()) < least:
        raise DataError(f'at the time offset that fits best, {count} of {len(flange.inside)} '
                        f'profiles have poses of their time, and {problem.target.name} needs '
                        f'{least}: record a longer sweep', code='few')
    return flange


def _best_over_offsets(problem: Problem, rng: np.random.Generator) -> Linearisation:
    """
    Return the best fit over several offsets, or the first convincing one.

    After an offset at which most samples fit, none further from zero is tried.
    """
    fits, loss = list[Linearisation](), partial(mean_log_square, problem)
    for offset in sorted(np.arange(-10, 11, 2), key=abs):  # prior sigmas
        clock_values = np.zeros(len(problem.pose_parameters))
        clock_values[0] = offset * problem.config.time_offset_std
        shifted = problem.with_pose_parameters(clock_values)
        for start in islice(shifted.target.starts(shifted, rng), 3):
            fits.append(robust_fit(shifted, start))
            if is_convincing(problem, fits[-1]):
                return fits[-1]
        if typical_square(station_squares(problem, min(fits, key=loss))) < CONVINCING_SQUARE:
            break
    return min(fits, key=loss)
