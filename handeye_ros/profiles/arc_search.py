"""
Which points of a profile may lie on the arc of a sphere.

A profile is (n, 2): along the laser line, range; NaN where there was no return.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.profiles.circles import candidates, fit_each, fit_to_columns
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.profiles.segment import noise_level, returned
import numpy as np
from numpy.typing import NDArray

SMALLEST_RADIUS, LARGEST_RADIUS = 1e-4, 0.5  # of the arc of a sphere of unknown radius (m)
SMALLEST_SHARE = 0.29  # of an arc's radius in that of the sphere: less is seen too steeply
LARGEST_SHARE = 1.05  # the same, for short and noisy arcs
TOLERANCE_SIGMAS = 6.0
STEEP = 0.5  # an arc that ends at a larger angle of incidence (rad) ends at its rim
RIM_WIDTH = 0.24  # of the arc before its rim (rad) that is not used
RIM_COSINE = 0.5  # points at a larger angle of incidence, the rim of the arc, are bad
FEWEST_FITTED = 5  # points on a circle, with which it is fitted again
WIDTHS = (3.0, 2.0, 1.0, 1.0)  # tolerances, within which points are taken for the next circle
ALIKE = (2.0, 1.0)  # the same of a circle that another profile of the stop shows


@dataclass
class ArcSearch:
    """What comes back of a profile (n, 2), its noise, circles that may be its arc, and why not."""

    points: Array
    noise: float
    circles: Iterator[Array]
    reason: str = ''

    @classmethod
    def of(cls, points: Array, config: Config) -> ArcSearch:
        """Return the search of a profile; raises FeatureError where there is nothing to search."""
        valid = points.take(returned(points), axis=0)
        min_points, radius = config.sampling.min_points, config.target.radius
        if len(valid) < min_points:
            raise FeatureError(f'fewer than {min_points} returns in the profile')
        # speckle that is alike over some columns does not show in the noise level
        noise = max(noise_level(valid[:, 1], config.noise.sensor), config.noise.sensor / 2)
        limits = (SMALLEST_RADIUS, LARGEST_RADIUS)
        if radius > 0:
            limits = SMALLEST_SHARE * radius, (LARGEST_SHARE + 0.1) * radius
        return cls(valid, noise, candidates(valid, *limits, TOLERANCE_SIGMAS * noise))


def refined(searches: Sequence[ArcSearch], circles: Sequence[Array],
            widths: Sequence[float] = WIDTHS) -> list[NDArray[np.bool_]]:
    """Return which points of each search lie on its circle, fitted again to them, no rims."""
    if len(searches) == 1:
        return [_refined_one(searches[0], circles[0], widths)]
    return _refined_together(searches, circles, widths) if searches else []


def _refined_one(search: ArcSearch, circle: Array, widths: Sequence[float]
                 ) -> NDArray[np.bool_]:
    """Return the same of one search: arrays of one dimension take half the time then."""
    points, tolerance = search.points, TOLERANCE_SIGMAS * search.noise
    used = on = np.zeros(len(points), dtype=bool)
    x, z = points.T.copy()
    for width in widths:
        along, away = x - circle[0], z - circle[1]
        distance = np.sqrt(along * along + away * away)
        on = np.abs(distance - circle[2]) < width * tolerance
        # the light falls on one side of a ball only
        towards = away if away @ on > 0 else -away
        on &= towards > 0
        used = on & (towards > RIM_COSINE * distance)
        rows = used.nonzero()[0]
        if len(rows) < FEWEST_FITTED:
            break
        circle = fit_to_columns(x.take(rows), z.take(rows), steps=1)
    return used & ~_rim(points, on, circle)


def _refined_together(searches: Sequence[ArcSearch], circles: Sequence[Array],
                      widths: Sequence[float]) -> list[NDArray[np.bool_]]:
    """Return the same of several, whose circles are fitted all at once."""
    count = np.array([len(search.points) for search in searches], dtype=int)
    valid = np.arange(count.max()) < count[:, None]
    x, z = np.zeros((2, *valid.shape))
    for i, search in enumerate(searches):
        x[i, :count[i]], z[i, :count[i]] = search.points.T
    tolerance = TOLERANCE_SIGMAS * np.array([search.noise for search in searches])
    used = on = np.zeros_like(valid)
    circle = np.array(circles)
    for width in widths:
        along, away = x - circle[:, :1], z - circle[:, 1:2]
        distance = np.sqrt(along * along + away * away)
        on = np.abs(distance - circle[:, 2:]) < (width * tolerance)[:, None]
        on &= valid
        # the light falls on one side of a ball only
        towards = np.where(np.einsum('kn,kn->k', away, on) > 0, 1.0, -1.0)[:, None] * away
        on &= towards > 0
        used = on & (towards > RIM_COSINE * distance)
        enough = used.sum(axis=1) >= FEWEST_FITTED
        circle = np.where(enough[:, None], fit_each(x, z, used), circle)
    return [used[i, :n] & ~_rim(search.points, on[i, :n], circle[i])
            for i, (search, n) in enumerate(zip(searches, count, strict=True))]


def _rim(points: Array, on: NDArray[np.bool_], circle: Array) -> NDArray[np.bool_]:
    """
    Return which points are near an end of the arc where the surface turns away.

    The light comes back badly before it stops to come back at all; how steep that is depends on
    the part of the tilt that a profile does not show, so it is told by where the arc ends.
    """
    if not on.any():
        return on
    along, away = points[:, 0] - circle[0], points[:, 1] - circle[1]
    turn = np.arctan2(along, away if away @ on > 0 else -away)
    first, last = _quantiles(turn[on], (0.005, 0.995))
    left = (turn < first + RIM_WIDTH) & (first < -STEEP)
    return np.asarray(left | ((turn > last - RIM_WIDTH) & (last > STEEP)))


def _quantiles(values: Array, shares: tuple[float, ...]) -> list[float]:
    """Return what np.quantile does of finite values, with less ado."""
    ordered = np.sort(values)
    places = [share * (len(ordered) - 1) for share in shares]
    return [float(ordered[int(p)] + (ordered[min(int(p) + 1, len(ordered) - 1)]
                                     - ordered[int(p)]) * (p - int(p))) for p in places]
