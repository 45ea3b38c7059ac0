# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A gauge of equal teeth in scanned points: its position, and the face of each point.

The direction of the row is that across which the heights agree best; the phase is that at which
the nominal teeth fit best. Points near a corner, and points of no face, take no part.
"""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.arithmetic import robust_std
from handeye_ros.config import VerifyConfig
from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError
from handeye_ros.verification.fit import Quantity, Shape
from handeye_ros.verification.station_set import StationSet
from handeye_ros.words import mm
import numpy as np
from numpy.typing import NDArray

TOP, VALLEY, RISING, FALLING = 0, 1, 2, 3
# Of the unknowns: how much pitch and height are larger than nominal, the outward offset of the
# flanks (m), and their slope (horizontal distance per height).
TEETH = slice(5, 9)
CORNER_SHARE = 0.12  # of the height: nearer to a corner no point is used
OFF_ALL_FACES = 0.15  # of the height: a point further from all faces is on none
BIN_WIDTH = 0.05  # of the pitch
OUTLIER_SIGMAS = 4.0  # sigmas of the points of a face
# of the sensor's noise: the smallest scatter assumed when outliers are removed
MIN_SCATTER = 0.1
MIN_SHARE_ON_GAUGE = 0.2  # of the points must be on the gauge
MIN_FACE_SHARE = 0.01  # of the points must be on tops and valleys, and on flanks
ROUND_COUNT = 6
MIN_COSINE = 0.05  # cosine of a face to the ray, at least


def teeth(stations: StationSet, X: Array, settings: VerifyConfig) -> Shape:
    """
    Return the teeth, and the stations with the points on them only, whose kind is their face.

    Raises DataError where they lie on no such teeth.
    """
    pitch, height = settings.lengths
    flank_length = settings.flank or pitch / 4
    p = stations.problem.points_in_base(X)
    frame = _frame(p, pitch, height, flank_length)
    q = np.append(np.zeros(8), flank_length / height)
    for _ in range(ROUND_COUNT):
        rows, face, tooth = _faces(_local(p, frame, q), pitch, height, q)
        share = len(rows) / len(p)
        if share < MIN_SHARE_ON_GAUGE:
            break
        obs = replace(stations.observations.select(rows), kind=face)
        shape = _shape(stations.with_observations(obs), frame, pitch, height, tooth, q)
        q = shape.fit_unknowns(p[rows], iterations=1)
    top, valley, *flanks = np.bincount(face, minlength=4) / len(p)
    least = float(min(top + valley, sum(flanks)))
    if share < MIN_SHARE_ON_GAUGE or least < MIN_FACE_SHARE:
        raise DataError(
            f'this is not the gauge: {share:.0%} of the points lie on teeth of pitch '
            f'{mm(pitch)} and height {mm(height)}, and {least:.1%} on their flats or on their '
            'flanks. Give both lengths (verify.lengths=[PITCH, HEIGHT]), and scan the gauge alone')
    stations, p = shape.stations, p[rows]
    rays = stations.problem.mounts_of_rows[0] @ X[:3, 2]
    wrt_range = np.abs((shape.wrt_point(p, q) * rays).sum(axis=1))
    good, noise = _without_outliers(
        shape.distance(p, q), np.maximum(wrt_range, MIN_COSINE),
        np.stack([stations.recording_of_point, face, tooth], axis=1),
        MIN_SCATTER * float(np.median(stations.observations.error_root[:, 1, 0])))
    obs = stations.observations.select(good)
    root = np.zeros_like(obs.error_root)
    root[:, 1, 0] = np.maximum(obs.error_root[:, 1, 0], noise[good])
    stations = stations.with_observations(replace(obs, error_root=root))
    return _shape(stations, frame, pitch, height, tooth[good], q)


def _without_outliers(distances: Array, wrt_range: Array, group_key: Indices, min_scatter: float
                      ) -> tuple[NDArray[np.bool_], Array]:
    """
    Return which points (m,) are no outliers of their pass and face, and their noise (m,).

    wrt_range: derivatives of the distances; group_key: (m, 3) pass, face and tooth; min_scatter:
    the smallest scatter assumed (m). A sensor measures steep faces worse than it states, so the
    noise is the scatter of the points of a pass about their own mean.
    """
    # numpy 2.0 alone returns a column
    group = np.unique(group_key, axis=0, return_inverse=True)[1].ravel()
    good, noise = np.zeros(len(group), dtype=bool), np.zeros(len(group))
    for k in range(group.max() + 1):
        members = np.flatnonzero(group == k)
        deviation = distances[members] - np.median(distances[members])
        scatter = max(robust_std(deviation), min_scatter)
        inliers = np.abs(deviation) <= OUTLIER_SIGMAS * scatter
        count = int(inliers.sum())
        # about a mean and a slope of their own
        scatter = deviation[inliers].std() * np.sqrt(count / max(count - 2, 1))
        good[members[inliers]], noise[members] = True, scatter / np.median(wrt_range[members])
    return good, noise


def _local(p: Array, frame: Array, q: Array) -> Array:
    """Return points (m, 3) in the frame of the gauge, as its unknowns move it."""
    rotation, (x, z) = q[:3], q[3:5]
    in_frame = se3.apply(se3.inverse(frame), p)
    return np.asarray(in_frame @ se3.exp_rotation(rotation).T + [x, 0.0, z])


def _shape(stations: StationSet, frame: Array, pitch: float, height: float, tooth: Indices,
           start: Array) -> Shape:
    """
    Return the teeth as a shape; tooth: (m,) the tooth of each point on a flank.

    Unknowns (9,): rotation, x and z of the gauge, and TEETH.
    """
    face = stations.observations.kind
    side = np.where(face == RISING, -1.0, 1.0)

    def distance(p: Array, q: Array) -> Array:
        x, _, z = _local(p, frame, q).T
        pitch_off, height_off, outwards, slope = q[TEETH]
        out = side * (x - (pitch + pitch_off) * tooth) - (pitch / 4 + outwards)
        from_flank = (out + slope * (z - height / 2)) / np.hypot(1.0, slope)
        return np.asarray(np.where(face == TOP, z - height - height_off,
                                   np.where(face == VALLEY, z, from_flank)))

    return Shape(stations, start, distance, lambda q: [pitch, height] + q[TEETH][:2],
                 (Quantity('pitch', nominal=pitch, characteristic='E'),
                  Quantity('height', nominal=height, characteristic='E')))


def _faces(local: Array, pitch: float, height: float, q: Array
           ) -> tuple[Indices, Indices, Indices]:
    """
    Return the rows (k,) of the points that clearly lie on a face, with face and tooth of each.

    The face (k,) is TOP, VALLEY, RISING or FALLING, the tooth (k,) its number.
    """
    x, z = local[:, 0], local[:, 2]
    pitch_off, _, outwards, slope = q[TEETH]
    tooth = np.round(x / (pitch + pitch_off)).astype(np.intp)
    from_middle = x - (pitch + pitch_off) * tooth  # of its tooth
    slope, margin = abs(slope), CORNER_SHARE * height
    out = np.abs(from_middle) - (pitch / 4 + outwards)  # past the middle of the flank
    reach = slope * height / 2
    on_top, in_valley = out < -reach - margin, out > reach + margin
    on_flank = np.abs(z - height / 2) < height / 2 - margin
    flank_label = np.where(from_middle < 0, RISING, FALLING)
    face = np.where(on_top, TOP, np.where(in_valley, VALLEY, flank_label))
    distance = np.where(on_top, z - height, np.where(in_valley, z, out + slope * (z - height / 2)))
    rows = np.flatnonzero((np.abs(distance) < OFF_ALL_FACES * height) & (
        on_top | in_valley | on_flank & (np.abs(out) < reach + margin)))
    return rows, face[rows].astype(np.intp), tooth[rows]


def _frame(p: Array, pitch: float, height: float, flank_length: float) -> Array:
    """
    Return the approximate pose of the gauge in the base (4, 4).

    Which way it is up does not matter: teeth and gaps have the same pitch and height.
    """
    middle = p.mean(axis=0)
    flat = np.linalg.svd((p - middle)[::max(len(p) // 3000, 1)], full_matrices=False)[2].T
    flat[:, 0] *= np.linalg.det(flat)
    local = (p - middle) @ flat

    def unevenness(turn: float) -> float:
        """Return the variance of the heights within strips across a direction."""
        x = local[:, 0] * np.cos(turn) + local[:, 1] * np.sin(turn)
        strip = np.floor((x - x.min()) / (BIN_WIDTH * pitch)).astype(int)
        mean = np.bincount(strip, local[:, 2]) / np.maximum(np.bincount(strip), 1)
        return float(((local[:, 2] - mean[strip]) ** 2).mean())

    turn = min(np.deg2rad(np.arange(0.0, 180.0, 2.0)), key=unevenness)
    for size in (0.5, 0.1):
        turn = min(turn + np.deg2rad(size * np.arange(-5, 6)), key=unevenness)
    R = flat @ se3.exp_rotation(np.array([0.0, 0.0, turn]))
    x, _, z = ((p - middle) @ R).T
    low, high = np.quantile(z, [0.02, 0.98])
    z = z + height / 2 - (low + high) / 2

    def misfit(phase: float) -> float:
        """Return the median distance of the heights from those of nominal teeth."""
        out = np.abs((x - phase + pitch / 2) % pitch - pitch / 2) - pitch / 4
        return float(np.median(np.abs(z - np.clip(0.5 - out / flank_length, 0.0, 1.0) * height)))

    phase = min(np.linspace(0, pitch, 120, endpoint=False), key=misfit)
    return se3.transform(R, middle + R @ [phase, 0.0, (low + high) / 2 - height / 2])
