# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sweep of the profiler over ball and block: from profiles and poses to points (Jing 2020).

The flange moves along a line without rotation. Profiles with two faces that meet in a ridge show
the block, profiles with an arc the ball; all others are ignored.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Arc, Array, TimedPose
from handeye_ros.errors import DataError, FeatureError, UnusableMessageError
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.segment import noise_level, Segment, straight_segments
from handeye_ros.sampling.stream import interpolate
import numpy as np
from numpy.typing import NDArray

NAME = 'the sweep over ball and block'
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
STRAYS = 0.2  # share of the longest run: a shorter run is not of the block

SWEPT = ('ball', 'face_c', 'face_d')


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    Points of the profiles of the sweep, (n, 4) each: x, z in the sensor plane, q3, 1 sigma (m).

    face_c is the face at smaller x. q30: reading of P3 at which the flange frame is taken. stamps:
    of each point's profile, by the name of the part.
    """

    ball: Array
    face_c: Array
    face_d: Array
    q30: float
    stamps: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def sweep_from(profiles: Sequence[AnyProfile], poses: Sequence[TimedPose], config: Config,
               q3_first: float, q30: float | None = None) -> Sweep:
    """
    Return the points of a sweep.

    profiles, poses: in the order of their stamps; q3_first: reading of P3 at the first pose (m);
    q30: reading at which the flange frame is taken (m), by default the middle. config:
    noise.sensor, target.radius of the ball (0: unknown), sampling.min_points. Raises
    DataError.
    """
    first, last = poses[0].stamp, poses[-1].stamp
    inside = [p for p in profiles if first <= p.stamp <= last]
    if not inside:
        raise DataError(
            f'{NAME} cannot be solved: no profile lies within the time of the poses; record both '
            'together')
    ways = q3_first + _ways(interpolate(poses, [first, *(p.stamp for p in inside)]))
    found = _found(inside, ways, config)
    parts = {name: np.concatenate([rows for _, rows in found[name]]) for name in SWEPT}
    stamps = {name: np.concatenate([np.full(len(rows), stamp) for stamp, rows in found[name]])
              for name in SWEPT}
    middle = float(ways.min() + ways.max()) / 2
    return Sweep(**parts, q30=middle if q30 is None else q30, stamps=stamps)


def _found(profiles: Sequence[AnyProfile], ways: Array, config: Config
           ) -> dict[str, list[tuple[int, Array]]]:
    """Return stamp and rows (k, 4) of each profile, by the part of the sweep."""
    runs: list[list[tuple[int, list[Array]]]] = [[]]  # of profiles that show two faces
    arcs: list[tuple[int, float, Arc]] = []
    missed = 0
    for profile, q3 in zip(profiles, ways, strict=True):
        try:
            points = profile.read().points
        except UnusableMessageError:
            continue
        if two := ridge(points, config):
            runs += [[]] if missed > MISSED else []
            runs[-1].append((profile.stamp,
                             [_at(q3, *_face_points(face, points)) for face in two]))
            missed = 0
            continue
        missed += 1
        if arc := _arc(points, config):
            arcs.append((profile.stamp, float(q3), arc))
    # the rim of the ball shows so little that two lines may fit it as well
    longest = max(map(len, runs))
    faces = [face for run in runs if len(run) > STRAYS * longest for face in run]
    found = {'ball': _ball(arcs, config.target.radius), **{
        name: [(stamp, rows[k]) for stamp, rows in faces] for k, name in enumerate(SWEPT[1:])}}
    for what, name in (('ball', 'ball'), ('block', 'face_c')):
        if len(found[name]) < FEWEST_PROFILES:
            raise DataError(
                f'{NAME} cannot be solved: {len(found[name])} profiles show the {what}; sweep '
                f'over it slowly, at least {FEWEST_PROFILES} profiles')
    return found


def _ways(T: Array) -> Array:
    """Return the travel (n - 1,) along the flange's z from the first of poses (n, 4, 4), m."""
    turn = float(np.max(se3.angle(T[:, :3, :3] @ T[0, :3, :3].T)))
    if turn > LARGEST_TURN:
        raise DataError(
            f'{NAME} cannot be solved: the flange turns by {np.degrees(turn):.2f} degrees; move '
            'P3 alone')
    moved = (T[:, :3, 3] - T[0, :3, 3]) @ T[0, :3, :3]
    aside = float(np.sqrt((moved[:, :2] ** 2).sum(axis=1).mean()))
    if np.ptp(moved[:, 2]) < SMALLEST_WAY or aside > LARGEST_ASIDE:
        raise DataError(
            f'{NAME} cannot be solved: the flange moves {np.ptp(moved[:, 2]) * 1e3:.1f} mm along '
            f'its z, and {aside * 1e3:.2f} mm aside; move P3 alone, over ball and block; the '
            'flange frame has z along P3')
    return np.asarray(moved[1:, 2])


def ridge(points: Array, config: Config) -> tuple[Segment, Segment] | None:
    """Return the two faces of a block in a profile (n, 2), the one at smaller x first, or None."""
    segments = straight_segments(points, config.noise.sensor, config.sampling.min_points)
    if len(segments) < 2:
        return None
    two = sorted(segments, key=lambda s: -len(s.rows))[:2]
    left, right = sorted(two, key=lambda s: float(points[s.rows, 0].mean()))
    seen = np.isfinite(points).all(axis=1)
    noise = max(noise_level(points[seen, 1], config.noise.sensor), config.noise.sensor)
    bend = (np.arctan(left.slope) - np.arctan(right.slope)) * config.profile.range_sign
    x = (right.offset - left.offset) / (left.slope - right.slope) if bend else np.inf
    between = points[left.rows, 0].mean() < x < points[right.rows, 0].mean()
    enough = len(left.rows) + len(right.rows) >= SHARE * seen.sum()
    straight = max(left.noise, right.noise) < STRAIGHT * noise
    # nearer to the sensor in the middle, so the range falls towards it from both sides
    return (left, right) if (
        -bend > RIDGE_ANGLE and between and enough and straight) else None


def _face_points(segment: Segment, points: Array) -> tuple[Array, Array]:
    """Return mean points (k, 2) of a face, and their sigma (k,)."""
    margin = int(END * len(segment.rows))
    inner = points[segment.rows[margin:len(segment.rows) - margin]]
    order = np.argsort(inner[:, 0])
    bins = np.array_split(inner[order], min(BINS, len(inner)))
    count = np.array([len(points) for points in bins])
    std = segment.noise / np.hypot(1.0, segment.slope)
    return np.array([points.mean(axis=0) for points in bins]), std / np.sqrt(count)


def _arc(points: Array, config: Config) -> Arc | None:
    """Return the arc of the ball in a profile (n, 2), or None."""
    target = replace(config.target, type='sphere')
    try:
        (arc,) = arc_features(points, replace(config, target=target))
    except FeatureError:
        return None
    enough = len(arc.raw) >= SHARE * np.isfinite(points).all(axis=1).sum()
    return arc if enough else None


def _ball(arcs: Sequence[tuple[int, float, Arc]], radius: float) -> list[tuple[int, Array]]:
    """Return stamp and rows (k, 4) of each arc, without points at grazing incidence."""
    radius = radius or max((arc.radius for *_, arc in arcs), default=0.0)
    found = []
    for stamp, q3, arc in arcs:
        steep = np.abs(arc.points[:, 1] - arc.centre[1]) > STEEP * radius
        if steep.any():
            found.append((stamp, _at(q3, arc.points[steep], arc.std[steep])))
    return found


def _at(q3: float, points: Array, std: Array) -> Array:
    """Return rows (k, 4): x, z, q3, 1 sigma (m)."""
    return np.column_stack([points, np.full(len(points), q3), std])
