# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From a recording to the stations of a routine: the features and points that show the artefact.

Where several surfaces are in sight, those in a region of interest take part, or the nearest one.
A sweep over the artefact takes its poses at the time offset of the calibration, and its rotations
later by the lag, as does a pass over a gauge of teeth, of which single points are taken.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
import math
from typing import TypeVar

from handeye_ros.arithmetic import even_indices, evenly_spaced
from handeye_ros.config import Config
from handeye_ros.data import (
    Array,
    Calibration,
    EdgePoint,
    FaceLine,
    Feature,
    has_return,
    Indices,
    Profile,
    Sample,
)
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.problem import Observations, Problem
from handeye_ros.estimation.target import Target
from handeye_ros.frames import mount_poses, mount_poses_of, T_sensor_plane, target_frame
from handeye_ros.sampling.sweep import ClockedPoses, passes_expanded
from handeye_ros.sampling.trajectory import Trajectory
from handeye_ros.targets import TARGETS
from handeye_ros.targets.profile_target import edge_error_root, NO_OBSERVATIONS, observations_at
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.station_set import MIN_STATIONS, StationSet
import numpy as np

SWEEP_SAMPLES = 60  # samples of a sweep
KNOWN_OFFSET_STD = 1e-3  # s: a time offset stated less exactly is none
SAME_SURFACE_DISTANCE = 1.5e-3  # m: pieces this near to a plane are one surface,
# or within so many times the median distance of the nearest pieces: a wrong calibration spreads
# them
FAR_RATIO = 4.0
MIN_SEEN_SHARE = 0.5  # of the stops must see the nearest surface
# pairs of features that define a trial point, line or plane, where there are so many
MIN_TRIALS = 300
PASS_PROFILES, POINTS_OF_PROFILE = 12, 80  # of a pass that are used, and of each of them

FeatureKind = TypeVar('FeatureKind', EdgePoint, FaceLine)


def stations_of(routine: Routine, recordings: Iterable[Sequence[Sample]], calibration: Calibration,
                config: Config) -> StationSet:
    """
    Return the stations of the samples of each recording, with the conditions of a routine.

    Of several surfaces in sight the nearest one takes part; verify.near limits the region. Raises
    DataError where it leaves nothing, and InputError for a sweep without a time offset.
    """
    X = calibration.T_flange_sensor @ T_sensor_plane(config)
    shown, choices = zip(*(_select_artefact(routine, recorded, X, calibration, config)
                           for recorded in recordings), strict=True)
    samples = [sample for recorded in shown for sample in recorded]
    poses = mount_poses_of(samples, config)
    target = TARGETS[routine.target]
    problem = _problem(target, poses, _observations(routine, samples, poses @ X), config,
                       is_face=target.kinds == ('face',))
    return StationSet(
        problem, np.array([sample.stamp for sample in samples], dtype=np.int64),
        tuple(map(len, shown)), np.arange(len(poses)), '; '.join(
            f'recording {k}: {choice}' for k, choice in enumerate(choices, 1) if choice))


def _problem(target: Target, poses: Array, observations: Observations, config: Config,
             is_face: bool) -> Problem:
    """
    Return what is seen from poses (n, 4, 4); config.verify.aim is a further error of their place.

    is_face: whether the artefact is a face. The ends of a line are none, and the flanks of teeth
    are steep by design.
    """
    noise = replace(
        config.noise, distortion=config.noise.distortion if is_face else 0.0,
        robot_translation=math.hypot(config.noise.robot_translation, config.verify.aim))
    return Problem(target, poses, observations, replace(config, noise=noise), long_errors=True)


def _select_artefact(routine: Routine, samples: Sequence[Sample], X: Array,
                     calibration: Calibration, config: Config) -> tuple[Sequence[Sample], str]:
    """
    Return the samples reduced to the features of the artefact, and how its surface was chosen.

    That is a sentence, '' where there was no choice.
    """
    if any(sample.moving for sample in samples):
        samples = _with_calibrated_times(samples, calibration, config)
    T = mount_poses_of(samples, config) @ X
    if config.verify.near:
        samples = _crop_to_ball(samples, T, config)
    if routine.target == 'plane':
        return _select_nearest_surface(samples, T, config.profile.range_sign)
    return samples, ''


def stations_of_passes(passes: Iterable[tuple[Sequence[Profile], Trajectory]],
                       calibration: Calibration, config: Config) -> StationSet:
    """
    Return some points of the profiles of each pass, each with its own pose.

    The robot's error is taken to be one for the whole pass.
    """
    parts, noise = [NO_OBSERVATIONS], np.array([[0.0, 0.0], [config.noise.sensor, 0.0]])
    poses, stamps, counts = list[Array](), list[int](), list[int]()
    offset = config.offset_ns
    for profiles, trajectory in passes:
        flange = trajectory.at(np.array([p.stamp + offset for p in profiles], dtype=np.int64),
                               calibration.rotation_lag)
        usable = np.flatnonzero(flange.inside)
        usable = usable[even_indices(len(usable), PASS_PROFILES)]
        for number, index in enumerate(usable.tolist(), len(stamps)):
            valid = profiles[index].points[has_return(profiles[index].points)]
            points = valid[even_indices(len(valid), POINTS_OF_PROFILE)]
            parts.append(observations_at(
                number, points, 0, np.repeat(noise[None], len(points), axis=0), number))
        poses.append(flange.T_base_flange[usable])
        stamps += [profiles[index].stamp for index in usable.tolist()]
        counts.append(len(usable))
    problem = _problem(TARGETS['plane'], mount_poses(np.concatenate(poses), config),
                       Observations.concatenated(parts), config, is_face=False)
    return StationSet(problem, np.array(stamps, dtype=np.int64), tuple(counts),
                      np.repeat(np.arange(len(counts)), counts))


def _observations(routine: Routine, samples: Sequence[Sample], T: Array) -> Observations:
    """
    Return the conditions of a routine; T: (n, 4, 4) sensor planes in the base.

    Of edge points the one of each station that is nearest to a common line or point takes part:
    two distances from the line, three from the point.
    """
    if not routine.edge_distances:
        return TARGETS[routine.target].observe(samples)
    stop, edges, ends = _features_with_stops(samples, T, EdgePoint)
    distances, _ = _distances_from_common(ends, stop, 3 - routine.edge_distances)
    parts = [NO_OBSERVATIONS]
    for number in np.unique(stop).tolist():
        edge = edges[min(np.flatnonzero(stop == number), key=distances.__getitem__)]
        for direction in range(routine.edge_distances):
            parts.append(observations_at(
                number, edge.point[None], direction, edge_error_root(edge)[None]))
    return Observations.concatenated(parts)


def _features_with_stops(samples: Sequence[Sample], T: Array, feature_type: type[FeatureKind]
                         ) -> tuple[Indices, list[FeatureKind], Array]:
    """
    Return the stop (k,) of each feature of a type, these features, and their ends (k, 2, 3).

    The ends are in the base; T: (n, 4, 4) sensor planes of the n samples.
    """
    pairs = [(stop, feature) for stop, sample in enumerate(samples)
             for feature in sample.features if isinstance(feature, feature_type)]
    return (np.array([stop for stop, _ in pairs], dtype=np.intp),
            [feature for _, feature in pairs],
            np.array([_ends_in_base(feature, T[stop]) for stop, feature in pairs]))


def _distances_from_common(points: Array, stop: Indices, dimension: int) -> tuple[Array, Array]:
    """
    Return the distance of each feature (k,) from the point, line or plane that the stops share.

    Return the distance of the nearest feature of each stop (s,) too. Evenly chosen pairs of
    features of different stops, MIN_TRIALS or up to twice as many, define a point, line or plane
    each: the best is near at least one feature of most stops.

    points: (k, n, 3) of each feature; stop: (k,) its stop, ascending; dimension: 0 for a point, 1
    for a line, 2 for a plane.
    """
    first = np.unique(stop, return_index=True)[1]
    best, lowest = (np.full(len(stop), np.inf), np.full(len(first), np.inf)), np.inf
    pairs = [pair for pair in combinations(range(len(stop)), 2) if stop[pair[0]] != stop[pair[1]]]
    for pair in pairs[::max(len(pairs) // MIN_TRIALS, 1)]:
        defining = points[list(pair)].reshape(-1, 3)
        middle = defining.mean(axis=0)
        along = np.linalg.svd(defining - middle)[2][:dimension]
        offset = points - middle
        distances = np.linalg.norm(offset - offset @ along.T @ along, axis=2).max(axis=1)
        nearest = np.minimum.reduceat(distances, first)
        cost = float(np.median(nearest) + 0.1 * nearest.mean())
        if cost < lowest:
            best, lowest = (distances, nearest), cost
    return best


def _ends_in_base(feature: Feature, T: Array) -> Array:
    """Return the first and last point (2, 3) of a feature in the base; T: (4, 4) sensor plane."""
    return np.asarray(feature.polyline[[0, -1]] @ T[:3, [0, 2]].T + T[:3, 3])


def _crop_to_ball(samples: Sequence[Sample], T: Array, config: Config) -> list[Sample]:
    """
    Return the samples with only the features that come into a ball.

    T: (n, 4, 4) sensor planes in the base; verify.near has x, y, z and radius of the ball.
    """
    region = config.verify.near

    def is_inside(feature: Feature, T: Array) -> bool:
        first, last = _ends_in_base(feature, T) - np.array(region[:3])
        segment = last - first
        fraction = np.clip(-first @ segment / max(segment @ segment, 1e-30), 0.0, 1.0)
        return bool(np.linalg.norm(first + fraction * segment) <= region[3])

    inside = [replace(sample, features=tuple(f for f in sample.features if is_inside(f, plane)))
              for sample, plane in zip(samples, T, strict=True)]
    if samples and not any(sample.features for sample in inside):
        raise DataError(f'verify.near leaves nothing of the {len(samples)} stops: set it to a '
                        f'point of the artefact in {target_frame(config)} and a radius, in metres')
    return inside


def _select_nearest_surface(samples: Sequence[Sample], T: Array, range_sign: int
                            ) -> tuple[Sequence[Sample], str]:
    """
    Return the samples with the pieces of one surface only, and a sentence on which it is.

    The surface is the plane nearest to the sensor of those seen from MIN_SEEN_SHARE of the stops
    that show any piece, and from MIN_STATIONS; without one all pieces take part, and the sentence
    is ''. T: (n, 4, 4) sensor planes in the base.
    """
    stop, pieces, ends = _features_with_stops(samples, T, FaceLine)
    if len(pieces) == len(np.unique(stop)):
        return samples, ''
    depth = range_sign * np.array([piece.centre[1] for piece in pieces])
    # one plane after the other, each of the pieces that are on none of those before
    left, surfaces = np.arange(len(pieces)), list[Indices]()
    least = max(MIN_SEEN_SHARE * len(np.unique(stop)), MIN_STATIONS)
    while len(np.unique(stop[left])) >= least:
        distances, nearest = _distances_from_common(ends[left], stop[left], 2)
        on_plane = distances <= max(SAME_SURFACE_DISTANCE, FAR_RATIO * float(np.median(nearest)))
        if len(np.unique(stop[left[on_plane]])) >= least:
            surfaces.append(left[on_plane])
        left = left[~on_plane]
    if not surfaces:
        return samples, ''
    chosen = min(surfaces, key=lambda surface: np.median(depth[surface]))
    sentence = '' if len(surfaces) < 2 else (
        f'of {len(surfaces)} surfaces in sight it is the nearest, '
        f'{1e3 * abs(np.median(depth[chosen])):.0f} mm from the sensor, at '
        f'{len(np.unique(stop[chosen]))} of {len(samples)} stops')
    return [replace(sample, features=tuple(pieces[k] for k in chosen[stop[chosen] == number]))
            for number, sample in enumerate(samples)], sentence


def _with_calibrated_times(samples: Sequence[Sample], calibration: Calibration, config: Config
                           ) -> list[Sample]:
    """
    Return some samples of a moving robot, with the poses at the calibration's time offset.

    Raises InputError where neither the calibration nor the settings know it.
    """
    samples = evenly_spaced(passes_expanded(samples), SWEEP_SAMPLES)
    offset = calibration.time_offset
    if offset is None and config.time_offset_std > KNOWN_OFFSET_STD:
        raise InputError('the calibration has no time offset, which a sweep needs: verify with '
                         'stops, calibrate with a sweep, or state time_offset and time_offset_std '
                         f'({KNOWN_OFFSET_STD * 1e3:g} ms or less)')
    flange = ClockedPoses(samples).at(offset.value - config.time_offset if offset else 0.0,
                                      calibration.rotation_lag)
    return [replace(sample, T_base_flange=T, trajectory=None)
            for sample, T in zip(samples, flange.T_base_flange, strict=True)]
