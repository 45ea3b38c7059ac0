"""
Detects ends of faces that are only the border of the sensor's field of view.

The border of the field of view is learnt from the ends of profiles. Where a face leaves the field
of view, its end looks like an edge with nothing behind it. The border is straight: many ends on
one line, with all points ever seen on one side of it, are not edges.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from handeye_ros.data import Array, EdgePoint, FaceLine, Feature, Profile, Reject, Sample
from handeye_ros.errors import FeatureError
import numpy as np
from numpy.typing import NDArray

OPEN_KINDS = ('gap', 'open')  # ends with nothing behind them
TOLERANCE = 2e-4
FEWEST_ENDS = 5
SHARE_OF_ENDS = 0.3
SHARE_LEFT = 0.5  # smallest share of the samples with ends at a border that keep an edge
NEAREST = 1e-3  # smallest distance of an edge from the end of the view (m)


def without_border_ends(samples: Sequence[Sample]) -> tuple[list[Sample], list[Reject]]:
    """Return the samples without ends at the border of the view, and those left without edges."""
    ends = np.array([end.point for s in samples for end in _open_ends(s)])
    if len(ends) < FEWEST_ENDS:
        return list(samples), []
    lines = _believed(border_lines(ends.reshape(-1, 2), _seen(samples)), ends, samples)
    kept, rejects = [], []
    for sample in samples:
        at_border = [end for end in _open_ends(sample) if _on_any(end.point, lines)]
        features = tuple(f for f in sample.features if f not in at_border)
        if any(isinstance(f, EdgePoint) for f in features):
            kept.append(replace(sample, features=features))
        elif at_border:
            rejects.append(Reject(sample.stamp, 'the face ends only at the border of the field '
                                  'of view'))
        else:
            kept.append(sample)
    return kept, rejects


def _believed(lines: Array, ends: Array, samples: Sequence[Sample]) -> Array:
    """
    Return the lines (k, 3) that are borders of the view and not edges of the target.

    A robot programme that brings an edge to the same place of the view every time also makes a
    line. But at a true border most stations keep another edge, and the ends scatter less. So the
    straightest lines are accepted first, as long as their samples keep an edge.
    """
    found: Array = np.empty((0, 3))
    for group in sorted(_groups(lines, ends), key=lambda group: _scatter(group, ends)):
        tried = np.concatenate([found, group])
        on = [s for s in samples if any(_on_any(end.point, group) for end in _open_ends(s))]
        left = sum(any(isinstance(f, EdgePoint) and not (
            f.kind in OPEN_KINDS and _on_any(f.point, tried)) for f in s.features) for s in on)
        if left >= SHARE_LEFT * len(on):
            found = tried
    return found


def _groups(lines: Array, ends: Array) -> list[Array]:
    """Return the lines (k, 3) in groups that share most of their ends."""
    on, groups = _near(ends, lines), []
    while on.shape[1]:
        best = int(np.argmax(on.sum(axis=0)))
        shared = (on & on[:, best:best + 1]).sum(axis=0)
        alike = 2 * shared > on.sum(axis=0)
        alike[best] = True
        groups.append(lines[alike])
        on, lines = on[:, ~alike], lines[~alike]
    return groups


def _scatter(group: Array, ends: Array) -> float:
    """Return the RMS distance of the ends of a group of lines from their best line."""
    members = ends[_near(ends, group).any(axis=1)]
    smallest = np.linalg.svd(members - members.mean(axis=0), compute_uv=False)[-1]
    return float(smallest / len(members) ** 0.5)


def _open_ends(sample: Sample) -> list[EdgePoint]:
    return [f for f in sample.features if isinstance(f, EdgePoint) and f.kind in OPEN_KINDS]


def _seen(samples: Sequence[Sample]) -> Array:
    """Return points (n, 2) that span the visible region: ends of faces, and edges."""
    points = []
    for sample in samples:
        for f in sample.features:
            if isinstance(f, FaceLine):
                points += [f.centre + side * 1.7 * f.spread * f.direction for side in (-1, 1)]
            elif isinstance(f, EdgePoint):
                points.append(f.point)
    return np.array(points)


def border_lines(ends: Array, seen: Array) -> Array:
    """Return the lines (k, 3), normal and offset, through many of the ends (n, 2)."""
    some = ends[np.linspace(0, len(ends) - 1, min(len(ends), 60)).astype(int)]
    i, j = np.triu_indices(len(some), 1)
    along = some[j] - some[i]
    length = np.linalg.norm(along, axis=1)
    apart = length > 10 * TOLERANCE
    along, i = along[apart] / length[apart, None], i[apart]
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    offsets = (normals * some[i]).sum(axis=1)
    distances = seen @ normals.T - offsets
    one_side = ((distances.max(axis=0) < 2 * TOLERANCE)
                | (distances.min(axis=0) > -2 * TOLERANCE))
    lines = np.column_stack([normals, offsets])[one_side]
    needed = max(FEWEST_ENDS, SHARE_OF_ENDS * len(ends))
    return np.asarray(lines[_near(ends, lines).sum(axis=0) >= needed])


def _near(points: Array, lines: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(points @ lines[:, :2].T - lines[:, 2]) < TOLERANCE)


def _on_any(point: Array, lines: Array) -> bool:
    return bool(_near(point[None], lines).any())


def require_inside(features: Sequence[Feature], profiles: Sequence[Profile]) -> None:
    """
    Reject a stop if all its edges may be cut off by the border of the view.

    The view ends where the columns of a profile end. A driver that omits columns without a return
    hides this; then nothing is refused.
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
    """Return whether the profile also contains its columns without a return."""
    return bool(np.isnan(points).any())


def _to_the_end(edge: EdgePoint, points: Array) -> float:
    """Return the width (m) of the columns beside an edge, on the side with fewer."""
    seen = np.flatnonzero(np.isfinite(points).all(axis=1))
    at = seen[int(np.argmin(np.abs(points[seen] - edge.point).sum(axis=1)))]
    along = points[seen] @ edge.direction
    spacing = float(np.median(np.abs(np.diff(along) / np.diff(seen))))
    return float(min(at, len(points) - 1 - at) * spacing)
