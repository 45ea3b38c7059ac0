# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The rounded or bevelled ends of a plate: their shape, and the position of the edges.

The edge is where the planes of face and wall meet. A rounding of radius r that is visible down to
depth d ends r - sqrt(2 r d - d^2) before it. A bevel of 45 degrees and legs r is visible
completely (d = r) or not at all (d = 0), and ends as far before it as a rounding of that radius.
One profile shows the shape only roughly (`rounding_of`); all samples share it
(`with_common_shape`).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros.data import Array, EdgePoint, Feature, Sample
import numpy as np

SMALLEST_RADIUS, LARGEST_RADIUS = 5e-5, 4e-3  # radius of a rounding (m)
# The shapes that are tried: roundings of these radii, then bevels of these slopes.
TRIED_RADII = np.geomspace(SMALLEST_RADIUS, LARGEST_RADIUS, 40)[:, None]
TRIED_SLOPES = np.geomspace(0.6, 1.7, 8)[:, None]
ROUNDED, BEVELLED = slice(len(TRIED_RADII)), slice(len(TRIED_RADII), None)
# of each shape before it is seen: a rounding is as likely as a bevel
PRIOR = np.repeat(1 / np.array([len(TRIED_RADII), len(TRIED_SLOPES)]),
                  [len(TRIED_RADII), len(TRIED_SLOPES)])
STEEPEST_SINE = 0.97  # largest sine of the slope of a fitted arc: no light returns beyond
ALONG_STD = 0.3  # 1 sigma of where a point lies along the laser line, in columns
STRAY_SIGMAS = 3.0  # sigmas beyond which a point loses weight: near the rim most are wrong
BEND_SIGMAS = 2.0  # sigmas below the face line from which points indicate a bend
BEND_STEPS = 6  # iterations of the start of a bend
LEAST_LIKELY = -100.0  # smallest log likelihood of a shape that matters
TINY = 1e-30  # smallest information, for points that all lie on the face

# of the shape that all ends share
SHARP_DEPTH = 2.5e-5  # largest depth of ends that count as sharp (m)
# depth of a rounding, over its radius, from which light may be lost (26 degrees); where ends bend
# less, the sensor's field or the face is bent, or a driver that smooths bends a few by much more
LEAST_SEEN = 0.1
LARGEST_LOG_ODDS = 8.0  # largest log odds of one end against a shape
SHAPE_STD = 0.2  # relative 1 sigma of a radius or a bevel's legs: it may be an ellipse
SLANT_STD = 0.1  # 1 sigma of the log radius of one end: an oblique laser sees an ellipse
OBLIQUE_STD = 0.03  # 1 sigma of an edge over the radius: an oblique laser sees an ellipse
DEPTH_STD = 1.5e-5  # 1 sigma of the depth of an end (m)
LEAST_DEPTH = 1e-6  # of the middle of an arc (m)


def rounding_of(u: Array, v: Array, end: float, pitch: float, noise: float
                ) -> tuple[float, Array, tuple[float, float], float]:
    """
    Return the rounding at an end of a face in one profile.

    u (n,): outwards along the face; v (n,): below it; end: u of its end; pitch: of the points
    along it; noise: 1 sigma of v (m). Roundings and bevels are weighted by their likelihoods.

    Returned: depth of its end (m); log likelihoods (k + 1,) of roundings with the k TRIED_RADII,
    and of a bevel, 0 for the best; (out, below) of the part of the rounding that is located best
    (m), and 1 sigma of its outward position for a given radius. The steepest points have most
    weight, so this part hardly depends on the best radius.
    """
    begin, slope, weights, misfit = _fitted_shapes(u, v, pitch, noise)
    depths = _depths_of_end(np.maximum(end - begin, 0.0))[:, 0]
    likely = np.maximum((misfit.min() - misfit) / 2, LEAST_LIKELY)
    shapes = np.append(likely[ROUNDED], np.log(np.exp(likely[BEVELLED]).mean()))
    share = np.exp(likely) * PRIOR
    best = int(likely[ROUNDED].argmax())
    steep = weights[best] * slope[best] ** 2
    information = max(float(steep.sum()), TINY)
    sine = float(steep @ (slope[best] / np.sqrt(1 + slope[best] ** 2))) / information
    radius = float(TRIED_RADII[best, 0])
    middle = float(begin[best, 0]) + radius * sine, radius * (1 - (1 - sine ** 2) ** 0.5)
    return (float(share @ depths / share.sum()), shapes - shapes.max(), middle,
            information ** -0.5)


def _fitted_shapes(u: Array, v: Array, pitch: float, noise: float
                   ) -> tuple[Array, Array, Array, Array]:
    """
    Return roundings of TRIED_RADII, then bevels of TRIED_SLOPES, fitted to an end of a face.

    By reweighted least squares with Cauchy's weights: where hardly any light comes back, ranges
    are wrong by many sigmas. Returned: where each leaves the face line (k, 1), its slope at the
    points (k, n), their weights (k, n), and -2 log likelihood of each (k,).
    """
    # a first begin of each: it passes through the centre of the low points
    low = v >= min(BEND_SIGMAS * noise, v.max())
    depth = max(float(v[low].mean()), 0.0)
    begin = u[low].mean() - _distances_at(depth)
    longest_step = np.maximum(u[-1] - begin, pitch) / 3
    for _ in range(BEND_STEPS):
        below, slope = _shapes(u - begin)
        off = v - below
        # how far a point lies along the laser line is uncertain: it counts where a shape is steep
        variance = noise ** 2 + (ALONG_STD * pitch * slope) ** 2
        strays = off ** 2 / (variance * STRAY_SIGMAS ** 2)
        weights = 1 / (variance * (1 + strays))
        # one Gauss-Newton step of each begin: the depth at a point changes by minus the slope
        steep = weights * slope
        information = np.maximum((steep * slope).sum(axis=1, keepdims=True), TINY)
        step = (steep * off).sum(axis=1, keepdims=True) / information
        begin = begin - np.clip(step, -longest_step, longest_step)
    misfit = (STRAY_SIGMAS ** 2 * np.log1p(strays) + np.log(variance / noise ** 2)).sum(axis=1)
    return begin, slope, weights, misfit


def _distances_at(depth: float) -> Array:
    """Return how far from their start the shapes (k, 1) are at a depth."""
    within = np.minimum(depth, STEEPEST_SINE * TRIED_RADII)
    return np.concatenate([np.sqrt(within * (2 * TRIED_RADII - within)), depth / TRIED_SLOPES])


def _depths_of_end(away: Array) -> Array:
    """Return how deep the shapes (k, 1) that end at distances (k, 1) from their start end."""
    below_middle = np.sqrt(np.maximum(TRIED_RADII ** 2 - away[ROUNDED] ** 2, 0.0))
    return np.concatenate([TRIED_RADII - below_middle, TRIED_SLOPES * away[BEVELLED]])


def _shapes(away: Array) -> tuple[Array, Array]:
    """Return depths and slopes (k, n) of the shapes at distances (k, n) from their start."""
    along_arc, along_bevel = np.maximum(away[ROUNDED], 0.0), np.maximum(away[BEVELLED], 0.0)
    sine = np.minimum(along_arc / TRIED_RADII, STEEPEST_SINE)
    cosine = np.sqrt(1 - sine * sine)
    slope = sine / cosine
    beyond = np.maximum(along_arc - STEEPEST_SINE * TRIED_RADII, 0.0)  # straight on
    depth = TRIED_RADII * (1 - cosine) + slope * beyond
    return (np.concatenate([depth, TRIED_SLOPES * along_bevel]),
            np.concatenate([slope, TRIED_SLOPES * (along_bevel > 0)]))


@dataclass(frozen=True)
class EdgeShape:
    """
    Shape of the target's edges.

    size: radius, or legs of the bevel (m), 0 if sharp; relative_std: 1 sigma of size over size.
    """

    size: float = 0.0
    relative_std: float = 0.0
    is_round: bool = True


def with_common_shape(samples: Sequence[Sample]) -> list[Sample]:
    """
    Return the samples with edge points where the planes of face and wall intersect.

    All samples share the shape of rounded or bevelled ends, but one profile shows it only
    roughly, or not at all if a bevel returns no light. So the shape that is likeliest for all ends
    together is used. Edges with a visible wall need no correction.
    """
    shape = common_shape(samples)
    return [replace(s, features=tuple(_moved(f, shape) for f in s.features)) for s in samples]


def common_shape(samples: Sequence[Sample]) -> EdgeShape:
    """Return the edge shape that all samples support, with one common radius where they agree."""
    ends = [f for s in samples for f in s.features
            if isinstance(f, EdgePoint) and f.ending != 'roof']
    depth = np.array([end.drop_depth for end in ends])
    if len(ends) < 3 or np.median(depth) <= SHARP_DEPTH:
        return EdgeShape()
    bent = [end.shape_log_odds for end in ends if len(end.shape_log_odds)]
    log_odds = sum(map(_blurred, bent), np.zeros(len(TRIED_RADII) + 1))
    if np.logaddexp.reduce(log_odds[:-1]) - np.log(len(TRIED_RADII)) > log_odds[-1]:
        shape = EdgeShape(*_radius(log_odds[:-1]))
    else:  # deeper ends say more about the shape
        order = np.argsort(depth)
        share = np.cumsum(depth[order] ** 2)
        most = depth[order][np.searchsorted(share, share[-1] / 2)]
        shape = EdgeShape(float(np.median(depth[depth > most / 2])), SHAPE_STD, is_round=False)
    return shape if np.median(depth) > LEAST_SEEN * shape.size else EdgeShape()


def _blurred(shapes: Array) -> Array:
    """
    Return the log likelihoods (k + 1,) of the shapes at one end, bounded against model error.

    A laser that crosses at a slant sees an ellipse: other radii nearby are as likely.
    """
    logs = np.log(TRIED_RADII[:, 0])
    kernel = -0.5 * ((logs[:, None] - logs) / SLANT_STD) ** 2
    radii = np.logaddexp.reduce(kernel + shapes[:-1], axis=1)
    radii += shapes[:-1].max() - radii.max()
    return np.asarray(np.maximum(np.append(radii, shapes[-1]), -LARGEST_LOG_ODDS))


def _radius(log_odds: Array) -> tuple[float, float]:
    """Return the radius (m) and its relative 1 sigma from log likelihoods (k,) of TRIED_RADII."""
    from scipy.interpolate import CubicSpline  # 0.09 s, only for round edges
    tried = np.log(TRIED_RADII[:, 0])
    logs = np.linspace(tried[0], tried[-1], 8 * len(log_odds))
    likely = CubicSpline(tried, log_odds)(logs)
    weights = np.exp(likely - likely.max())
    mean = float(weights @ logs / weights.sum())
    spread = float(weights @ (logs - mean) ** 2 / weights.sum()) ** 0.5
    return float(np.exp(mean)), float(np.hypot(spread, SHAPE_STD))


def _moved(feature: Feature, shape: EdgeShape) -> Feature:
    """
    Return a feature with its edge point moved to the intersection of face and wall.

    Of a rounding the middle of the visible arc is extrapolated to the wall: it is measured, so the
    result is on the wall for any crossing angle of the laser. Of a bevel, or a barely visible
    rounding, the end is. A bevel returns light as a whole or not at all; it is as wide as deep.
    """
    if not isinstance(feature, EdgePoint) or feature.ending == 'roof':
        return feature
    edge, size = feature, shape.size
    if not size:
        return replace(edge, drop=np.zeros(2))
    back, drop, least, std = 0.0, edge.drop, DEPTH_STD, 0.0
    from_arc = shape.is_round and 0 < edge.arc_std < size
    if from_arc:
        back, least, std = float(edge.arc_offset @ edge.direction), LEAST_DEPTH, edge.arc_std
        drop = edge.arc_offset - back * edge.direction
    depth = min(max(float(np.hypot(*drop)), least), size)
    if shape.is_round:
        out = float(np.sqrt(depth * (2 * size - depth)))
        share = 1 - depth / out
        std = std if from_arc else (size - depth) / out * DEPTH_STD
    else:
        share = float(np.clip(1.5 - 2 * depth / size, 0.0, 1.0))
        out = (1 - share) * size
    return replace(edge, point=edge.point + (back + size - out) * edge.direction, drop=drop,
                   std=float(np.sqrt(edge.std ** 2 + std ** 2 + (OBLIQUE_STD * size) ** 2)),
                   shape_std=shape.relative_std * size * share)
