# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Smooth functions of few coefficients: of the sensor's plane, of a surface, of the robot's poses.

Those of plane and surface are orthogonal to motions of the sensor and tilts of the surface, which
the unknowns of the problem absorb.
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import eigen
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

# Distances at which the robot's errors have the correlation 0.5: m, rad, s.
POSITION_LENGTH, ROTATION_LENGTH, TIME_LENGTH = 1.0, 1.4, 0.5
BEND_PER_RANGE = 0.2  # by how much more a line is bent at the largest range than in the middle
BEND_OF_S = 0.3  # a line is bent less as an S


def polynomials(uv: Array, degrees: Sequence[int]) -> Array:
    """
    Return products (m, k) of Legendre polynomials at u and v (m, 2), -1 to 1, degree by degree.

    Those of one degree have RMS 1 together over this range.
    """
    norm = np.sqrt(2 * np.arange(max(degrees) + 1) + 1)
    a, b = (legendre.legvander(w, max(degrees)) * norm for w in uv.T)
    return np.concatenate([a[:, :degree + 1] * b[:, degree::-1] / (degree + 1) ** 0.5
                           for degree in degrees], axis=1)


def split_by_degree(columns: Array, degrees: Sequence[int]) -> list[Array]:
    """Return the columns (..., k) of polynomials, split by their degree."""
    return np.split(columns, np.cumsum([degree + 1 for degree in degrees])[:-1], axis=-1)


def normalised(w: Array) -> Array:
    """Return values (m, ...) scaled along the first axis to -1 to 1."""
    low, high = w.min(axis=0), w.max(axis=0)
    return np.asarray((2 * w - low - high) / np.maximum(high - low, 1e-9))


def projected_off(columns: Array, absorbed: Array) -> Array:
    """Return columns (m, k) projected onto the complement of the columns of absorbed (m, j)."""
    return np.asarray(columns - absorbed @ np.linalg.lstsq(absorbed, columns, rcond=1e-5)[0])


def distortion_fields(points: Array, degrees: Sequence[int]) -> list[Array]:
    """
    Return displacement fields (m, 2, k) at points (m, 2) of the sensor plane, one per degree.

    The k fields of one degree have RMS 1 together along each axis, and contain no rigid motion of
    the plane.
    """
    m = len(points)
    along_axes = np.kron(np.eye(2), polynomials(normalised(points), degrees)).astype(float)
    fields = projected_off(along_axes, rigid_displacements(points - points.mean(axis=0)))
    fields = fields.reshape(2, m, 2, -1).swapaxes(0, 1)  # point, axis, terms along x and z
    return [field.reshape(m, 2, -1) for field in split_by_degree(fields, degrees)]


def bent_line(points: Array) -> Array:
    """
    Return heights (m, 3) of a bent light plane at points (m, 2) over the plane that fits best.

    They grow with x^2, by 1 from the middle to the end of the line, with x^2 by the range (light
    that leaves a point is bent more where it is farther), and less with x^3, as an S. The plane
    is that of the field of view.
    """
    middle, half = line_span(points)
    u = (points[:, 0] - middle) / half
    bent = u ** 2 - 1 / 3
    return np.column_stack([bent, BEND_PER_RANGE * bent * normalised(points[:, 1]),
                            BEND_OF_S * (u ** 3 - 3 / 5 * u)])


def line_span(points: Array) -> tuple[float, float]:
    """
    Return x of the middle of the laser line (m), and half its length, by the points (m, 2) seen.

    The field of view is as wide on both sides of x = 0, wherever a target is seen; but where a
    driver publishes x on one side only, its middle is that of the points.
    """
    low, high = points[:, 0].min(), points[:, 0].max()
    middle, half = (0.0, max(-low, high)) if low < 0 < high else ((low + high) / 2,
                                                                  (high - low) / 2)
    return float(middle), max(float(half), 1e-9)


def grid_over(points: Array, ticks: Sequence[float] | Array) -> Array:
    """Return a grid (k, 2) over the bounding box of points (m, 2), scaled to -1 to 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray((low + high) / 2 + grid(ticks) * (high - low) / 2)


def grid(ticks: Sequence[float] | Array) -> Array:
    """Return all pairs (k, 2) of some coordinates."""
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)


def rigid_displacements(points: Array) -> Array:
    """Return the displacements (2 m, 3), all x first, of points (m, 2) under rigid motions."""
    x, z = points.T
    ones, zeros = np.ones(len(x)), np.zeros(len(x))
    return np.concatenate([np.column_stack([ones, zeros, z]), np.column_stack([zeros, ones, -x])])


def bent_surface(p: Array, on_surface: NDArray[np.bool_], degrees: Sequence[int]) -> list[Array]:
    """Return heights (m, k) over the plane through points p[on_surface], each degree of RMS 1."""
    points = p[on_surface]
    if len(points) <= 3:
        return [np.zeros((len(p), 0))] * len(degrees)
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    uv = centred @ axes[:, :0:-1]
    waves = polynomials(normalised(uv), degrees)
    terms = np.zeros((len(p), waves.shape[1]))
    terms[on_surface] = projected_off(waves, np.column_stack([np.ones(len(uv)), uv]))
    return split_by_degree(terms, degrees)


def scaled_pose_vectors(poses: Array) -> Array:
    """Return positions and rotation vectors (n, 6) of poses (n, 4, 4), over length scales."""
    return np.concatenate([poses[:, :3, 3] / POSITION_LENGTH,
                           se3.turns_from_mean(poses) / ROTATION_LENGTH], axis=1)


def smooth_basis(poses: Array, long_errors: bool = False) -> Array:
    """
    Return a square root (n, k) of the kernel at poses (n, 4, 4): k <= 24 basis functions.

    Of many poses, 24 distant ones span it (Nystroem method).
    """
    vectors = scaled_pose_vectors(poses)
    return _kernel_root(vectors, farthest_points(vectors, 24), long_errors)


def smooth_basis_in_time(times: Array, long_errors: bool) -> Array:
    """Return a square root (n, k) of a kernel, see _kernel_root, at times (n,) in s, k <= 48."""
    count = min(48, len(times), 2 + int(np.ptp(times) / TIME_LENGTH))
    evenly = np.linspace(times.min(), times.max(), count)
    nearest = np.abs(times - evenly[:, None]).argmin(axis=1)
    return _kernel_root(times[:, None] / TIME_LENGTH, np.unique(nearest).tolist(), long_errors)


def _kernel_root(vectors: Array, chosen: list[int], long_errors: bool = False) -> Array:
    """
    Return the root (n, k) of a kernel at vectors (n, j), spanned by the chosen rows.

    The kernel is rational quadratic, of errors of all wavelengths (for the estimate), or of long
    ones (for the report). Errors of joints and links have long wavelengths: if short ones were
    assumed with them, the absence of short ones would prove the long ones small, which the samples
    show least.
    """
    squared = ((vectors[:, None] - vectors[chosen]) ** 2).sum(axis=2)
    correlations = np.exp2(-squared) if long_errors else 1.0 / (1.0 + squared)
    values, axes = eigen(correlations[chosen])
    keep = values > 1e-6 * values[-1]
    return np.asarray(correlations @ (axes[:, keep] / np.sqrt(values[keep])))


def farthest_points(vectors: Array, most: int) -> list[int]:
    """
    Return the indices of at most `most` vectors (n, 6), by farthest-point sampling.

    Vectors nearer than 0.006 (6 mm, 0.5 degrees) count as a repeated pose.
    """
    chosen = [0]
    nearest = ((vectors - vectors[0]) ** 2).sum(axis=1)
    while len(chosen) < most and nearest.max() > 0.006 ** 2:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((vectors - vectors[chosen[-1]]) ** 2).sum(axis=1))
    return chosen
