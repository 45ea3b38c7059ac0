# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reflector points of a laser tracker in a file, with the bag of the sweep (Jing 2020)."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.bags.bag import read as read_bag
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import BadValueError, DataError, InputError
from handeye_ros.frames import sensor_axes
from handeye_ros.published import jing2020
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import FIELD, field_points
from handeye_ros.tables import LENGTH, Table, TableError
from handeye_ros.tabulated.method import (
    FileMethod,
    Index,
    Input,
    LARGEST_DROPPED_SHARE,
    rms,
    TableAnswer,
    Values,
)
from handeye_ros.tabulated.sweeps import Sweep, sweep_from, SWEPT
import numpy as np
from numpy.typing import NDArray

FEWEST = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}  # points in the file
# unknowns that a fit to the points of a part has
UNKNOWNS = {'arc': 6, 'line': 4, 'face_c': 3, 'face_d': 3,
            'swept_ball': 6, 'swept_face_c': 3, 'swept_face_d': 3}
SMALLEST_ANGLE = 0.17  # smallest angle between the faces, and of the arc (rad)
ORDERED = 20  # points of arc and line whose order is checked
ONE_WAY = 0.75  # smallest share of steps in one direction; about half for unordered points
LARGEST_TURN = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
WRONG = 6.0  # sigmas of a point that is left out,
BESIDE = 4.0  # if it is also as many times the median distance of its part
LARGEST_RMS = 3.0  # sigmas of the points that remain
DRAWS, SEED = 100, 0  # of the noise, for the covariance


@dataclass(frozen=True, eq=False)
class TrackerSession(Values):
    """
    The points of both instruments.

    part: (n,) a key of UNKNOWNS; points: (n, 3), of the reflector in the tracker's frame, swept
    ones as in Sweep; sigma: (n,) of each coordinate (m); sample: (n,) the index in samples, which
    are the row or the stamp of each, and its kind. ball: (3,) its centre by the tracker;
    sweeping: (3,) the sweep's rough direction, x along the line, z the range; h0, h1: as in
    jing2020.Tracker; q30: as in Sweep.
    """

    part: NDArray[np.str_]
    points: Array
    sigma: Array
    sample: Index
    kinds: tuple[tuple[int, str], ...]
    ball: Array
    sweeping: Array
    h0: float
    h1: float
    q30: float

    @property
    def samples(self) -> tuple[tuple[int, str], ...]:
        return self.kinds

    def of(self, part: str) -> Array:
        """Return the points (k, 3) of a part."""
        return np.asarray(self.points[self.part == part])

    def by_part(self, values: Array, statistic: Callable[[Array], Any]) -> Array:
        """Return for each point (n,) the statistic of the values (n,) of its part."""
        names, index = np.unique(self.part, return_inverse=True)
        return np.array([statistic(values[index == k]) for k in range(len(names))])[index]

    def select(self, mask: NDArray[np.bool_]) -> TrackerSession:
        """Return the points where the mask (n,) is true; the samples stay."""
        return replace(self, part=self.part[mask], points=self.points[mask],
                       sigma=self.sigma[mask], sample=self.sample[mask])

    def subset(self, samples: Index) -> TrackerSession:
        some = self.select(np.isin(self.sample, samples))
        return replace(some, sample=np.searchsorted(samples, some.sample),
                       kinds=tuple(self.kinds[i] for i in samples))

    def reflector(self) -> jing2020.Tracker:
        """Return the points of the tracker."""
        return jing2020.Tracker(self.of('arc'), self.of('line'), self.ball, self.of('face_c'),
                                self.of('face_d'), self.h0, self.h1)

    def chain(self) -> jing2020.Result:
        """Return the published answer; raises DataError."""
        ball, face_c, face_d = map(self.of, SWEPT)
        sweep = jing2020.Sweep(ball, face_c, face_d, self.q30)
        return jing2020.solve(self.reflector(), sweep, self.sweeping)

    def require_determined(self, config: Config) -> None:
        """Raise for an arc or a line that is not in measured order, and for a short arc."""
        arc, line = (points[np.linspace(0, len(points) - 1, min(len(points), ORDERED)).astype(int)]
                     for points in (self.of('arc'), self.of('line')))
        centre, axis = jing2020.fit_arc(self.of('arc'))
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

    def solve(self, config: Config) -> TableAnswer:
        """Return the published answer without wrong points, its covariance by draws of noise."""
        # the distance of a reflector from a swept face has the noise of both instruments
        by_both = np.isin(self.part, ('face_c', 'face_d'))
        sigma = np.hypot(self.sigma, by_both * config.noise.sensor)
        chain, agreed = self.chain(), self
        _require_directions(chain)
        for _ in range(3):  # wrong points bend the first fit
            off = self.distances(chain.T_flange_sensor, agreed)
            good = off < np.maximum(WRONG * sigma, BESIDE * self.by_part(off, np.median))
            self._require_agreement(self.by_part(~good, np.mean) / LARGEST_DROPPED_SHARE)
            agreed = self.select(good)
            chain = agreed.chain()
        X, off = chain.T_flange_sensor, self.distances(chain.T_flange_sensor, agreed)
        excess = agreed.by_part(off[good] / sigma[good], rms)
        agreed._require_agreement(excess / LARGEST_RMS)
        # generalised cross-validation: each point predicted by a fit without it
        share = agreed.by_part(np.ones(len(agreed.part)), lambda ones: 1 / len(ones))
        unknowns = np.array([UNKNOWNS[part] for part in agreed.part])
        left_out = off[good] / (1 - np.minimum(unknowns * share / 2, 0.5))
        count = len(self.kinds)
        total, believed = (np.bincount(of, minlength=count)
                           for of in (self.sample, self.sample[good]))
        used = 2 * believed >= total
        squares = np.bincount(self.sample, off ** 2, minlength=count)
        return TableAnswer(X, agreed.covariance(X, excess, config.tracker.noise), used,
                      np.sqrt(squares / np.maximum(total, 1)), rms(off[good]), rms(left_out),
                      agreed.subset(np.flatnonzero(used)),
                      target={'radius': chain.radius, 'face_angle': float(chain.angles[0])})

    def _require_agreement(self, excess: Array) -> None:
        """Raise where the excess (n,) of any point over its limit is more than 1."""
        if excess.max() > 1:
            raise DataError(
                f'the points contradict each other, most of all those of '
                f'{self.part[excess.argmax()]}: check which face is which, h0 and h1, the '
                'readings of P3, and the noise of both instruments', reason='misfit')

    def covariance(self, X: Array, excess: Array, of_ball: float) -> Array:
        """
        Return the covariance (6, 6) of the chain around X.

        excess: (n,) the residuals over their noise; of_ball: 1 sigma of its centre (m).
        """
        rng = np.random.default_rng(SEED)
        sigma = np.repeat((self.sigma * np.maximum(excess, 1.0))[:, None], 3, axis=1)
        sigma[np.isin(self.part, SWEPT), 2] = 0.0  # the reading of P3
        drawn = [replace(self, points=self.points + sigma * rng.normal(size=sigma.shape),
                         ball=self.ball + of_ball * rng.normal(size=3)) for _ in range(DRAWS)]
        off = np.array([se3.difference(one.chain().T_flange_sensor, X) for one in drawn])
        return np.asarray(off.T @ off / DRAWS)

    def distances(self, X: Array, fitted: TrackerSession) -> Array:
        """Return the distances (n,) of the points from what those of `fitted` show with X."""
        arc, line = fitted.of('arc'), fitted.of('line')
        centre, axis = jing2020.fit_arc(arc)
        radius = np.linalg.norm(np.cross(arc - centre, axis), axis=1).mean()
        spokes = self.of('arc') - centre
        aside = np.linalg.norm(np.cross(spokes, axis), axis=1) - radius
        from_line = np.cross(self.of('line') - line.mean(axis=0), jing2020.fit_line(line))
        ball, own = fitted.of('swept_ball'), self.of('swept_ball')
        direction, middle, radius = jing2020.fit_swept_ball(ball, self.q30, X[2, :3])
        from_middle = jing2020.swept(own, self.q30, direction) - middle
        off = {'arc': np.hypot(spokes @ axis, aside), 'line': np.linalg.norm(from_line, axis=1),
               'swept_ball': np.abs(np.linalg.norm(from_middle, axis=1) - radius)}
        T_sensor_tracker = se3.inverse(jing2020.link_frame(fitted.reflector(), self.q30) @ X)
        for face in ('face_c', 'face_d'):
            plane, own = (jing2020.swept(session.of(f'swept_{face}'), self.q30, X[2, :3])
                          for session in (fitted, self))
            normal, middle = jing2020.fit_plane(plane), plane.mean(axis=0)
            off[f'swept_{face}'] = np.abs((own - middle) @ normal)
            spots = se3.apply(T_sensor_tracker, self.of(face))
            off[face] = np.abs((spots - middle) @ normal)
        distances = np.zeros(len(self.part))
        for part, values in off.items():
            distances[self.part == part] = values
        return distances

    def residuals(self, X: Array, fitted: Index, measured: Index) -> Array:
        return self.distances(X, self.subset(fitted))[np.isin(self.sample, measured)]

    def field(self) -> Array:
        return field_points()


def _require_directions(chain: jing2020.Result) -> None:
    """Raise for nearly parallel faces, and for a sweep that is not along the line."""
    if min(*chain.angles, *(np.pi - chain.angles)) < SMALLEST_ANGLE:
        raise DataError('the two faces of the block are nearly parallel; use faces at 45 degrees '
                        'or more')
    turn = math.acos(min(1.0, float(chain.direction @ chain.T_flange_sensor[2, :3])))
    if turn > LARGEST_TURN:
        raise DataError(
            f'the sweep runs {math.degrees(turn):.0f} degrees beside the line of the reflector; '
            'check which face is which, tracker.direction, and that the line was measured '
            'towards larger readings of P3')


def _read(path: Path, config: Config) -> Input:
    direction, known = np.array(config.tracker.direction), config.tracker
    if not direction.any():
        raise BadValueError('tracker.direction', direction.tolist(), 'a direction that is not '
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
    reflector = read_table(file)
    sweep = sweep_from(recording.profiles, recording.poses, config)
    return Input(session_of(reflector, sweep, config), recording.profiles[0].frame_id or 'laser',
                 (*recording.inputs, input_values(file)), recording.warnings)


def read_table(path: Path) -> list[tuple[str, Array]]:
    """
    Return the kind and the position (3,) of the reflector, row by row (metres).

    Columns kind (arc, line, ball, face_c or face_d) and x, y, z with their unit, as in `x [mm]`,
    in the order measured. Raises TableError.
    """
    table = Table(path)
    kinds, points = table.text('kind'), table.values('xyz', LENGTH)
    for row, kind in enumerate(kinds, 1):
        if kind not in FEWEST:
            raise TableError(path, f'row {row}: kind is "{kind}", expected {", ".join(FEWEST)}')
    for kind, fewest in FEWEST.items():
        if kinds.count(kind) < fewest:
            raise TableError(path, f'holds {kinds.count(kind)} points of the kind {kind}; at '
                             f'least {fewest} are needed')
    return list(zip(kinds, points, strict=True))


def session_of(reflector: Sequence[tuple[str, Array]], sweep: Sweep, config: Config
               ) -> TrackerSession:
    """Return the session; its samples are the rows of the file, then the profiles."""
    rows = [(row, kind, point) for row, (kind, point) in enumerate(reflector, 1) if kind != 'ball']
    ball = np.mean([point for kind, point in reflector if kind == 'ball'], axis=0)
    stamps, profile = np.unique(sweep.stamps, return_inverse=True)
    of_ball = np.isin(stamps, sweep.stamps[sweep.part == 0])
    kinds = [(row, kind) for row, kind, _ in rows] + [
        (int(stamp), 'swept ball' if ball else 'swept faces')
        for stamp, ball in zip(stamps, of_ball, strict=True)]
    known = config.tracker
    toward = sensor_axes(config)[:3, :3].T @ np.array(known.direction)
    return TrackerSession(
        np.concatenate([[kind for _, kind, _ in rows], np.array(SWEPT)[sweep.part]]),
        np.concatenate([[point for *_, point in rows], sweep.points]),
        np.concatenate([np.full(len(rows), known.noise), sweep.sigma]),
        np.concatenate([np.arange(len(rows)), len(rows) + profile]), tuple(kinds), ball,
        toward / np.linalg.norm(toward), known.h0, known.h1, sweep.q30)


TRACKER = FileMethod(
    'tracker', ('eye_in_hand',),
    'measure a longer arc and line, sweep over more of ball and faces',
    'which face is which, h0 and h1, and the readings of P3?', FIELD, _read, profiles=True)
