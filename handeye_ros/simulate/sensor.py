# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The profiler: what its columns see, its own errors, and the frame in which its driver sends."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.simulate.solids import cast, hidden, Relief, Solid
import numpy as np
from numpy.polynomial.legendre import legval2d
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, gaussian_filter1d

CHUNK_PROFILES = 32  # profiles cast at once, so that the arrays stay in the cache
EDGE_COLUMNS = 3  # on either side of a step, where more points are lost
SPECKLE_COLUMNS = 5.0  # 1 sigma of the filter that correlates the speckle of neighbours


def tangent(points: Array) -> Array:
    """Return the tangent x / z of the ray's angle of points (..., 2) in the sensor plane."""
    return np.asarray(points[..., 0] / points[..., 1])


def lift(points: Array) -> Array:
    """Return points (..., 2) of the standard sensor plane as 3D points."""
    return np.stack([points[..., 0], np.zeros(points.shape[:-1]), points[..., 1]], axis=-1)


def rays(sensor: SensorModel) -> tuple[Array, Array]:
    """
    Return origins and directions (3, n) of the rays of the columns, standard sensor frame.

    The directions have z = 1, so that the parameter of a point on a ray is its range (m).
    """
    zeros, ones = np.zeros(sensor.columns), np.ones(sensor.columns)
    along = np.linspace(-1, 1, sensor.columns)
    across, bent = along * sensor.half_width, along ** 2 * sensor.line_bend
    if sensor.sampling == 'fan':
        middle = sum(sensor.range) / 2
        return np.stack([zeros, zeros, zeros]), np.stack([across, bent / middle, ones])
    return np.stack([across * sensor.range[1], bent, zeros]), np.stack([zeros, zeros, ones])


def render(sensor: SensorModel, solids: Sequence[Solid], T: Array,
           relief: Relief | None = None) -> tuple[Array, Array]:
    """
    Return exact ranges and angles of incidence (m, n) of the columns, NaN without a return.

    T: (m, 4, 4) T_target_sensor; the solids are in the target frame. relief: heights that are
    added to the solids at the intersection of a ray with z = 0, None: none.
    """
    ranges, angles = np.empty((2, len(T), sensor.columns))
    for k in range(0, len(T), CHUNK_PROFILES):
        part = slice(k, k + CHUNK_PROFILES)
        ranges[part], angles[part] = _render(sensor, solids, T[part], relief)
    return ranges, angles


def _render(sensor: SensorModel, solids: Sequence[Solid], T: Array, relief: Relief | None
            ) -> tuple[Array, Array]:
    origin, direction = rays(sensor)
    o = np.einsum('mij,jn->imn', T[:, :3, :3], origin) + T[:, :3, 3].T[:, :, None]
    d = np.einsum('mij,jn->imn', T[:, :3, :3], direction)
    raised: Array | float = 0.0
    if relief:  # lower the ray instead of raising the solids, for each ray separately
        at_face = -o[2] / np.where(np.abs(d[2]) > 1e-6, d[2], 1e-6)
        raised = relief(o[0] + at_face * d[0], o[1] + at_face * d[1])
    o[2] -= raised
    z, cosine = cast(solids, o, d)
    angle = np.arccos(np.clip(cosine, 0, 1))
    near, far = sensor.range
    x = origin[0] + direction[0] * np.where(np.isfinite(z), z, 0)
    visible = (z > near) & (z < far) & (np.abs(x) <= sensor.half_width * z * (1 + 1e-12))
    visible &= angle < sensor.max_incidence
    camera = T[:, :3, :3] @ [0.0, *sensor.camera] + T[:, :3, 3]
    points = o + d * np.where(visible, z, near)
    for eye in (camera, T[:, :3, 3]) if sensor.sampling == 'fan_x' else (camera,):
        lowered = eye.T[:, :, None] - np.array([0.0, 0.0, 1.0])[:, None, None] * raised
        visible &= ~hidden(solids, points, lowered)
    return np.where(visible, z, np.nan), np.where(visible, angle, np.nan)


def measure(sensor: SensorModel, z: Array, angle: Array, rng: Generator,
            distortion: Distortion | None = None) -> Array:
    """Return the reported ranges (m, n) of exact ones (m) and their angles of incidence (rad)."""
    rim = (angle / sensor.max_incidence)**8
    noise = sensor.noise * (1 + 4 * rim) * rng.normal(size=z.shape)
    exact = z + distortion.range_errors(z) if distortion else z
    measured = exact + noise + sensor.rim_bias * rim**4
    row, before = np.nonzero(steps(sensor, z))
    # a point between the two levels at some of the steps
    column, fraction = before + rng.integers(0, 2, len(before)), rng.random(len(before))
    level = measured[row, before] * fraction + measured[row, before + 1] * (1 - fraction)
    is_mixed = np.isfinite(level) & (rng.random(len(before)) < sensor.mixed)
    measured[row[is_mixed], column[is_mixed]] = level[is_mixed]
    # lost points, more of them near steps
    probability = np.full(z.shape, sensor.lost)
    for shift in range(1 - EDGE_COLUMNS, EDGE_COLUMNS + 1):
        probability[row, np.clip(before + shift, 0, z.shape[1] - 1)] = sensor.lost_at_edge
    measured[rng.random(z.shape) < probability] = np.nan
    # points off by up to 5 mm, and false returns
    probability = np.where(np.isfinite(measured), sensor.outliers, sensor.outliers / 5)
    row, column = np.nonzero(rng.random(measured.shape) < probability)
    wrong = measured[row, column] + rng.uniform(-5e-3, 5e-3, len(row))
    anywhere = rng.uniform(*sensor.range, len(row))
    measured[row, column] = np.clip(np.where(np.isfinite(wrong), wrong, anywhere), *sensor.range)
    # a short piece of some profiles, 3-8 mm nearer
    width = max(3, sensor.columns // 40)
    for profile in np.nonzero(rng.random(len(measured)) < sensor.reflections)[0]:
        start = rng.integers(0, sensor.columns - width)
        piece = measured[profile, start:start + width]
        piece[:] = np.maximum(piece - rng.uniform(3e-3, 8e-3), sensor.range[0])
    return _smoothed(sensor, measured)


def steps(sensor: SensorModel, z: Array) -> NDArray[np.bool_]:
    """Return (m, n - 1) whether the range jumps, or the light ends, between two columns."""
    pitch = 2 * sensor.half_width * sensor.range[1] / sensor.columns
    jump = np.abs(np.diff(z, axis=1)) > max(3e-4, 6 * pitch)
    visible = np.isfinite(z)
    return np.asarray(jump | (visible[:, 1:] != visible[:, :-1]))


def plane_points(sensor: SensorModel, ranges: Array, distortion: Distortion | None = None
                 ) -> Array:
    """Return the points (m, n, 2) of ranges (m, n) in the standard sensor plane (m)."""
    origin, direction = rays(sensor)
    points = np.stack([origin[0] + direction[0] * ranges, ranges], axis=-1)
    if distortion:
        points = distortion.scaled(points)
    if sensor.resolution:
        points = np.round(points / sensor.resolution) * sensor.resolution
    return points


GROUND_HEIGHT = -2e-4  # m over the target's face: lower points are on another surface
SPOT_SIGMAS = 2.5  # sigmas of a spot
FAINTEST = 0.15  # smallest visible fraction of a spot on one surface, times its brightness


def blurred(sensor: SensorModel, z: Array, T: Array) -> Array:
    """
    Return ranges (m, n) for a spot of finite width.

    T: (m, 4, 4) T_target_sensor. The camera measures the brighter of two surfaces under one spot,
    at the middle of its lit part.
    """
    across = np.linspace(-1, 1, z.shape[1]) * sensor.half_width
    height = T[:, 2, :1] * across * z + T[:, 2, 2:3] * z + T[:, 2, 3:]
    pitch = 2 * sensor.half_width * np.mean(sensor.range) / sensor.columns
    reach = int(np.ceil(SPOT_SIGMAS * sensor.spot / pitch))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * pitch / sensor.spot)**2)
    kernel /= kernel.sum()
    visible, on_target = np.isfinite(z), height > GROUND_HEIGHT
    best, result = np.full(z.shape, FAINTEST), np.full(z.shape, np.nan)
    for lit, bright in ((visible & on_target, 1.0), (visible & ~on_target, sensor.ground)):
        fraction, total = _filtered(z, lit, kernel)
        wins = bright * fraction > best
        result[wins] = total[wins] / fraction[wins]
        best = np.where(wins, bright * fraction, best)
    return result


def _filtered(z: Array, lit: NDArray[np.bool_], kernel: Array) -> tuple[Array, Array]:
    """Return the sums of weights, and of weighted ranges, of the lit points of each row."""
    return (convolve1d(lit.astype(float), kernel, axis=1, mode='constant'),
            convolve1d(np.where(lit, z, 0.0), kernel, axis=1, mode='constant'))


def _smoothed(sensor: SensorModel, z: Array) -> Array:
    """Return ranges (m, n) after the mean filter of the driver; missing returns stay missing."""
    if sensor.smoothing < 2:
        return z
    visible = np.isfinite(z)
    count, total = _filtered(z, visible, np.ones(sensor.smoothing))
    return np.where(visible, total / np.maximum(count, 1), np.nan)


def speckle(sensor: SensorModel, shape: tuple[int, ...], rng: Generator) -> Array:
    """Return range errors (m) of a shape (m, n), which are correlated along each row."""
    white = rng.normal(size=shape)
    smooth = gaussian_filter1d(white, SPECKLE_COLUMNS, axis=1, mode='wrap')
    return np.asarray(sensor.speckle * smooth / smooth.std())


GRID_POINTS = 21  # points along each side of the field


@dataclass(frozen=True, eq=False)
class Distortion:
    """
    Errors of the sensor that do not change: of the range, and of the scale (SensorModel.scale).

    weights: (16,) of the products of Legendre polynomials up to third order, in x and range (m)
    """

    sensor: SensorModel
    weights: Array

    def range_errors(self, z: Array) -> Array:
        """Return the errors (m, n) of ranges z (m, n) (m), one row for each profile."""
        near, far = self.sensor.range
        x = np.linspace(-1, 1, z.shape[1])
        depth = (z - (near + far) / 2) / ((far - near) / 2)
        unit = np.sqrt(2 * np.arange(4) + 1)  # makes each polynomial of RMS 1 over -1 to 1
        weights = self.weights.reshape(4, 4) * np.outer(unit, unit)
        return np.asarray(legval2d(np.broadcast_to(x, z.shape), depth, weights))

    def scaled(self, points: Array) -> Array:
        """Return points (..., 2) of the standard sensor plane with the error of the scale."""
        middle = np.array([0.0, sum(self.sensor.range) / 2])
        return np.asarray(middle + (1 + self.sensor.scale) * (points - middle))

    @property
    def T_true_reported(self) -> Array:
        """Return the motion (4, 4) that best maps reported points of the field to true ones."""
        z, across = np.meshgrid(
            np.linspace(*self.sensor.range, GRID_POINTS),
            np.linspace(-1, 1, GRID_POINTS) * self.sensor.half_width, indexing='ij')
        distorted = z + self.range_errors(z)
        x = across * (distorted if self.sensor.sampling == 'fan' else z)
        true = lift(np.stack([across * z, z], axis=-1)).reshape(-1, 3)
        reported = lift(self.scaled(np.stack([x, distorted], axis=-1))).reshape(-1, 3)
        return se3.align_points(reported, true)


def draw_distortion(sensor: SensorModel, rng: Generator) -> Distortion | None:
    """Return the distortion of a sensor, None without one."""
    if not (sensor.distortion or sensor.scale):
        return None
    weights = rng.normal(size=16)
    return Distortion(sensor, sensor.distortion * weights / np.linalg.norm(weights))


@dataclass(frozen=True, eq=False)
class Frame:
    """
    A published frame.

    T_standard_sensor: (4, 4) pose of the published frame in the standard one (x along the laser
        line, z the range, y = 0)
    axes: of the published frame, along the line and range
    range_sign: -1 if the published range decreases with the distance
    """

    T_standard_sensor: Array
    axes: tuple[str, str] = ('x', 'z')
    range_sign: int = 1

    def published(self, points: Array) -> Array:
        """Return points (..., 2) of the standard sensor plane as this frame publishes them."""
        R, t = self.T_standard_sensor[:3, :3], self.T_standard_sensor[:3, 3]
        in_frame = (lift(points) - t) @ R
        return np.asarray(in_frame[..., ['xyz'.index(axis) for axis in self.axes]])


Z_UP = np.diag([1.0, -1.0, -1.0])
FRAMES = {
    'standard': Frame(np.eye(4)),
    'z_up': Frame(se3.transform(Z_UP, np.array([0, 0, 0.2])), range_sign=-1),
    # zero in the middle of the range, which is counted upwards, and at the left of a wide field
    'off_centre': Frame(se3.transform(Z_UP, np.array([-0.07, 0, 0.275])), range_sign=-1),
    'x_reversed': Frame(se3.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))),
    'y_along_line': Frame(se3.transform(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
                                        np.zeros(3)), axes=('y', 'z')),
}
