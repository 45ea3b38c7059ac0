# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The rounded or bevelled end of a plate: its shape, and the position of the edge.

The edge is where the planes of face and wall meet. A rounding of radius r that is visible down to
depth d ends r - sqrt(2 r d - d^2) before it. A bevel of 45 degrees and legs r is visible
completely (d = r) or not at all (d = 0), and ends as far before it as a rounding of that radius.
One profile shows the shape only roughly; all samples share it (sampling/edge_shapes.py).
"""
from __future__ import annotations

from handeye_ros.data import Array
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
