"""What the stations of a calibration say together of the edges that they show."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from handeye_ros.data import Array, EdgePoint, Feature, Reject, Sample
from handeye_ros.sampling.view_border import without_border_ends
import numpy as np

FEWEST_EDGES = 3
SHARPEST = 2.5e-5  # depth of ends that are as good as sharp (m)
SET_BACK = 1.05  # of the edges before where face and wall meet, as a share of their depth, and
SET_BACK_DOUBT = 0.25  # 1 sigma of it: a rounding has another share than a bevel


def judged_together(samples: Sequence[Sample]) -> tuple[list[Sample], list[Reject]]:
    """Return the samples with the edges that all of them believe in, and those without any."""
    kept, rejects = without_border_ends(samples)
    return with_bevel(kept), rejects


def with_bevel(samples: Sequence[Sample]) -> list[Sample]:
    """
    Return the samples with their edges where the planes of face and wall meet.

    How far a rounded or bevelled end lies before that is alike at all stations, but one profile
    shows it only roughly, or not at all when the bevel sends no light back. It is told from how
    deep most of the ends lie below the face line; where a wall was seen nothing is to be done.
    """
    depth = typical_bevel(samples)
    if not depth:
        return list(samples)
    return [replace(s, features=tuple(_moved(f, depth) for f in s.features)) for s in samples]


def typical_bevel(samples: Sequence[Sample]) -> float:
    """Return how deep the ends of faces lie below their lines, 0.0 for sharp edges (m)."""
    edges = [f for s in samples for f in s.features if isinstance(f, EdgePoint)]
    depths: Array = np.array([edge.bevel for edge in edges if edge.kind != 'roof'])
    depth = float(np.median(depths)) if len(depths) >= FEWEST_EDGES else 0.0
    return depth if depth > SHARPEST else 0.0


def _moved(feature: Feature, depth: float) -> Feature:
    if not isinstance(feature, EdgePoint) or feature.kind == 'roof':
        return feature
    return replace(feature, point=feature.point + SET_BACK * depth * feature.direction,
                   std=float(np.hypot(feature.std, SET_BACK_DOUBT * depth)))
