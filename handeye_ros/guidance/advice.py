# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Guidance: the uncertainty so far, what limits it, and the next pose."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from handeye_ros import se3, targets
from handeye_ros.calibration import clock_notes
from handeye_ros.checks.moved import outliers_at_one_end
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.arm_errors import CORRECTED_ARM
from handeye_ros.estimation.blocks import LINE_BEND, ROBOT_SCALE, ROBOT_SMOOTH, SENSOR_SCALE
from handeye_ros.estimation.budget import budget
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import direction_in_words, mount_frame
from handeye_ros.guidance.candidates import Proposal, propose
from handeye_ros.guidance.first_moves import AdvisedMove, next_move, seen_feature_noun
from handeye_ros.guidance.view import learn_view, view_levers
from handeye_ros.pipeline import Answer
from handeye_ros.se3 import mapped_std, weakest_direction
from handeye_ros.threads import single_threaded
import numpy as np
from scipy.spatial.transform import Rotation

ROUGHLY_KNOWN = 3e-3  # m: points mapped worse than this cannot be aimed at
GOOD_COUNT = 15  # samples, before which nothing but the wanted accuracy is enough
MIN_GAIN = 0.02  # of the mapped points' sigma: less is no reason for another sample
MIN_FACTOR = 0.5  # of the sigma: a smaller cause is not named


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty in one direction: 1 sigma, and its limit, in m or rad as unit says."""

    name: str
    std: float
    limit: float
    unit: str


class LimitingFactor(NamedTuple):
    """
    A systematic cause of the uncertainty.

    terms: how the names of its terms in the budget begin; key: the setting of its prior; text: the
    cause in words; remedy: what would have to be better, as more samples do not help.
    """

    terms: tuple[str, ...]
    key: str
    text: str
    remedy: str


LIMITING_FACTORS = (
    LimitingFactor((ROBOT_SMOOTH,), 'noise.robot_smooth', "the robot's accuracy as configured",
                   'robot, or a better statement of its accuracy,'),
    LimitingFactor((ROBOT_SCALE, SENSOR_SCALE), 'noise.robot_scale',
                   "the scale of the robot's lengths as configured",
                   'robot, or a better statement of its scale,'),
    LimitingFactor(('distortion_',), 'noise.distortion', "the sensor's linearity as configured",
                   'sensor'),
    LimitingFactor((LINE_BEND,), 'noise.line_bend', 'how straight the laser line is as configured',
                   'sensor'),
    LimitingFactor(('flatness_',), 'noise.flatness',
                   "the flatness of the target's faces as configured", 'target'),
    LimitingFactor(('setback_', 'incidence_', 'shape_'), 'target.setback_std',
                   'how far faces end before their edges', 'target'),
    LimitingFactor((CORRECTED_ARM,), 'kinematics', 'the uncertainty of the corrected arm',
                   'correction of the arm'))


@dataclass(frozen=True, eq=False)
class Advice:
    """
    Advice for the operator.

    sentences: what to do, and why, in the order of their weight
    next_pose: the pose that helps most; None before the sensor is roughly known, in a sweep, and
        where no pose within the limits keeps the target in view
    move_from_first_pose: the next move, described from the first pose, while the sensor is not
        roughly known; else None
    sigmas: the uncertainty in each direction, last that of mapped points; empty before an answer
    enough: whether the samples are sufficient
    why: the reason of enough, in one sentence
    """

    sentences: tuple[str, ...]
    next_pose: Proposal | None
    move_from_first_pose: AdvisedMove | None
    sigmas: tuple[Uncertainty, ...]
    enough: bool
    why: str

    @property
    def text(self) -> str:
        """Return all sentences as one text."""
        return '. '.join(s[0].upper() + s[1:] for s in self.sentences) + '.'


@single_threaded
def advise(samples: Sequence[Sample], config: Config, answer: Answer | None = None,
           seen: Array | None = None, failed_poses: Sequence[Array] = ()) -> Advice:
    """
    Return what to do next after samples, in the order of their stamps.

    answer: their answer, None where there are no samples; seen: points (n, 2) of profiles, from
    which the field of view is learnt; failed_poses: poses of the flange (4, 4) at which stops
    gave no sample. The limits of guidance.* are relative to the first sample.
    """
    target = targets.target_for(config)
    what, sweeping = seen_feature_noun(target), config.sampling.moving
    sweep_on = (f'continue to sweep over the {what}: to and fro across it, with tilts about all '
                'axes, near and far, with changes of speed')
    if answer is None or not samples:
        return _before_an_answer(f'take the first sample: hold the sensor square to the target, '
                                 f'with the {what} in the middle of the view')
    view = learn_view(samples, seen)
    solution = answer.solution if answer.samples_agree else None
    levers = view_levers(solution.estimate.X if solution else np.eye(4), view)
    if solution is None or mapped_std(levers, solution.transform_covariance) > ROUGHLY_KNOWN:
        refusal = None if solution or len(samples) < target.min_samples else answer.refusal
        if sweeping:
            return _before_an_answer(sweep_on, None, refusal)
        move = next_move(len(samples), target, config, view)
        return _before_an_answer(move.text, move, refusal)

    sigmas = sigma_table(solution.transform_covariance, levers, config)
    proposal = None
    if not sweeping:
        certain_view = view.inner(sigmas[-1].std)  # in view there, however the sensor is off
        proposal = propose(solution, samples, config, certain_view, levers, failed_poses)
    enough, why = enough_and_why(sigmas[-1].std, sigmas[-1].limit,
                                 proposal.std if proposal else None,
                                 largest_limiting_factor(solution, levers), len(samples))
    if refused := outliers_at_one_end(solution) or str(answer.refusal or ''):
        enough, why = False, refused
    sentences = [why, *clock_notes(solution)]
    if not enough:
        sentences.append(
            sweep_on if sweeping else
            _motion_in_words(samples[-1].T_base_flange, proposal, config, what) if proposal else
            f'no pose within guidance.reach, guidance.tilt and guidance.turn keeps the {what} in '
            'view: widen them')
    return Advice(tuple(sentences), proposal, None, sigmas, enough, why)


def _before_an_answer(text: str, move: AdvisedMove | None = None, refusal: Exception | None = None
                      ) -> Advice:
    why = str(refusal) if refusal else 'there is no answer yet'
    return Advice((text, why) if refusal else (text,), None, move, (), False, why)


def sigma_table(covariance: Array, levers: Array, config: Config) -> tuple[Uncertainty, ...]:
    """
    Return the uncertainty along each axis, in the weakest directions, and of mapped points.

    covariance: (6, 6) of the transform; levers: (k, 3) of the points.
    """
    table = list[Uncertainty]()
    for what, part, limit, unit in (
            ('position along', covariance[:3, :3], config.limits.translation, 'm'),
            ('rotation about', covariance[3:, 3:], config.limits.rotation, 'rad')):
        table += [Uncertainty(f'{what} {axis}', variance ** 0.5, limit, unit)
                  for axis, variance in zip('xyz', np.diag(part).tolist(), strict=True)]
        largest, axis = weakest_direction(part)
        table.append(Uncertainty(
            f'{what} {direction_in_words(axis, mount_frame(config))} (worst)', largest, limit,
            unit))
    return (*table, Uncertainty('points in view', float(mapped_std(levers, covariance)),
                                config.guidance.accuracy, 'm'))


def largest_limiting_factor(solution: Solution, levers: Array
                            ) -> tuple[LimitingFactor, float] | None:
    """
    Return the largest systematic cause, and its sigma over that of mapped points.

    None below MIN_FACTOR. White noise is none of the causes: more samples reduce it. levers: (k,
    3) of the points, as in sigma_table.
    """
    *terms, total = budget(solution, levers)
    squares = [sum(term.mapped ** 2 for term in terms if term.name.startswith(factor.terms))
               for factor in LIMITING_FACTORS]
    largest = int(np.argmax(squares))
    ratio = squares[largest] ** 0.5 / total.mapped
    return (LIMITING_FACTORS[largest], ratio) if ratio >= MIN_FACTOR else None


def enough_and_why(std: float, accuracy: float, expected: float | None,
                   largest: tuple[LimitingFactor, float] | None, count: int) -> tuple[bool, str]:
    """
    Return whether the samples are sufficient, and the reason.

    std: 1 sigma of mapped points (m), now; expected: after one more sample; accuracy: as wanted;
    largest: see largest_limiting_factor.
    """
    content = (f'points in view are known to {1e3 * std:.3f} mm (1 sigma, {1e3 * accuracy:.3f} '
               'wanted)')
    remedy = ''
    if largest:
        cause, ratio = largest
        content += f', of which {1e3 * ratio * std:.3f} mm is {cause.text} ({cause.key})'
        remedy = f', a better {cause.remedy} would'
    if std > accuracy and count >= GOOD_COUNT and expected and (
            expected > (1 - MIN_GAIN) * std):
        return True, f'enough: {content}; more samples bring little{remedy}'
    if expected:
        content += f'; one more sample would bring {1e3 * expected:.3f} mm'
    return (True, f'enough: {content}') if std <= accuracy else (False, content)


def _motion_in_words(T_base_flange: Array, proposal: Proposal, config: Config, what: str) -> str:
    """Return in words the motion from the last sample to the next pose."""
    T = se3.inverse(T_base_flange) @ proposal.T_base_flange
    shift = 1e3 * (proposal.T_base_flange[:3, 3] - T_base_flange[:3, 3])
    turns = np.degrees(se3.euler_angles(Rotation.from_matrix(T[:3, :3]), 'XYZ'))
    flange, base = config.robot_effector_frame, config.base_frame
    turned, moved = (', '.join(f'{v:+.0f}' for v in values) for values in (turns, shift))
    x, z = 1e3 * proposal.place
    return (f'next, from the last sample: turn by {turned} degrees about {flange} x, then y, then '
            f'z, and move by {moved} mm along {base} x, y, z; the {what} is then at '
            f'x = {x:.0f} mm, range {z:.0f} mm')
