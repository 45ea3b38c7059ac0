"""Which of several things in sight is the artefact: a region of interest, the nearest surface."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

from handeye_ros.data import Arc, Array, FaceLine, Feature, Sample
import numpy as np
from numpy.typing import NDArray

SAME = (1.5e-3, 4e-3, 1e-2)  # m: pieces of one surface lie so near to a plane; more where the
MOST_SEE = 0.8  # share of the stops does not see any one: the calibration is wrong then
FAR = 0.01  # m: so far from it a wrong calibration may put a piece of a surface
LEAST_SHARE = 0.5  # of the stops, that see the nearest surface
LEAST_STOPS = 4
MOST_SURFACES, MOST_PAIRS = 4, 300  # of pieces that a plane is laid through


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


def near(samples: Sequence[Sample], poses: Array, X: Array, region: Sequence[float]
         ) -> list[Sample]:
    """Return the samples with those features alone that come into a ball: x, y, z, radius."""
    kept = []
    for sample, T in zip(samples, poses, strict=True):
        inside = []
        for feature in sample.features:
            a, b = ends(feature, T @ X) - np.array(region[:3])
            way = b - a
            share = np.clip(-a @ way / max(way @ way, 1e-30), 0.0, 1.0)
            if np.linalg.norm(a + share * way) <= region[3]:
                inside.append(feature)
        kept.append(replace(sample, features=tuple(inside)))
    return kept


def nearest(samples: Sequence[Sample], poses: Array, X: Array, range_sign: int
            ) -> tuple[list[Sample], str]:
    """
    Return the samples with the pieces of one surface alone, and which that is, in words.

    Of the planes that at least half of the stops see, it is the one nearest to the sensor. Two
    are two surfaces where a stop sees both; a piece on none may be of the next one within FAR.
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
    kept = {id(pieces[row][1]) for row in np.flatnonzero(surface == chosen)}
    text = '' if enough.sum() < 2 else (
        f'of {enough.sum()} surfaces in sight it is the nearest, '
        f'{1e3 * abs(depths[chosen]):.0f} mm from the sensor, at {stops[chosen]} of '
        f'{len(samples)} stops')
    return [replace(s, features=tuple(f for f in s.features if id(f) in kept))
            for s in samples], text


def _surfaces(points: Array, stop: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return of which surface (k,) each piece is; points: (k, 2, 3)."""
    free, planes = np.ones(len(points), dtype=bool), list[tuple[Array, Array]]()
    for same in SAME:
        _, on = _largest(points, stop, free, same)
        if len(np.unique(stop[on])) >= MOST_SEE * len(np.unique(stop)):
            break
    while len(np.unique(stop[free])) > 1 and len(planes) < MOST_SURFACES:
        plane, on = _largest(points, stop, free, same)
        planes.append(plane)
        free &= ~on
    away = np.array([np.abs((points - p) @ n).max(axis=1) for p, n in planes])
    kept = [0]
    for k in range(1, len(planes)):
        own = np.argmin(away[[*kept, k]], axis=0)
        seen = [set(stop[own == j].tolist()) for j in range(len(kept) + 1)]
        if any(seen[-1] & other for other in seen[:-1]):
            kept.append(k)
    own, far = np.argmin(away[kept], axis=0), away[kept].min(axis=0)
    nearest = np.array([far[(stop == s) & (own == o)].min()
                        for s, o in zip(stop, own, strict=True)])
    return np.where((far < same) | ((far == nearest) & (far < FAR)), own, -1)


def _largest(points: Array, stop: NDArray[np.intp], free: NDArray[np.bool_], same: float
             ) -> tuple[tuple[Array, Array], NDArray[np.bool_]]:
    """Return point and normal of the plane that most stops see, and the free pieces in it."""
    best, most = (points[free][0, 0], np.array([0.0, 0, 1])), (0, 0.0)
    found = free
    pairs = [(a, b) for a, b in combinations(np.flatnonzero(free).tolist(), 2)
             if stop[a] != stop[b]]
    for a, b in pairs[::max(len(pairs) // MOST_PAIRS, 1)]:
        four = points[[a, b]].reshape(4, 3)
        normal = np.linalg.svd(four - four.mean(axis=0))[2][2]
        away = np.abs((points - four.mean(axis=0)) @ normal).max(axis=1)
        on = free & (away < same)
        score = (len(np.unique(stop[on])), -float(away[on].sum()) / max(on.sum(), 1))
        if score > most:
            best, most, found = (four.mean(axis=0), normal), score, on
    return best, found
