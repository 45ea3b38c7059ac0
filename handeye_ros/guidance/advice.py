# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Guidance: the uncertainty so far, what is missing, and the next pose."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_frame, mounted, name_direction
from handeye_ros.guidance.candidates import Search
from handeye_ros.guidance.moves import missing, Move, next_move, noun
from handeye_ros.guidance.rules import limits_of, visited
from handeye_ros.guidance.score import (
    Cause,
    largest_cause,
    learn_view,
    Mapping,
    mapping,
    with_sample,
)
from handeye_ros.se3 import worst_rotation, worst_translation
import numpy as np
from scipy.spatial.transform import Rotation

ROUGHLY_KNOWN = 3e-3  # m: points mapped worse than this cannot be aimed at
MOST_MISSING = 2  # sentences on what is missing
GOOD_COUNT = 15  # samples, before which nothing but the wanted accuracy is enough
LITTLE = 0.02  # of the mapped points' sigma: less is no reason for another sample
# What helps where more samples do not, by the setting that limits.
REMEDIES = {'noise.robot_smooth': 'robot, or a better statement of its accuracy,',
            'noise.robot_scale': 'robot, or a better statement of its scale,',
            'noise.distortion': 'sensor', 'noise.line_bend': 'sensor', 'noise.flatness': 'target',
            'target.setback_std': 'target'}
SWEEP = ('continue to sweep over the {}: to and fro across it, with tilts about all axes, near '
         'and far, with changes of speed')
SEED = 0  # the same samples give the same advice


@dataclass(frozen=True)
class Sigma:
    """Uncertainty in one direction: 1 sigma and its limit, m or rad (unit)."""

    name: str
    std: float
    limit: float
    unit: str = 'm'


@dataclass(frozen=True, eq=False)
class Proposal:
    """
    The next pose, T_base_flange (4, 4), and the uncertainty expected after it.

    place: (2,) where in the sensor plane the feature will be seen; std: 1 sigma of mapped points
    with it (m).
    """

    T_base_flange: Array
    place: Array
    std: float


@dataclass(frozen=True, eq=False)
class Advice:
    """
    Advice for the operator.

    sentences: in the order of their weight; next: the pose that helps most, None before the
    sensor is roughly known; move: what to do instead then; sigmas: empty before there is an
    answer; enough: whether to stop; why: the reason, one sentence.
    """

    sentences: tuple[str, ...]
    next: Proposal | None  # noqa: A003
    move: Move | None
    sigmas: tuple[Sigma, ...]
    enough: bool
    why: str

    @property
    def text(self) -> str:
        """Return all sentences as one text."""
        return '. '.join(s[0].upper() + s[1:] for s in self.sentences) + '.'


def advise(samples: Sequence[Sample], config: Config, solution: Solution | None,
           trouble: str = '', seen: Array | None = None,
           refused: Sequence[Array] = (), notes: Sequence[str] = ()) -> Advice:
    """
    Return the advice after some samples; the limits of guidance.* are relative to the first.

    solution: of those that agree, None before there is one; trouble: why there is none, or why it
    was refused; seen: points (n, 2) of profiles, to learn the view from; refused: poses of the
    flange (4, 4) at which stops gave no sample; notes: on the time offset, during a sweep.
    """
    method = targets.method_for(config)
    if not samples:
        return _unguided(f'take the first sample: hold the sensor square to the target, with the '
                         f'{noun(method)} in the middle of the view', None, trouble)
    view = learn_view(samples, seen)
    mapped = None if solution is None else mapping(solution.estimate.X, view)
    if solution is None or mapped is None or mapped.std(_stated(solution)) > ROUGHLY_KNOWN:
        if config.sampling.moving:
            return _unguided(SWEEP.format(noun(method)), None, trouble)
        move = next_move(len(samples), method, config, view)
        return _unguided(move.text, move, trouble)
    limits = limits_of(mounted(samples, config)[0], config)
    sigmas = sigma_table(solution, mapped, config)
    lacking = missing(solution, view, limits)[:MOST_MISSING]
    if config.sampling.moving:
        return _of_sweep(solution, sigmas, lacking, trouble, notes)
    surely = view.shrunk(mapped.std(_stated(solution)))  # seen there, wherever the sensor is
    search = Search(solution, surely, limits, mapped, visited(samples, refused, config),
                    samples[-1].T_base_flange)
    proposal = propose(search, config) or propose(replace(  # where there is no room for a margin
        search, view=view, visited=visited(samples, refused, config, margin=(0.0, 0.0))), config)
    enough, why = judged(sigmas, proposal, largest_cause(solution, mapped), len(samples))
    content = [why, *lacking * (not enough)]
    if proposal and not enough:
        content.append(_directions(samples[-1].T_base_flange, proposal, config, noun(method)))
    if not proposal and not enough:
        content.append('no pose within guidance.reach, guidance.tilt and guidance.turn keeps the '
                       f'{noun(method)} in view: widen them')
    return Advice(tuple(filter(None, [trouble, *content])), proposal, None, sigmas,
                  enough and not trouble, why)


def _unguided(text: str, move: Move | None, trouble: str) -> Advice:
    why = trouble or 'there is no answer yet'
    return Advice(tuple(filter(None, [text, trouble])), None, move, (), False, why)


def _of_sweep(solution: Solution, sigmas: tuple[Sigma, ...], lacking: Sequence[str], trouble: str,
              notes: Sequence[str]) -> Advice:
    """Return the advice during a sweep: what is missing, without a next pose."""
    enough, why = judged(sigmas, None, None, len(solution.problem.poses))
    content = [trouble, why, *notes, *(() if enough else lacking)]
    return Advice(tuple(filter(None, content)), None, None, sigmas, enough and not trouble, why)


def _stated(solution: Solution) -> Array:
    return solution.reported[:6, :6]


def sigma_table(solution: Solution, mapped: Mapping, config: Config) -> tuple[Sigma, ...]:
    """Return the uncertainty along each axis, in the worst directions, and of mapped points."""
    covariance, limits, frame = _stated(solution), config.limits, mount_frame(config)
    std = np.sqrt(np.diag(covariance))
    sigmas = [Sigma(f'position {axis}', float(s), limits.translation)
              for axis, s in zip('xyz', std[:3], strict=True)]
    sigmas += [Sigma(f'rotation about {axis}', float(s), limits.rotation, 'rad')
               for axis, s in zip('xyz', std[3:], strict=True)]
    shift, along = worst_translation(covariance)
    turn, about = worst_rotation(covariance)
    far, way = mapped.worst(covariance)
    return (*sigmas,
            Sigma(f'position along {name_direction(along, frame)} (worst)', shift,
                  limits.translation),
            Sigma(f'rotation about {name_direction(about, frame)} (worst)', turn,
                  limits.rotation, 'rad'),
            Sigma(f'points in view, along {name_direction(way, frame)} (worst)', far,
                  config.guidance.accuracy),
            Sigma('points in view', mapped.std(covariance), config.guidance.accuracy))


def propose(search: Search, config: Config) -> Proposal | None:
    """Return the pose with the largest gain, None if none keeps the feature in view."""
    rng = np.random.default_rng(SEED)
    drawn = search.draw(rng)
    if not drawn:
        return None
    part = search.refined(drawn, rng)
    best = part.best()
    T = part.poses[best]
    in_hand = config.calibration_type == 'eye_in_hand'
    return Proposal(T if in_hand else se3.inverse(T), part.anchors[best],
                    with_sample(search.solution, search.mapping,
                                part.problem.subset(np.array([best]))))


def judged(sigmas: Sequence[Sigma], proposal: Proposal | None, cause: Cause | None,
           count: int) -> tuple[bool, str]:
    """Return whether the samples are sufficient, and the reason."""
    std, accuracy = sigmas[-1].std, sigmas[-1].limit
    over = [s for s in sigmas[:-2] if s.std > s.limit]
    if over:
        return False, f'{over[-1].name} is uncertain by {_figure(over[-1])}'
    content = (f'points in view are known to {1e3 * std:.3f} mm (1 sigma, {1e3 * accuracy:.3f} '
               'wanted)')
    if cause:
        content += f', of which {1e3 * cause.std:.3f} mm is {cause.text} ({cause.key})'
    after = f'one more sample would bring {1e3 * proposal.std:.3f} mm' if proposal else ''
    if std <= accuracy:
        return True, '; '.join(filter(None, [f'enough: {content}', after]))
    if proposal and count >= GOOD_COUNT and proposal.std > (1 - LITTLE) * std:
        remedy = (f'a better {REMEDIES[cause.key]} would' if cause and cause.key in REMEDIES else
                  'noise dominates')
        return True, f'enough: {content}; more samples bring little, {remedy}'
    return False, '; '.join(filter(None, [content, after]))


def _figure(sigma: Sigma) -> str:
    if sigma.unit == 'm':
        return f'{1e3 * sigma.std:.2f} mm (limit {1e3 * sigma.limit:.2f})'
    return f'{np.degrees(sigma.std):.3f} degrees (limit {np.degrees(sigma.limit):.3f})'


def _directions(T_base_flange: Array, proposal: Proposal, config: Config, what: str) -> str:
    """Return in words the motion from the last sample to the next pose."""
    T = se3.inverse(T_base_flange) @ proposal.T_base_flange
    shift = 1e3 * (proposal.T_base_flange[:3, 3] - T_base_flange[:3, 3])
    turns = Rotation.from_matrix(T[:3, :3]).as_euler('XYZ', degrees=True)
    flange, base = config.robot_effector_frame, config.base_frame
    turned = ', then '.join(f'{angle:+.0f} degrees about {flange} {axis}'
                            for angle, axis in zip(turns, 'xyz', strict=True)
                            if abs(angle) >= 0.5)
    moved = ', '.join(f'{v:+.0f}' for v in shift)
    x, z = 1e3 * proposal.place
    return (f'next, from the last sample: turn {turned or "nothing"}, and move by {moved} mm '
            f'along {base} x, y, z; the {what} is then at x = {x:.0f} mm, range {z:.0f} mm')
