"""What the stations of a calibration say together of the edges that they show."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from handeye_ros.data import EdgePoint, Feature, Reject, Sample
from handeye_ros.profiles.bends import reach
from handeye_ros.sampling.view_border import without_border_ends
import numpy as np

FEWEST_EDGES = 3
SHARPEST = 2.5e-5  # depth of ends that are as good as sharp (m)
SURE = 5.0  # logarithm of odds: the most that one end says of its shape
SHAPE_DOUBT = 0.1  # 1 sigma of how far an end is from its edge, as a share of that
OBLIQUE_DOUBT = 0.03  # the same of the radius: a laser that crosses at a slant sees an ellipse
DEPTH_DOUBT = 1.5e-5  # 1 sigma of the depth of an end (m)


def judged_together(samples: Sequence[Sample]) -> tuple[list[Sample], list[Reject]]:
    """Return the samples with the edges that all of them believe in, and those without any."""
    kept, rejects = without_border_ends(samples)
    return with_bevel(kept), rejects


def with_bevel(samples: Sequence[Sample]) -> list[Sample]:
    """
    Return the samples with their edges where the planes of face and wall meet.

    How a rounded or bevelled end bends is alike at all stations, but one profile shows it only
    roughly, or not at all when the bevel sends no light back. So the radius that most of the ends
    show is taken for all; where a wall was seen nothing is to be done.
    """
    radius = typical_radius(samples)
    return [replace(s, features=tuple(_moved(f, radius) for f in s.features)) for s in samples]


def typical_radius(samples: Sequence[Sample]) -> float:
    """
    Return the radius that the ends of faces are rounded with, 0.0 for sharp edges (m).

    The legs of the bevel instead, where most look like one; see bends.
    """
    ends = [f for s in samples for f in s.features
            if isinstance(f, EdgePoint) and f.kind != 'roof']
    if len(ends) < FEWEST_EDGES or np.median([end.bevel for end in ends]) <= SHARPEST:
        return 0.0
    depth, radius = np.array([(end.bevel, end.radius) for end in ends]).T
    votes = np.clip([end.roundness for end in ends], -SURE, SURE)
    found = radius if votes.sum() > 0 else depth
    order = np.argsort(found)
    # what was seen further down tells more of its shape
    share = np.cumsum(depth[order] ** 2)
    return float(found[order][np.searchsorted(share, share[-1] / 2)])


def _moved(feature: Feature, radius: float) -> Feature:
    """
    Return a feature, an edge point where face and wall meet, and its bend as far as the wall.

    To first order in the slants at which the laser crosses the edge, the wall is as far below
    the edge of a sheared circle as this leads outwards.
    """
    if not isinstance(feature, EdgePoint) or feature.kind == 'roof':
        return feature
    if not radius:
        return replace(feature, bend=np.zeros(2))
    depth = max(feature.bevel, DEPTH_DOUBT)
    out = reach(radius, depth)
    by_depth = max(radius - depth, 0.0) / out * DEPTH_DOUBT
    away = radius - out
    std = np.sqrt(feature.std ** 2 + (SHAPE_DOUBT * away) ** 2 + by_depth ** 2
                  + (OBLIQUE_DOUBT * radius) ** 2)
    return replace(feature, point=feature.point + away * feature.direction, std=float(std),
                   bend=feature.bend * (out / depth))
