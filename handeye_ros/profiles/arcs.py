"""
The arc of a sphere in a profile, found among clutter.

A profile is (n, 2): along the laser line, range; NaN where there was no return.
"""
from __future__ import annotations

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.profiles.segment import noise_level
import numpy as np
from numpy.typing import NDArray

HYPOTHESES = 96
SEARCH_POINTS = 256
NORMAL_POINTS = 12
SMALLEST_RADIUS, LARGEST_RADIUS = 1e-4, 0.5  # of the arc of a sphere of unknown radius (m)
LARGEST_SHARE = 1.05  # of an arc's radius in that of the sphere, for short and noisy arcs
TINY = 1e-12
TOLERANCE_SIGMAS = 6.0
SMALLEST_DENSITY = 0.5  # of an arc's points among those between its ends
STEEP = 0.5  # an arc that ends at a larger angle of incidence (rad) ends at its rim
RIM_WIDTH = 0.24  # of the arc before its rim (rad) that is not used
RIM_COSINE = 0.5  # points at a larger angle of incidence, the rim of the arc, are bad
SMALLEST_ANGLE = 0.5  # of an arc that fixes its circle (rad)


def arc_features(points: Array, config: Config) -> tuple[Arc]:
    """
    Return the arc of the sphere in a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return.
    Raises FeatureError when there is none.
    """
    valid = points[np.isfinite(points).all(axis=1)]
    min_points = config.sampling.min_points
    if len(valid) < min_points:
        raise FeatureError(f'fewer than {min_points} returns in the profile')
    noise = max(noise_level(valid[:, 1], config.noise.sensor), config.noise.sensor)
    circle = _dominant_circle(valid, config.target.radius, TOLERANCE_SIGMAS * noise)
    if circle is None:
        raise FeatureError('no arc of the sphere in the profile')
    inliers = _refined(valid, circle, TOLERANCE_SIGMAS * noise)
    if inliers.sum() < min_points:
        raise FeatureError(f'fewer than {min_points} points on an arc of the sphere')
    rows = np.flatnonzero(inliers)
    if len(rows) < SMALLEST_DENSITY * (rows[-1] - rows[0] + 1):
        raise FeatureError('no arc of the sphere in the profile, only scattered points')
    arc = normal_points(valid[inliers])
    if config.target.radius > 0 and arc.radius > LARGEST_SHARE * config.target.radius:
        raise FeatureError(f'the arc in the profile has a radius of {arc.radius * 1e3:.1f} mm, '
                           'more than the sphere')
    if arc.radius < SMALLEST_RADIUS or _covered_angle(arc) < SMALLEST_ANGLE:
        raise FeatureError('the arc of the sphere in the profile is too short')
    return (arc,)


def _dominant_circle(points: Array, radius: float, tolerance: float) -> Array | None:
    """Return the circle (x, z, r) through three points on which the most points lie."""
    circles = _hypotheses(points)
    r = circles[:, 2]
    if radius > 0:
        circles = circles[(r > 0.2 * radius) & (r < 1.02 * radius)]
    else:
        circles = circles[(r > SMALLEST_RADIUS) & (r < LARGEST_RADIUS)]
    if not len(circles):
        return None
    voters = points[::-(-len(points) // SEARCH_POINTS)]
    distance = np.linalg.norm(voters - circles[:, None, :2], axis=2) - circles[:, 2:]
    best = int(np.argmax((np.abs(distance) < tolerance).sum(axis=1)))
    return np.asarray(circles[best])


def _hypotheses(points: Array) -> Array:
    """Return circles (k, 3) through three points each, spread over the profile."""
    circles = []
    for parts in (2.5, 4, 8):
        span = max(int(len(points) / parts / 2), 1)
        first = np.unique(np.linspace(0, len(points) - 1 - 2 * span, HYPOTHESES).astype(int))
        circles.append(_through(points[first], points[first + span], points[first + 2 * span]))
    found = np.concatenate(circles)
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    u, v = b - a, c - a
    cross = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u ** 2).sum(axis=1), (v ** 2).sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        centre = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu])
        centre = centre / cross[:, None]
        return np.column_stack([a + centre, np.linalg.norm(centre, axis=1)])


def _refined(points: Array, circle: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return which points lie on the circle, fitted again to those that do, rims left out."""
    inliers = np.zeros(len(points), dtype=bool)
    for width in (3.0, 2.0, 1.0, 1.0):
        offset = points - circle[:2]
        distance = np.linalg.norm(offset, axis=1)
        steep = np.abs(offset[:, 1]) < RIM_COSINE * distance
        inliers = (np.abs(distance - circle[2]) < width * tolerance) & ~steep
        if inliers.sum() < 5:
            break
        circle = fit_circle(points[inliers])
    return inliers & ~_rim(points, inliers, circle)


def _rim(points: Array, inliers: NDArray[np.bool_], circle: Array) -> NDArray[np.bool_]:
    """
    Return which points are near an end of the arc where the surface turns away.

    The light comes back badly before it stops to come back at all; how steep that is depends on
    the part of the tilt that a profile does not show, so it is told by where the arc ends.
    """
    offset = points - circle[:2]
    towards = np.sign(offset[inliers, 1].sum())
    turn = np.arctan2(offset[:, 0], towards * offset[:, 1])
    if not inliers.any():
        return inliers
    first, last = np.quantile(turn[inliers], [0.005, 0.995])
    left = (turn < first + RIM_WIDTH) & (first < -STEEP)
    return np.asarray(left | ((turn > last - RIM_WIDTH) & (last > STEEP)))


def fit_circle(points: Array) -> Array:
    """Return the circle (x, z, r) with the least squared radial distances to (n, 2) points."""
    mean = points.mean(axis=0)
    centred = points - mean
    A = np.column_stack([2 * centred, np.ones(len(points))])
    x, z, c = _least_squares(A, (centred ** 2).sum(axis=1))
    circle = np.array([x, z, np.sqrt(c + x * x + z * z)])
    for _ in range(4):  # Gauss-Newton from the algebraic fit, which is biased for short arcs
        offset = centred - circle[:2]
        distance = np.linalg.norm(offset, axis=1)
        away = np.maximum(distance, TINY)[:, None]  # equal points have their centre in them
        J = np.column_stack([offset / away, np.ones(len(points))])
        circle = circle + _least_squares(J, distance - circle[2])
    return np.asarray(circle + [*mean, 0.0])


def _least_squares(A: Array, b: Array) -> Array:
    """Return the solution (3,) of many equations, of least norm when they say too little."""
    return np.asarray(np.linalg.lstsq(A.T @ A, A.T @ b, rcond=1e-12)[0])


def normal_points(raw: Array) -> Arc:
    """Return the arc of (n, 2) raw points, with at most NORMAL_POINTS normal points."""
    circle = fit_circle(raw)
    offset = raw - circle[:2]
    distance = np.linalg.norm(offset, axis=1)
    middle = offset.mean(axis=0)
    angle = np.arctan2(middle[0] * offset[:, 1] - middle[1] * offset[:, 0], offset @ middle)
    order = np.argsort(angle)
    angle, residual = angle[order], distance[order] - circle[2]
    noise = float(np.sqrt(residual @ residual / max(len(raw) - 3, 1)))
    shares = np.array_split(np.arange(len(raw)), min(NORMAL_POINTS, len(raw) // 3))
    count = np.array([len(share) for share in shares])
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    radius = circle[2] + np.add.reduceat(residual, first) / count
    turn = np.add.reduceat(angle, first) / count + np.arctan2(middle[1], middle[0])
    points = circle[:2] + radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return Arc(points, noise / np.sqrt(count), circle[:2], float(circle[2]), raw)


def _covered_angle(arc: Arc) -> float:
    first, last = arc.points[0] - arc.centre, arc.points[-1] - arc.centre
    cosine = first @ last / np.linalg.norm(first) / np.linalg.norm(last)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
