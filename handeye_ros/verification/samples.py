# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Samples of a verification: the time offset of a sweep, and the surface that is the artefact.

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
from handeye_ros.estimation.least_squares import Rows, System
from handeye_ros.frames import in_mount, mounted
from handeye_ros.sampling.sweep import evenly_chosen, Pairing, single_samples
from handeye_ros.verification.fixed_fit import points_in_base
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.shapes import derivatives, StationSet
import numpy as np
from numpy.typing import NDArray

SURE = 4.0  # sigmas of a change
SMALLEST = 1e-4  # s: a smaller change does not matter to a scan
MOST = 60  # samples of a sweep
OUTLIER, FOREIGN = 4.0, 20.0  # robust sigmas of the points: left out; of another surface
ROUNDS = 4  # of fits, each without the outliers of the previous one
CORRELATED = 1_000_000_000  # ns, over which residuals are not independent
# m: pieces this near to a plane are one surface. The next value is tried if fewer than
# MOST_SEE of the stops see one plane: then the calibration is wrong.
SAME = (1.5e-3, 4e-3, 1e-2)
MOST_SEE = 0.8
FAR = 0.01  # m: a wrong calibration may put a piece of a surface this far from it
LEAST_SHARE = 0.5  # of the stops must see the nearest surface
LEAST_STOPS = 4
MOST_SURFACES, MOST_PAIRS = 4, 300  # pairs of pieces that define a trial plane


def at_offset(routine: Routine, samples: Sequence[Sample], X: Array, calibration: Calibration,
              config: Config) -> tuple[list[Sample], str]:
    """
    Return samples of a moving robot with the poses at the best fitting time offset.

    Also returns in words whether this offset is that of the calibration. X: (4, 4) sensor plane
    in the mount. Samples that show another surface or edge are left out.
    """
    samples = single_samples(samples)
    samples = [samples[i] for i in evenly_chosen(len(samples), MOST)]
    poses = mounted(samples, config)
    stations = StationSet(poses, routine.observe(samples, poses, X))
    offset, std, foreign = _fitted(routine, samples, stations, X, config)
    T = Pairing.of(samples).at(offset).T_base_flange
    estimated = TimeOffset(config.time_offset + offset, std)
    previous = calibration.time_offset or TimeOffset(config.time_offset, 0.0)
    sentence = compared(estimated, previous)[1]
    if foreign.any():
        sentence += f'; {foreign.sum()} of {len(samples)} profiles show another surface'
    return [replace(sample, T_base_flange=pose, motion=None) for sample, pose, out in
            zip(samples, T, foreign, strict=True) if not out], sentence


def _fitted(routine: Routine, samples: Sequence[Sample], stations: StationSet, X: Array,
            config: Config) -> tuple[float, float, NDArray[np.bool_]]:
    """Return the best offset for a routine's shape, its std (s), and foreign samples (n,)."""
    pairing, obs = Pairing.of(samples), stations.observations
    _, shape = routine.shape(stations, points_in_base(stations, X), config.verify)

    def distances(x: Array) -> Array:
        poses = in_mount(pairing.at(x[-1]).T_base_flange, config)
        points = points_in_base(replace(stations, poses=poses), X)
        return shape.distance(points, obs.kind, x[:-1])

    def refined(x: Array, inliers: NDArray[np.bool_]) -> Array:
        system: System[Array] = System(
            lambda x: Rows(distances(x)[inliers], lambda: derivatives(distances, x)[inliers]),
            np.add, np.zeros(int(inliers.sum()), dtype=np.intp))
        return system.least_squares(x)

    x, inliers = np.append(shape.start, 0.0), np.ones(len(obs.station), dtype=bool)
    for _ in range(ROUNDS):
        x = refined(x, inliers)
        distance = np.abs(distances(x))
        inliers = distance <= OUTLIER * 1.4826 * np.median(distance)
    stamps = np.array([sample.stamp for sample in samples])[obs.station[inliers]]
    std = _grouped_std(distances(x)[inliers], derivatives(distances, x)[inliers],
                       stamps // CORRELATED)
    foreign = np.zeros(len(samples), dtype=bool)
    foreign[obs.station[distance > FOREIGN * 1.4826 * np.median(distance)]] = True
    return float(x[-1]), std, foreign


def compared(offset: TimeOffset, previous: TimeOffset) -> tuple[bool, str]:
    """Return whether the time offset has changed, and by how much in words."""
    change, std = offset.value - previous.value, math.hypot(offset.std, previous.std)
    change_text = f'{change * 1e3:+.2f} ms (1 sigma {std * 1e3:.2f})'
    if abs(change) <= max(SURE * std, SMALLEST):
        return False, f'the time offset is as it was: {change_text}'
    return True, (f'the time offset has changed by {change_text}: the clock or the delay of '
                  f'sensor or robot is another; set time_offset to {offset.value:.5f}, or '
                  'calibrate again')


def _grouped_std(r: Array, J: Array, group: Array) -> float:
    """Return 1 sigma of the last unknown for residuals (m,) correlated within groups (m,)."""
    nuisance, last = J[:, :-1], J[:, -1]
    reduced = last - nuisance @ np.linalg.lstsq(nuisance, last, rcond=None)[0]
    _, group_index = np.unique(group, return_inverse=True)
    scores = np.bincount(group_index, reduced * r)
    freedom = max(len(scores) - J.shape[1], 1)
    return float(np.sqrt((scores ** 2).sum() * len(scores) / freedom) / (reduced @ reduced))


def ends(feature: Feature, T: Array) -> Array:
    """Return the first and last point (2, 3) of a feature in the base; T: (4, 4) sensor plane."""
    if isinstance(feature, FaceLine):
        points = feature.centre + np.outer(
            [-3 ** 0.5, 3 ** 0.5], feature.spread * feature.direction)
    elif isinstance(feature, Arc):
        points = feature.points[[0, -1]]
    else:
        points = np.array([feature.point, feature.point])
    return np.asarray(points @ T[:3, [0, 2]].T + T[:3, 3])


def in_region(samples: Sequence[Sample], poses: Array, X: Array, region: Sequence[float]
              ) -> list[Sample]:
    """Return the samples with only the features in a ball: x, y, z, radius."""
    selected = []
    for sample, T in zip(samples, poses, strict=True):
        in_ball = []
        for feature in sample.features:
            a, b = ends(feature, T @ X) - np.array(region[:3])
            segment = b - a
            fraction = np.clip(-a @ segment / max(segment @ segment, 1e-30), 0.0, 1.0)
            if np.linalg.norm(a + fraction * segment) <= region[3]:
                in_ball.append(feature)
        selected.append(replace(sample, features=tuple(in_ball)))
    return selected


def on_nearest_surface(samples: Sequence[Sample], poses: Array, X: Array, range_sign: int
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
    points = np.array([ends(f, poses[k] @ X) for k, f in pieces])
    surface = _surfaces(points, stop)
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
    """Return the surface (k,) of each piece; points: (k, 2, 3)."""
    free, planes = np.ones(len(points), dtype=bool), list[tuple[Array, Array]]()
    for tolerance in SAME:
        _, on = _largest(points, stop, free, tolerance)
        if len(np.unique(stop[on])) >= MOST_SEE * len(np.unique(stop)):
            break
    while len(np.unique(stop[free])) > 1 and len(planes) < MOST_SURFACES:
        plane, on = _largest(points, stop, free, tolerance)
        planes.append(plane)
        free &= ~on
    away = np.array([np.abs((points - p) @ n).max(axis=1) for p, n in planes])
    distinct = [0]
    for k in range(1, len(planes)):
        nearest_plane = np.argmin(away[[*distinct, k]], axis=0)
        stops_of_plane = [set(stop[nearest_plane == j].tolist()) for j in range(len(distinct) + 1)]
        if any(stops_of_plane[-1] & stops_of_other for stops_of_other in stops_of_plane[:-1]):
            distinct.append(k)
    nearest_plane, distance = np.argmin(away[distinct], axis=0), away[distinct].min(axis=0)
    nearest = np.array([distance[(stop == s) & (nearest_plane == o)].min()
                        for s, o in zip(stop, nearest_plane, strict=True)])
    on_plane = (distance < tolerance) | ((distance == nearest) & (distance < FAR))
    return np.where(on_plane, nearest_plane, -1)


def _largest(points: Array, stop: NDArray[np.intp], free: NDArray[np.bool_], tolerance: float
             ) -> tuple[tuple[Array, Array], NDArray[np.bool_]]:
    """Return point and normal of the plane visible at most stops, and its unassigned pieces."""
    best, best_score = (points[free][0, 0], np.array([0.0, 0, 1])), (0, 0.0)
    best_pieces = free
    pairs = [(a, b) for a, b in combinations(np.flatnonzero(free).tolist(), 2)
             if stop[a] != stop[b]]
    for a, b in pairs[::max(len(pairs) // MOST_PAIRS, 1)]:
        four = points[[a, b]].reshape(4, 3)
        normal = np.linalg.svd(four - four.mean(axis=0))[2][2]
        away = np.abs((points - four.mean(axis=0)) @ normal).max(axis=1)
        on = free & (away < tolerance)
        score = (len(np.unique(stop[on])), -float(away[on].sum()) / max(on.sum(), 1))
        if score > best_score:
            best, best_score, best_pieces = (four.mean(axis=0), normal), score, on
    return best, best_pieces
