# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verification routines, by name, and the shapes that they fit."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
import math

from handeye_ros import se3
from handeye_ros.arithmetic import fit_round
from handeye_ros.config import Config, VerifyConfig, with_values
from handeye_ros.data import Array
from handeye_ros.errors import InputError
from handeye_ros.verification.fit import Quantity, Shape
from handeye_ros.verification.station_set import StationSet
from handeye_ros.verification.tooth_gauge import teeth
from handeye_ros.words import count_of
import numpy as np

FEW = 'few'  # code of the refusal of fewer recordings than a routine needs


def line(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """
    Return a straight line; kinds 0 and 1 are its two distances.

    Its q (4,) are two offsets (m) and two slopes, across the first direction of the points.
    """
    p, kind = stations.problem.points_in_base(X), stations.observations.kind[:, None]
    middle = p.mean(axis=0)
    frame = np.linalg.svd(p - middle)[2].T

    def distance(p: Array, q: Array) -> Array:
        local, offsets, slopes = (p - middle) @ frame, q[:2], q[2:]
        away = local[:, 1:] - offsets - local[:, :1] * slopes
        return np.asarray(np.take_along_axis(away, kind, 1)[:, 0])

    return Shape(stations, np.zeros(4), distance)


def point(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """
    Return one point; kinds 0 to 2 are its distances along x, y and z.

    Its q (3,) is its place relative to the middle of the points (m).
    """
    kind = stations.observations.kind[:, None]
    middle = stations.problem.points_in_base(X).mean(axis=0)

    def distance(p: Array, q: Array) -> Array:
        return np.asarray(np.take_along_axis(p - middle - q, kind, 1)[:, 0])

    reference = settings.reference or (None, None, None)
    return Shape(stations, np.zeros(3), distance, lambda q: np.asarray(middle + q),
                 tuple(Quantity(axis, nominal=touched) for axis, touched in zip(
                     'xyz', reference, strict=True)))


def plane(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """Return one plane, of which nothing is measured but its distances."""
    return _planes(stations, X, 1, lambda normals, heights: np.empty(0), ())


def step(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """
    Return the faces of one block or more; measured: their heights over the first of each.

    A block has one recording more than lengths.
    """
    blocks = len(stations.counts) - len(settings.lengths)

    def values(normals: Array, heights: Array) -> Array:
        of_block = heights.reshape(blocks, -1)
        return (of_block[:, 1:] - of_block[:, :1]).ravel()

    of_each = len(settings.lengths) // blocks
    return _planes(stations, X, blocks, values, tuple(
        Quantity(f'height of face {k % of_each + 1} over face 0'
                 + (f' of block {k // of_each + 1}' if blocks > 1 else ''),
                 nominal=length, characteristic='E')
        for k, length in enumerate(settings.lengths)))


def square(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """Return two planes that are not parallel; measured: the angle between them."""
    def values(normals: Array, heights: Array) -> Array:
        across, along = np.linalg.norm(np.cross(*normals)), -(normals[0] @ normals[1])
        return np.array([np.arctan2(across, along)])

    return _planes(stations, X, 2, values, (
        Quantity('angle between the faces', nominal=np.pi / 2, unit='rad'),))


def _planes(stations: StationSet, X: Array, blocks: int, values: Callable[[Array, Array], Array],
            quantities: tuple[Quantity, ...]) -> Shape:
    """
    Return a plane for each recording; those of one block are parallel.

    Each block has as many recordings, one after the other. values(normals, heights): of the
    quantities, by the normals (count, 3) of all planes and their heights (count,) over the origin
    of the base (m). The q (2 blocks + count,) are two slopes of each block, then the height of
    each plane over the middle of its points (m).
    """
    p, count = stations.problem.points_in_base(X), len(stations.counts)
    recording = stations.recording_of_point
    block = np.arange(count) * blocks // count  # of each recording
    middles = np.array([p[recording == k].mean(axis=0) for k in range(count)])
    centred = p - middles[recording]
    sensors, frames = (stations.problem.poses @ X)[:, :3, 3], np.empty((blocks, 3, 3))
    for k in range(blocks):
        frames[k] = np.linalg.svd(centred[block[recording] == k], full_matrices=False)[2].T
        # upwards is towards the sensor
        sensor = sensors[block[stations.recording_of_pose] == k].mean(axis=0)
        frames[k, :, 2] *= np.sign((sensor - middles[block == k][0]) @ frames[k, :, 2])

    def normals_of(q: Array) -> Array:
        slopes = q[:2 * blocks].reshape(blocks, 2)
        return se3.unit(frames[:, :, 2] + np.einsum('kij,kj->ki', frames[:, :, :2], slopes))[block]

    def distance(p: Array, q: Array) -> Array:
        over_middle = ((p - middles[recording]) * normals_of(q)[recording]).sum(axis=1)
        return np.asarray(over_middle - q[2 * blocks:][recording])

    def values_of(q: Array) -> Array:
        normals = normals_of(q)
        return values(normals, (middles * normals).sum(axis=1) + q[2 * blocks:])

    return Shape(stations, np.zeros(2 * blocks + count), distance, values_of, quantities)


def spheres(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """
    Return one sphere of each recording; measured: radii, and distances of the centres.

    Their q (4 count,) are centre and radius of one after the other (m).
    """
    p, count = stations.problem.points_in_base(X), len(stations.counts)
    recording = stations.recording_of_point
    start = np.concatenate([fit_round(p[recording == k]) for k in range(count)])

    def distance(p: Array, q: Array) -> Array:
        balls = q.reshape(count, 4)[recording]
        return np.asarray(np.linalg.norm(p - balls[:, :3], axis=1) - balls[:, 3])

    def values(q: Array) -> Array:
        balls = q.reshape(count, 4)
        return np.append(balls[:, 3], np.linalg.norm(np.diff(balls[:, :3], axis=0), axis=1))

    radii = [Quantity('radius' if count == 1 else f'radius of ball {k}',
                      nominal=settings.radius or None, characteristic='PS')
             for k in range(1, count + 1)]
    distances = [Quantity(f'distance of balls {k} and {k + 1}', nominal=length,
                          characteristic='SD') for k, length in enumerate(settings.lengths, 1)]
    return Shape(stations, start, distance, values, (*radii, *distances))


@dataclass(frozen=True)
class Routine:
    """
    One way to verify a calibration.

    measures: a description of what is measured
    target: the target.type whose features the stations give; empty where points are taken in
        passes, while the robot moves
    recording_counts: for each valid number of verify.lengths the possible numbers of recordings,
        ascending
    shape: what is fitted to the stations, with the sensor plane at X (4, 4) in the mount
    form_name: what the scatter of each face, ball or axis is called in the result; empty: not told
    form_symbol: the symbol of this scatter as a characteristic, see result_file.py
    edge_distances: into how many distances an edge point counts, two from a line or three from a
        point; 0: the points count as in a calibration
    nominal_keys: the keys of the nominal values that the page asks for
    """

    name: str
    measures: str
    target: str
    recording_counts: Mapping[int, Sequence[int]]
    shape: Callable[[StationSet, Array, VerifyConfig], Shape]
    form_name: str = ''
    form_symbol: str = ''
    edge_distances: int = 0
    nominal_keys: Sequence[str] = ()

    @property
    def in_passes(self) -> bool:
        """Return whether points are taken while the robot moves."""
        return not self.target

    def recordings_for(self, lengths: int) -> Sequence[int]:
        """Return the possible numbers of recordings; raises InputError for wrong lengths."""
        if lengths not in self.recording_counts:
            counts = _numbers_text(list(self.recording_counts), 'length')
            raise InputError(f'{self.name} needs {counts} (verify.lengths), and got {lengths}')
        return self.recording_counts[lengths]

    def settings(self, config: Config, recordings: int | None = None) -> Config:
        """
        Return the settings that extract the features of the routine.

        recordings: their number, once all are there; raises InputError for a wrong number.
        """
        if recordings is not None:
            possible = self.recordings_for(len(config.verify.lengths))
            if recordings not in possible:
                heights = (
                    f' for {count_of(len(config.verify.lengths), "length")}: verify.lengths has '
                    'the heights of each block, repeated each time it is laid'
                    if len(self.recording_counts) > 1 and recordings > possible[-1] else '')
                raise InputError(
                    f'{self.name} needs {_numbers_text(possible, "recording")}, and got '
                    f'{recordings}{heights}', code='' if recordings > possible[-1] else FEW)
        return config if self.in_passes else with_values(config, {
            'target.type': self.target, 'method': 'auto', 'target.radius': config.verify.radius})

    def form_errors(self, stations: StationSet, distances: Array) -> Iterator[Quantity]:
        """
        Yield the scatter of distances (m,) of each face or ball: highest less lowest point.

        Of a point: 3 sigma along each axis of the base. Their own std is that of n independent
        normal distances; that of the span is its limit for many (Gumbel's distribution of both
        extremes), 6 % too large for 10.
        """
        by_axis = self.edge_distances == 3
        number = stations.observations.kind if by_axis else stations.recording_of_point
        for k in range(int(number.max()) + 1 if self.form_name else 0):
            values = distances[number == k]
            n, sigma = max(len(values), 2), float(values.std(ddof=1))
            if by_axis:
                size, std, which = 3 * sigma, 3 * sigma / math.sqrt(2 * (n - 1)), 'xyz'[k]
            else:
                size, std = float(np.ptp(values)), sigma * math.pi / math.sqrt(6 * math.log(n))
                which = f'{k + 1}, noise included'
            yield Quantity(f'{self.form_name} {which}', size, std,
                           characteristic=self.form_symbol)


ROUTINES: dict[str, Routine] = {routine.name: routine for routine in (
    Routine('line', 'distances of edge points from a straight edge', 'line', {0: [1]}, line,
            edge_distances=2),
    Routine('plane', 'distances of points from a flat face', 'plane', {0: [1]}, plane,
            'flatness of face', 'F'),
    Routine('point', 'one point seen from everywhere: scatter, and bias of a touched one', 'line',
            {0: [1]}, point, '3 sigma of the points along', edge_distances=3,
            nominal_keys=['verify.reference']),
    Routine('sphere', 'radius of a ball', 'sphere', {0: [1]}, spheres, 'form error of ball', 'PF',
            nominal_keys=['verify.radius']),
    Routine('ball_bar', 'distance of two balls', 'sphere', {1: [2]}, spheres,
            'form error of ball', 'PF', nominal_keys=['verify.radius', 'verify.lengths']),
    Routine('step', 'heights of parallel faces over the first, of one block to three', 'plane',
            # a block has one face more than heights
            {n: [n + blocks for blocks in (1, 2, 3) if n % blocks == 0 and n + blocks <= 12]
             for n in range(1, 12)}, step, nominal_keys=['verify.lengths']),
    Routine('square', 'angle between two faces, and their flatness', 'plane', {0: [2]},
            square, 'flatness of face', 'F'),
    Routine('tooth', 'pitch and height of a tooth gauge, scanned in passes', '',
            {2: range(2, 21)}, teeth),
)}
"""The routines of `handeye verify`."""


def _numbers_text(numbers: Sequence[int], what: str) -> str:
    text = f'{numbers[0]} to {numbers[-1]}' if len(numbers) > 3 else ' or '.join(map(str, numbers))
    return f'{text} {what}' if numbers[-1] == 1 else f'{text} {what}s'
