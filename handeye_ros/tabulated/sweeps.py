# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sweep of the profiler over ball and block: from profiles and poses to points (Jing 2020).

The flange moves along a line without rotation. Profiles with two faces that meet in a ridge show
the block, profiles with an arc the ball; all others are ignored.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
import math
from typing import NamedTuple

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, TimedPose
from handeye_ros.errors import DataError, degrees, FeatureError, UnusableMessageError
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.faces import corner_features
from handeye_ros.sampling.stream import interpolate
import numpy as np

RIDGE_ANGLE = 0.35  # smallest angle between two faces that meet (rad)
LARGEST_TURN = 2e-3  # largest rotation of the flange during a sweep (rad)
LARGEST_ASIDE = 2e-4  # largest deviation of the flange from its line (m, RMS)
SMALLEST_WAY = 0.02
FEWEST_PROFILES = 5
# consecutive profiles without two faces that do not end a run of block profiles
MOST_MISSED_PROFILES = 3

SWEPT_PARTS = ('swept_ball', 'swept_face_c', 'swept_face_d')


class Piece(NamedTuple):
    """
    Points of a part of ball, block or arm: a row of the file, or what one profile shows of it.

    sample: the row or the stamp
    part: of SWEPT_PARTS (face_c is the face at smaller x), or the kind in the file
    points: (k, 3), in the tracker's frame, swept ones x and z in the sensor plane and the reading
        of P3
    sigma: (k,) of each coordinate, of swept ones of x and z (metres)
    """

    sample: int
    part: str
    points: Array
    sigma: Array


def sweep_from(profiles: Sequence[AnyProfile], poses: Sequence[TimedPose], config: Config
               ) -> tuple[list[Piece], float]:
    """
    Return what a sweep shows of ball and block, and the reading of P3 in its middle (m).

    profiles, poses: in the order of their stamps; config: tracker.first_reading of P3 at the
    first pose, noise.sensor, target.radius of the ball (0: unknown), sampling.min_points. Raises
    DataError.
    """
    first, last = poses[0].stamp, poses[-1].stamp
    inside = [p for p in profiles if first <= p.stamp <= last]
    if not inside:
        raise DataError('no profile lies within the time of the poses; record both together')
    q3 = config.tracker.first_reading + _ways(interpolate(poses, [
        first, *(p.stamp for p in inside)]))
    ball: list[Piece] = []
    blocks: list[tuple[int, list[Piece]]] = []
    for index, profile in enumerate(inside):
        with suppress(UnusableMessageError, FeatureError):
            seen = [Piece(profile.stamp, part, np.insert(points, 2, q3[index], axis=1), sigma)
                    for part, points, sigma in _seen(profile.read().points, config)]
            if len(seen) == 1:
                ball += seen
            else:
                blocks.append((index, seen))
    # the rim of the ball shows so little that two lines may fit it as well
    cuts = 1 + np.flatnonzero(np.diff([index for index, _ in blocks]) > 1 + MOST_MISSED_PROFILES)
    block = max((blocks[first:last] for first, last in pairwise([0, *cuts, len(blocks)])), key=len)
    for what, count in (('ball', len(ball)), ('block', len(block))):
        if count < FEWEST_PROFILES:
            raise DataError(f'{count} profiles show the {what}; sweep over it slowly, at least '
                            f'{FEWEST_PROFILES} profiles')
    return [*ball, *(piece for _, two in block for piece in two)], (q3.min() + q3.max()) / 2


def _ways(T: Array) -> Array:
    """Return the travel (n - 1,) along the flange's z from the first of poses (n, 4, 4), m."""
    turn = float(np.max(se3.angle(T[:, :3, :3] @ T[0, :3, :3].T)))
    if turn > LARGEST_TURN:
        raise DataError(f'the flange turns by {degrees(turn)} during the sweep; move P3 alone')
    moved = (T[:, :3, 3] - T[0, :3, 3]) @ T[0, :3, :3]
    aside = float(np.sqrt((moved[:, :2] ** 2).sum(axis=1).mean()))
    if np.ptp(moved[:, 2]) < SMALLEST_WAY or aside > LARGEST_ASIDE:
        raise DataError(
            f'the flange moves {np.ptp(moved[:, 2]) * 1e3:.1f} mm along its z, and '
            f'{aside * 1e3:.2f} mm aside; move P3 alone, over ball and block; the flange frame '
            'has z along P3')
    return np.asarray(moved[1:, 2])


def _seen(points: Array, config: Config) -> list[tuple[str, Array, Array]]:
    """
    Return the part of the ball, or the two faces of the block, in a profile (n, 2).

    Points (k, 2) and their sigma (k,) of each. Raises FeatureError for a profile of neither.
    """
    with suppress(FeatureError):
        arc, = arc_features(points, config)
        return [(SWEPT_PARTS[0], arc.points, arc.std)]
    left, right = corner_features(points, config)[:2]
    # nearer to the sensor in the middle, so the range falls towards it from both sides
    bend = float(np.linalg.det([left.direction, right.direction])) * config.profile.range_sign
    if bend < math.sin(RIDGE_ANGLE):
        raise FeatureError('a groove, or an edge too blunt')
    return [(SWEPT_PARTS[1], left.points, left.points_std),
            (SWEPT_PARTS[2], right.points, right.points_std)]
