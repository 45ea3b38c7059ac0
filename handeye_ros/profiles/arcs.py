"""
The arc of a sphere in a profile, found among clutter.

A profile is (n, 2): along the laser line, range; NaN where there was no return.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
import math

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array
from handeye_ros.profiles.arc_search import (
    ALIKE,
    ArcSearch,
    LARGEST_SHARE,
    refined,
    SMALLEST_RADIUS,
    SMALLEST_SHARE,
    TOLERANCE_SIGMAS,
)
from handeye_ros.profiles.bins import bin_means, SURELY_MORE, variance_of_bins
from handeye_ros.profiles.circles import fit_circle
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.profiles.segment import noise_level
import numpy as np
from numpy.typing import NDArray

NORMAL_POINTS = 12
BLOCKS = 4  # of each share of an arc, whose scatter tells that of its normal point
MOST_SCATTER = 2.5  # RMS distance of an arc's points from their circle, in sigmas
BELIEVED_SCATTER = 1.5  # the same, in sigmas of the configured noise, that needs no test
SLOWEST = 0.5  # share of the scatter that the normal points may have
SMALLEST_DENSITY = 0.5  # of an arc's points among those between its ends
LEAST_SAGITTA = 2.5  # tolerances that an arc must bulge, or a corner is as well one
SMALLEST_ANGLE = 0.5  # of an arc that fixes its circle (rad)
ROUNDER = 2.0  # times the squares of the circle are those of two lines, at least
LINE_POINTS = 4  # fewest of each of the two
AT_ONCE = 32  # profiles
MOST_AWAY = 3.0  # sigmas of a point, that normal points of the same arc are apart
JUDGED_POINTS = 128  # of the arc, that are looked at for that
TINY = 1e-30  # (m^2)


def arc_features(points: Array, config: Config) -> tuple[Arc]:
    """
    Return the arc of the sphere in a profile.

    points: (n, 2) in the sensor plane, NaN where there was no return.
    Raises FeatureError when there is none.
    """
    (found,) = arcs_of_each([points], config)
    if isinstance(found, FeatureError):
        raise found
    return found


def arcs_of_each(profiles: Sequence[Array], config: Config) -> list[tuple[Arc] | FeatureError]:
    """
    Return what arc_features does of profiles, many at once, or the error that it raises.

    At a stop all show nearly the same arc, so where one does the others are looked at first.
    """
    if len(profiles) > AT_ONCE:
        return [found for first in range(0, len(profiles), AT_ONCE)
                for found in arcs_of_each(profiles[first:first + AT_ONCE], config)]
    found: dict[int, tuple[Arc] | FeatureError] = {}
    going: dict[int, ArcSearch] = {}
    for i, points in enumerate(profiles):
        try:
            going[i] = ArcSearch.of(points, config)
        except FeatureError as error:
            found[i] = error
    for i in [*going][:1]:
        found |= _searched({i: going.pop(i)}, config)
        if isinstance(arc := found[i], tuple):
            found |= _alike(arc[0], going, config)
    found |= _searched({i: search for i, search in going.items() if i not in found}, config)
    return [found[i] for i in range(len(profiles))]


def _alike(arc: Arc, searches: dict[int, ArcSearch], config: Config) -> dict[int, tuple[Arc]]:
    """Return the arcs of those profiles that show the same as another does."""
    circle, found = np.append(arc.centre, arc.radius), {}
    inliers = refined(list(searches.values()), [circle] * len(searches), ALIKE)
    for (i, search), used in zip(searches.items(), inliers, strict=True):
        with suppress(FeatureError):
            one = _arc(search.points, used, search.noise, config)
            away = np.linalg.norm(one.points - arc.centre, axis=1) - arc.radius
            # of one that has moved only a part would be near enough
            if np.abs(away).max() < MOST_AWAY * search.noise:
                found[i] = (one,)
    return found


def _searched(going: dict[int, ArcSearch], config: Config
              ) -> dict[int, tuple[Arc] | FeatureError]:
    """Return the arcs of profiles, searched from nothing, or why there are none."""
    found: dict[int, tuple[Arc] | FeatureError] = {}
    while going:
        circles = {i: next(search.circles, None) for i, search in going.items()}
        found |= {i: FeatureError(search.reason or 'no arc of the sphere in the profile')
                  for i, search in going.items() if circles[i] is None}
        going = {i: search for i, search in going.items() if i not in found}
        tried = refined(list(going.values()), [c for c in circles.values() if c is not None])
        for (i, search), inliers in zip(going.items(), tried, strict=True):
            try:
                found[i] = (_arc(search.points, inliers, search.noise, config),)
            except FeatureError as error:
                search.reason = search.reason or str(error)
        going = {i: search for i, search in going.items() if i not in found}
    return found


def _arc(points: Array, inliers: NDArray[np.bool_], noise: float, config: Config) -> Arc:
    """Return the arc of some points; raises FeatureError when it is none."""
    min_points, radius = config.sampling.min_points, config.target.radius
    if inliers.sum() < min_points:
        raise FeatureError(f'fewer than {min_points} points on an arc of the sphere')
    rows = inliers.nonzero()[0]
    if len(rows) < SMALLEST_DENSITY * (rows[-1] - rows[0] + 1):
        raise FeatureError('no arc of the sphere in the profile, only scattered points')
    arc = normal_points(points.take(rows, axis=0))
    if _wanders(arc, noise, config):
        raise FeatureError('no arc of the sphere in the profile, only something like it')
    if 0 < LARGEST_SHARE * radius < arc.radius:
        raise FeatureError(f'the arc in the profile has a radius of {arc.radius * 1e3:.1f} mm, '
                           'more than the sphere')
    if arc.radius < SMALLEST_SHARE * radius:
        raise FeatureError(f'the arc in the profile has a radius of {arc.radius * 1e3:.1f} mm, '
                           'too little for the sphere')
    angle = _covered_angle(arc)
    sagitta = arc.radius * (1 - np.cos(angle / 2))
    if arc.radius < SMALLEST_RADIUS or angle < SMALLEST_ANGLE or (
            sagitta < LEAST_SAGITTA * TOLERANCE_SIGMAS * noise):
        raise FeatureError('the arc of the sphere in the profile is too short')
    if _is_corner(arc):
        raise FeatureError('no arc of the sphere in the profile, only straight pieces')
    return arc


def _wanders(arc: Arc, noise: float, config: Config) -> bool:
    """
    Return whether points do not scatter about their circle, but wander from side to side of it.

    So do those of a corner, or of two surfaces that a circle happens to touch.
    """
    x, z = (arc.raw - arc.centre).T
    off = np.sqrt(x * x + z * z) - arc.radius
    of_shares = np.sqrt(((arc.points - arc.centre) ** 2).sum(axis=1)) - arc.radius
    scatter, slow = float(off @ off) / len(off), float(of_shares @ of_shares) / len(of_shares)
    white = min(BELIEVED_SCATTER * config.noise.sensor,
                MOST_SCATTER * noise_level(arc.raw[:, 1], config.noise.sensor))
    believed = np.hypot(white, BELIEVED_SCATTER * config.noise.distortion)
    return scatter > believed ** 2 and (scatter > (MOST_SCATTER * noise) ** 2
                                        or slow > SLOWEST * scatter)


def _is_corner(arc: Arc) -> bool:
    """
    Return whether two straight lines fit the points of an arc about as well as the circle does.

    A circle that lies in a corner, or passes through two surfaces, finds many points near it; but
    the halves of an arc are bent as well.
    """
    x, z = (arc.raw[::-(-len(arc.raw) // JUDGED_POINTS)] - arc.centre).T
    off = np.sqrt(x * x + z * z) - arc.radius
    to_x, to_z = float(np.add.reduce(x)), float(np.add.reduce(z))
    length = max(math.hypot(to_x, to_z), TINY)
    u, v = (to_x * z - to_z * x) / length, (to_x * x + to_z * z) / length
    order = u.argsort()
    u, v = u[order], v[order] - np.add.reduce(v) / len(v)
    sums = np.array([np.ones(len(u)), u, v, u * u, u * v, v * v]).cumsum(axis=1)
    first = sums[:, LINE_POINTS - 1:-LINE_POINTS]
    squares = _squares_of_lines(first) + _squares_of_lines(sums[:, -1:] - first)
    return bool(squares.min() < ROUNDER * (off @ off))


def _squares_of_lines(sums: Array) -> Array:
    """Return the squared distances (k,) of points from their lines, of sums of 1, u, v, ..."""
    n, u, v, uu, uv, vv = sums
    uu, uv, vv = np.maximum(uu - u * u / n, TINY), uv - u * v / n, vv - v * v / n
    slope = uv / uu
    return np.asarray((vv - slope * uv) / (1 + slope * slope))


def normal_points(raw: Array) -> Arc:
    """
    Return the arc of (n, 2) raw points, with at most NORMAL_POINTS normal points.

    The points of several profiles may be mixed: what repeats in all of them scatters from one
    part of the arc to the next, and so is not taken for something that averages out.
    """
    circle = fit_circle(raw)
    x, z = raw[:, 0] - circle[0], raw[:, 1] - circle[1]
    distance = np.sqrt(x * x + z * z)
    middle = np.array([x.mean(), z.mean()])
    angle = np.arctan2(middle[0] * z - middle[1] * x, middle[0] * x + middle[1] * z)
    order = np.argsort(angle)
    angle, residual = angle[order], distance[order] - circle[2]
    shares = min(NORMAL_POINTS, len(raw) // 3)
    radius, count = bin_means(residual, shares)
    turn = bin_means(angle, shares)[0] + np.arctan2(middle[1], middle[0])
    points = circle[:2] + (circle[2] + radius)[:, None] * np.column_stack(
        [np.cos(turn), np.sin(turn)])
    std = np.sqrt(_variance(residual, radius, len(raw) / shares) * len(raw) / shares / count)
    return Arc(points, std, circle[:2], float(circle[2]), raw)


def _variance(residual: Array, of_shares: Array, size: float) -> float:
    """Return the variance of a normal point, the mean of a share of the residuals (n,)."""
    white = float(residual @ residual) / max(len(residual) - 3, 1) / size
    blocks = bin_means(residual, BLOCKS * len(of_shares))[0] if size > 2 * BLOCKS else of_shares
    fine = variance_of_bins(blocks, white * len(blocks) / len(of_shares))
    # what is alike over a whole share scatters between them
    coarse = float(of_shares @ of_shares) / max(len(of_shares) - 3, 1)
    coarse = coarse if coarse > SURELY_MORE * white else white
    return max(fine * len(of_shares) / len(blocks), coarse)


def _covered_angle(arc: Arc) -> float:
    first, last = arc.points[0] - arc.centre, arc.points[-1] - arc.centre
    cosine = first @ last / np.linalg.norm(first) / np.linalg.norm(last)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
