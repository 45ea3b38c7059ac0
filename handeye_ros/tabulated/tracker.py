# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reflector points of a laser tracker in a file, with the bag of the sweep (Jing 2020)."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.bags.bag import read as read_bag
from handeye_ros.checks.refusals import LARGEST_DROPPED_SHARE
from handeye_ros.config import Config
from handeye_ros.data import Array, rms
from handeye_ros.errors import BadValueError, DataError, InputError
from handeye_ros.frames import sensor_axes
from handeye_ros.published import jing2020
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import field_points, FIELD_TEXT
from handeye_ros.tables import LENGTH, Table, TableError
from handeye_ros.tabulated.sweeps import Piece, sweep_from, SWEPT_PARTS
from handeye_ros.tabulated.values import Index, Input, TableAnswer, Values
import numpy as np

FEWEST_POINTS = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}  # points in the file
# unknowns that a fit to the points of a part has
UNKNOWNS = {'arc': 6, 'line': 4, 'face_c': 3, 'face_d': 3,
            'swept_ball': 6, 'swept_face_c': 3, 'swept_face_d': 3}
SMALLEST_ANGLE = 0.17  # smallest angle between the faces, and of the arc (rad)
ORDER_CHECK_POINTS = 20  # points of arc and line whose order is checked
ONE_WAY = 0.75  # smallest share of steps in one direction; about half for unordered points
LARGEST_TURN = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
OUTLIER_SIGMAS = 6.0  # sigmas of a point that is left out,
OUTLIER_RATIO = 4.0  # if it is also as many times the median distance of its part
LARGEST_RMS = 3.0  # sigmas of the points that remain
NOISE_DRAWS, SEED = 100, 0  # of the noise, for the covariance


@dataclass(frozen=True, eq=False)
class TrackerSession(Values):
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
        return sensor_axes(self.config)

    def subset(self, samples: Index) -> TrackerSession:
        return replace(self, pieces=[self.pieces[i] for i in samples])

    @cached_property
    def measured(self) -> jing2020.Readings:
        """Return the points of both instruments by part."""
        parts = {part: np.concatenate([p.points for p in self.pieces if p.part == part])
                 for part in UNKNOWNS}
        return jing2020.Readings(parts | {'ball': self.ball[None]},
                                 self.config.tracker.h0 + self.config.tracker.h1, self.q30)

    def by_part(self, values: Any, statistic: Callable[[Any], Any]) -> Array:
        """Return for each piece (n,) the statistic of the values (n,) of its part."""
        parts, index = np.unique([piece.part for piece in self.pieces], return_inverse=True)
        return np.array([statistic(values[index == k]) for k in range(len(parts))])[index]

    def chain(self) -> jing2020.Result:
        """Return the published answer, of the sensor plane; raises DataError."""
        direction = self.axes[:3, :3].T @ np.array(self.config.tracker.direction)
        return jing2020.solve(self.measured, direction / np.linalg.norm(direction))

    def require_determined(self) -> None:
        """Raise for points in the wrong order, a short arc, parallel faces, a crooked sweep."""
        parts = (self.measured.parts['arc'], self.measured.parts['line'])
        arc, line = (points[np.linspace(
            0, len(points) - 1, min(len(points), ORDER_CHECK_POINTS)).astype(int)]
                     for points in parts)
        centre, axis = jing2020.fit_arc(self.measured.parts['arc'])
        spokes = arc - centre
        turns = np.cross(spokes[:-1], spokes[1:]) @ axis
        for what, steps in (('arc', turns), ('line', np.diff(line @ jing2020.fit_line(line)))):
            if max((steps > 0).mean(), (steps < 0).mean()) < ONE_WAY:
                raise DataError(f'the points of the {what} go back and forth; list them in the '
                                'order measured')
        turn = np.arctan2(np.linalg.norm(np.cross(spokes[0], spokes[-1])), spokes[0] @ spokes[-1])
        if turn < SMALLEST_ANGLE:
            raise DataError(f'the arc spans {np.degrees(turn):.1f} degrees; turn R2 by 30 degrees '
                            'or more')
        chain = self.chain()
        if min(*chain.angles, *(np.pi - chain.angles)) < SMALLEST_ANGLE:
            raise DataError('the two faces of the block are nearly parallel; use faces at 45 '
                            'degrees or more')
        turn = math.acos(min(1.0, float(chain.direction @ chain.T_flange_sensor[2, :3])))
        if turn > LARGEST_TURN:
            raise DataError(
                f'the sweep runs {math.degrees(turn):.0f} degrees beside the line of the '
                'reflector; check which face is which, tracker.direction, and that the line was '
                'measured towards larger readings of P3')

    def solve(self) -> TableAnswer:
        """Return the published answer without wrong points, its covariance by draws of noise."""
        # the distance of a reflector from a swept face has the noise of both instruments
        sigma = np.array([np.hypot(rms(piece.sigma), piece.part.startswith('face')
                                   * self.config.noise.sensor) for piece in self.pieces])
        every = used = np.arange(len(self))
        for _ in range(3):  # wrong points bend the first fit
            off = self.residuals(self.subset(used).chain().T_flange_sensor, used, every)
            good = off < np.maximum(OUTLIER_SIGMAS * sigma,
                                    OUTLIER_RATIO * self.by_part(off, np.median))
            used = np.flatnonzero(good)
        agreed = self.subset(used)
        chain = agreed.chain()
        X, off = chain.T_flange_sensor, self.residuals(chain.T_flange_sensor, used, every)
        lost = self.by_part(~good, np.mean) / LARGEST_DROPPED_SHARE
        excess = self.by_part(np.where(good, off / sigma, np.nan),
                              lambda known: np.sqrt(np.nanmean(known ** 2)))
        worst = np.maximum(lost, excess / LARGEST_RMS)
        if worst.max() > 1:
            raise DataError(
                'the points contradict each other, most of all those of '
                f'{self.pieces[int(worst.argmax())].part}: check which face is which, h0 and h1, '
                'the readings of P3, and the noise of both instruments', reason='misfit')
        # generalised cross-validation: each point predicted by a fit without it
        share = np.array([UNKNOWNS[piece.part] / len(self.measured.parts[piece.part])
                          for piece in agreed.pieces])
        left_out = off[good] / (1 - np.minimum(share / 2, 0.5))
        return TableAnswer(
            X, agreed.covariance(X, excess[good]), good, off,
            rms(off[good]), rms(left_out),
            target={'radius': chain.radius, 'face_angle': float(chain.angles[0])})

    def covariance(self, X: Array, excess: Array) -> Array:
        """
        Return the covariance (6, 6) of the chain around X.

        excess: (n,) the residuals over their noise.
        """
        rng, of_ball = np.random.default_rng(SEED), self.config.tracker.noise
        # each coordinate of a point by the tracker, but not the reading of P3
        sigmas = [scale * piece.sigma[:, None] * [1, 1, piece.part not in SWEPT_PARTS]
                  for piece, scale in zip(self.pieces, np.maximum(excess, 1.0), strict=True)]
        off = []
        for _ in range(NOISE_DRAWS):
            pieces = [piece._replace(points=piece.points + sigma * rng.normal(size=sigma.shape))
                      for piece, sigma in zip(self.pieces, sigmas, strict=True)]
            session = replace(self, pieces=pieces, ball=self.ball + of_ball * rng.normal(size=3))
            off.append(se3.difference(session.chain().T_flange_sensor, X))
        return np.asarray(np.transpose(off) @ off / NOISE_DRAWS)

    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        """Return the RMS distances of measured pieces from what the fitted ones show with X."""
        known = self.subset(fitted).measured
        parts = known.parts
        line, along = parts['line'].mean(axis=0), jing2020.fit_line(parts['line'])
        pivot, axis = jing2020.fit_arc(parts['arc'])
        direction, centre, radius = jing2020.fit_swept_ball(
            parts['swept_ball'], self.q30, X[2, :3])
        T_sensor_tracker = se3.inverse(jing2020.link_frame(known) @ X)
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
                return beside(points, line, along)
            in_sensor = (jing2020.swept(points, self.q30, direction) if part in SWEPT_PARTS
                         else se3.apply(T_sensor_tracker, points))
            if part == 'swept_ball':
                return np.linalg.norm(in_sensor - centre, axis=1) - radius
            middle, normal = planes[part.removeprefix('swept_')]
            return (in_sensor - middle) @ normal

        pieces = self.subset(measured).pieces
        return np.array([rms(off(piece.part, piece.points)) for piece in pieces])

    def field(self) -> Array:
        return field_points()


def read(path: Path, config: Config) -> Input:
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
    return Input(TrackerSession(config, [*pieces, *swept], ball, q30),
                 recording.profiles[0].frame_id or 'laser',
                 (*recording.inputs, input_values(file)), warnings=tuple(recording.warnings))


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
