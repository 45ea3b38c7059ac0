# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The arc of a sphere in a profile, found among clutter.

A profile is (n, 2): along the laser line, range; NaN where there was no return. A circle is (3,):
x, z and radius.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
import math

from handeye_ros.arithmetic import even_indices, SIGMA_OF_MEDIAN
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Indices
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.lines import bin_means, SURELY_MORE, variance_of_bins
from handeye_ros.profiles.ransac import circles_among
from handeye_ros.profiles.segment import (
    MAX_NOISE,
    noise_level,
    surface_columns,
)
from handeye_ros.words import mm
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

MIN_ARC_RADIUS, MAX_ARC_RADIUS = 1e-4, 0.5  # of the arc of a sphere of unknown radius (m)
MIN_RADIUS_RATIO = 0.29  # smallest radius of an arc over that of the sphere: less is too steep
MAX_RADIUS_RATIO = 1.05  # the largest, for short and noisy arcs
TOLERANCE_SIGMAS = 6.0
# widths of successive fits, in tolerances: of a new circle, and of one with another noise
ARC_FIT_WIDTHS, ARC_REFIT_WIDTHS = (3.0, 2.0, 1.0, 1.0), (2.0, 1.0)
MIN_FITTED = 5  # fewest points for another fit of a circle
# noise over assumed noise that starts a new search; searches at most
NOISE_RATIO, MAX_SEARCHES = 2.0, 5
RIM_INCIDENCE = 0.5  # an arc that ends at a larger angle of incidence (rad) ends at its rim
RIM_WIDTH = 0.24  # angle of the arc before its rim that is not used (rad)
RIM_COSINE = 0.5  # smallest cosine of the incidence of a usable point: the rim is bad
ARC_POINTS, SWEPT_ARC_POINTS = 12, 6  # of an arc; where hundreds of profiles show the ball
FINER_BINS = 4  # per bin of an arc: their scatter gives the variance of its mean point
MIN_DENSITY = 0.5  # smallest share of an arc's points among those between its ends
MIN_ARC_SAGITTA = 2.5  # smallest sagitta of an arc, in tolerances: less may be a corner
MIN_ARC_ANGLE = 0.5  # smallest angle of an arc that determines its circle (rad)
MIN_ROUNDNESS = 2.0  # smallest ratio of the squares of two lines to those of the circle
MIN_LINE_POINTS = 4  # fewest points of each line
JUDGED_POINTS = 128  # points of an arc, at most, that the corner test uses
CONVERGED_STEP = 1e-6  # step of a converged fit, as a share of the radius
SCATTERED = 'too few points, or only scattered ones, on an arc of the sphere in the profile'
TINY = 1e-30


def arc_features(points: Array, config: Config) -> tuple[Arc]:
    """
    Return the arc of the sphere in a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return. Raises FeatureError with the
    reason for the best circle.
    """
    columns = surface_columns(points, config.noise.sensor)
    valid = points.take(columns, axis=0)
    if len(valid) < config.sampling.min_points:
        raise FeatureError(f'fewer than {config.sampling.min_points} returns in the profile')
    # speckle that is correlated over some columns does not show in the noise level
    noise = max(noise_level(valid[:, 1], config.noise.sensor), config.noise.sensor / 2)
    radius, reason = config.target.radius, ''
    smallest, largest = MIN_ARC_RADIUS, MAX_ARC_RADIUS
    if radius > 0:
        smallest, largest = MIN_RADIUS_RATIO * radius, (MAX_RADIUS_RATIO + 0.1) * radius
    for circle in circles_among(valid, smallest, largest, TOLERANCE_SIGMAS * noise):
        try:
            return (_arc(*_arc_inliers(valid, circle, noise, config), config),)
        except FeatureError as error:
            reason = reason or str(error)
    if radius > 0 and not reason:
        with suppress(FeatureError):
            arc_features(points, replace(config, target=replace(config.target, radius=0.0)))
            reason = ('the profile shows an arc, but not of a sphere of target.radius '
                      f'{mm(radius)}: correct it, or set it to 0, and it is estimated')
    raise FeatureError(reason or 'no arc of the sphere in the profile')


def fit_circle(points: Array, steps: int = 4) -> Array:
    """
    Return the circle (x, z, r) with the least squared radial distances to (n, 2) points.

    steps: of Gauss-Newton from the algebraic fit of `fit_round`, which is biased for short arcs.
    It is written out here, about the mean of the points: profiles are read in less time.
    """
    middle = points.sum(axis=0) / len(points)
    x, z = (points - middle).T
    q, J = x * x + z * z, np.ones((3, len(x)))
    J[0], J[1] = x, z
    x_c, z_c = _solved(2 * J[:2] @ J[:2].T, J[:2] @ q)
    r = math.sqrt(float(q.sum()) / len(q) + x_c * x_c + z_c * z_c)
    for _ in range(steps):
        J[0], J[1] = x - x_c, z - z_c
        distance = np.sqrt(J[0] * J[0] + J[1] * J[1])
        J[:2] /= np.maximum(distance, TINY)  # a point may equal the centre
        step = _solved(J @ J.T, J @ (distance - r))
        x_c, z_c, r = x_c + step[0], z_c + step[1], r + step[2]
        if max(map(abs, step)) < CONVERGED_STEP * r:
            break
    return np.array([x_c + middle[0], z_c + middle[1], r])


def _solved(A: Array, b: Array) -> list[float]:
    """Return the solution of normal equations, near the minimum norm if they are singular."""
    diagonal = A.ravel()[::len(b) + 1]
    diagonal += 1e-12 * diagonal.sum() + TINY
    solution: list[float] = dgesv(A, b)[2].tolist()  # a third of the time of numpy's solve
    return solution


def distances_from_circle(points: Array, circle: Array) -> Array:
    """Return the distances (n,) of points (n, 2) outside of a circle, negative inside."""
    x, z = (points - circle[:2]).T
    return np.asarray(np.sqrt(x * x + z * z) - circle[2])


def _arc_inliers(points: Array, circle: Array, noise: float, config: Config
                 ) -> tuple[Array, float]:
    """
    Return the points (k, 2) of an arc near a circle, of all (n, 2), and their noise.

    Circles are fitted to nearer and nearer points. noise_level does not see noise that is
    correlated over some columns and larger than configured, and then only the part of an arc that
    happens to lie near the circle would be found. So the noise is that of all points between its
    ends, and if it is larger the search goes on with it.
    """
    widths: Sequence[float] = ARC_FIT_WIDTHS
    columns, (x, z) = np.empty(0, dtype=np.intp), points.T.copy()
    for _ in range(MAX_SEARCHES):
        for width in widths:
            if len(columns) >= MIN_FITTED:
                circle = fit_circle(points.take(columns, axis=0), steps=1)
            dx, dz = x - circle[0], z - circle[1]
            distance = np.sqrt(dx * dx + dz * dz)
            near = np.abs(distance - circle[2]) < width * TOLERANCE_SIGMAS * noise
            # the light falls on one side of a ball only
            towards_light = dz if dz @ near > 0 else -dz
            near &= towards_light > 0
            columns = np.flatnonzero(near & (towards_light > RIM_COSINE * distance))
            if len(columns) < MIN_FITTED:
                raise FeatureError(SCATTERED)
        columns = _without_rims(columns, near, np.arctan2(dx, towards_light))
        if len(columns) < MIN_FITTED:
            break
        circle = fit_circle(points.take(columns, axis=0), steps=1)
        between_ends = points[columns[0]:columns[-1] + 1]
        deviations = np.abs(distances_from_circle(between_ends, circle))
        middle = len(deviations) // 2
        scatter = SIGMA_OF_MEDIAN * float(np.partition(deviations, middle)[middle])
        if not NOISE_RATIO * noise < scatter < MAX_NOISE * config.noise.sensor:
            break
        noise, widths = scatter, ARC_REFIT_WIDTHS
    if len(columns) < max(config.sampling.min_points, 2 * MIN_LINE_POINTS) or (
            len(columns) < MIN_DENSITY * (columns[-1] - columns[0] + 1)):
        raise FeatureError(SCATTERED)
    return points.take(columns, axis=0), noise


def _without_rims(columns: Indices, near: NDArray[np.bool_], angle: Array) -> Indices:
    """
    Return the columns of an arc without those beside a rim of the ball.

    near (n,): which points are near the circle; angle (n,): theirs on it. Few returns come from
    near a rim, and then none. The angle at which they end depends on the tilt across the profile,
    which is unknown; so the end of the arc is used instead.
    """
    angles = np.sort(angle[near])
    stray = len(angles) // 200
    first, last = angles[stray], angles[-1 - stray]
    arc_angle = angle[columns]
    beside_rim = ((arc_angle < first + RIM_WIDTH) & (first < -RIM_INCIDENCE)
                  | (arc_angle > last - RIM_WIDTH) & (last > RIM_INCIDENCE))
    return np.asarray(columns[~beside_rim])


def _arc(points: Array, noise: float, config: Config) -> Arc:
    """Return the arc of points (n, 2) on a circle; raises FeatureError when it is none."""
    radius = config.target.radius
    arc = fitted_arc(points, SWEPT_ARC_POINTS if config.sampling.moving else ARC_POINTS)
    if 0 < MAX_RADIUS_RATIO * radius < arc.radius or arc.radius < MIN_RADIUS_RATIO * radius:
        raise FeatureError(f'the arc in the profile has a radius of {arc.radius * 1e3:.1f} mm, '
                           f'which does not fit the sphere of {mm(radius)}')
    # angle and sagitta from its ends
    chord = float(np.linalg.norm(arc.points[-1] - arc.points[0]))
    angle = 2 * math.asin(min(chord / (2 * arc.radius), 1.0))
    sagitta = arc.radius * (1 - math.cos(angle / 2))
    if arc.radius < MIN_ARC_RADIUS or angle < MIN_ARC_ANGLE or (
            sagitta < MIN_ARC_SAGITTA * TOLERANCE_SIGMAS * noise):
        raise FeatureError('the arc of the sphere in the profile is too short')
    if _is_corner(arc):
        raise FeatureError('no arc of the sphere in the profile, only straight pieces')
    return arc


def _is_corner(arc: Arc) -> bool:
    """
    Return whether two straight lines fit the ordered points of an arc about as well as a circle.

    A circle in a corner, or through two surfaces, also has many points near it. But two lines do
    not fit a true arc, whose halves are curved.
    """
    points = arc.measured[even_indices(len(arc.measured), JUDGED_POINTS)]
    residual, (x, z) = distances_from_circle(points, arc.circle), (points - arc.centre).T
    sums = np.array([np.ones(len(x)), x, z, x * x, x * z, z * z]).cumsum(axis=1)
    first_line = sums[:, MIN_LINE_POINTS - 1:-MIN_LINE_POINTS]  # that ends at each point
    squares = _squares_of_lines(first_line) + _squares_of_lines(sums[:, -1:] - first_line)
    return bool(squares.min() < MIN_ROUNDNESS * (residual @ residual))


def _squares_of_lines(sums: Array) -> Array:
    """Return the summed squares (k,) about fitted lines; sums: of 1, x, z, xx, xz and zz."""
    n, x, z, xx, xz, zz = sums
    xx, xz, zz = xx - x * x / n, xz - x * z / n, zz - z * z / n
    return np.asarray((xx + zz) / 2 - np.hypot((xx - zz) / 2, xz))


def fitted_arc(raw: Array, most: int = ARC_POINTS) -> Arc:
    """
    Return the arc of (n, 2) raw points, with at most so many mean points.

    The points of several profiles may be mixed. Errors common to all profiles scatter between
    parts of the arc, so they are not taken for noise that averages out.
    """
    circle = fit_circle(raw)
    from_centre = (raw - circle[:2]) @ [1, 1j]
    middle = from_centre.mean() / abs(from_centre.mean())
    angle, residual = np.angle(from_centre / middle), distances_from_circle(raw, circle)
    order = angle.argsort()
    bins = min(most, len(raw) // 3)
    angles, count = bin_means(angle[order], bins)
    residual_means, _ = bin_means(residual[order], bins)
    places = (circle[2] + residual_means) * middle * np.exp(1j * angles)
    variance = _variance_of_mean(residual[order], residual_means, len(raw) / bins)
    return Arc(circle[:2] + np.column_stack([places.real, places.imag]),
               np.sqrt(variance * len(raw) / bins / count), circle[:2], float(circle[2]), raw)


def _variance_of_mean(residual: Array, means: Array, size: float) -> float:
    """Return the variance of the means (k,) of bins of the residuals (n,), of a mean size."""
    white_var = float(residual @ residual) / max(len(residual) - 3, 1) / size
    finer = bin_means(residual, FINER_BINS * len(means))[0] if size > 2 * FINER_BINS else means
    fine = variance_of_bins(finer, white_var * len(finer) / len(means))
    # what is alike over a whole bin scatters between them
    coarse = float(means @ means) / max(len(means) - 3, 1)
    coarse = coarse if coarse > SURELY_MORE * white_var else white_var
    return max(fine * len(means) / len(finer), coarse)
