# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Reflector points of a laser tracker in a file, with the bag of the sweep (Jing 2020).

In the sweep over ball and block the flange moves along a line without rotation. Profiles with two
faces that meet in a ridge show the block, profiles with an arc the ball; all others are ignored.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
import math
from pathlib import Path
from typing import Any, NamedTuple

from handeye_ros import se3
from handeye_ros.bags.bag import read as read_bag
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, rms, TimedPose
from handeye_ros.errors import (
    BadValueError,
    DataError,
    degrees,
    FeatureError,
    InputError,
    mm,
    UnusableMessageError,
)
from handeye_ros.frames import T_sensor_plane
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.faces import corner_features
from handeye_ros.published import jing2020
from handeye_ros.results.calibration_file import field_points, FIELD_TEXT, input_values
from handeye_ros.sampling.stream import interpolate
from handeye_ros.tables import LENGTH, Table, TableError
from handeye_ros.tabulated.values import TableAnswer, TableProblem
import numpy as np

FEWEST_POINTS = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}  # points in the file
SWEPT_PARTS = ('swept_ball', 'swept_face_c', 'swept_face_d')
# unknowns that a fit to the points of a part has
UNKNOWNS = {'arc': 6, 'line': 4, 'face_c': 3, 'face_d': 3,
            'swept_ball': 6, 'swept_face_c': 3, 'swept_face_d': 3}
IN_ORDER = 0.9  # correlation of the places of arc and line with their order, at least
LARGEST_TURN = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
LARGEST_RMS, LARGEST_OF_ROW = 3.0, 10.0  # sigmas of the points of a part, of a row of the file
NOISE_DRAWS, SEED = 100, 0  # of the noise, for the covariance
# of the sweep
RIDGE_ANGLE = 0.35  # smallest angle between two faces that meet (rad)
LARGEST_SWEEP_TURN = 2e-3  # largest rotation of the flange during a sweep (rad)
LARGEST_ASIDE = 2e-4  # largest deviation of the flange from its line (m, RMS)
SMALLEST_WAY = 0.02  # m
FEWEST_PROFILES = 5
# consecutive profiles without two faces that do not end a run of block profiles
MOST_MISSED_PROFILES = 3


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


@dataclass(frozen=True, eq=False)
class TrackerSession(TableProblem):
    """
    The points of both instruments.

    pieces: of the arc, the line, the faces and the sweep
    ball: (3,) its centre by the tracker
    q30: the reading of P3 where the flange frame is taken (metres)
    """

    pieces: Sequence[Piece]
    ball: Array
    q30: float

    name = 'tracker'
    calibration_types = ('eye_in_hand',)
    advice = 'measure a longer arc and line, sweep over more of ball and faces'
    check = 'which face is which, h0 and h1, and the readings of P3?'
    over = FIELD_TEXT

    @property
    def samples(self) -> list[tuple[int, str]]:
        return [(piece.sample, piece.part) for piece in self.pieces]

    @property
    def axes(self) -> Array:
        """Return T_sensor_plane (4, 4)."""
        return T_sensor_plane(self.config)

    def field(self) -> Array:
        return field_points()

    @cached_property
    def measured(self) -> jing2020.Readings:
        """Return the points of both instruments by part."""
        parts = {part: np.concatenate([p.points for p in self.pieces if p.part == part])
                 for part in UNKNOWNS}
        return jing2020.Readings(parts | {'ball': self.ball[None]},
                                 self.config.tracker.h0 + self.config.tracker.h1, self.q30)

    def chain(self) -> jing2020.Result:
        """Return the published answer, of the sensor plane; raises DataError."""
        direction = self.axes[:3, :3].T @ np.array(self.config.tracker.direction)
        return jing2020.solve(self.measured, direction / np.linalg.norm(direction))

    def require_determined(self) -> None:
        """Raise DataError for points in the wrong order, and for a sweep beside the line."""
        arc, line = self.measured.parts['arc'], self.measured.parts['line']
        centre, axis = jing2020.fit_arc(arc)
        spokes = arc - centre
        middle = spokes.mean(axis=0)
        turns = np.arctan2(np.cross(middle, spokes) @ axis, spokes @ middle)
        for what, places in (('arc', turns), ('line', line @ jing2020.fit_line(line))):
            if abs(np.corrcoef(places, np.arange(len(places)))[0, 1]) < IN_ORDER:
                raise DataError(f'the points of the {what} go back and forth; list them in the '
                                'order measured')
        chain = self.chain()
        turn = math.acos(min(1.0, float(chain.direction @ chain.T_flange_sensor[2, :3])))
        if turn > LARGEST_TURN:
            raise DataError(
                f'the sweep runs {math.degrees(turn):.0f} degrees beside the line of the '
                'reflector; check which face is which, tracker.direction, and that the line was '
                'measured towards larger readings of P3')

    def solve(self) -> TableAnswer:
        """Return the published answer, its covariance by draws of noise; raises DataError."""
        chain = self.chain()
        X, off = chain.T_flange_sensor, self.residuals(chain)
        parts = np.array([piece.part for piece in self.pieces])
        is_swept = np.isin(parts, SWEPT_PARTS)
        # the distance of a reflector from a swept face has the noise of both instruments
        sigmas = off / np.array([np.hypot(rms(piece.sigma), piece.part.startswith('face')
                                          * self.config.noise.sensor) for piece in self.pieces])
        excess = {part: max(rms(sigmas[parts == part]), 1.0) for part in UNKNOWNS}
        limit = np.where(is_swept, np.inf, LARGEST_OF_ROW)  # a single profile matters little
        limit[[excess[part] > LARGEST_RMS for part in parts]] = LARGEST_RMS
        worst = int(np.argmax(sigmas / limit))
        if sigmas[worst] > limit[worst]:
            raise DataError(
                f'the points contradict each other, most of all {parts[worst]} of '
                f'{"the profile" if is_swept[worst] else "row"} {self.pieces[worst].sample}, by '
                f'{mm(float(off[worst]))}: measure again or leave that row out, and check which '
                'face is which and the noise of both instruments', reason='misfit')
        # generalised cross-validation: each point predicted by a fit without it
        share = np.array([UNKNOWNS[part] / len(self.measured.parts[part]) for part in parts])
        return TableAnswer(
            X, self.covariance(X, excess), np.ones(len(off), dtype=bool), off, rms(off),
            rms(off / (1 - np.minimum(share / 2, 0.5))),
            target={'radius': chain.radius, 'face_angle': float(chain.angles[0])})

    def covariance(self, X: Array, excess: Mapping[str, float]) -> Array:
        """
        Return the covariance (6, 6) of the chain around X.

        excess: the residuals of each part over their noise.
        """
        rng, of_ball = np.random.default_rng(SEED), self.config.tracker.noise
        off = []
        for _ in range(NOISE_DRAWS):
            # of each coordinate of a point by the tracker, but not of the reading of P3
            pieces = [piece._replace(points=piece.points + rng.normal(size=piece.points.shape) * (
                          excess[piece.part] * piece.sigma[:, None]
                          * [1, 1, piece.part not in SWEPT_PARTS])) for piece in self.pieces]
            session = replace(self, pieces=pieces, ball=self.ball + of_ball * rng.normal(size=3))
            off.append(se3.difference(session.chain().T_flange_sensor, X))
        return np.asarray(np.transpose(off) @ off / NOISE_DRAWS)

    def residuals(self, chain: jing2020.Result) -> Array:
        """Return the RMS distance (n,) of each piece from what all show by the chain (m)."""
        parts, direction = self.measured.parts, chain.direction
        _, centre, radius = jing2020.fit_swept_ball(parts['swept_ball'], self.q30, direction)
        pivot, axis = jing2020.fit_arc(parts['arc'])
        start, along = parts['line'].mean(axis=0), jing2020.fit_line(parts['line'])
        T_sensor_tracker = se3.inverse(jing2020.link_frame(self.measured) @ chain.T_flange_sensor)
        planes = {}
        for face in ('face_c', 'face_d'):
            points = jing2020.swept(parts[f'swept_{face}'], self.q30, direction)
            planes[face] = points.mean(axis=0), jing2020.fit_plane(points)

        def beside(points: Array, start: Array, along: Array) -> Array:
            return np.asarray(np.linalg.norm(np.cross(points - start, along), axis=1))

        reach = beside(parts['arc'], pivot, axis).mean()

        def off(part: str, points: Array) -> Any:
            if part == 'arc':
                return np.hypot((points - pivot) @ axis, beside(points, pivot, axis) - reach)
            if part == 'line':
                return beside(points, start, along)
            in_sensor = (jing2020.swept(points, self.q30, direction) if part in SWEPT_PARTS
                         else se3.apply(T_sensor_tracker, points))
            if part == 'swept_ball':
                return np.linalg.norm(in_sensor - centre, axis=1) - radius
            middle, normal = planes[part.removeprefix('swept_')]
            return (in_sensor - middle) @ normal

        return np.array([rms(off(piece.part, piece.points)) for piece in self.pieces])


def read(path: Path, config: Config) -> TrackerSession:
    """Read the reflector's points, and the bag of the sweep; raises InputError, DataError."""
    known = config.tracker
    if not any(known.direction):
        raise BadValueError('tracker.direction', list(known.direction), 'a direction that is not '
                            'zero')
    file = (path if path.is_dir() else path.parent) / known.file
    recording = read_bag(path, config)
    if not file.is_file():
        raise TableError(file, 'no such file: put the reflector points beside the bag, or set '
                         'tracker.file')
    missing = [f'tracker.{name}' for name in ('h0', 'h1', 'first_reading')
               if math.isnan(getattr(known, name))]
    if missing:
        raise InputError(f'{" and ".join(missing)} must be set: the answer changes by their full '
                         'size, so they have no default; see config/tracker.yaml')
    pieces, ball = read_table(file, known.noise)
    swept, q30 = sweep_from(recording.profiles, recording.poses, config)
    return TrackerSession(config, [*pieces, *swept], ball, q30,
                          frame=recording.profiles[0].frame_id or 'laser',
                          inputs=[*recording.inputs, input_values(file)],
                          warnings=recording.warnings)


def read_table(path: Path, noise: float) -> tuple[list[Piece], Array]:
    """
    Return the positions of the reflector, row by row, and the centre (3,) of the ball.

    Columns kind (arc, line, ball, face_c or face_d) and x, y, z with their unit, as in `x [mm]`,
    in the order measured; noise: 1 sigma (m). Raises TableError.
    """
    table = Table(path)
    kinds, points = table.text('kind'), table.values('xyz', LENGTH)
    for row, kind in enumerate(kinds, 1):
        if kind not in FEWEST_POINTS:
            raise TableError(
                path, f'row {row}: kind is "{kind}", expected {", ".join(FEWEST_POINTS)}')
    for kind, fewest in FEWEST_POINTS.items():
        if kinds.count(kind) < fewest:
            raise TableError(path, f'holds {kinds.count(kind)} points of the kind {kind}; at '
                             f'least {fewest} are needed')
    of_ball = np.array(kinds) == 'ball'
    return [Piece(row + 1, kinds[row], points[row:row + 1], np.array([noise]))
            for row in np.flatnonzero(~of_ball).tolist()], points[of_ball].mean(axis=0)


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
    ball, runs, latest = list[Piece](), [list[Piece]()], 0
    for index, (profile, reading) in enumerate(zip(inside, q3.tolist(), strict=True)):
        with suppress(UnusableMessageError, FeatureError):
            seen = [Piece(profile.stamp, part, np.insert(points, 2, reading, axis=1), sigma)
                    for part, points, sigma in _seen(profile.read().points, config)]
            if len(seen) == 1:
                ball += seen
                continue
            # the rim of the ball shows so little that two lines may fit it as well
            if index > latest + 1 + MOST_MISSED_PROFILES:
                runs.append([])
            runs[-1] += seen
            latest = index
    block = max(runs, key=len)
    for what, count in (('ball', len(ball)), ('block', len(block) // 2)):
        if count < FEWEST_PROFILES:
            raise DataError(f'{count} profiles show the {what}; sweep over it slowly, at least '
                            f'{FEWEST_PROFILES} profiles')
    return [*ball, *block], (q3.min() + q3.max()) / 2


def _ways(T: Array) -> Array:
    """Return the travel (n - 1,) along the flange's z from the first of poses (n, 4, 4), m."""
    turn = float(np.max(se3.angle(T[:, :3, :3] @ T[0, :3, :3].T)))
    if turn > LARGEST_SWEEP_TURN:
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
