# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sweep of the profiler over ball and block: from profiles and poses to points (Jing 2020).

The flange moves along a line without rotation. Profiles with two faces that meet in a ridge show
the block, profiles with an arc the ball; all others are ignored.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Arc, Array, TimedPose
from handeye_ros.errors import DataError, degrees, FeatureError, UnusableMessageError
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.segment import noise_level, Segment, straight_segments
from handeye_ros.sampling.stream import interpolate
import numpy as np
from numpy.typing import NDArray

RIDGE_ANGLE = 0.35  # smallest angle between two faces that meet (rad)
SHARE = 0.6  # smallest share of a profile's points on the two faces, or on the arc
STRAIGHT = 1.5  # largest scatter of a straight face over the noise; pieces of an arc exceed it
STEEP = 0.5  # smallest cosine of the incidence angle at a used point of the ball
END = 0.1  # share of a face left out at each end, where points are mixed
BINS = 12  # largest number of mean points of a face in one profile
LARGEST_TURN = 2e-3  # largest rotation of the flange during a sweep (rad)
LARGEST_ASIDE = 2e-4  # largest deviation of the flange from its line (m, RMS)
SMALLEST_WAY = 0.02
FEWEST_PROFILES = 5
MISSED = 3  # consecutive profiles without two faces that do not end a run of block profiles

SWEPT = ('swept_ball', 'swept_face_c', 'swept_face_d')


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    Points of the profiles of the sweep.

    part: (n,) the index in SWEPT, face_c is the face at smaller x; points: (n, 3) x, z in the
    sensor plane and the reading of P3; sigma: (n,) of x and z; stamps: (n,) of their profiles;
    q30: the reading at which the flange frame is taken (metres).
    """

    part: NDArray[np.intp]
    points: Array
    sigma: Array
    stamps: NDArray[np.int64]
    q30: float


def sweep_from(profiles: Sequence[AnyProfile], poses: Sequence[TimedPose], config: Config
               ) -> Sweep:
    """
    Return the points of a sweep, the flange frame taken in its middle.

    profiles, poses: in the order of their stamps; config: tracker.first_reading of P3 at the
    first pose, noise.sensor, target.radius of the ball (0: unknown), sampling.min_points. Raises
    DataError.
    """
    first, last = poses[0].stamp, poses[-1].stamp
    inside = [p for p in profiles if first <= p.stamp <= last]
    if not inside:
        raise DataError('no profile lies within the time of the poses; record both together')
    stamps = np.array([p.stamp for p in inside])
    q3 = config.tracker.first_reading + _ways(interpolate(poses, [first, *stamps.tolist()]))
    pieces = _pieces(inside, config)
    profile, part = np.repeat([(piece.profile, piece.part) for piece in pieces],
                              [len(piece.sigma) for piece in pieces], axis=0).T
    points = np.column_stack([np.concatenate([piece.points for piece in pieces]), q3[profile]])
    return Sweep(part, points, np.concatenate([piece.sigma for piece in pieces]), stamps[profile],
                 float(q3.min() + q3.max()) / 2)


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


class _Piece(NamedTuple):
    """Points (k, 2) of a part (index in SWEPT) in a profile (its index), and their sigma (k,)."""

    profile: int
    part: int
    points: Array
    sigma: Array


def _pieces(profiles: Sequence[AnyProfile], config: Config) -> list[_Piece]:
    """Return what the profiles show of ball and block; raises DataError where that is little."""
    blocks: list[tuple[int, list[_Piece]]] = []
    arcs: list[tuple[int, Arc]] = []
    for index, profile in enumerate(profiles):
        try:
            points = profile.read().points
        except UnusableMessageError:
            continue
        if two := ridge(points, config):
            blocks.append((index, [_Piece(index, 1 + side, *_face_points(face, points))
                                   for side, face in enumerate(two)]))
        elif arc := _arc(points, config):
            arcs.append((index, arc))
    # the rim of the ball shows so little that two lines may fit it as well
    cuts = 1 + np.flatnonzero(np.diff([index for index, _ in blocks]) > 1 + MISSED)
    block = max((blocks[first:last] for first, last in pairwise([0, *cuts, len(blocks)])), key=len)
    for what, count in (('ball', len(arcs)), ('block', len(block))):
        if count < FEWEST_PROFILES:
            raise DataError(f'{count} profiles show the {what}; sweep over it slowly, at least '
                            f'{FEWEST_PROFILES} profiles')
    radius = config.target.radius or max(arc.radius for _, arc in arcs)
    pieces = [piece for _, two in block for piece in two]
    for index, arc in arcs:  # without points at grazing incidence
        steep = np.abs(arc.points[:, 1] - arc.centre[1]) > STEEP * radius
        pieces.append(_Piece(index, 0, arc.points[steep], arc.std[steep]))
    return pieces


def ridge(points: Array, config: Config) -> tuple[Segment, Segment] | None:
    """Return the two faces of a block in a profile (n, 2), the one at smaller x first, or None."""
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    if len(segments) < 2:
        return None
    two = sorted(segments, key=lambda s: -len(s.rows))[:2]
    left, right = sorted(two, key=lambda s: float(points[s.rows, 0].mean()))
    seen = np.isfinite(points).all(axis=1)
    noise = max(noise_level(points[seen, 1], config.noise.sensor), config.noise.sensor)
    # nearer to the sensor in the middle, so the range falls towards it from both sides
    bend = (np.arctan(right.slope) - np.arctan(left.slope)) * config.profile.range_sign
    if bend <= RIDGE_ANGLE:
        return None
    x = (right.offset - left.offset) / (left.slope - right.slope)
    between = points[left.rows, 0].mean() < x < points[right.rows, 0].mean()
    enough = len(left.rows) + len(right.rows) >= SHARE * seen.sum()
    straight = max(left.noise, right.noise) < STRAIGHT * noise
    return (left, right) if between and enough and straight else None


def _face_points(segment: Segment, points: Array) -> tuple[Array, Array]:
    """Return mean points (k, 2) of a face, and their sigma (k,)."""
    margin = int(END * len(segment.rows))
    inner = points[segment.rows[margin:len(segment.rows) - margin]]
    bins = np.array_split(inner[np.argsort(inner[:, 0])], min(BINS, len(inner)))
    std = segment.noise / np.hypot(1.0, segment.slope)
    return np.array([b.mean(axis=0) for b in bins]), std / np.sqrt([len(b) for b in bins])


def _arc(points: Array, config: Config) -> Arc | None:
    """Return the arc of the ball in a profile (n, 2), or None."""
    target = replace(config.target, type='sphere')
    try:
        arc, = arc_features(points, replace(config, target=target))
    except FeatureError:
        return None
    enough = len(arc.raw) >= SHARE * np.isfinite(points).all(axis=1).sum()
    return arc if enough else None
