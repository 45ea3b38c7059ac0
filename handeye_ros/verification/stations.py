# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From the samples of a recording to the stations of a routine: what of them shows the artefact.

Where several surfaces are in sight, those in a region of interest take part, or the nearest one.
A sweep over the artefact takes its poses at the time offset that fits best; this offset is
compared with the calibration's.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
import math

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, FaceLine, Feature, Sample, TimeOffset
from handeye_ros.frames import in_mount, mounted, sensor_axes
from handeye_ros.sampling.sweep import evenly_chosen, Pairing, single_samples
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.shapes import derivatives, StationSet
import numpy as np
from numpy.typing import NDArray

SURE = 4.0  # sigmas of a change
SMALLEST = 1e-4  # s: a smaller change does not matter to a scan
MOST = 60  # samples of a sweep
OUTLIER, FOREIGN = 4.0, 20.0  # robust sigmas of the points: left out; of another surface
STEPS, ALL = 16, 6  # Gauss-Newton steps, of which the first with all points
CORRELATED = 1_000_000_000  # ns, over which residuals are not independent
# m: pieces this near to a plane are one surface. The next value is tried if fewer than
# MOST_SEE of the stops see one plane: then the calibration is wrong.
SAME = (1.5e-3, 4e-3, 1e-2)
MOST_SEE = 0.8
FAR = 0.01  # m: a wrong calibration may put a piece of a surface this far from it
LEAST_SHARE = 0.5  # of the stops must see the nearest surface
LEAST_STOPS = 4
MOST_SURFACES, MOST_PAIRS = 4, 300  # pairs of pieces that define a trial plane


def stations_of(routine: Routine, samples: Sequence[Sample], calibration: Calibration,
                config: Config) -> StationSet:
    """
    Return the stations of one bag, with the conditions of a routine.

    Of several surfaces in sight the nearest one takes part; verify.near limits the region.
    """
    X, notes = calibration.T_flange_sensor @ sensor_axes(config), []
    if config.sampling.moving and samples:
        samples, note = _at_offset(routine, samples, X, calibration, config)
        notes.append(note)
    poses = mounted(samples, config) if samples else np.empty((0, 4, 4))
    if config.verify.near and samples:
        samples = _in_region(samples, poses @ X, config.verify.near)
    if routine.target == 'plane':
        samples, note = _on_nearest_surface(samples, poses @ X, config.profile.range_sign)
        notes.insert(0, note)
    return StationSet(poses, routine.observe(samples, poses, X),
                      stamps=np.array([sample.stamp for sample in samples], dtype=np.int64),
                      surface='; '.join(filter(None, notes)))


def _at_offset(routine: Routine, samples: Sequence[Sample], X: Array, calibration: Calibration,
               config: Config) -> tuple[list[Sample], str]:
    """
    Return samples of a moving robot with the poses at the best fitting time offset.

    Also returns in words whether this offset is that of the calibration. X: (4, 4) sensor plane
    in the mount. Samples that show another surface or edge are left out.
    """
    samples = single_samples(samples)
    samples = [samples[i] for i in evenly_chosen(len(samples), MOST)]
    poses, pairing = mounted(samples, config), Pairing.of(samples)
    stations = StationSet(poses, routine.observe(samples, poses, X))
    obs = stations.observations
    _, shape = routine.shape(stations, stations.points(X), config.verify)

    def distances(x: Array) -> Array:
        """Return the distances from the shape; x: its unknowns and the offset."""
        T = in_mount(pairing.at(x[-1]).T_base_flange, config)
        return shape.distance(obs.in_base(T, X), obs.kind, x[:-1])

    x, inliers = np.append(shape.start, 0.0), np.ones(len(obs), dtype=bool)
    for step in range(STEPS):
        r = distances(x)
        scatter = 1.4826 * np.median(np.abs(r))
        if step >= ALL:
            inliers = np.abs(r) <= OUTLIER * scatter
        x = x - np.linalg.lstsq(derivatives(distances, x)[inliers], r[inliers], rcond=None)[0]
    stamps = np.array([sample.stamp for sample in samples])
    std = _grouped_std(distances(x)[inliers], derivatives(distances, x)[inliers],
                       stamps[obs.station[inliers]] // CORRELATED)
    foreign = set(obs.station[np.abs(distances(x)) > FOREIGN * scatter].tolist())
    previous = calibration.time_offset or TimeOffset(config.time_offset, 0.0)
    _, sentence = compared(TimeOffset(config.time_offset + float(x[-1]), std), previous)
    if foreign:
        sentence += f'; {len(foreign)} of {len(samples)} profiles show another surface'
    T = pairing.at(x[-1]).T_base_flange
    return [replace(sample, T_base_flange=T[k], motion=None) for k, sample in enumerate(samples)
            if k not in foreign], sentence


def _grouped_std(r: Array, J: Array, group: Array) -> float:
    """Return 1 sigma of the last unknown for residuals (m,) correlated within groups (m,)."""
    nuisance, last = J[:, :-1], J[:, -1]
    reduced = last - nuisance @ np.linalg.lstsq(nuisance, last, rcond=None)[0]
    _, group_index = np.unique(group, return_inverse=True)
    scores = np.bincount(group_index, reduced * r)
    freedom = max(len(scores) - J.shape[1], 1)
    return float(np.sqrt((scores ** 2).sum() * len(scores) / freedom) / (reduced @ reduced))


def compared(offset: TimeOffset, previous: TimeOffset) -> tuple[bool, str]:
    """Return whether the time offset has changed, and by how much in words."""
    change, std = offset.value - previous.value, math.hypot(offset.std, previous.std)
    change_text = f'{change * 1e3:+.2f} ms (1 sigma {std * 1e3:.2f})'
    if abs(change) <= max(SURE * std, SMALLEST):
        return False, f'the time offset is as it was: {change_text}'
    return True, (f'the time offset has changed by {change_text}: the clock or the delay of '
                  f'sensor or robot is another; set time_offset to {offset.value:.5f}, or '
                  'calibrate again')


def _ends(feature: Feature, T: Array) -> Array:
    """Return the first and last point (2, 3) of a feature in the base; T: (4, 4) sensor plane."""
    if isinstance(feature, FaceLine):
        points = feature.centre + np.outer(
            [-3 ** 0.5, 3 ** 0.5], feature.spread * feature.direction)
    elif isinstance(feature, Arc):
        points = feature.points[[0, -1]]
    else:
        points = np.array([feature.point, feature.point])
    return np.asarray(points @ T[:3, [0, 2]].T + T[:3, 3])


def _in_region(samples: Sequence[Sample], T: Array, region: Sequence[float]) -> list[Sample]:
    """Return the samples with only the features in a ball: x, y, z, radius; T: sensor planes."""
    def is_inside(feature: Feature, T: Array) -> bool:
        a, b = _ends(feature, T) - np.array(region[:3])
        segment = b - a
        fraction = np.clip(-a @ segment / max(segment @ segment, 1e-30), 0.0, 1.0)
        return bool(np.linalg.norm(a + fraction * segment) <= region[3])

    return [replace(sample, features=tuple(f for f in sample.features if is_inside(f, at)))
            for sample, at in zip(samples, T, strict=True)]


def _on_nearest_surface(samples: Sequence[Sample], T: Array, range_sign: int
                        ) -> tuple[list[Sample], str]:
    """
    Return the samples with the pieces of one surface only, and its description.

    It is the plane nearest to the sensor of those that at least half of the stops see. Two planes
    are two surfaces where a stop sees both; a piece on none belongs to the next one within FAR.
    """
    pieces = [(k, f) for k, s in enumerate(samples) for f in s.features
              if isinstance(f, FaceLine)]
    stop = np.array([k for k, _ in pieces])
    if len(np.unique(stop)) < LEAST_STOPS or len(stop) == len(np.unique(stop)):
        return list(samples), ''
    surface = _surfaces(np.array([_ends(f, T[k]) for k, f in pieces]), stop)
    stops = np.array([len(np.unique(stop[surface == k])) for k in range(surface.max() + 1)])
    depth = range_sign * np.array([f.centre[1] for _, f in pieces])
    depths = np.array([np.median(depth[surface == k]) for k in range(len(stops))])
    enough = stops >= max(LEAST_SHARE * stops.max(), LEAST_STOPS)
    chosen = int(np.argmin(np.where(enough, depths, np.inf)))
    on_chosen = {id(pieces[row][1]) for row in np.flatnonzero(surface == chosen)}
    sentence = '' if enough.sum() < 2 else (
        f'of {enough.sum()} surfaces in sight it is the nearest, '
        f'{1e3 * abs(depths[chosen]):.0f} mm from the sensor, at {stops[chosen]} of '
        f'{len(samples)} stops')
    return [replace(s, features=tuple(f for f in s.features if id(f) in on_chosen))
            for s in samples], sentence


def _surfaces(points: Array, stop: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the surface (k,) of each piece, -1: of none; points: (k, 2, 3) its ends."""
    free = np.ones(len(points), dtype=bool)
    for tolerance in SAME:
        on, away = _largest(points, stop, free, tolerance)
        if len(np.unique(stop[on])) >= MOST_SEE * len(np.unique(stop)):
            break
    distances = [away]
    for _ in range(MOST_SURFACES - 1):
        free &= ~on
        if len(np.unique(stop[free])) < 2:
            break
        on, away = _largest(points, stop, free, tolerance)
        nearest = np.argmin([*distances, away], axis=0)
        last = nearest == len(distances)
        if np.isin(stop[last], stop[~last]).any():  # one stop sees it and another: a surface
            distances.append(away)
    nearest, distance = np.argmin(distances, axis=0), np.min(distances, axis=0)
    least = np.array([distance[(stop == s) & (nearest == n)].min()
                      for s, n in zip(stop, nearest, strict=True)])
    on_plane = (distance < tolerance) | ((distance == least) & (distance < FAR))
    return np.where(on_plane, nearest, -1)


def _largest(points: Array, stop: NDArray[np.intp], free: NDArray[np.bool_], tolerance: float
             ) -> tuple[NDArray[np.bool_], Array]:
    """Return which free pieces are on the plane seen at most stops, and all distances from it."""
    best, best_score = (free, np.zeros(len(points))), (0, 0.0)
    pairs = [(a, b) for a, b in combinations(np.flatnonzero(free).tolist(), 2)
             if stop[a] != stop[b]]
    for a, b in pairs[::max(len(pairs) // MOST_PAIRS, 1)]:
        four = points[[a, b]].reshape(4, 3)
        normal = np.linalg.svd(four - four.mean(axis=0))[2][2]
        away = np.abs((points - four.mean(axis=0)) @ normal).max(axis=1)
        on = free & (away < tolerance)
        score = (len(np.unique(stop[on])), -float(away[on].sum()) / max(on.sum(), 1))
        if score > best_score:
            best, best_score = (on, away), score
    return best
