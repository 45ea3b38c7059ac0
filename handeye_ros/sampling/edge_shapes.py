# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The common shape of the edges over all samples, and the edge points that follow from it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros.data import Array, EdgePoint, Feature, Sample
from handeye_ros.profiles.edge_rounding import TRIED_RADII
import numpy as np

SHARP_DEPTH = 2.5e-5  # largest depth of ends that count as sharp (m)
# the same over the size of the shape: from this depth of a rounding on light may be lost (26
# degrees); where ends bend less, the sensor's field or the face is bent, or a driver that smooths
# bends a few by much more
SHARP_RELATIVE_DEPTH = 0.1
MAX_LOG_RATIO = 8.0  # largest log odds of one end against a shape
SHAPE_STD = 0.2  # relative 1 sigma of a radius or a bevel's legs: it may be another curve
ELLIPSE_RADIUS_STD = 0.1  # 1 sigma of the log radius of one end: an oblique laser sees an ellipse
ELLIPSE_EDGE_STD = 0.03  # 1 sigma of an edge over the radius: an oblique laser sees an ellipse
DEPTH_STD = 1.5e-5  # 1 sigma of the depth of an end (m)
MIN_DEPTH = 1e-6  # of the middle of an arc (m)


@dataclass(frozen=True)
class EdgeShape:
    """
    Shape of the target's edges.

    size: radius, or legs of the bevel (m), 0 if sharp; relative_std: 1 sigma of size over size;
    is_round: rounded, else bevelled.
    """

    size: float = 0.0
    relative_std: float = 0.0
    is_round: bool = True


def with_common_edge_shape(samples: Sequence[Sample], shape: EdgeShape | None = None
                           ) -> list[Sample]:
    """
    Return the samples with edge points where the planes of face and wall intersect.

    All samples share the shape of rounded or bevelled ends, but one profile shows it only
    roughly, or not at all if a bevel returns no light. So the shape that is likeliest for all ends
    together is used. Edges with a visible wall need no correction. The samples of a session are as
    measured, those of an answer moved; what is moved already stays as it is.

    shape: that of other samples, which these are compared with; None: their own.
    """
    shape = shape or common_shape(samples)
    return [replace(sample, features=tuple(
        _with_corrected_edge(feature, shape) for feature in sample.features))
            for sample in samples]


def common_shape(samples: Sequence[Sample]) -> EdgeShape:
    """
    Return the one shape that is likeliest for all ends together.

    Sharp with fewer than three ends, or where half of them bend by less than SHARP_DEPTH or
    SHARP_RELATIVE_DEPTH of the size.
    """
    edges = [f for sample in samples for f in sample.features
             if isinstance(f, EdgePoint) and f.ending != 'roof']
    depth = np.hypot(*np.reshape([edge.to_lowest for edge in edges], (-1, 2)).T)
    if len(edges) < 3 or np.median(depth) <= SHARP_DEPTH:
        return EdgeShape()
    bent = [edge.shape_log_likelihoods for edge in edges if len(edge.shape_log_likelihoods)]
    log_likelihoods = sum(map(_blurred, bent), np.zeros(len(TRIED_RADII) + 1))
    rounded = np.logaddexp.reduce(log_likelihoods[:-1]) - np.log(len(TRIED_RADII))
    if rounded > log_likelihoods[-1]:
        shape = EdgeShape(*_radius_and_std(log_likelihoods[:-1]))
    else:  # deeper ends say more about the legs of a bevel
        order = np.argsort(depth)
        squares = np.cumsum(depth[order] ** 2)
        weighted_median = depth[order][np.searchsorted(squares, squares[-1] / 2)]
        legs = float(np.median(depth[depth > weighted_median / 2]))
        shape = EdgeShape(legs, SHAPE_STD, is_round=False)
    return shape if np.median(depth) > SHARP_RELATIVE_DEPTH * shape.size else EdgeShape()


def _blurred(log_likelihoods: Array) -> Array:
    """
    Return log likelihoods (k + 1,) of the shapes at one end, bounded against model error.

    A laser that crosses at a slant sees an ellipse: other radii nearby are as likely.
    """
    log_radii = np.log(TRIED_RADII[:, 0])
    kernel = -0.5 * ((log_radii[:, None] - log_radii) / ELLIPSE_RADIUS_STD) ** 2
    rounded = np.logaddexp.reduce(kernel + log_likelihoods[:-1], axis=1)
    rounded += log_likelihoods[:-1].max() - rounded.max()
    return np.asarray(np.maximum(np.append(rounded, log_likelihoods[-1]), -MAX_LOG_RATIO))


def _radius_and_std(log_likelihoods: Array) -> tuple[float, float]:
    """Return the radius (m) and its relative 1 sigma from log likelihoods (k,) of TRIED_RADII."""
    from scipy.interpolate import CubicSpline  # 0.09 s, only for round edges
    tried = np.log(TRIED_RADII[:, 0])
    log_radii = np.linspace(tried[0], tried[-1], 8 * len(log_likelihoods))
    log_likelihood = CubicSpline(tried, log_likelihoods)(log_radii)
    weights = np.exp(log_likelihood - log_likelihood.max())
    mean = float(weights @ log_radii / weights.sum())
    spread = float(weights @ (log_radii - mean) ** 2 / weights.sum()) ** 0.5
    return float(np.exp(mean)), float(np.hypot(spread, SHAPE_STD))


def _with_corrected_edge(feature: Feature, shape: EdgeShape) -> Feature:
    """
    Return a feature with its edge point moved to the intersection of face and wall.

    Of a rounding the middle of the visible arc is extrapolated to the wall: it is measured, so the
    result is on the wall for any crossing angle of the laser. Of a bevel, or a barely visible
    rounding, the end is. A bevel returns light as a whole or not at all; it is as wide as deep.
    """
    if not isinstance(feature, EdgePoint) or feature.ending == 'roof' or feature.is_corrected:
        return feature
    edge, size = replace(feature, is_corrected=True), shape.size
    if not size:
        return replace(edge, to_lowest=np.zeros(2))
    # the point of the shape that is measured: how far outwards of the end it is, and how deep
    is_arc = shape.is_round and 0 < edge.rounding_std < size
    outwards = float(edge.rounding_offset @ edge.direction) if is_arc else 0.0
    to_lowest = edge.rounding_offset - outwards * edge.direction if is_arc else edge.to_lowest
    depth = min(max(float(np.hypot(*to_lowest)), MIN_DEPTH if is_arc else DEPTH_STD), size)
    from_start, wrt_depth, wrt_size = _place_at_depth(depth, shape)
    wall = outwards + size - from_start
    std = edge.rounding_std if is_arc else wrt_depth * DEPTH_STD
    return replace(edge, point=edge.point + wall * edge.direction, to_lowest=to_lowest,
                   std=float(np.sqrt(edge.std ** 2 + std ** 2 + (ELLIPSE_EDGE_STD * size) ** 2)),
                   shape_std=shape.relative_std * size * wrt_size)


def _place_at_depth(depth: float, shape: EdgeShape) -> tuple[float, float, float]:
    """
    Return how far from its start, along the face, a shape has a depth (both in m).

    And how much the distance from there to the wall, which is `size` from the start, changes by
    the depth (without the sign) and by the size. The end of a bevel is its start if it is less
    than a quarter as deep as the bevel, and its foot, at the wall, if more than three quarters;
    between these its place goes from one to the other.
    """
    size = shape.size
    if shape.is_round:
        from_start = float(np.sqrt(depth * (2 * size - depth)))
        return from_start, (size - depth) / from_start, 1 - depth / from_start
    wrt_size = float(np.clip(1.5 - 2 * depth / size, 0.0, 1.0))
    return (1 - wrt_size) * size, 0.0, wrt_size
