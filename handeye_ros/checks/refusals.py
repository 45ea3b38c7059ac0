# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is refused without a hypothesis about its cause, in the order of a solve.

Samples without an answer (frame, number, rotations); samples that no answer fits; answers that
cannot be tested, that are too uncertain, or that leave out what the samples show.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from handeye_ros.calibration import unused_edges_in_words
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.arm_errors import CORRECTED_ARM
from handeye_ros.estimation.noise import EDGE_INDEX
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import axes_across, direction_in_words, mount_frame
from handeye_ros.se3 import (
    mapped_covariance,
    turns_from_mean,
    weakest_direction,
    weakest_rotation,
)
from handeye_ros.targets.profile_target import ProfileTarget
from handeye_ros.words import count_of, degrees, mm, without_numbers
import numpy as np

MAX_DROPPED_SHARE = 0.34  # largest share of the stations that an answer may leave out
MIN_REDUNDANT = 3  # redundant conditions needed, and as many for each dropped station
MAX_P_WRONG = 0.1  # largest probability that one of few samples is wrong
# the same where several stations were dropped and similar surfaces may be confused
SURELY_WRONG_P = 0.99
STRAY_EDGES_CHI2 = 9.0  # of edges (3 sigma): above which they are of something else
MIN_TURN = 0.01  # rad: less RMS rotation about an axis counts as none
# rad RMS about the second axis: tilts by 12 degrees to both sides; less may look like a move
SMALL_SECOND_TURN = 0.12
MISFIT_CHI2, MISFIT_TIMES = 40.0, 4.0  # of a misfit: reduced chi-squared, residuals over the noise
# residuals of a sensor turned by half, over those of the answer, that surely tell them apart
TWIN_RATIO = 5.0
SHOW_ALL_OF_THE_VIEW = (
    'take more samples with the target in all parts of the field of view (near, far, left, '
    'right), each with another tilt')


class UnexplainedError(DataError):
    """A refusal that another setting may explain; any other names a cause that is certain."""


def require_distinct_frame(frame_id: str, config: Config) -> None:
    """
    Raise DataError if two of the frames of profiles, flange and base have one name.

    frame_id: of the profiles. The answer would relate a frame to itself.
    """
    base, flange, of_profiles = (name.lstrip('/') for name in (
        config.base_frame, config.robot_effector_frame, frame_id))
    if base == flange:
        raise DataError(f'robot_base_frame and robot_effector_frame are both "{base}": set them '
                        'to the frames of base and flange', code='frame')
    if of_profiles in (base, flange):
        key = 'robot_base_frame' if of_profiles == base else 'robot_effector_frame'
        raise DataError(
            f'the profiles have the frame_id "{frame_id}", and {key} is the same frame, so the '
            'result would be a transform from this frame to itself: set another frame_id in the '
            f'driver of the sensor, or set {key}', code='frame')


def require_samples(samples: Sequence[Sample], rejects: Sequence[Reject], target: ProfileTarget
                    ) -> None:
    """
    Raise DataError when there are fewer samples than the target needs.

    Another setting may explain that (UnexplainedError) only where there were stops enough.
    """
    if len(samples) < target.min_samples:
        causes = Counter(without_numbers(reject.reason) for reject in rejects)
        reasons = Counter(reject.reason for reject in rejects)
        example = max(reasons, default='',
                      key=lambda reason: (causes[without_numbers(reason)], reasons[reason]))
        why = f' ({count_of(len(rejects), "stop")} gave none, most often: {example})' if (
            rejects) else ''
        refusal, advice = DataError, 'take more, with the laser across the target'
        if len(samples) + sum(not reject.final for reject in rejects) >= target.min_samples:
            refusal, advice = UnexplainedError, (
                'check target.type, and that the laser crosses the target')
        raise refusal(
            f'{count_of(len(samples), "usable sample")}{why}; the target {target.name} needs at '
            f'least {target.min_samples}: {advice}', code='few')


def require_features(samples: Sequence[Sample], target: ProfileTarget) -> None:
    """Raise DataError for a sample without the features that every one of the target has."""
    for sample in samples:
        for missing in Counter(target.required_features) - Counter(map(type, sample.features)):
            raise DataError(
                f'the sample with the stamp {sample.stamp} lacks a feature ({missing.noun}) that '
                f'the target {target.name} needs in every sample: gather the samples with this '
                'target', code='features')


def require_rotations(poses: Array, frame: str, lost: str) -> None:
    """
    Raise DataError for poses (n, 4, 4) of the mount that do not turn about two axes.

    frame: the mount frame, in which the axis is reported; lost: what one axis leaves unknown.
    """
    turns, axes = rms_turns_and_axes(poses)
    if turns[0] < MIN_TURN:
        raise DataError(
            f'all poses share one orientation (within {np.degrees(turns[0]):.2f} degrees): the '
            'position of the sensor cannot be separated from the position of the target; tilt '
            'the tool by 15 degrees or more about two axes', code='one_orientation')
    if turns[1] < MIN_TURN:
        raise DataError(
            f'all poses share one rotation axis ({direction_in_words(axes[0], frame)}; they turn '
            f'by {np.degrees(turns[0]):.1f} degrees RMS about it): {lost}; tilt the tool by 15 '
            f'degrees or more about {axes_across(axes[0], frame)}', code='one_axis')


def rms_turns_and_axes(poses: Array) -> tuple[Array, Array]:
    """
    Return the RMS rotations (3,) of poses (n, 4, 4) in rad, and their principal axes (3, 3).

    Largest first; the axes are the rows, in the frame that the sensor is fixed in.
    """
    squares, axes = np.linalg.eigh(np.cov(turns_from_mean(poses), rowvar=False, bias=True))
    return np.sqrt(np.maximum(squares[::-1], 0.0)), axes.T[::-1]


def misfit_refusal(solution: Solution) -> UnexplainedError | None:
    """Return the refusal of a solution that its samples contradict, None where they agree."""
    limits, rms = solution.full_problem.config.limits, solution.posterior.residual_rms
    dropped = solution.dropped_squares
    if rms > limits.residual:
        return UnexplainedError(
            f'samples and poses contradict each other by {mm(rms)} RMS (limits.residual is '
            f'{mm(limits.residual)}), and no known convention error explains it: check the poses '
            '(frames, convention, units), whether the clocks of sensor and robot agree, whether '
            'every sample shows the target itself and no clamp or second plate, target.type and '
            'its measures, profile.unit, profile.axes, profile.range_sign and profile.invalid',
            code='misfit')
    total = len(solution.full_problem.poses)
    if len(dropped) > MAX_DROPPED_SHARE * total:
        return UnexplainedError(
            f'{len(dropped)} of {total} samples contradict the others, so no answer can be '
            'trusted: check that target and sensor are fixed and that the laser crosses only the '
            'target', code='misfit')
    times = rms / solution.posterior.expected_rms
    if times > limits.scatter or (
            solution.posterior.reduced_chi_squared > MISFIT_CHI2 and times > MISFIT_TIMES):
        beyond = f' (limits.scatter is {limits.scatter:g})' if times > limits.scatter else ''
        return UnexplainedError(
            f'the residuals of {mm(rms)} RMS are {times:.1f} times what the configured noise '
            f'explains{beyond}: there is another cause than noise; check profile.range_sign, '
            'profile.axes and target.type, or raise noise.* if the robot or the sensor really is '
            'that inaccurate', code='misfit')
    return None


def require_testable(solution: Solution) -> None:
    """
    Raise UnexplainedError for an answer with too few redundant conditions to test it.

    Also if a sample is probably wrong, and without it too few conditions would remain or others
    may be wrong too.
    """
    used, dropped = len(solution.used_stations), len(solution.dropped_squares)
    redundancy = solution.posterior.redundancy

    def needed(outliers: int) -> int:  # the choice of outliers, by the same residuals, costs one
        return MIN_REDUNDANT * (1 + outliers) + (outliers > 0)

    if redundancy < needed(dropped):
        why = f' ({dropped} of them contradict the others)' if dropped else ''
        raise UnexplainedError(
            f'{used + dropped} usable samples{why} give only {redundancy} redundant equations; at '
            f'least {needed(dropped)} are needed: take more samples at new poses', code='few')
    # if one more sample were dropped
    per_sample = int(solution.posterior.ranks.max())
    missing = needed(dropped + 1) - (redundancy - per_sample)
    others_wrong_too = (solution.probability_wrong > SURELY_WRONG_P and dropped > 1
                        and solution.full_problem.shows_several)
    if others_wrong_too or (solution.probability_wrong > MAX_P_WRONG and missing > 0):
        raise UnexplainedError(
            f'these {used} samples contradict each other: either the robot is less accurate than '
            'noise.robot_smooth states, or at least one sample is wrong (a pose wrong by about a '
            'millimetre, or another surface); so few samples cannot show which: take '
            f'{max(1, -(-missing // per_sample))} more at new poses, or repeat them all',
            code='outlier')


def require_no_half_turn_twin(solution: Solution) -> None:
    """Raise DataError for views so much alike that a sensor turned by half would see the same."""
    place, misfit = solution.problem.target.half_turn_misfit(solution.posterior.linear)
    # a larger residual has other causes
    residual = min(solution.posterior.residual_rms, solution.full_problem.config.limits.residual)
    if 2 * misfit < TWIN_RATIO * residual:
        raise DataError(
            f'all samples show the target {place} of the view (within {mm(misfit)}), and a sensor '
            f'turned by half about it would see the same: {SHOW_ALL_OF_THE_VIEW}', code='views')


def require_certain(covariance: Array, config: Config, advice: str, levers: Array | None = None
                    ) -> None:
    """
    Raise DataError (uncertain) for a transform with larger uncertainty than the limits.

    covariance: (6, 6) of the transform; advice: what to do, in words; levers: (m, 3) of the points
    that the samples show, from the sensor along the axes of the mount. A rotation and a
    translation that make up for each other there are no uncertainty of what the sensor measures.
    """
    errors = [('rotation about', 'rotation', degrees, weakest_rotation(covariance)),
              ('position along', 'translation', mm, weakest_direction(covariance))]
    if levers is not None:
        errors.append(('place of the points that the samples show, along', 'points', mm,
                       weakest_direction(mapped_covariance(levers, covariance))))
    for what, key, with_unit, (std, direction) in errors:
        limit = getattr(config.limits, key)
        if not std <= limit:
            how = f'uncertain by {with_unit(std)} (1 sigma; ' if std < 1 else 'not determined ('
            raise DataError(
                f'the {what} {direction_in_words(direction, mount_frame(config))} is {how}limits.'
                f'{key} is {with_unit(limit)}): {advice}', code='uncertain')


def missing_motion(solution: Solution, config: Config) -> str:
    """Return in words the motion that the samples lack, or that a corrected arm limits them."""
    covariance = solution.transform_covariance
    of_arm = solution.added_covariances.get(CORRECTED_ARM)
    if of_arm is not None and (weakest_direction(covariance - of_arm)[0]
                               < weakest_direction(covariance)[0] / 2):
        return ('most of that comes from the corrected arm: correct it again with more samples '
                '(handeye kinematics), in configurations like those of these')
    problem, frame = solution.problem, mount_frame(config)
    rotation_known = weakest_rotation(covariance)[0] <= config.limits.rotation
    alike_views = problem.target.alike_views_in_words(problem, solution.estimate)
    if rotation_known and alike_views:
        return alike_views
    turns, axes = rms_turns_and_axes(solution.full_problem.poses)
    if turns[1] > SMALL_SECOND_TURN:
        return SHOW_ALL_OF_THE_VIEW
    return (f'the poses turn by only {degrees(turns[1])} RMS about '
            f'{direction_in_words(axes[1], frame)}; tilt the tool about this axis by 15 degrees '
            'or more to both sides')


def require_edges(solution: Solution) -> None:
    """
    Raise UnexplainedError for an answer that does not use most of the visible edges.

    Also if those used scatter, as the ends of a floor beside the target do, and the residuals are
    larger than the noise (m): of worn edges only the first is true.
    """
    target = solution.full_problem.target
    if not target.edge_kinds:
        return
    posterior, at_rest = solution.posterior, not solution.problem.is_sweep
    factor = posterior.noise.variance_factors[EDGE_INDEX]
    # a robot on its way has errors of its own
    if at_rest and factor > STRAY_EDGES_CHI2 and posterior.residual_rms > posterior.expected_rms:
        raise UnexplainedError(
            f'the edges of the target scatter {factor ** 0.5:.1f} times more than the profiles '
            'allow: check that the laser crosses the target alone, and no clamp, bar or second '
            'plate beside it, profile.range_sign, and that the edges are straight and sharp',
            code='edges')
    used, shown = (int(problem.shows_edge.sum())
                   for problem in (solution.problem, solution.full_problem))
    if used < max(target.min_samples, (1 - MAX_DROPPED_SHARE) * shown):
        dropped = len(solution.dropped_squares)
        needed = (f'the target {target.name} needs {target.min_samples}'
                  if used < target.min_samples else '')
        why = '; '.join(filter(None, (f'{dropped} contradict the others' if dropped else '',
                                      unused_edges_in_words(solution), needed)))
        raise UnexplainedError(
            f'only {used} of the {shown} samples that show an edge agree on the target, and such '
            f'an answer cannot be trusted ({why}): check target.size, that the edges are straight '
            'and that the laser crosses them steeply, inside the field of view, and no others, or '
            'calibrate from the plane alone (target.type plane)', code='edges')


def require_predicted(left_out: float, residual: float, limit: float) -> None:
    """Raise UnexplainedError for samples that differ too much (m RMS) when they are left out."""
    if not left_out <= limit:
        noisy = residual > 0.5 * left_out  # else the fit follows single samples
        why = ('the noise of sensor or robot is that large; take more samples, or raise '
               'limits.residual if this accuracy is enough' if noisy else
               'too few samples, or some are wrong; take more')
        raise UnexplainedError(
            f'samples differ by {mm(left_out)} RMS from what the others predict (limits.residual '
            f'is {mm(limit)}), and by {mm(residual)} from the answer: {why}', code='left_out')
