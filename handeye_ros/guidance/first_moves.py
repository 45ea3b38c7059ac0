# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The first moves, before the sensor is roughly known.

They are a fixed design (below: a table for each sort of target), described from the first pose in
axes that can be seen: the laser line, the light plane, the viewing direction. Exchange searches,
and for a sphere small steps after them, found the moves that leave mapped points least uncertain
once there are as many samples as an answer needs: with the noise of a common robot (0.05 mm, 0.02
degrees), over several sensors on the flange, with moves that are off by 4 degrees and 3 mm.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array
from handeye_ros.guidance.view import View
from handeye_ros.targets.profile_target import ProfileTarget
import numpy as np

# A row for each sample, the first looks squarely. Columns: turn about the viewing direction, in
# shares of the largest; tilts about the laser line and about the normal of the light plane, in
# shares of the largest; place along the line and in range, -1 to 1; and for a sphere how far its
# middle is off the light plane, in radii.
SPHERE_MOVES = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, 0.81, 0.5, 0.55, 0.68, -0.6],
    [-1.0, -0.85, -0.43, -0.26, -0.7, -0.6],
    [0.0, -0.93, -0.18, 0.31, -0.7, 0.6],
    [1.0, 0.9, 0.31, -0.29, -0.7, -0.6],
    [1.0, -0.77, -0.55, -0.47, 0.7, 0.6],
    [-1.0, 0.95, 0.0, -0.7, 0.7, 0.6],
])
OTHER_MOVES = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, 0.67, -0.67, -0.7, 0.7, 0.0],
    [-0.7, 0.0, -0.95, 0.7, -0.7, 0.0],
    [1.0, 0.0, 0.95, -0.7, -0.7, 0.0],
    [-1.0, -0.67, 0.67, 0.7, -0.7, 0.0],
    [1.0, -0.67, -0.67, -0.7, 0.7, 0.0],
    [1.0, 0.67, 0.67, 0.7, 0.7, 0.0],
    [-1.0, -0.67, 0.67, -0.7, 0.7, 0.0],
])
TWO_EDGES_MOVES = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [-1.0, -0.67, 0.67, -0.7, 0.0, 0.0],
    [-1.0, 0.67, -0.67, 0.0, -0.7, 0.0],
    [-1.0, 0.67, 0.67, 0.0, 0.0, 0.0],
    [-0.7, -0.67, -0.67, 0.0, -0.7, 0.0],
    [0.1, 0.95, 0.0, -0.7, 0.7, 0.0],
    [1.0, 0.0, -0.95, 0.0, 0.7, 0.0],
])
STATIONS_PER_EDGE = 3  # stations before the next edge of a plate
SPARE_TURN = 0.26  # rad: margin to the largest, for the operator


@dataclass(frozen=True, eq=False)
class AdvisedMove:
    """
    A move relative to the first pose, described by the view of the laser line.

    text: the move in words, for the operator
    turn: rad about the viewing direction (the range axis), done first
    tilt: (2,) rad about the laser line and about the normal of the light plane
    place: (2,) where in the sensor plane the feature then is
    edge: which of the target's edges the line crosses, from 0
    beside: how far the middle of a sphere is off the light plane, along its normal, in radii
    """

    text: str
    turn: float
    tilt: Array
    place: Array
    edge: int = 0
    beside: float = 0.0


def seen_feature_noun(target: ProfileTarget) -> str:
    """Return the feature that the laser line must show, in words."""
    return 'edge' if target.edge_kinds else target.name


def next_move(sample_count: int, target: ProfileTarget, config: Config, view: View) -> AdvisedMove:
    """Return the move after a number of samples (at least one)."""
    is_round, two_edges = Arc in target.required_features, len(target.edge_kinds) > 1
    moves = SPHERE_MOVES if is_round else TWO_EDGES_MOVES if two_edges else OTHER_MOVES
    turn, *shares, beside = moves[sample_count % len(moves)]
    tilt = np.round(np.array(shares[:2]) * config.guidance.tilt, 3)
    inner = view.inner()
    place = inner.middle + shares[2:] * inner.size / 2
    edge = sample_count // STATIONS_PER_EDGE % 2 if two_edges else 0

    largest = config.guidance.turn
    if not is_round:  # the line has to cross where parts of the target meet
        largest = min(largest, np.pi / 2 - config.sampling.min_crossing_angle)
    angle = abs(turn) * max(largest - SPARE_TURN, 0.0)
    if edge:  # obliquely across the other one
        angle = min(np.pi / 2 - angle, config.guidance.turn)
    mirror_sign = -1.0 if sample_count // len(moves) % 2 else 1.0  # each other time through
    turn = float(np.copysign(angle, turn * mirror_sign))
    text = _move_in_words(target, config, turn, tilt, place, edge, beside)
    return AdvisedMove(text, turn, tilt, place, edge, float(beside))


def _move_in_words(target: ProfileTarget, config: Config, turn: float, tilt: Array, place: Array,
                   edge: int, beside: float) -> str:
    """Return a move in words; the arguments are as in AdvisedMove."""
    # beside the robot the sensor stays, and the robot turns the target the other way
    mover, other, turn_axis, sign = (
        ('sensor', 'target', 'its viewing direction', 1) if config.in_hand else
        ('target', 'sensor', 'the viewing direction', -1))
    where = ('at the other edge, that meets the first one in the corner, ' if edge else
             'at the same edge, ' if len(target.edge_kinds) > 1 else '')
    turns = ', then '.join(
        f'{np.degrees(sign * angle):+.0f} degrees about {axis}' for angle, axis in (
            (turn, turn_axis), (tilt[0], 'the laser line'),
            (tilt[1], 'the normal of the light plane')) if angle)
    turned = f'turn the {mover} {turns}' if turns else f'hold the {mover} square to the {other}'
    x, z = place * 1e3
    side = 'positive' if beside > 0 else 'negative'
    crossing = f'; let the line cross the ball {abs(beside):.1f} of its radius beside the top, ' \
               f'its middle on the {side} side of the light plane' if beside else ''
    return (f'from the pose of the first sample, {where}{turned}; keep the '
            f'{seen_feature_noun(target)} in '
            f'view, at x = {round(x)} mm, range {round(z)} mm{crossing}')
