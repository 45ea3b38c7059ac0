# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From stops to the corrected arm: model selection from simple to rich, and what is refused or told.

Each model is cross-validated by regions of the joint space. A model with more errors is chosen
only if it predicts the left-out stops better. What contradicts an arm is refused.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from handeye_ros.arithmetic import rms
from handeye_ros.arm import (
    Arm,
    DIRECTION,
    KIND_OF_ERROR,
    KINDS,
    OFFSET,
    POSITION,
    PRISMATIC,
    REVOLUTE,
)
from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError
from handeye_ros.robot.fit import (
    arm_covariance,
    ArmFit,
    MIN_STOPS,
    solved_with_arm,
    with_estimated_weights,
    without_bad_stops,
)
from handeye_ros.threads import single_threaded
from handeye_ros.words import count_of, degrees, mm
import numpy as np

UNSOLVED = 'unsolved'  # code of refusals that wrong clocks may explain
UNCHANGED_ARM = 'the URDF as it is'
MAX_REGIONS = 8  # of the joint space, each left out once
MIN_OF_REGION = 3  # stops of a region
FOLD_ROUNDS = 2
MIN_AGREEING_SHARE = 0.5  # smallest share of the stops that agree
HOPELESS_FACTOR = 20.0  # times the limit of the residual: no arm is so inaccurate
# by kind of joint (rad, m): tolerance of the limits, which are often stated roughly
MAX_EXTRAPOLATION = {REVOLUTE: 0.35, PRISMATIC: 0.1}
# the same: smallest range of values that determines the error of a joint
UNMOVED_SPREAD = {REVOLUTE: 0.02, PRISMATIC: 0.005}
MAX_ERROR = {DIRECTION: 0.02, POSITION: 0.01}  # of an axis, if the URDF belongs to the robot


@dataclass(frozen=True, eq=False)
class ValidatedFit:
    """
    A fit with some kinds of errors of the arm, and its cross-validation.

    left_out: (n,) the cross-validation error of each stop (m)
    variance_ratio: variance of the cross-validation errors over the predicted one, of the worst
        region, at least 1: more shows errors of the arm that the model does not include
    """

    fit: ArmFit
    left_out: Array
    variance_ratio: float

    @property
    def left_out_rms(self) -> float:
        """Return the RMS of the cross-validation errors of the used stops (m)."""
        return rms(self.left_out[self.fit.used])


@dataclass(frozen=True, eq=False)
class ArmSelection:
    """
    The chosen model, and all models; the simplest has no errors of the arm.

    arm: the corrected arm with its k errors, their covariance, and where they were found
    covariance: (6, 6) of the hand-eye transform X
    undetermined: (k,) posterior over prior sigma of each error, 1 where the data say nothing
    robot_smooth: RMS of the smooth remaining error of the robot, per axis (m)
    notes: sentences for the user
    """

    models: tuple[ValidatedFit, ...]
    chosen: ValidatedFit
    arm: Arm
    covariance: Array
    undetermined: Array
    robot_smooth: float
    notes: tuple[str, ...]


def require_enough_stops(usable: int) -> None:
    """Raise DataError for fewer stops than the kinematics need."""
    if usable < MIN_STOPS:
        raise DataError(f'{count_of(usable, "usable robot configuration")}; the kinematics need '
                        f'at least {MIN_STOPS}, and 40 are a good number: record more, with '
                        'all joints moving')


def require_within_limits(arm: Arm, q: Array) -> None:
    """Raise DataError for values (n, joints) beyond the limits of a joint."""
    for joint, low, high in zip(arm.joints, q.min(axis=0), q.max(axis=0), strict=True):
        tolerance = MAX_EXTRAPOLATION[joint.type]
        if low < joint.lower - tolerance or high > joint.upper + tolerance:
            raise DataError(
                f'{joint.name} goes from {low:.4g} to {high:.4g}, and the URDF limits it to '
                f'{joint.lower:.4g} to {joint.upper:.4g} (radians or metres): check unit (degrees '
                'stated as radians?), sign, zero, and order of the joint values, whether it is '
                'counted from the horizontal, and the limits in the URDF')


def unmoved_notes(arm: Arm, q: Array) -> Iterator[str]:
    """Yield a sentence for each joint whose error the values (n, joints) do not determine."""
    for joint, spread in zip(arm.joints, np.ptp(q, axis=0).tolist(), strict=True):
        if spread < UNMOVED_SPREAD[joint.type]:
            size = (degrees if joint.type == REVOLUTE else mm)(spread)
            yield (f'{joint.name} moves by {size} only: these configurations do not determine its '
                   'error')


@single_threaded
def select_model(fit: ArmFit, stop_count: int, limit: float) -> ArmSelection:
    """
    Return the corrected arm and its hand-eye transform by the best model; raises DataError.

    fit: the hand-eye transform alone with the arm as stated, of stops that agree; stop_count: of
    all stops; limit: the largest valid residual (m).
    """
    stated = fit.arm
    if fit.used.sum() < max(MIN_STOPS, MIN_AGREEING_SHARE * stop_count) or (
            fit.residual_rms > HOPELESS_FACTOR * limit):
        raise _contradiction(fit, stop_count, limit)
    of_all_kinds = without_bad_stops(solved_with_arm(fit, stated.with_errors_of(KINDS)))
    if of_all_kinds.residual_rms > limit or of_all_kinds.used.mean() < MIN_AGREEING_SHARE:
        raise _contradiction(of_all_kinds, stop_count, limit)
    agreed, fold = replace(fit, used=of_all_kinds.used), _regions(fit.q)
    models = [_validated(
        with_estimated_weights(solved_with_arm(agreed, stated.with_errors_of(kinds))), fold)
              for kinds in ((), (OFFSET,), KINDS)]
    chosen = models[0]
    for richer in models[1:]:
        chosen = richer if _predicts_better(richer, chosen) else chosen
    _require_same_robot(chosen.fit.arm)
    covariance, smooth = arm_covariance(of_all_kinds, chosen.fit)
    # by how much its left-out stops are further off than even the richest model predicts
    covariance *= models[-1].variance_ratio
    arm = replace(chosen.fit.arm, covariance=covariance[6:, 6:],
                  configurations=fit.q[chosen.fit.used])
    return ArmSelection(tuple(models), chosen, arm, covariance[:6, :6],
                        _undetermined(chosen.fit), smooth,
                        tuple(_notes(models, chosen, stop_count)))


def _regions(q: Array, most: int = MAX_REGIONS) -> Indices:
    """
    Return the number (n,) of the region of each stop.

    The joint values (n, joints) are halved repeatedly across their direction of largest spread.
    """
    region = np.zeros(len(q), dtype=np.intp)
    if most > 1 and len(q) >= 2 * MIN_OF_REGION:
        centred = q - q.mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        low, high = np.split(np.argsort(along, kind='stable'), [len(q) // 2])
        region[low] = _regions(q[low], most // 2)
        region[high] = most // 2 + _regions(q[high], most // 2)
    return region


def _validated(fit: ArmFit, fold: Indices) -> ValidatedFit:
    """Return the model of a fit; fold: (n,) regions of the stops, left out one by one."""
    errors, variance_ratio = np.empty(len(fold)), 1.0
    for number in np.unique(fold):
        in_fold = fold == number
        without = with_estimated_weights(replace(fit, used=fit.used & ~in_fold),
                                         rounds=FOLD_ROUNDS)
        errors[in_fold] = without.distances[in_fold]
        r, J = replace(without, used=fit.used & in_fold).whitened_rows
        predicted = len(r) + np.sum((J @ without.covariance) * J)
        variance_ratio = max(variance_ratio, float(r @ r / max(predicted, 1.0)))
    return ValidatedFit(fit, errors, variance_ratio)


def _predicts_better(richer: ValidatedFit, simpler: ValidatedFit) -> bool:
    """Return whether a model predicts left-out stops better by more than one standard error."""
    used = richer.fit.used
    gain = simpler.left_out[used] ** 2 - richer.left_out[used] ** 2
    return bool(gain.mean() > gain.std() / len(gain) ** 0.5)


def _undetermined(fit: ArmFit) -> Array:
    """Return the posterior over the prior sigma (k,) of the errors, with the priors as stated."""
    stated = replace(fit, tau_squares=np.ones_like(fit.tau_squares))
    return np.sqrt(np.diag(stated.covariance)[6:6 + len(stated.prior_stds)]) / stated.prior_stds


def _require_same_robot(arm: Arm) -> None:
    """Raise DataError for an axis that would be further from the URDF than MAX_ERROR."""
    for kind, largest in MAX_ERROR.items():
        sizes = np.linalg.norm(arm.errors[:, KIND_OF_ERROR == kind], axis=1)
        worst = int(np.argmax(sizes))
        if sizes[worst] > largest:
            size = (mm if kind == POSITION else degrees)(float(sizes[worst]))
            raise DataError(
                f'the axis of {arm.joints[worst].name} would be {size} off the URDF, more than '
                'the error of any real arm: the URDF is of another robot, or of a variant of it')


def _notes(models: Sequence[ValidatedFit], chosen: ValidatedFit, stop_count: int
           ) -> Iterator[str]:
    """Yield a sentence for contradicting stops, and for a richer model that is not used."""
    richest = models[-1]
    if dropped := stop_count - int(richest.fit.used.sum()):
        yield f'{dropped} of {stop_count} stops contradict the others and are not used'
    if chosen is not richest:
        rich, simple = (' and '.join(model.fit.arm.estimated_kinds) for model in (richest, chosen))
        yield (f'the model with {rich} predicts left-out stops no better than '
               f'{simple or UNCHANGED_ARM}: the simpler one is the answer')


def _contradiction(fit: ArmFit, stop_count: int, limit: float) -> DataError:
    """Return the refusal of a fit that leaves contradictions; see select_model."""
    return DataError(
        f'joint values and measured points contradict each other: the best fit, of '
        f'{fit.used.sum()} of {stop_count} configurations, leaves {mm(fit.residual_rms)}, a robot '
        f'that is only inaccurate at most {mm(limit)}: check that the URDF is of this robot, '
        '--base and --flange, the sign of each joint, whether a joint is counted from the '
        'horizontal, all units (degrees or radians?), calibration_type, and that the target is '
        'the stated one and fixed', code=UNSOLVED)
