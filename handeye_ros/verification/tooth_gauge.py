# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A gauge of equal teeth in scanned points: its position, and the face of each point.

The direction of the row is that across which the heights agree best; the phase is that at which
the nominal teeth fit best. Points near a corner, and points of no face, take no part.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.config import Config, VerifyConfig
from handeye_ros.data import Array, Profile
from handeye_ros.errors import DataError, mm
from handeye_ros.estimation.problem import Observations
from handeye_ros.frames import in_mount
from handeye_ros.sampling.trajectory import Trajectory
from handeye_ros.verification.shapes import BAGS, by_point, Kinds, Shape, StationSet, system_of
import numpy as np
from numpy.typing import NDArray

TOP, VALLEY, RISING, FALLING = 0, 1, 2, 3
PROFILES, POINTS = 12, 80  # of a pass that are used, and of each of them
CORNER = 0.12  # of the height: nearer to a corner no point is used
FAR = 0.15  # of the height: a point further from all faces is on none
BIN = 0.05  # of the pitch
CUT = 4.0  # sigmas of the points of a face
ROUNDING = 0.1  # of the sensor's noise: the smallest scatter assumed when outliers are removed
LEAST_SHARE = 0.2  # of the points must be on the gauge
LEAST_FACE = 0.01  # of the points must be on tops and valleys, and on flanks
ROUNDS = 6
GRAZING = 0.05  # cosine of a face to the ray, at least


def stations_of_pass(profiles: Sequence[Profile], track: Trajectory, config: Config) -> StationSet:
    """
    Return some points of the profiles of a pass, each with its own pose.

    The robot's error is taken to be one for the whole pass.
    """
    offset = round(config.time_offset * 1e9)
    flange = track.at(np.array([p.stamp + offset for p in profiles], dtype=np.int64))
    T = in_mount(flange.T_base_flange[flange.inside], config)
    used = [p for p, inside in zip(profiles, flange.inside, strict=True) if inside]
    chosen = np.unique(np.linspace(0, max(len(used) - 1, 0), PROFILES).astype(int))[:len(used)]
    points, station = [], []
    for k, index in enumerate(chosen):
        valid = used[index].points[np.isfinite(used[index].points).all(axis=1)]
        rows = np.unique(np.linspace(0, max(len(valid) - 1, 0), POINTS).astype(int))[:len(valid)]
        points.append(valid[rows])
        station.append(np.full(len(rows), k))
    count = sum(map(len, station))
    L = np.zeros((count, 2, 2))
    L[:, 1, 0] = config.noise.sensor
    obs = Observations(np.concatenate([np.empty(0, np.intp), *station]).astype(np.intp),
                       np.concatenate([np.empty((0, 2)), *points]),
                       np.zeros(count, np.intp), L, np.arange(count))
    return StationSet(T[chosen], obs, np.zeros(len(chosen), dtype=np.intp))


def fitted(stations: StationSet, p: Array, nominal: VerifyConfig) -> tuple[StationSet, Shape]:
    """
    Return the points (m, 3) on the gauge, their faces, and the shape.

    Raises DataError where they lie on no such teeth.
    """
    pitch, height = nominal.lengths
    flank = nominal.flank or pitch / 4
    frame = _frame(p, pitch, height, flank)
    q = np.zeros(9)
    q[8] = flank / height
    for _ in range(ROUNDS):
        kind, tooth, on_gauge = _faces(_local(p, frame, q), pitch, height, q)
        if on_gauge.mean() < LEAST_SHARE:
            break
        shape = _shape(frame, pitch, height, tooth[on_gauge], q)
        q = system_of(shape, p[on_gauge], kind[on_gauge]).least_squares(q, iterations=1)
    top, valley, *flanks = np.bincount(kind[on_gauge], minlength=4) / len(p)
    least = float(min(top + valley, sum(flanks)))
    if on_gauge.mean() < LEAST_SHARE or least < LEAST_FACE:
        raise DataError(
            f'this is not the gauge: {on_gauge.mean():.0%} of the points lie on teeth of pitch '
            f'{mm(pitch)} and height {mm(height)}, and {least:.1%} on their flats or on their '
            'flanks. Give both lengths (verify.lengths=[PITCH, HEIGHT]), and scan the gauge alone')
    obs = stations.observations
    least = ROUNDING * float(np.median(obs.noise[on_gauge, 1, 0]))
    by_p = by_point(shape, p[on_gauge], kind[on_gauge], q)
    by_range = np.abs((by_p * _rays(stations, p)[on_gauge]).sum(axis=1))
    on_gauge, scale = _cleaned(
        shape.distance(p[on_gauge], kind[on_gauge], q), np.maximum(by_range, GRAZING), on_gauge,
        np.stack([obs.kind // BAGS, kind, tooth], axis=1), least)
    chosen = obs.select(on_gauge)
    noise = np.zeros_like(chosen.noise)
    noise[:, 1, 0] = np.maximum(chosen.noise[:, 1, 0], scale)
    chosen = replace(chosen, noise=noise, kind=kind[on_gauge] + chosen.kind // BAGS * BAGS)
    return replace(stations, observations=chosen), _shape(frame, pitch, height, tooth[on_gauge], q)


def _rays(stations: StationSet, p: Array) -> Array:
    """Return the direction (m, 3) in which each point moves with increasing range."""
    T, obs = stations.poses[stations.observations.station], stations.observations
    in_mount = np.einsum('mji,mj->mi', T[:, :3, :3], p - T[:, :3, 3])
    plane = np.linalg.lstsq(np.column_stack([obs.points, np.ones(len(p))]), in_mount,
                            rcond=None)[0]
    return np.asarray(T[:, :3, :3] @ plane[1])


def _cleaned(distances: Array, by_range: Array, candidates: NDArray[np.bool_],
             face: NDArray[np.intp], min_scatter: float) -> tuple[NDArray[np.bool_], Array]:
    """
    Return which points (m,) are no outliers of their pass and face, and the noise (k,).

    distances: of the candidates, by_range: their derivatives; face: (m, 3) pass, kind and tooth;
    min_scatter: the smallest scatter assumed (m). A sensor measures steep faces worse than it
    states, so the noise is the scatter of the points of a pass about their own mean.
    """
    rows = np.flatnonzero(candidates)
    group = np.unique(face[rows], axis=0, return_inverse=True)[1]
    group = group.reshape(-1)  # numpy 2.0 alone returns it as a column
    good, noise = np.zeros(len(rows), dtype=bool), np.zeros(len(rows))
    for k in range(group.max() + 1):
        members = np.flatnonzero(group == k)
        deviation = distances[members] - np.median(distances[members])
        scatter = max(1.4826 * float(np.median(np.abs(deviation))), min_scatter)
        inliers = np.abs(deviation) <= CUT * scatter
        count = int(inliers.sum())
        # about a mean and a slope of their own
        scatter = deviation[inliers].std() * np.sqrt(count / max(count - 2, 1))
        good[members[inliers]], noise[members] = True, scatter / np.median(by_range[members])
    clean = np.zeros_like(candidates)
    clean[rows[good]] = True
    return clean, noise[good]


def _local(p: Array, frame: Array, q: Array) -> Array:
    """Return points in the gauge's frame (m, 3), moved by the first five unknowns."""
    in_frame = se3.apply(se3.inverse(frame), p)
    return np.asarray(in_frame @ se3.exp_rotation(q[:3]).T + [q[3], 0.0, q[4]])


def _shape(frame: Array, pitch: float, height: float, tooth: NDArray[np.intp], start: Array
           ) -> Shape:
    """
    Return the teeth as a shape; tooth: (m,) the tooth of each point on a flank.

    Unknowns: rotation, x and z of the gauge, the deviations of pitch and height from nominal, the
    outward offset of the flanks, and their slope (horizontal distance per height).
    """
    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        x, _, z = _local(p, frame, q).T
        face = kind % BAGS
        side = np.where(face == RISING, -1.0, 1.0)
        out = side * (x - (pitch + q[5]) * tooth) - (pitch / 4 + q[7])
        flank = (out + q[8] * (z - height / 2)) / np.hypot(1.0, q[8])
        return np.asarray(np.where(face == TOP, z - height - q[6],
                                   np.where(face == VALLEY, z, flank)))

    return Shape(start, distance, lambda q: np.array([pitch + q[5], height + q[6]]),
                 (pitch, height))


def _faces(local: Array, pitch: float, height: float, q: Array
           ) -> tuple[Kinds, NDArray[np.intp], NDArray[np.bool_]]:
    """Return face and tooth of each point, and which points are clearly of one."""
    x, z = local[:, 0], local[:, 2]
    tooth = np.round(x / (pitch + q[5])).astype(np.intp)
    u = x - (pitch + q[5]) * tooth
    slope, middle, margin = abs(q[8]), pitch / 4 + q[7], CORNER * height
    out = np.abs(u) - middle  # past the middle of the flank
    reach = slope * height / 2
    on_top, in_valley = out < -reach - margin, out > reach + margin
    on_flank = np.abs(z - height / 2) < height / 2 - margin
    kind = np.where(on_top, TOP, np.where(in_valley, VALLEY, np.where(u < 0, RISING, FALLING)))
    distance = np.where(on_top, z - height, np.where(in_valley, z, out + slope * (z - height / 2)))
    on_face = (on_top | in_valley | on_flank & (np.abs(out) < reach + margin)) & (
        np.abs(distance) < FAR * height)
    return kind.astype(np.intp), tooth, on_face


def _frame(p: Array, pitch: float, height: float, flank: float) -> Array:
    """
    Return the approximate pose of the gauge in the base (4, 4).

    Which way it is up does not matter: teeth and gaps have the same pitch and height.
    """
    middle = p.mean(axis=0)
    z = np.linalg.svd((p - middle)[::max(len(p) // 3000, 1)], full_matrices=False)[2][2]
    side = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.7 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    flat = np.column_stack([side, np.cross(z, side), z])
    local = (p - middle) @ flat

    def spread(turn: float) -> float:
        return _unevenness(local, turn, BIN * pitch)

    turns = np.deg2rad(np.arange(0.0, 180.0, 2.0))
    turn = min(turns, key=spread)
    for size in (0.5, 0.1):
        turn = min(turn + np.deg2rad(size * np.arange(-5, 6)), key=spread)
    R = flat @ np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0],
                         [0, 0, 1]])
    local = (p - middle) @ R
    low, high = np.quantile(local[:, 2], [0.02, 0.98])
    local[:, 2] += height / 2 - (low + high) / 2
    phases = np.linspace(0, pitch, 120, endpoint=False)
    away = [np.median(np.abs(local[:, 2] - _height(local[:, 0] - v, pitch, height, flank)))
            for v in phases]
    shift = np.array([phases[int(np.argmin(away))], 0.0, (low + high) / 2 - height / 2])
    return se3.transform(R, middle + R @ shift)


def _unevenness(local: Array, turn: float, size: float) -> float:
    """Return the variance of the heights within strips across a direction."""
    x = local[:, 0] * np.cos(turn) + local[:, 1] * np.sin(turn)
    strip = np.floor((x - x.min()) / size).astype(int)
    count = np.bincount(strip)
    mean = np.bincount(strip, local[:, 2]) / np.maximum(count, 1)
    return float(((local[:, 2] - mean[strip]) ** 2).mean())


def _height(x: Array, pitch: float, height: float, flank: float) -> Array:
    """Return the height of nominal teeth at x."""
    out = np.abs((x + pitch / 2) % pitch - pitch / 2) - pitch / 4
    return np.asarray(np.clip(0.5 - out / flank, 0.0, 1.0) * height)
