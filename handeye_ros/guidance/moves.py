# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the samples lack, and moves described by the view of the laser line.

Before the sensor is roughly known, the first samples are those of a fixed design, described from
the first pose in axes that can be seen: the laser line, the light plane, the viewing direction.
Searches by exchange, and for a sphere by small steps after it, found for each sort of target the
moves that leave mapped points least uncertain once there are as many samples as an answer needs:
with the noise of a common robot (0.05 mm, 0.02 degrees), over several sensors on the flange, with
moves that are off by 4 degrees and 3 mm.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.problem import Problem, Target
from handeye_ros.estimation.solve import Solution
from handeye_ros.guidance.rules import Limits, twist_of
from handeye_ros.guidance.score import View
from handeye_ros.guidance.views import anchor_of
import numpy as np

# Turn about the viewing direction, in shares of the largest; tilts about the laser line and about
# the normal of the light plane, in shares of the largest; place along the line and in range, -1
# to 1; and for a sphere how far its middle is off the light plane, in radii. The first sample
# looks squarely.
SPHERE = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, 0.81, 0.5, 0.55, 0.68, -0.6],
    [-1.0, -0.85, -0.43, -0.26, -0.7, -0.6],
    [0.0, -0.93, -0.18, 0.31, -0.7, 0.6],
    [1.0, 0.9, 0.31, -0.29, -0.7, -0.6],
    [1.0, -0.77, -0.55, -0.47, 0.7, 0.6],
    [-1.0, 0.95, 0.0, -0.7, 0.7, 0.6],
])
ONE_EDGE = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, 0.67, -0.67, -0.7, 0.7, 0.0],
    [-0.7, 0.0, -0.95, 0.7, -0.7, 0.0],
    [1.0, 0.0, 0.95, -0.7, -0.7, 0.0],
    [-1.0, -0.67, 0.67, 0.7, -0.7, 0.0],
    [1.0, -0.67, -0.67, -0.7, 0.7, 0.0],
    [1.0, 0.67, 0.67, 0.7, 0.7, 0.0],
    [-1.0, -0.67, 0.67, -0.7, 0.7, 0.0],
])
TWO_EDGES = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, -0.67, 0.67, -0.7, 0.0, 0.0],
    [-1.0, 0.67, -0.67, 0.0, -0.7, 0.0],
    [-1.0, 0.67, 0.67, 0.0, 0.0, 0.0],
    [-0.7, -0.67, -0.67, 0.0, -0.7, 0.0],
    [0.1, 0.95, 0.0, -0.7, 0.7, 0.0],
    [1.0, 0.0, -0.95, 0.0, 0.7, 0.0],
])
PER_EDGE = 3  # stations before the next edge of a plate
SPARE_TURN = 0.26  # rad: margin to the largest, for the operator
WANTED_TILT = 0.6  # of the largest tilt, to either side
WANTED_TURN = 0.52  # rad to either side
WANTED_PLACES = 0.5  # of the view
FILLING = 0.6  # of the view's width: a larger feature has no place along the line
WANTED_PER_EDGE = 3


@dataclass(frozen=True, eq=False)
class Move:
    """
    A move relative to the first pose, described by the view of the laser line.

    turn: rad about the viewing direction (the range axis), done first; tilt: (2,) rad about the
    laser line and about the normal of the light plane; place: (2,) where in the sensor plane the
    feature then is; edge: which of the target's edges the line crosses, from 0; beside: how far
    the middle of a sphere is off the light plane, along its normal, in radii.
    """

    text: str
    turn: float
    tilt: Array
    place: Array
    edge: int = 0
    beside: float = 0.0


def design(method: Target) -> Array:
    """Return the moves (n, 6) for the target of a method."""
    if _round(method):
        return SPHERE
    return TWO_EDGES if len(method.essential) > 1 else ONE_EDGE


def next_move(taken: int, method: Target, config: Config, view: View) -> Move:
    """Return the move after a number of samples (at least one)."""
    steps = design(method)
    mirrored = -1.0 if taken // len(steps) % 2 else 1.0
    step = steps[taken % len(steps)] * [mirrored, 1, 1, 1, 1, 1]
    edge = taken // PER_EDGE % 2 if len(method.essential) > 1 else 0
    turn = _turn(step[0], edge, method, config)
    tilt = np.round(step[1:3] * config.guidance.tilt, 3)
    inner = view.inner()
    place = (inner.low + inner.high) / 2 + step[3:5] * inner.size / 2
    text = (f'{_start(edge, method)}: {_turns(turn, tilt)}; '
            f'{_shown(method, place, step[3:5])}{_beside(step[5])}')
    return Move(text, turn, tilt, place, edge, float(step[5]))


def _round(method: Target) -> bool:
    """Return whether the target looks the same at every crossing."""
    return method.kinds == ('arc',)


def _turn(share: float, edge: int, method: Target, config: Config) -> float:
    """Return the turn from the first pose: at the other edge, and obliquely across it."""
    largest = config.guidance.turn
    if not _round(method):  # the line has to cross where parts of the target meet
        largest = min(largest, np.pi / 2 - config.sampling.min_crossing_angle)
    turn = abs(share) * max(largest - SPARE_TURN, 0.0)
    turn = min(np.pi / 2 - turn, config.guidance.turn) if edge else turn
    return float(np.copysign(turn, share))


def noun(method: Target) -> str:
    """Return the feature that the laser line must show, in words."""
    return 'edge' if method.essential else method.name


def _start(edge: int, method: Target) -> str:
    if len(method.essential) < 2:
        return 'from the pose of the first sample'
    return ('from the pose of the first sample, at the same edge' if edge == 0 else
            'from the pose of the first sample, at the other edge, that meets the first one in '
            'the corner')


def _turns(turn: float, tilt: Array) -> str:
    """Return the rotations in words."""
    parts = [f'{np.degrees(angle):+.0f} degrees about {axis}' for angle, axis in (
        (turn, 'its viewing direction'), (tilt[0], 'the laser line'),
        (tilt[1], 'the normal of the light plane')) if angle]
    return (f'turn the sensor {", then ".join(parts)}' if parts
            else 'hold the sensor square to the target')


def _shown(method: Target, place: Array, share: Array) -> str:
    """Return where in the view the feature should appear, in words."""
    x, z = place * 1e3
    along = ('low', 'middle', 'high')[int(np.sign(share[0])) + 1]
    near = ('near', 'middle', 'far')[int(np.sign(share[1])) + 1]
    return (f'keep the {noun(method)} in view, at the {along} end of the line and {near} '
            f'(x = {x:.0f} mm, range {z:.0f} mm)').replace('middle end', 'middle')


def _beside(share: float) -> str:
    """Return how far from its centre the laser line cuts a sphere, in words."""
    if not share:
        return ''
    side = 'positive' if share > 0 else 'negative'
    return (f'; let the line cross the ball {abs(share):.1f} of its radius beside the top, its '
            f'middle on the {side} side of the light plane')


@dataclass(frozen=True)
class Spread:
    """One kind of diversity of the samples: its amount, the amount wanted, and both in words."""

    share: float
    text: str


def missing(solution: Solution, view: View, limits: Limits) -> list[str]:
    """Return in words what the samples of a solution lack, the most important first."""
    problem = solution.problem
    spreads = [*_rotations(problem.poses, solution.estimate.X, limits), *_coverage(problem, view),
               *_edges(problem)]
    return [s.text for s in sorted(spreads, key=lambda s: s.share) if s.share < 1.0]


def _rotations(poses: Array, X: Array, limits: Limits) -> list[Spread]:
    first, R = limits.first[:3, :3] @ X[:3, :3], poses[:, :3, :3] @ X[:3, :3]
    twist = twist_of(first, R)
    about_z = np.column_stack([np.zeros((len(R), 2)), twist])
    swing = se3.log_rotation(np.swapaxes(first @ se3.exp_rotation(about_z), 1, 2) @ R)
    tilt, turn = WANTED_TILT * limits.tilt, min(WANTED_TURN, WANTED_TILT * limits.turn)
    return [_turned('tilt about the laser line', swing[:, 0], tilt),
            _turned('tilt about the normal of the light plane', swing[:, 1], tilt),
            _turned('turn about the viewing direction', twist, turn)]


def _turned(what: str, angles: Array, wanted: float) -> Spread:
    """Return the spread of angles (n,) to both sides."""
    half = float(np.ptp(angles)) / 2
    return Spread(half / wanted if wanted else 1.0,
                  f'{what}: {np.degrees(half):.0f} degrees to either side so far, '
                  f'{np.degrees(wanted):.0f} wanted')


def _coverage(problem: Problem, view: View) -> list[Spread]:
    """Return the spread of the features over the view, along the line and in range."""
    obs, n = problem.observations, len(problem.poses)
    anchors = np.array([anchor_of(problem, i) for i in range(n)])
    lengths = [np.ptp(obs.points[obs.station == i], axis=0)[0] for i in range(n)]
    fills = np.median(lengths) > FILLING * view.size[0]
    spreads = []
    for axis, what in ((0, 'along the laser line'), (1, 'in range')):
        so_far, wanted = np.ptp(anchors[:, axis]), WANTED_PLACES * view.size[axis]
        if wanted > 0 and not (axis == 0 and fills):
            spreads.append(Spread(float(so_far / wanted), (
                f'places of the {noun(problem.method)} {what}: over {so_far * 1e3:.0f} mm so '
                f'far, {wanted * 1e3:.0f} mm wanted')))
    return spreads


def _edges(problem: Problem) -> list[Spread]:
    """Return for each visible edge the number of samples, if there are several edges."""
    obs, method = problem.observations, problem.method
    if len(method.essential) < 2:
        return []
    counts = {method.kinds[k]: len(np.unique(obs.station[obs.kind == k]))
              for k in np.unique(obs.kind) if method.kinds[k] in method.essential}
    return [Spread(count / WANTED_PER_EDGE, f'edge {name}: {count} samples so far, '
                   f'{WANTED_PER_EDGE} wanted') for name, count in counts.items()]
