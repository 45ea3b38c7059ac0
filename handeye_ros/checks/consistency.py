# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether samples and poses determine an answer and agree with it.

Frames and rotations of a recording; redundancy and uncertainty of an answer; its residuals.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros.checks.alternatives import LARGEST_DROPPED_SHARE
from handeye_ros.checks.change_point import moved_slightly, require_unmoved
from handeye_ros.checks.errors import (
    ContradictingStationsError,
    InconsistentError,
    OneAxisError,
    OneOrientationError,
    ScatterError,
    SensorFrameError,
    TooFewConditionsError,
    TooFewSamplesError,
    TooUncertainError,
    UnidentifiedOutlierError,
)
from handeye_ros.checks.shape import require_edges, require_not_only_scale
from handeye_ros.config import Config, LimitsConfig
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import degrees, mm
from handeye_ros.estimation.problem import Problem, Target
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_frame, mounted, name_direction, other_axes
from handeye_ros.se3 import worst_rotation, worst_translation
import numpy as np
from scipy.spatial.transform import Rotation

FEWEST_REDUNDANT = 3  # redundant conditions needed, and as many for each dropped station
CONTAMINATED = 0.1  # largest probability that one of few samples is wrong
SURE = 0.99  # the same if several stations were dropped and similar surfaces may be confused
SMALLEST_TURN = 0.01  # rad: less RMS rotation about an axis counts as none
MISFITTING = 9.0  # variance factor (3 sigma) above which other causes than noise are tested


def require_solvable(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
                     method: Target) -> None:
    """
    Raise for samples without an answer: number of samples, rotations.

    Raises TooFewSamplesError, OneOrientationError and OneAxisError.
    """
    _require_samples(samples, rejects, method)
    require_rotations(mounted(samples, config), mount_frame(config), method.one_axis)


def require_answer(agreed: Solution, config: Config) -> str:
    """
    Raise for an answer that is untestable, too uncertain or ignores edges; return a warning.

    Raises DataError. The warning says that sensor or target moved slightly, '' if not.
    """
    _require_judged(agreed)
    warning = moved_slightly(agreed)  # first: a move also makes the answer uncertain
    require_certain(agreed, config)
    _require_points(agreed, config)
    require_edges(agreed)
    return warning


def _require_samples(samples: Sequence[Sample], rejects: Sequence[Reject], method: Target) -> None:
    """Raise TooFewSamplesError when there are fewer samples than the method needs."""
    if len(samples) < method.minimum:
        reasons = [reason for reason, _ in Counter(r.reason for r in rejects).most_common()]
        raise TooFewSamplesError(method.name, len(samples), method.minimum, len(rejects),
                                 reasons[0] if reasons else '')


def require_own_frame(frame_id: str, config: Config) -> None:
    """
    Raise SensorFrameError if the profiles are in a frame with the name of a robot frame.

    frame_id: of the profiles. The answer would relate a frame to itself.
    """
    for key, robots in (('robot_effector_frame', config.robot_effector_frame),
                        ('robot_base_frame', config.base_frame)):
        if frame_id == robots:
            raise SensorFrameError(frame_id, key)


def require_rotations(poses: Array, frame: str, lost: str) -> None:
    """
    Raise for poses (n, 4, 4) that rotate about no axis, or about only one.

    frame: the mount frame, in which the axis is reported; lost: what one axis leaves unknown.
    Raises OneOrientationError and OneAxisError.
    """
    turns, axes = turning(poses)
    if turns[0] < SMALLEST_TURN:
        raise OneOrientationError(float(turns[0]))
    if turns[1] < SMALLEST_TURN:
        raise OneAxisError(name_direction(axes[0], frame), float(turns[0]),
                           other_axes(axes[0], frame), lost)


def turning(poses: Array) -> tuple[Array, Array]:
    """
    Return the RMS rotations (3,) of poses (n, 4, 4) in rad, and their principal axes (3, 3).

    Largest first; the axes are the rows, in the frame that the sensor is fixed in.
    """
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    _, s, axes = np.linalg.svd(vectors - vectors.mean(axis=0), full_matrices=len(vectors) < 3)
    turns = np.zeros(3)
    turns[:len(s)] = s / len(poses) ** 0.5
    return turns, axes


def require_certain(agreed: Solution, config: Config) -> None:
    """
    Raise for an answer with larger uncertainty than the limits.

    Raises TooUncertainError, which names the direction and the motion that is missing.
    """
    solution, poses = agreed, agreed.whole.poses
    limits, frame = config.limits, mount_frame(config)
    turn_std, axis = worst_rotation(solution.reported)
    if turn_std > limits.rotation:
        raise TooUncertainError.rotation(name_direction(axis, frame), turn_std, limits.rotation,
                                         missing_motion(poses, frame))
    shift_std, direction = worst_translation(solution.reported)
    if shift_std > limits.translation:
        raise TooUncertainError.translation(name_direction(direction, frame), shift_std,
                                            limits.translation,
                                            missing_motion(poses, frame))


def _require_points(agreed: Solution, config: Config) -> None:
    """Raise TooUncertainError where the measured points are more uncertain than the limit."""
    limit, frame = config.limits.points, mount_frame(config)
    std, direction = _worst_points(agreed)
    if std > limit:
        raise TooUncertainError(
            f'the points that the samples show are uncertain by {mm(std)} along '
            f'{name_direction(direction, frame)} (1 sigma; limits.points is {mm(limit)}): '
            f'{missing_motion(agreed.whole.poses, frame)}')


def _worst_points(solution: Solution) -> tuple[float, Array]:
    """
    Return the largest 1 sigma (m) of the observed points in the mount, and its direction (3,).

    A rotation and a translation that make up for each other at the target are no uncertainty of
    what the sensor measures; each alone may be large.
    """
    turned = solution.problem.observations.points @ solution.estimate.X[:3, [0, 2]].T
    by_rotation = np.cross(np.eye(3), turned[:, None, :]).swapaxes(1, 2)
    moved = np.concatenate([np.broadcast_to(np.eye(3), by_rotation.shape), by_rotation], axis=2)
    mean = np.einsum('kij,jl,kml->im', moved, solution.reported[:6, :6], moved) / len(moved)
    values, vectors = np.linalg.eigh(mean)
    return float(np.sqrt(values[-1])), vectors[:, -1]


def _require_judged(agreed: Solution) -> None:
    """
    Raise for an answer with too few redundant conditions to test it.

    Raises TooFewConditionsError. Raises UnidentifiedOutlierError if a sample is probably wrong,
    and without it too few conditions would remain or others may be wrong too.
    """
    dropped, left = len(agreed.dropped), agreed.redundancy
    needed = FEWEST_REDUNDANT * (1 + dropped) + bool(dropped)
    if left < needed:
        raise TooFewConditionsError(len(agreed.used), dropped, left, needed)
    each = int(agreed.ranks.max())
    missing = FEWEST_REDUNDANT * (2 + dropped) + 1 - (left - each)
    not_all_found = agreed.contaminated > SURE and dropped > 1 and agreed.whole.ambiguous
    if not_all_found or (agreed.contaminated > CONTAMINATED and missing > 0):
        raise UnidentifiedOutlierError(len(agreed.used), max(1, -(-missing // each)))


def missing_motion(poses: Array, frame: str) -> str:
    """Return in words the motion that poses (n, 4, 4) lack."""
    turns, axes = turning(poses)
    if turns[1] > 0.12:  # rad RMS: tilts by 12 degrees to both sides
        return ('take more samples with the target in all parts of the field of view (near, far, '
                'left, right), each with another tilt')
    return (f'the poses turn by only {degrees(turns[1])} RMS about '
            f'{name_direction(axes[1], frame)}; tilt the tool about this axis by 15 degrees or '
            'more to both sides')


@dataclass(frozen=True)
class Misfit:
    """Residuals of samples against an answer: RMS and expected RMS (m), share dropped."""

    rms: float
    expected: float
    share: float
    variance_factor: float
    limits: LimitsConfig

    @property
    def wild(self) -> bool:
        """Return whether the residuals exceed any plausible noise or robot error."""
        return self.rms > self.limits.scatter * self.expected or (
            self.variance_factor > 40.0 and self.rms > 4.0 * self.expected)

    @property
    def hopeless(self) -> bool:
        """Return whether no answer is possible."""
        return (self.share > LARGEST_DROPPED_SHARE or self.rms > self.limits.residual
                or self.wild)


def misfit_of(problem: Problem, agreed: Solution) -> Misfit:
    """Return the misfit of the samples of a problem."""
    return Misfit(agreed.residual_rms, agreed.expected_rms,
                  len(agreed.dropped) / len(problem.poses), agreed.variance_factor,
                  problem.config.limits)


def require_consistent(problem: Problem, agreed: Solution) -> None:
    """
    Raise for an answer that samples or poses contradict.

    Too little rotation of the poses is reported first, since it can cause the other errors.

    Raises TooUncertainError, MovedError, ScaleError, InconsistentError,
    ContradictingStationsError or ScatterError.
    """
    misfit = misfit_of(problem, agreed)
    if misfit.hopeless:
        require_certain(agreed, problem.config)
        require_unmoved(problem, agreed)
    require_not_only_scale(agreed)
    if misfit.rms > misfit.limits.residual:
        raise InconsistentError(misfit.rms, misfit.limits.residual)
    if misfit.share > LARGEST_DROPPED_SHARE:
        raise ContradictingStationsError(len(agreed.dropped), len(problem.poses))
    if misfit.wild:
        raise ScatterError(misfit.rms, misfit.expected, misfit.limits.scatter)
