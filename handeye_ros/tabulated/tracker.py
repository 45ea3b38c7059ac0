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
from typing import NamedTuple, Self

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.bags.recording import read_bag
from handeye_ros.config import Config
from handeye_ros.csv_tables import CsvTable, LENGTH, TableError
from handeye_ros.data import AnyProfile, Array, SEED, TimedPose
from handeye_ros.errors import (
    BadValueError,
    DataError,
    FeatureError,
    InputError,
    UnusableMessageError,
)
from handeye_ros.estimation.least_squares import rms_by
from handeye_ros.frames import T_sensor_plane
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.faces import face_pair_features
from handeye_ros.published import jing2020
from handeye_ros.results.file_values import input_provenance
from handeye_ros.sampling.interpolation import interpolate
from handeye_ros.tabulated.problem import TableAnswer, TableProblem
from handeye_ros.words import count_of, degrees, mm
import numpy as np

MIN_POINTS = {'arc': 6, 'line': 3, 'face_c': 3, 'face_d': 3, 'ball': 1}  # points in the file
SWEPT_PARTS = ('swept_ball', 'swept_face_c', 'swept_face_d')
PARTS = ('arc', 'line', 'face_c', 'face_d', *SWEPT_PARTS)  # the ball counts by its mean alone
# number of unknowns in the fits to the points of these parts: circle of the arc, line, swept ball
# with the way of the sweep, two planes, and the transform
UNKNOWNS = 6 + 4 + 6 + 2 * 3 + 6
MIN_FORWARD_SHARE = 0.9  # of the way along arc and line
MAX_LINE_ANGLE = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
MAX_PART_RMS, MAX_ROW_RMS = 3.0, 10.0  # sigmas of the points of a part, of a row
NOISE_DRAWS = 100  # for the covariance
# of the sweep
RIDGE_ANGLE = 0.35  # smallest angle between two faces that meet (rad)
MAX_SWEEP_TURN = 2e-3  # largest rotation of the flange during a sweep (rad)
MAX_ASIDE = 2e-4  # largest deviation of the flange from its line (m, RMS)
MIN_TRAVEL = 0.02  # m: shortest travel of P3
MIN_PROFILES = 5  # of the ball, and of the block
# consecutive profiles without two faces that do not end a run of block profiles
MAX_MISSED_PROFILES = 3


class PartPoints(NamedTuple):
    """
    The points of one part of ball, block or arm, from one row of the file or from one profile.

    sample: the number of the row, or the stamp of the profile (ns)
    points: (k, 3) in the tracker's frame; of swept parts x and z in the sensor plane and the
        reading of P3 (m)
    """

    sample: int
    points: Array


@dataclass(frozen=True, eq=False)
class TrackerProblem(TableProblem):
    """
    The points that tracker and profiler measured.

    part_points: of each of PARTS, and of the ball by the tracker; face_c is the face at smaller x
    q30: the reading of P3 at which the flange frame is taken (m)
    """

    part_points: Mapping[str, Sequence[PartPoints]]
    q30: float

    name = 'tracker'
    calibration_types = ('eye_in_hand',)
    advice = 'measure a longer arc and line, sweep over more of ball and faces'
    to_check = 'which face is which, h0 and h1, and the readings of P3?'

    @classmethod
    def read(cls, path: Path, config: Config) -> Self:
        """Return the reflector's points and the sweep in a bag; raises InputError, DataError."""
        tracker = config.tracker
        if not any(tracker.direction):
            raise BadValueError('tracker.direction', list(tracker.direction),
                                'a direction that is not zero')
        file = (path if path.is_dir() else path.parent) / tracker.file
        recording = read_bag(path, config)
        if not file.is_file():
            raise TableError(file, 'no such file: put the reflector points beside the bag, or set '
                             'tracker.file')
        missing = [f'tracker.{name}' for name in ('h0', 'h1', 'first_reading')
                   if math.isnan(getattr(tracker, name))]
        if missing:
            raise InputError(f'{" and ".join(missing)} must be set: the answer changes by their '
                             'full size, so they have no default; see config/tracker.yaml')
        by_reflector = read_reflector_points(file)
        swept, q30 = sweep_from(recording.profiles, recording.poses, config)
        return cls(config, {**by_reflector, **swept}, q30,
                   frame=recording.profiles[0].frame_id or 'laser',
                   inputs=[*recording.inputs, input_provenance(file)], warnings=recording.warnings)

    @property
    def sample_ids(self) -> list[tuple[int, str]]:
        return [(one.sample, part) for part in PARTS for one in self.part_points[part]]

    @property
    def T_sensor_plane(self) -> Array:
        return T_sensor_plane(self.config)

    @cached_property
    def readings(self) -> jing2020.Readings:
        """Return the points of both instruments by part."""
        parts = {part: np.concatenate([one.points for one in self.part_points[part]])
                 for part in (*PARTS, 'ball')}
        parts['ball'] = parts['ball'].mean(axis=0, keepdims=True)
        return jing2020.Readings(parts, self.config.tracker.h0 + self.config.tracker.h1, self.q30)

    @cached_property
    def result(self) -> jing2020.Result:
        """Return the published answer of the readings; raises DataError."""
        return self.published_answer(self.readings)

    def published_answer(self, readings: jing2020.Readings) -> jing2020.Result:
        """Return the answer of Jing 2020, of the sensor plane; raises DataError."""
        direction = self.T_sensor_plane[:3, :3].T @ np.array(self.config.tracker.direction)
        return jing2020.solve(readings, se3.unit(direction))

    def require_usable(self) -> None:
        """Raise DataError for points in the wrong order, and for a sweep beside the line."""
        arc, line = self.readings.parts['arc'], self.readings.parts['line']
        centre, axis = jing2020.fit_arc(arc)
        for part, steps in (
                ('arc', np.cross(arc[:-1] - centre, arc[1:] - centre) @ axis),
                ('line', np.diff(line, axis=0) @ jing2020.fit_line(line))):
            if steps.sum() < MIN_FORWARD_SHARE * np.abs(steps).sum():
                raise DataError(f'the points of the {part} go back and forth; list them in the '
                                'order measured')
        along_line = self.result.direction @ self.result.T_flange_sensor[2, :3]
        angle = math.acos(min(1.0, float(along_line)))
        if angle > MAX_LINE_ANGLE:
            raise DataError(
                f'the sweep runs {math.degrees(angle):.0f} degrees beside the line of the '
                'reflector; check which face is which, tracker.direction, and that the line was '
                'measured towards larger readings of P3')

    def estimate(self) -> TableAnswer:
        """Return the published answer, its covariance by draws of noise; raises DataError."""
        answer, distances = self.result, self.distances(self.result)
        counts = [len(one.points) for part in PARTS for one in self.part_points[part]]
        residuals = rms_by(np.repeat(np.arange(len(counts)), counts),
                           np.concatenate([distances[part] for part in PARTS]), len(counts))
        self.require_agreement(distances, residuals)
        residual_rms = rms(residuals)
        return TableAnswer(
            answer.T_flange_sensor, self.covariance(answer.T_flange_sensor, distances),
            np.ones(len(residuals), dtype=bool), residuals, residual_rms,
            residual_rms / (1 - UNKNOWNS / sum(counts)),  # generalised cross-validation
            target={'radius': answer.radius, 'face_angle': answer.face_angle})

    def require_agreement(self, distances: Mapping[str, Array], residuals: Array) -> None:
        """Raise DataError where a part or a row is further off than the noise of instruments."""
        contradicting = list[tuple[float, str]]()
        for (sample, part), residual in zip(self.sample_ids, residuals.tolist(), strict=True):
            is_swept = part in SWEPT_PARTS
            # the distance of a reflector from a swept face has the noise of both instruments
            noise = math.hypot(0.0 if is_swept else self.config.tracker.noise,
                               0.0 if part in ('arc', 'line') else self.config.noise.sensor)
            part_is_off = rms(distances[part]) > MAX_PART_RMS * noise
            # one profile matters little
            row_is_off = not is_swept and residual > MAX_ROW_RMS * noise
            if part_is_off or row_is_off:
                contradicting.append(
                    (residual, f'{part} of {"profile" if is_swept else "row"} {sample}'))
        if contradicting:
            distance, worst = max(contradicting)
            raise DataError(
                f'the points contradict each other, most of all {worst}, by {mm(distance)}: '
                'measure again or leave that row out, and check which face is which, the unit of '
                'the table, tracker.h0 and tracker.h1, and the noise of both instruments',
                code='misfit')

    def covariance(self, X: Array, distances: Mapping[str, Array]) -> Array:
        """Return the covariance (6, 6) of X (4, 4) by draws of the noise that distances show."""
        tracker_noise, rng, errors = self.config.tracker.noise, np.random.default_rng(SEED), []
        noise = {'ball': tracker_noise} | {
            part: max(rms(values), 0.0 if part in SWEPT_PARTS else tracker_noise)
            for part, values in distances.items()}
        for _ in range(NOISE_DRAWS):  # of each coordinate, but not of the reading of P3
            parts = {part: points + noise[part] * rng.normal(size=points.shape) * [
                1, 1, part not in SWEPT_PARTS] for part, points in self.readings.parts.items()}
            drawn = self.published_answer(replace(self.readings, parts=parts))
            errors.append(se3.difference(drawn.T_flange_sensor, X))
        return np.asarray(np.transpose(errors) @ errors / NOISE_DRAWS)

    def distances(self, answer: jing2020.Result) -> dict[str, Array]:
        """
        Return the distances (n,) of the points of each of PARTS from what all show (m).

        Of the arc from a circle, of the line from a straight line, of the swept ball from a
        sphere, and of each face, by both instruments, from its swept plane.
        """
        parts, direction = self.readings.parts, answer.direction
        _, ball, radius = jing2020.fit_swept_ball(parts['swept_ball'], self.q30, direction)
        centre, axis = jing2020.fit_arc(parts['arc'])
        spokes, line = parts['arc'] - centre, parts['line'] - parts['line'].mean(axis=0)
        radii = np.linalg.norm(spokes, axis=1)
        swept = {part: jing2020.swept(parts[part], self.q30, direction) for part in SWEPT_PARTS}
        T_sensor_tracker = se3.inverse(jing2020.link_frame(self.readings)
                                       @ answer.T_flange_sensor)
        distances = {
            'arc': np.hypot(spokes @ axis, radii - radii.mean()),
            'line': np.linalg.norm(np.cross(line, jing2020.fit_line(line)), axis=1),
            'swept_ball': np.linalg.norm(swept['swept_ball'] - ball, axis=1) - radius}
        for face in ('face_c', 'face_d'):
            points = swept[f'swept_{face}']
            middle, normal = points.mean(axis=0), jing2020.fit_plane(points)
            distances[f'swept_{face}'] = (points - middle) @ normal
            distances[face] = (se3.apply(T_sensor_tracker, parts[face]) - middle) @ normal
        return distances


def read_reflector_points(path: Path) -> dict[str, list[PartPoints]]:
    """
    Return the positions of the reflector (m) by kind, one for each row.

    The table has the columns kind (arc, line, ball, face_c or face_d) and x, y, z with their unit,
    as in `x [mm]`; its rows are in the order measured. Raises TableError.
    """
    table = CsvTable(path)
    kinds, points = table.texts('kind'), table.values('xyz', LENGTH)
    for row, kind in enumerate(kinds, 1):
        if kind not in MIN_POINTS:
            raise TableError(
                path, f'row {row}: kind is "{kind}", expected {", ".join(MIN_POINTS)}')
    for kind, fewest in MIN_POINTS.items():
        if kinds.count(kind) < fewest:
            raise TableError(path, f'holds {count_of(kinds.count(kind), "point")} of the kind '
                             f'{kind}; at least {fewest} are needed')
    return {kind: [PartPoints(row + 1, points[row:row + 1]) for row in range(len(kinds))
                   if kinds[row] == kind] for kind in MIN_POINTS}


def sweep_from(profiles: Sequence[AnyProfile], poses: Sequence[TimedPose], config: Config
               ) -> tuple[dict[str, list[PartPoints]], float]:
    """
    Return the points of each of SWEPT_PARTS in a sweep, and the reading of P3 in its middle (m).

    profiles, poses: those of the sweep, in the order of their stamps
    config: gives tracker.first_reading, the reading of P3 at the first pose, noise.sensor,
        target.radius of the ball (0: unknown) and sampling.min_points

    Raises DataError for a flange that does not move along its z alone, and for a sweep that does
    not show ball and block in enough profiles.
    """
    first, last = poses[0].stamp, poses[-1].stamp
    profiles = [profile for profile in profiles if first <= profile.stamp <= last]
    if not profiles:
        raise DataError('no profile lies within the time of the poses; record both together')
    q3 = config.tracker.first_reading + _travel(interpolate(poses, [
        first, *(profile.stamp for profile in profiles)]))
    seen = dict[int, dict[str, PartPoints]]()  # by the index of the profile, and the part
    for index, (profile, reading) in enumerate(zip(profiles, q3.tolist(), strict=True)):
        with suppress(UnusableMessageError, FeatureError):
            seen[index] = {part: PartPoints(profile.stamp, np.insert(points, 2, reading, axis=1))
                           for part, points in _parts_in(profile.read().points, config).items()}
    # two lines may also fit the rim of the ball: the block is the longest run of two faces
    corners = np.array([index for index in seen if 'swept_ball' not in seen[index]], dtype=int)
    gaps = np.flatnonzero(np.diff(corners) > 1 + MAX_MISSED_PROFILES) + 1
    block = max(np.split(corners, gaps), key=len).tolist()
    ball = [index for index in seen if 'swept_ball' in seen[index]]
    for name, indices in (('ball', ball), ('block', block)):
        if len(indices) < MIN_PROFILES:
            raise DataError(f'the {name} is in {count_of(len(indices), "profile")} only; sweep '
                            f'over it slowly, at least {MIN_PROFILES} profiles')
    swept = {part: [seen[index][part] for index in (ball if part == 'swept_ball' else block)]
             for part in SWEPT_PARTS}
    return swept, (q3.min() + q3.max()) / 2


def _travel(T: Array) -> Array:
    """
    Return the travel (n - 1,) along the flange's z from the first of poses (n, 4, 4) (m).

    Raises DataError for another motion than along a line, without a turn.
    """
    turn = float(np.max(se3.angle(T[:, :3, :3] @ T[0, :3, :3].T)))
    moved = (T[:, :3, 3] - T[0, :3, 3]) @ T[0, :3, :3]
    along, aside = np.ptp(moved[:, 2]), rms(np.linalg.norm(moved[:, :2], axis=1))
    if turn > MAX_SWEEP_TURN or aside > MAX_ASIDE or along < MIN_TRAVEL:
        raise DataError(
            f'in the sweep the flange moves {along * 1e3:.1f} mm along its z and '
            f'{aside * 1e3:.2f} mm aside, and turns by {degrees(turn)}: move P3 alone, over ball '
            'and block; the flange frame has z along P3')
    return np.asarray(moved[1:, 2])


def _parts_in(points: Array, config: Config) -> dict[str, Array]:
    """
    Return the points (k, 2) of each part in a profile (n, 2): swept_ball, or both swept faces.

    Raises FeatureError for a profile of neither.
    """
    with suppress(FeatureError):
        arc, = arc_features(points, config)
        return {'swept_ball': arc.points}
    left, right = face_pair_features(points, config)[:2]
    # a ridge is nearer to the sensor in the middle: the range falls towards it from both sides
    bend = float(np.linalg.det([left.direction, right.direction])) * config.profile.range_sign
    if bend < math.sin(RIDGE_ANGLE):
        raise FeatureError('a groove, or an edge too blunt')
    return {'swept_face_c': left.points, 'swept_face_d': right.points}
