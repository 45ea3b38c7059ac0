# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From configurations and measurements to the corrected arm: model selection from simple to rich.

Each model is cross-validated by regions of the joint space. A model with more parameters is chosen
only if it predicts the left-out points better. What contradicts an arm is refused, and the error
in joint values or settings that explains it is named.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math

from handeye_ros.arm import (
    Arm,
    Chain,
    DIRECTION,
    GEOMETRY,
    OFFSET,
    parameters,
    POSITION,
    PRISMATIC,
    REVOLUTE,
)
from handeye_ros.data import Array
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.least_squares import single_threaded
from handeye_ros.robot.estimate import (
    adjusted,
    Fit,
    MINIMUM,
    reported_covariance,
    with_arm,
    without_outliers,
)
import numpy as np
from numpy.typing import NDArray

UNSOLVED = 'unsolved'  # reason of refusals that wrong clocks may explain
REGIONS = 8  # of the joint space, each left out once
FEWEST_OF_REGION = 3
FOLD_ROUNDS = 2
MOST_FREEDOM = 6  # independent conditions of a stop: a pose has no more
MOST_SHARE = 0.8  # largest ratio of parameters to conditions
AGREEING = 0.5  # smallest share of the configurations that agree
HOPELESS = 20.0  # times the limit of the residual: no arm is so inaccurate
LARGEST_ERROR = {DIRECTION: 0.02, POSITION: 0.01}  # of an axis, if the URDF belongs to the robot
LARGEST_TURN, LARGEST_SHIFT = 0.02, 0.01  # 1 sigma of the sensor's pose (rad, m)
STEPS = 15  # configurations on the line from one to another
# Per kind of joint, rad and m: tolerance of the limits, which are often stated roughly, and the
# smallest range of values that determines the error of a joint.
BEYOND = {REVOLUTE: 0.35, PRISMATIC: 0.1}
STILL = {REVOLUTE: 0.02, PRISMATIC: 0.005}
BETTER = 0.2  # a change that reduces the residual to less than this fraction is the cause
OTHER_SIDE = {'eye_in_hand': 'eye_on_base', 'eye_on_base': 'eye_in_hand'}


@dataclass(frozen=True, eq=False)
class Model:
    """A fit with some kinds of parameters; left_out: (n,) cross-validation errors (m)."""

    kinds: tuple[str, ...]
    fit: Fit
    left_out: Array

    @property
    def words(self) -> str:
        """Return the kinds in words."""
        return ', '.join(self.kinds) or 'URDF as it is'

    @property
    def left_out_rms(self) -> float:
        """Return the RMS of the cross-validation errors of the used points (m)."""
        return float(np.sqrt((self.left_out[self.fit.used] ** 2).mean()))

    @property
    def left_out_median(self) -> float:
        """Return the median of the cross-validation errors of the used points (m)."""
        return float(np.median(self.left_out[self.fit.used]))


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    The chosen model, and all models; the simplest has no errors of the arm.

    covariance: (u, u) of X, the targets, and the k parameters of the arm; sigma_ratios: (k,)
    posterior over prior sigma of each parameter; smooth: RMS of the smooth remaining error of
    the robot (m); warnings: sentences.
    """

    models: tuple[Model, ...]
    chosen: Model
    covariance: Array
    sigma_ratios: Array
    smooth: float
    warnings: tuple[str, ...]

    @property
    def arm(self) -> Arm:
        """Return the arm with its errors."""
        return self.chosen.fit.state.arm

    @property
    def stds(self) -> Array:
        """Return 1 sigma (k,) of the parameters of the arm."""
        first = self.chosen.fit.data.unknowns
        return np.sqrt(np.diag(self.covariance)[first:first + len(self.arm.values)])


@single_threaded
def solve(start: Fit, limit: float, cause: Callable[[], str]) -> Outcome:
    """
    Return the corrected arm and its hand-eye transform.

    start: the hand-eye transform alone; limit: the largest valid residual (m); cause: the likely
    error if it is exceeded, in words. Raises DataError.
    """
    chain = start.state.arm.chain
    if start.noise_rms > HOPELESS * limit:
        raise contradiction(start.noise_rms, HOPELESS * limit, cause())
    richest = _fit(start, chain, GEOMETRY)
    if richest.noise_rms > limit or richest.used.mean() < AGREEING:
        misfit = float(np.median(start.data.distances(start.state)))
        raise contradiction(max(misfit, richest.noise_rms), limit, cause())
    _require_mount(richest)
    fold = regions(start.data.q)
    start = adjusted(replace(start, used=richest.used))
    fits = [((), start), ((OFFSET,), _fit(start, chain, (OFFSET,))), (GEOMETRY, richest)]
    models = tuple(Model(kinds, replace(fit, used=richest.used), _left_out(fit, fold))
                   for kinds, fit in fits)
    chosen = models[0]
    for model in models[1:]:
        chosen = model if _better(model, chosen) else chosen
    _require_same_robot(chosen.fit.state.arm)
    wide, covariance = reported_covariance(richest, chosen.fit.state)
    covariance = covariance * _misfit(models[-1])
    return Outcome(models, chosen, covariance, _sigma_ratios(chosen.fit), wide.smooth_rms,
                   tuple(_warnings(models, chosen)))


def _fit(start: Fit, chain: Chain, kinds: Sequence[str]) -> Fit:
    chosen = parameters(chain, kinds)
    return without_outliers(with_arm(start, Arm(chain, chosen, np.zeros(len(chosen)))))


def regions(q: Array) -> NDArray[np.intp]:
    """Return the region (n,) of joint space of configurations (n, joints)."""
    groups = [np.arange(len(q))]
    while len(groups) < REGIONS and min(map(len, groups)) >= 2 * FEWEST_OF_REGION:
        halves = []
        for group in groups:
            centred = q[group] - q[group].mean(axis=0)
            _, _, axes = np.linalg.svd(centred, full_matrices=False)
            order = group[np.argsort(centred @ axes[0], kind='stable')]
            halves += [order[:len(order) // 2], order[len(order) // 2:]]
        groups = halves
    region = np.empty(len(q), dtype=np.intp)
    for number, group in enumerate(groups):
        region[group] = number
    return region


def _left_out(fit: Fit, fold: NDArray[np.intp]) -> Array:
    """Return the errors (n,) of points, each predicted without its region."""
    data, errors = fit.data, np.empty(len(fit.data))
    for number in range(int(fold.max()) + 1):
        in_region = fold == number
        fit_without = adjusted(replace(fit, used=fit.used & ~in_region), rounds=FOLD_ROUNDS)
        errors[in_region] = data.distances(fit_without.state)[in_region]
    return errors


def _better(model: Model, simpler: Model) -> bool:
    """Return whether a model predicts left-out points better by more than one standard error."""
    used = model.fit.used
    gain = simpler.left_out[used] ** 2 - model.left_out[used] ** 2
    return bool(gain.mean() > gain.std() / len(gain) ** 0.5)


def _misfit(model: Model) -> float:
    """
    Return the variance of left-out errors relative to that predicted by the fit, at least 1.

    With h parameters per condition, the predicted variance is (1 + h) / (1 - h) times that of the
    residuals. A larger one shows errors of the arm that the model does not include.
    """
    fit, J = model.fit, model.fit.jacobian[model.fit.rows]
    conditions = np.minimum(np.bincount(fit.data.block[fit.rows]), MOST_FREEDOM).sum()
    h = min(float(np.einsum('mi,mi->', J @ fit.covariance, J)) / conditions, MOST_SHARE)
    return max(1.0, float((model.left_out_rms / fit.noise_rms) ** 2 * (1 - h) / (1 + h)))


def _sigma_ratios(fit: Fit) -> Array:
    """Return the posterior over the prior sigma (k,) of the parameters, without prior scales."""
    first, arm = fit.data.unknowns, fit.state.arm
    as_configured = replace(fit, weights=replace(
        fit.weights, variances=np.ones_like(fit.weights.variances)))
    variances = np.diag(as_configured.covariance)[first:first + len(arm.values)]
    return np.sqrt(variances) / arm.stds


def _require_mount(fit: Fit) -> None:
    std = np.sqrt(np.diag(fit.covariance)[:6])
    for quantity, size, limit in (('orientation', std[3:].max(), LARGEST_TURN),
                                  ('position', std[:3].max(), LARGEST_SHIFT)):
        if size > limit:
            raise DataError(
                f'these configurations do not determine the {quantity} of the sensor: move all '
                'joints, and bring the target to different points of the field of view')


def _require_same_robot(arm: Arm) -> None:
    for kind, largest in LARGEST_ERROR.items():
        for i, joint in enumerate(arm.chain.joints):
            error = float(np.linalg.norm(arm.of(i, kind)))
            if error > largest:
                size = (mm(error) if kind == POSITION
                        else f'{math.degrees(error):.2g} degrees')
                raise DataError(
                    f'the axis of {joint.name} would be {size} off the URDF, more than the error '
                    'of any real arm: the URDF is of another robot, or of a variant of it')


def _warnings(models: Sequence[Model], chosen: Model) -> list[str]:
    sentences, last = [], models[-1]
    dropped = int((~last.fit.used).sum())
    if dropped:
        sentences.append(f'{dropped} of {len(last.fit.used)} points contradict the others and are '
                         'left out')
    if chosen is not last:
        sentences.append(f'the model with {" and ".join(last.kinds)} predicts left-out points no '
                         f'better than {" and ".join(chosen.kinds) or "the URDF as it is"}: the '
                         'simpler one is the answer')
    arm, q = last.fit.state.arm, last.fit.data.q
    if one_configuration(arm, q):
        sentences.append('all poses have one configuration of elbow and wrist: other '
                         'configurations determine more joint parameters')
    return sentences


def one_configuration(arm: Arm, q: Array) -> bool:
    """
    Return whether a six-axis arm stays on one side of all its singularities.

    Then no straight line in joint space from the first configuration to another crosses one.
    """
    joints, fractions = arm.chain.joints, np.linspace(0.0, 1.0, STEPS)[:, None, None]
    if len(joints) != 6 or any(joint.kind != REVOLUTE for joint in joints):
        return False
    between = (q[0] + fractions * (q - q[0])).reshape(-1, 6)
    return len(np.unique(np.sign(np.linalg.det(Arm(arm.chain).jacobians(between))))) == 1


def too_few(usable: int) -> DataError:
    """Return the error for fewer configurations than the kinematics need."""
    return DataError(f'{usable} usable robot configurations; the kinematics need at least '
                     f'{MINIMUM}, and 40 are a good number: record more, with all joints moving',
                     reason=UNSOLVED)


def contradiction(residual: float, limit: float, cause: str) -> DataError:
    """Return the error for joint values, URDF and measured points that do not belong together."""
    cause = cause or ('check that the URDF is of this robot, the unit and the sign of each joint, '
                      'calibration_type, and that the target did not move')
    return DataError(f'joint values and measured points contradict each other by {mm(residual)} '
                     f'RMS, beyond the {mm(limit)} of a robot that is only inaccurate: {cause}',
                     reason=UNSOLVED)


def joint_notes(chain: Chain, readings: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint whose error is not determined.

    Raises DataError for values beyond the limits of a joint.
    """
    sentences = []
    for joint in chain.joints:
        value = joint.factor * readings[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[joint.kind] <= end <= joint.upper + BEYOND[joint.kind]:
                hint = ('; they seem to be degrees stated as radians'
                        if abs(end) > 2 * math.pi else '')
                raise DataError(
                    f'{joint.name} reaches {end:.4g}, and the URDF limits it to '
                    f'{joint.lower:.4g} to {joint.upper:.4g} (radians or metres){hint}: check the '
                    'unit of the joint values, or the limits in the URDF')
        if high - low < STILL[joint.kind]:
            size = (f'{math.degrees(high - low):.2g} degrees' if joint.kind == REVOLUTE
                    else f'{(high - low) * 1e3:.2g} mm')
            sentences.append(f'{joint.name} moves by {size} only: these configurations do not '
                             'determine its error')
    return sentences


@dataclass(frozen=True, eq=False)
class Change:
    """
    A possible error, in words, and its correction.

    joints: (n, n) matrix that corrects the joint values; other_side: the other calibration_type;
    unit: a factor on the points of the sensor.
    """

    words: str
    joints: Array
    other_side: bool = False
    unit: float = 1.0


def cause_of(chain: Chain, q: Array, on_flange: bool, refit: Callable[[Change], float]) -> str:
    """
    Return the error that explains joint values and measurements, '' if none does.

    q: (n, joints); refit: gives the residual with a change.
    """
    as_stated, *changes = _changes(chain, on_flange, float(np.median(np.abs(q).max(axis=0))))
    best, words = BETTER * refit(as_stated), ''
    for change in changes:
        try:
            rms = refit(change)
        except (DataError, np.linalg.LinAlgError):
            continue
        if rms < best:
            best, words = rms, change.words
    constant = [joint.name for joint, extent in zip(chain.joints, np.ptp(q, axis=0), strict=True)
                if extent == 0]
    if words or not constant:
        return words
    return f'{constant[0]} has the same value throughout: check where its values come from'


def _changes(chain: Chain, on_flange: bool, largest: float) -> Iterator[Change]:
    """Yield no change, then possible errors; largest: median of the joints' largest values."""
    identity = np.eye(len(chain.joints))
    revolute = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    yield Change('', identity)
    for factor, words, possible in (
            (math.radians(1), 'degrees stated as radians', largest > 2 * math.pi),
            (math.degrees(1), 'radians stated as degrees', largest < math.radians(10))):
        if possible:
            yield Change(f'the joint values seem to be {words}', np.diag(
                np.where(revolute, factor, 1.0)))
    for joint, column in zip(chain.joints, identity, strict=True):
        yield Change(f'{joint.name} seems to turn the other way than in the URDF',
                     np.diag(1 - 2 * column))
    if len(chain.joints) >= 3:
        coupled = identity.copy()
        coupled[2, 1] = 1.0
        yield Change(
            f'{chain.joints[2].name} seems to be counted from the horizontal, as some controllers '
            f'do: add {chain.joints[1].name} to it', coupled)
    other = OTHER_SIDE['eye_in_hand' if on_flange else 'eye_on_base']
    yield Change(f'set calibration_type to {other}', identity, other_side=True)
    for unit in (1e-3, 1e3):
        yield Change('the unit of what the sensor measures seems to be wrong', identity, unit=unit)
