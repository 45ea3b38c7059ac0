# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The rounded or bevelled end of a plate: its shape, and the position of the edge.

The edge is where the planes of face and wall meet. A rounding of radius r that is visible down to
depth d ends r - sqrt(2 r d - d^2) before it. A bevel of 45 degrees and legs r is visible
completely (d = r) or not at all (d = 0), and ends as far before it as a rounding of that radius.
One profile shows the shape only roughly; all samples share it (sampling/edge_shapes.py).

So k shapes are fitted at once, one to each row of an array (k, ...): all share u, outwards along
the face, and v, below it; each has its own `start`, the u where it leaves the face line.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
import numpy as np

# The shapes that are fitted: roundings of these radii (m), then bevels of these slopes.
TRIED_RADII = np.geomspace(5e-5, 4e-3, 40)[:, None]
TRIED_SLOPES = np.geomspace(0.6, 1.7, 8)[:, None]
ROUNDED, BEVELLED = slice(len(TRIED_RADII)), slice(len(TRIED_RADII), None)
# of each shape before it is seen: a rounding is as likely as a bevel
PRIOR = np.repeat(1 / np.array([len(TRIED_RADII), len(TRIED_SLOPES)]),
                  [len(TRIED_RADII), len(TRIED_SLOPES)])
STEEPEST_SINE = 0.97  # largest sine of the slope of a fitted arc: no light returns beyond
ALONG_STD = 0.3  # 1 sigma of where a point lies along the laser line, in columns
STRAY_SIGMAS = 3.0  # sigmas beyond which a point loses weight: near the rim most are wrong
BEND_SIGMAS = 2.0  # sigmas below the face line from which points indicate a bend
FIT_STEPS = 6  # Gauss-Newton steps of the start of a shape
MIN_LOG_LIKELIHOOD = -100.0  # smallest log likelihood of a shape that matters
TINY = 1e-30  # smallest information, for points that all lie on the face


@dataclass(frozen=True, eq=False)
class Bend:
    """
    How a face bends down at its end in one profile.

    depth: v of the end (m), the mean over all shapes by their likelihoods
    shape_log_likelihoods: (k + 1,) of roundings with the k TRIED_RADII, and of a bevel, 0 for the
        best
    rounding_u, rounding_v: the part of the likeliest rounding that is located best (m): the
        steepest points have most weight, so it hardly depends on the radius
    rounding_std: 1 sigma of rounding_u for a given radius
    """

    depth: float
    shape_log_likelihoods: Array
    rounding_u: float
    rounding_v: float
    rounding_std: float


def fitted_bend(u: Array, v: Array, end_u: float, pitch: float, noise: float) -> Bend:
    """
    Return the bend through the last points of a face.

    u, v (n,): of the points, in order; end_u: of the end; pitch: distance of neighbouring points
    along the face; noise: 1 sigma of v (m).
    """
    start, slope, weights, misfit = _fitted_shapes(u, v, pitch, noise)
    log_likelihood = np.maximum((misfit.min() - misfit) / 2, MIN_LOG_LIKELIHOOD)
    likelihood = np.exp(log_likelihood)
    log_likelihoods = np.append(log_likelihood[ROUNDED], np.log(likelihood[BEVELLED].mean()))
    posterior = likelihood * PRIOR
    depths = _depths_of_ends(np.maximum(end_u - start, 0.0))[:, 0]
    best = int(log_likelihood[ROUNDED].argmax())
    information = weights[best] * slope[best] ** 2  # of each point about the start
    total = max(float(information.sum()), TINY)
    sine = float(information @ (slope[best] / np.sqrt(1 + slope[best] ** 2))) / total
    radius = float(TRIED_RADII[best, 0])
    return Bend(float(posterior @ depths / posterior.sum()),
                log_likelihoods - log_likelihoods.max(),
                float(start[best, 0]) + radius * sine, radius * (1 - (1 - sine ** 2) ** 0.5),
                total ** -0.5)


def _fitted_shapes(u: Array, v: Array, pitch: float, noise: float
                   ) -> tuple[Array, Array, Array, Array]:
    """
    Return the shapes fitted to the points of an end: starts, slopes, weights and misfits.

    By reweighted least squares with Cauchy's weights: where hardly any light comes back, ranges
    are wrong by many sigmas. Returned: start (k, 1) of each shape, its slope at the points (k, n),
    their weights (k, n), and -2 log likelihood of each (k,).
    """
    # each shape first passes through the centre of the low points
    low = v >= min(BEND_SIGMAS * noise, v.max())
    start = u[low].mean() - _distances_at(max(float(v[low].mean()), 0.0))
    longest_step = np.maximum(u[-1] - start, pitch) / 3
    for _ in range(FIT_STEPS):
        depth, slope = _shapes(u - start)
        residual = v - depth
        # how far a point lies along the laser line is uncertain: it counts where a shape is steep
        variance = noise ** 2 + (ALONG_STD * pitch * slope) ** 2
        strays = residual ** 2 / (variance * STRAY_SIGMAS ** 2)
        weights = 1 / (variance * (1 + strays))
        # the depth at a point changes by minus the slope as the start moves
        gradient = weights * slope
        information = np.maximum((gradient * slope).sum(axis=1, keepdims=True), TINY)
        step = (gradient * residual).sum(axis=1, keepdims=True) / information
        start = start - np.clip(step, -longest_step, longest_step)
    misfit = (STRAY_SIGMAS ** 2 * np.log1p(strays) + np.log(variance / noise ** 2)).sum(axis=1)
    return start, slope, weights, misfit


def _distances_at(depth: float) -> Array:
    """Return how far from their start the shapes (k, 1) are at a depth."""
    within = np.minimum(depth, STEEPEST_SINE * TRIED_RADII)
    return np.concatenate([np.sqrt(within * (2 * TRIED_RADII - within)), depth / TRIED_SLOPES])


def _depths_of_ends(distances: Array) -> Array:
    """Return how deep the shapes (k, 1) that end at distances (k, 1) from their start end."""
    below_middle = np.sqrt(np.maximum(TRIED_RADII ** 2 - distances[ROUNDED] ** 2, 0.0))
    return np.concatenate([TRIED_RADII - below_middle, TRIED_SLOPES * distances[BEVELLED]])


def _shapes(distances: Array) -> tuple[Array, Array]:
    """Return depths and slopes (k, n) of the shapes at distances (k, n) from their start."""
    distances = np.maximum(distances, 0.0)
    sine = np.minimum(distances[ROUNDED] / TRIED_RADII, STEEPEST_SINE)
    cosine = np.sqrt(1 - sine * sine)
    slope = sine / cosine
    beyond = np.maximum(distances[ROUNDED] - STEEPEST_SINE * TRIED_RADII, 0.0)  # straight on
    depth = TRIED_RADII * (1 - cosine) + slope * beyond
    return (np.concatenate([depth, TRIED_SLOPES * distances[BEVELLED]]),
            np.concatenate([slope, TRIED_SLOPES * (distances[BEVELLED] > 0)]))
