# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The residual of each sample against the others, and what was seen at each stop.

The review needs three samples. Its fit is that of the solver, without the checks of an answer.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, Reject, Sample
from handeye_ros.errors import DataError, UnusableMessageError
from handeye_ros.estimation.problem import Problem, UNUSED
from handeye_ros.estimation.search import robust_solution
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import in_mount, mounted
from handeye_ros.results.evidence import StopSnapshot
from handeye_ros.results.outcome import left_out, Measured, measured_points
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.session import Outcome, Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.sweep import Pairing, single_samples, synchronised
import numpy as np

FEWEST = 3  # samples that can be compared
MOST_SINGLE = 120  # profiles of all passes that are compared
TOO_FAR = 5e-3  # m from every edge of the target: it is another one, or the fit is still wrong


class NoReviewError(DataError):
    """Samples that are too few, or from which no fit can start."""

    def __init__(self, samples: int) -> None:
        super().__init__(f'{samples} samples are used: at least {FEWEST} are needed for residuals')


@dataclass(frozen=True)
class Agreement:
    """
    RMS distances of a sample's points to the fitted target, in metres.

    residual: from the fit; left_out: from the fit without this sample; used: whether the fit
    believes it. Both residuals are the same for a sample that the fit does not use.
    """

    residual: float
    left_out: float
    used: bool


@dataclass(frozen=True, eq=False)
class Review:
    """
    The residuals of all samples with their common fit.

    agreements: one for each sample, None for one that shows nothing of the fitted target;
    solution: the fit, however uncertain.
    """

    agreements: tuple[Agreement | None, ...]
    solution: Solution


def review(samples: Sequence[Sample], included: Sequence[bool], config: Config) -> Review:
    """
    Return the residuals of samples; excluded ones are compared with the fit of the others.

    Raises NoReviewError for too few, DataError where no fit can be started.
    """
    if any(sample.single for sample in samples):
        return _of_passes(samples, included, config)
    # as in a solve: only edges that agree over all samples, none at the border of the view
    kept = with_common_shape([s for s, use in zip(samples, included, strict=True) if use])
    by_stamp = {sample.stamp: sample for sample in kept}
    chosen = [i for i, use in enumerate(included) if use and samples[i].stamp in by_stamp]
    samples = [by_stamp.get(s.stamp, s) for s in samples]
    if len(chosen) < FEWEST:
        raise NoReviewError(len(chosen))
    method = targets.method_for(config)
    fitted = [samples[i] for i in chosen]
    problem = Problem(method, mounted(fitted, config), method.observe(fitted), config)
    solution = robust_solution(problem, np.random.default_rng(0))
    rms = _residuals(samples, solution, config)
    used = {chosen[place]: k for k, place in enumerate(solution.used)}
    found = [None if np.isnan(value) else Agreement(float(value), float(value), i in used)
             for i, value in enumerate(rms)]
    predicted = _left_out([samples[i] for i in used], solution)
    for i, k in used.items():
        if np.isfinite(rms[i]):
            found[i] = Agreement(float(rms[i]), float(predicted[k]), True)
    return Review(tuple(found), solution)


def _of_passes(samples: Sequence[Sample], included: Sequence[bool], config: Config) -> Review:
    """Return the review of passes, each of several profiles, at the estimated time offset."""
    each = max(sum(len(sample.single) for sample in samples) // MOST_SINGLE, 1)
    fewer = [replace(sample, single=sample.single[::each]) for sample in samples]
    number = np.repeat(np.arange(len(fewer)), [len(sample.single) or 1 for sample in fewer])
    ones, use = single_samples(fewer), np.asarray(included, dtype=bool)[number]
    moved = synchronised([one for one, used in zip(ones, use, strict=True) if used], config)
    at = Pairing.of(ones).at(*moved.samples[0].offsets)
    found = review([replace(one, T_base_flange=T) for one, T in zip(
        ones, at.T_base_flange, strict=True)], list(use & at.inside), config)
    of_each = [[one for one, own in zip(found.agreements, number == k, strict=True) if one and own]
               for k in range(len(fewer))]
    return Review(tuple(_together(ones) for ones in of_each), found.solution)


def _together(ones: Sequence[Agreement]) -> Agreement | None:
    """Return the agreement of a pass from that of its profiles."""
    if not ones:
        return None
    believed = [one for one in ones if one.used]
    used = 2 * len(believed) >= len(ones)
    rms = np.sqrt(np.mean([(one.residual ** 2, one.left_out ** 2)
                           for one in (believed if used else ones)], axis=0))
    return Agreement(float(rms[0]), float(rms[1]), used)


def _residuals(samples: Sequence[Sample], solution: Solution, config: Config) -> Array:
    """Return the RMS residual (n,) of each sample at a solution, NaN without observations."""
    method, estimate = solution.problem.method, solution.estimate
    whole = Problem(method, mounted(samples, config), method.observe(samples), config)
    labelled = method.relabel(whole.observations, whole.points_in_base(estimate.X),
                                       estimate.target, config)
    problem = Problem(method, whole.poses, labelled.select(labelled.kind != UNUSED), config)
    measured = measured_points(samples, problem)
    return _rms(measured, measured.residuals(problem, estimate), len(samples))


def _left_out(used: Sequence[Sample], solution: Solution) -> Array:
    """Return the RMS residual (n,) of each used sample from the fit to the others."""
    measured = measured_points(used, solution.problem)
    n = len(used)
    return _rms(measured, left_out(solution, measured, max_folds=n), n)


def _rms(measured: Measured, residuals: Array, n: int) -> Array:
    """Return the RMS (n,) of the residuals (k,) of each station."""
    squares = residuals ** 2
    count = np.bincount(measured.station, minlength=n)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.asarray(np.sqrt(np.bincount(measured.station, squares, minlength=n) / count))


def flat_crossing(sample: Sample, solution: Solution, config: Config) -> str:
    """Return a sentence if the laser crosses an edge at too small an angle, else ''."""
    edges = [f.point for f in sample.features if isinstance(f, EdgePoint)]
    kinds = solution.problem.method.essential
    if not edges or not kinds:
        return ''
    angles = [_crossing([sample], np.array(edges), solution, kind, config) for kind in kinds]
    distance, angle, kind = min(zip(*zip(*angles, strict=True), kinds, strict=True))
    if distance > TOO_FAR or angle >= config.sampling.min_crossing_angle:
        return ''
    return (f'the laser crosses {kind} at {np.degrees(angle):.0f} degrees, less than '
            f'sampling.min_crossing_angle ({np.degrees(config.sampling.min_crossing_angle):.0f} '
            'degrees), so its edge point cannot count: turn the tool about the range axis')


def _with(problem: Problem, kind: int) -> list[int]:
    """Return the kinds of conditions that edge points of a kind have, this kind first."""
    obs = problem.observations
    points = obs.station * (obs.source.max() + 1) + obs.source
    seen = np.unique(obs.kind[np.isin(points, points[obs.kind == kind])])
    return [kind, *(int(k) for k in seen if k not in (kind, UNUSED))]


def _crossing(samples: Sequence[Sample], points: Array, solution: Solution, name: str,
              config: Config) -> tuple[float, float]:
    """Return distance to an edge (m) and crossing angle (rad) of the nearest of points (n, 2)."""
    method, estimate = solution.problem.method, solution.estimate
    pose = mounted(samples, config)[0] @ estimate.X
    in_base = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]
                              ) @ pose[:3, :3].T + pose[:3, 3]
    found = [method.conditions(in_base, np.full(len(points), kind), estimate.target,
                                        config)
             for kind in _with(solution.problem, method.kinds.index(name))]
    distance = np.linalg.norm([one.g for one in found], axis=0)
    nearest = int(np.argmin(distance))
    across = np.array([one.dg_dp[nearest] for one in found])
    along_laser = across @ pose[:3, 0] / np.linalg.norm(across, axis=1)
    steepness = min(1.0, float(np.linalg.norm(along_laser)))
    return float(distance[nearest]), float(np.arcsin(steepness))


NAMES = {'FaceLine': 'face line', 'EdgePoint': 'edge point', 'Arc': 'arc'}


def count_of(count: int, what: str) -> str:
    """Return a number with its noun: `1 sample`, `2 samples`."""
    return f'{count} {what}' if count == 1 else f'{count} {what}s'


def sample_summary(sample: Sample | Reject) -> str:
    """Return what a sample shows, or why there is none, in words."""
    if isinstance(sample, Reject):
        return sample.reason
    counts = Counter(NAMES[type(feature).__name__] for feature in sample.features)
    seen = ', '.join(count_of(count, name) for name, count in counts.items())
    return f'{seen} from {count_of(sample.profiles, "profile")}'


def stop_snapshots(session: Session, config: Config) -> tuple[StopSnapshot, ...]:
    """Return what was seen at all stops, in the order of their numbers, none marked as used."""
    return tuple(stop_snapshot(outcome, config) for outcome in session.outcomes)


def stop_snapshot(outcome: Outcome, config: Config) -> StopSnapshot:
    """Return what was seen at a stop."""
    stop, sample = outcome.stop.load(config), outcome.sample
    stamp = outcome.result.stamp
    T = sample.T_base_flange if sample else _middle(stop)
    return StopSnapshot(outcome.number, stamp, in_mount(T, config), _points(stop, stamp, config),
                        sample.features if sample else (), getattr(outcome.result, 'reason', ''),
                        samples=tuple(s.stamp for s in sample.single) if sample else ())


def _points(stop: Stop, stamp: int, config: Config) -> Array:
    """Return the points of the profile nearest to a stamp, none if it is unusable."""
    profile = min(stop.profiles, key=lambda p: abs(p.stamp - stamp), default=None)
    if profile is not None:
        with suppress(UnusableMessageError):
            return profile.read(config.profile).points
    return np.empty((0, 2))


def _middle(stop: Stop) -> Array:
    pose = stop.poses[len(stop.poses) // 2]
    return se3.from_quaternion(pose.translation, pose.quaternion)
