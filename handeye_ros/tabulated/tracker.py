# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reflector points of a laser tracker in a file, with the bag of the sweep (Jing 2020)."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import BadValueError, DataError, InputError
from handeye_ros.frames import sensor_axes
from handeye_ros.published import jing2020
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import FIELD, field_points
from handeye_ros.tables import LENGTH, Table, TableError
from handeye_ros.tabulated.method import Answer, FileMethod, Index, Input, ReadBag
from handeye_ros.tabulated.sweeps import Sweep, sweep_from, SWEPT
import numpy as np
from numpy.typing import NDArray

NAME = 'the chain through the laser tracker'
FEWEST = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}
# of the parts: the name in words, and the unknowns that a fit to its points has
PARTS = {'arc': ('the arc', 6), 'line': ('the line', 4), 'face_c': ('face_c', 3),
         'face_d': ('face_d', 3), 'swept_ball': ('the swept ball', 6),
         'swept_face_c': ('the swept face at smaller x', 3),
         'swept_face_d': ('the swept face at larger x', 3)}
SMALLEST_ANGLE = 0.17  # smallest angle between the faces, and of the arc (rad)
ORDERED = 20  # points of arc and line whose order is checked
ONE_WAY = 0.75  # smallest share of steps in one direction; about half for unordered points
LARGEST_TURN = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
LARGEST_STD = (5e-3, 1e-2)  # of an answer (m, rad)
WRONG = 6.0  # sigmas of a point that is left out,
BESIDE = 4.0  # if it is also as many times the median distance of its part
LARGEST_RMS = 3.0  # sigmas
LARGEST_DROPPED_SHARE = 0.34
DRAWS, SEED = 100, 0  # of the noise, for the covariance

Masks = Mapping[str, NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class Session:
    """
    The measurements of both instruments.

    points: of each part, (n, 3) in the tracker's frame, or (n, 4) as in Sweep; of: for each of
    them the index of its sample; samples: row of the file or stamp of the profile, and its kind;
    ball: (3,) its centre by the tracker; h0, h1: as in jing2020.Tracker; q30: as in Sweep.
    """

    points: Mapping[str, Array]
    of: Mapping[str, Index]
    samples: tuple[tuple[int, str], ...]
    ball: Array
    h0: float
    h1: float
    q30: float

    def reflector(self) -> jing2020.Tracker:
        """Return the points of the tracker."""
        arc, line, face_c, face_d = (self.points[part] for part in list(PARTS)[:4])
        return jing2020.Tracker(arc, line, self.ball, face_c, face_d, self.h0, self.h1)

    def chain(self, config: Config) -> jing2020.Result:
        """Return the published answer; raises DataError."""
        ball, face_c, face_d = (self.points[part][:, :3] for part in list(PARTS)[4:])
        return jing2020.solve(self.reflector(), jing2020.Sweep(ball, face_c, face_d, self.q30),
                              direction(config))

    def distances(self, X: Array, fitted: Session) -> dict[str, Array]:
        """Return the distance (n,) of all points from what those of `fitted` show with X."""
        off, known = {}, fitted.points
        centre, axis = jing2020.fit_arc(known['arc'])
        radius = np.linalg.norm(np.cross(known['arc'] - centre, axis), axis=1).mean()
        from_centre = self.points['arc'] - centre
        off['arc'] = np.hypot(from_centre @ axis, np.linalg.norm(
            np.cross(from_centre, axis), axis=1) - radius)
        along = jing2020.fit_line(known['line'])
        off['line'] = np.linalg.norm(np.cross(
            self.points['line'] - known['line'].mean(axis=0), along), axis=1)
        sweep = X[2, :3]
        ball, own = (jing2020.swept(session.points['swept_ball'][:, :3], self.q30, sweep)
                     for session in (fitted, self))
        sphere = np.linalg.lstsq(np.column_stack([2.0 * ball, np.ones(len(ball))]),
                                 (ball ** 2).sum(axis=1), rcond=None)[0]
        off['swept_ball'] = np.abs(np.linalg.norm(own - sphere[:3], axis=1)
                                   - math.sqrt(max(sphere[3] + sphere[:3] @ sphere[:3], 0.0)))
        T_sensor_tracker = se3.inverse(jing2020.link_frame(fitted.reflector(), self.q30) @ X)
        for face in ('face_c', 'face_d'):
            plane, own = (jing2020.swept(session.points[f'swept_{face}'][:, :3], self.q30, sweep)
                          for session in (fitted, self))
            normal, middle = jing2020.fit_plane(plane), plane.mean(axis=0)
            off[f'swept_{face}'] = np.abs((own - middle) @ normal)
            spots = se3.apply(T_sensor_tracker, self.points[face])
            off[face] = np.abs((spots - middle) @ normal)
        return {part: off[part] for part in PARTS}

    def noise(self, config: Config) -> dict[str, Array]:
        """Return 1 sigma (n,) of the distances, as stated."""
        tracker, both = config.tracker.noise, math.hypot(config.tracker.noise, config.noise.sensor)
        return {part: np.asarray(points[:, 3]) if part.startswith('swept') else np.full(
            len(points), both if 'face' in part else tracker)
            for part, points in self.points.items()}

    def select(self, masks: Masks) -> Session:
        """Return the points where masks are true; the samples stay."""
        return replace(self, points={part: points[masks[part]]
                                     for part, points in self.points.items()},
                       of={part: of[masks[part]] for part, of in self.of.items()})

    def subset(self, samples: Index) -> Session:
        """Return some samples (ascending indices)."""
        part = self.select({name: np.isin(of, samples) for name, of in self.of.items()})
        return replace(part, of={name: np.searchsorted(samples, of)
                                 for name, of in part.of.items()},
                       samples=tuple(self.samples[i] for i in samples))


def direction(config: Config) -> Array:
    """Return the direction of the sweep as a unit vector (3,): x along the line, z the range."""
    given = np.array(config.tracker.direction)
    if not given.any():
        raise BadValueError('tracker.direction', list(given), 'a direction that is not zero')
    return np.asarray(sensor_axes(config)[:3, :3].T @ given / np.linalg.norm(given))


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Session]:
    direction(config)
    file = (path if path.is_dir() else path.parent) / config.tracker.file
    recording = read_bag(path, config)
    if not file.is_file():
        raise TableError(file, 'no such file: put the reflector points beside the bag, or set '
                         'tracker.file')
    known = config.tracker
    missing = [f'tracker.{name}' for name in ('h0', 'h1', 'first_reading')
               if math.isnan(getattr(known, name))]
    if missing:
        raise InputError(f'{" and ".join(missing)} must be set: the answer changes by their full '
                         'size, so they have no default; see config/tracker.yaml')
    reflector = read_table(file)
    sweep = sweep_from(recording.profiles, recording.poses, config, known.first_reading)
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


def session_of(reflector: list[tuple[str, Array]], sweep: Sweep, config: Config) -> Session:
    """Return the session with numbered samples: first the rows of the file, then profiles."""
    rows = [(row, kind, point) for row, (kind, point) in enumerate(reflector, 1) if kind != 'ball']
    points, of = {}, {}
    for part in list(PARTS)[:4]:
        mine = [i for i, (_, kind, _) in enumerate(rows) if kind == part]
        points[part], of[part] = np.array([rows[i][2] for i in mine]), np.array(mine)
    stamps = np.unique(np.concatenate([sweep.stamps[part] for part in SWEPT]))
    for part in SWEPT:
        points[f'swept_{part}'] = getattr(sweep, part)
        of[f'swept_{part}'] = len(rows) + np.searchsorted(stamps, sweep.stamps[part])
    of_ball = np.isin(stamps, sweep.stamps['ball'])
    profiles = [(int(stamp), 'swept ball' if ball else 'swept faces')
                for stamp, ball in zip(stamps, of_ball, strict=True)]
    ball = np.mean([point for kind, point in reflector if kind == 'ball'], axis=0)
    return Session(points, of, (*((row, kind) for row, kind, _ in rows), *profiles), ball,
                   config.tracker.h0, config.tracker.h1, sweep.q30)


def _solve(data: Session, config: Config) -> Answer[Session]:
    """Return the published answer, with a covariance by draws of the noise."""
    _require_order(data.reflector())
    chain = data.chain(config)
    _require_angles(data.reflector(), chain.angles)
    _require_one_direction(chain)
    sigma, agreed = data.noise(config), data
    for _ in range(3):  # wrong points bend the first fit
        off = data.distances(chain.T_flange_sensor, agreed)
        good = {part: off[part] < np.maximum(WRONG * sigma[part], BESIDE * np.median(off[part]))
                for part in PARTS}
        _require_enough(good)
        agreed = data.select(good)
        chain = agreed.chain(config)
    off = data.distances(chain.T_flange_sensor, agreed)
    excess = {part: _rms(off[part][good[part]] / sigma[part][good[part]]) for part in PARTS}
    worst = max(PARTS, key=lambda part: excess[part])
    if excess[worst] > LARGEST_RMS:
        raise DataError(
            f'{NAME} cannot be solved: the points contradict each other: those of '
            f'{PARTS[worst][0]} by {excess[worst]:.1f} times their noise; check which face is '
            'which, h0 and h1, the readings of P3, and the noise of both instruments')
    covariance = _covariance(agreed, config, excess)
    _require_certain(covariance)
    count = len(data.samples)
    of, distances, believed = (np.concatenate([each[part] for part in PARTS])
                               for each in (data.of, off, good))
    total = np.bincount(of, minlength=count)
    used = 2 * np.bincount(of[believed], minlength=count) >= total
    # generalised cross-validation: each point predicted by a fit without it
    left_out = np.concatenate([off[part][good[part]] / (1 - min(
        PARTS[part][1] / (2 * good[part].sum()), 0.5)) for part in PARTS])
    squares = np.bincount(of, distances ** 2, minlength=count)
    return Answer(chain.T_flange_sensor, covariance, used,
                  np.sqrt(squares / np.maximum(total, 1)), _rms(distances[believed]),
                  _rms(left_out), agreed.subset(np.flatnonzero(used)),
                  {'radius': chain.radius, 'face_angle': float(chain.angles[0])})


def _rms(values: Array) -> float:
    return float(np.sqrt((values ** 2).mean()))


def _covariance(data: Session, config: Config, excess: Mapping[str, float]) -> Array:
    """Return the covariance (6, 6) of the chain; excess: residuals over noise, of each part."""
    rng, X = np.random.default_rng(SEED), data.chain(config).T_flange_sensor
    differences = []
    for _ in range(DRAWS):
        points = {}
        for part, values in data.points.items():
            size = max(excess[part], 1.0) if part != 'face_c' and part != 'face_d' else 1.0
            own = values[:, 3:] if part.startswith('swept') else config.tracker.noise
            noise = rng.normal(size=values.shape) * own * size
            if part.startswith('swept'):
                noise[:, 2:] = 0.0  # the reading of P3, and the sigma
            points[part] = values + noise
        ball = data.ball + rng.normal(size=3) * config.tracker.noise
        drawn = replace(data, points=points, ball=ball).chain(config)
        differences.append(se3.difference(drawn.T_flange_sensor, X))
    return np.asarray(np.einsum('ni,nj->ij', differences, differences) / DRAWS)


def _require_order(tracker: jing2020.Tracker) -> None:
    """Raise for an arc or a line whose points are not in measured order."""
    arc, line = (points[np.linspace(0, len(points) - 1, min(len(points), ORDERED)).astype(int)]
                 for points in (tracker.arc, tracker.line))
    centre, axis = jing2020.fit_arc(tracker.arc)
    turns = np.cross(arc[:-1] - centre, arc[1:] - centre) @ axis
    for what, steps in (('arc', turns), ('line', np.diff(line @ jing2020.fit_line(line)))):
        if max((steps > 0).mean(), (steps < 0).mean()) < ONE_WAY:
            raise DataError(
                f'{NAME} cannot be solved: the points of the {what} go back and forth; list them '
                'in the order measured')


def _require_angles(tracker: jing2020.Tracker, faces: Array) -> None:
    """Raise for an arc that is too short, and for faces that are nearly parallel."""
    centre, _ = jing2020.fit_arc(tracker.arc)
    first, last = tracker.arc[0] - centre, tracker.arc[-1] - centre
    turn = np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)
    if turn < SMALLEST_ANGLE:
        raise DataError(
            f'{NAME} cannot be solved: the arc spans {np.degrees(turn):.1f} degrees; turn R2 by '
            '30 degrees or more')
    if min(*faces, *(np.pi - faces)) < SMALLEST_ANGLE:
        raise DataError(
            f'{NAME} cannot be solved: the two faces of the block are nearly parallel; use faces '
            'at 45 degrees or more')


def _require_one_direction(chain: jing2020.Result) -> None:
    """Raise for a sweep whose direction by the ball differs from that of the link."""
    cosine = float(chain.direction @ chain.T_flange_sensor[2, :3])
    if cosine < np.cos(LARGEST_TURN):
        raise DataError(
            f'{NAME} cannot be solved: the sweep runs '
            f'{np.degrees(np.arccos(max(cosine, -1.0))):.0f} degrees beside the line of the '
            'reflector; check which face is which, tracker.direction, and that the line was '
            'measured towards larger readings of P3')


def _require_enough(good: Masks) -> None:
    for part, mask in good.items():
        if mask.mean() < 1 - LARGEST_DROPPED_SHARE or mask.sum() < FEWEST.get(part, 6):
            raise DataError(
                f'{NAME} cannot be solved: the points contradict each other: '
                f'{100 * (1 - mask.mean()):.0f} % of those of {PARTS[part][0]} left out; check '
                'which face is which, h0 and h1, and the readings of P3')


def _require_certain(covariance: Array) -> None:
    worst = [float(np.sqrt(np.linalg.eigvalsh(part)[-1]))
             for part in (covariance[:3, :3], covariance[3:, 3:])]
    if worst[0] > LARGEST_STD[0] or worst[1] > LARGEST_STD[1]:
        raise DataError(
            f'{NAME} cannot be solved: the answer is uncertain by {worst[0] * 1e3:.3g} mm and '
            f'{np.degrees(worst[1]):.3g} degrees (1 sigma); check which face is which; measure a '
            'longer arc and line, sweep over more of ball and faces')


def _residuals(data: Session, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    off = data.distances(X, data.subset(fitted))
    return np.concatenate([off[part][np.isin(data.of[part], measured)] for part in PARTS])


TRACKER = FileMethod(
    'tracker', ('eye_in_hand',),
    'measure a longer arc and line, sweep over more of ball and faces',
    _read, _solve, lambda data: data.samples, Session.subset, _residuals,
    lambda data: field_points(), FIELD, profiles=True)
