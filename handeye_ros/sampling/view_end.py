"""
Edges so near the end of the view that they may be cut off.

The end of the view is where the columns of a profile end. A driver that leaves columns without
a return out of its messages does not show it, so such profiles tell nothing.
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.data import Array, EdgePoint, Feature, Profile
from handeye_ros.profiles.errors import FeatureError
import numpy as np

NEAREST = 1e-3  # m from the end of the view to an edge


def require_inside(features: Sequence[Feature], profiles: Sequence[Profile]) -> None:
    """
    Refuse a stop all of whose edges lie too near the end of the view.

    profiles: those of the stop that show the features. Raises FeatureError.
    """
    edges = [feature for feature in features if isinstance(feature, EdgePoint)]
    columns = {len(profile.points) for profile in profiles}
    if not edges or len(columns) > 1 or not _shows_columns(profiles[0].points):
        return
    distances = [_to_the_end(edge, profiles[0].points) for edge in edges]
    if max(distances) < NEAREST:
        raise FeatureError(
            f'the edge lies {max(distances) * 1e3:.1f} mm from the end of the view, where it may '
            f'be cut off: move it {NEAREST * 1e3:.0f} mm or more into the view')


def _shows_columns(points: Array) -> bool:
    """Tell whether a profile has its columns without a return too."""
    return bool(np.isnan(points).any())


def _to_the_end(edge: EdgePoint, points: Array) -> float:
    """Return how far the columns go on beside an edge, on the shorter side (m)."""
    seen = np.flatnonzero(np.isfinite(points).all(axis=1))
    at = seen[int(np.argmin(np.abs(points[seen] - edge.point).sum(axis=1)))]
    along = points[seen] @ edge.direction
    spacing = float(np.median(np.abs(np.diff(along) / np.diff(seen))))
    return float(min(at, len(points) - 1 - at) * spacing)
