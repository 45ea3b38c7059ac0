# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The rough course of a seam, and its kind: where edges of two sheets face each other.

Edges of parallel sheets that face each other across a gap are a butt seam; one above the other
they are a lap. Edges of sheets at an angle in a hollow corner are a fillet, or a V where both
sheets bend outwards at their upper ends. The partner of a point is the nearest point on the other
sheet; borders of the part have none.
"""
from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.errors import DataError, mm
from handeye_ros.scanning.curves import unit
from handeye_ros.scanning.seam_sheets import Sheets
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

PARALLEL_COSINE = 0.8  # cosine between the normals of the sheets of a gap or a step
# cosines between outward directions, and to the partner
OPPOSITE_COSINE, AHEAD_COSINE = -0.5, -0.3
# cosine between one sheet's normal and the direction into the other: hollow corner
INWARD_COSINE = 0.3
NEXT_NEAREST = 1.15  # largest ratio of a partner's distance to that of the nearest partner
LARGEST_LINK = 8.0  # largest distance of neighbouring pairs of one seam, in spacings
SHORTEST_SEAM = 0.01  # m: smallest length of a seam
HIGHEST_LAP = 8e-3  # m: a higher step is no lap
NARROWEST_GAP = 4.0  # spacings: smallest gap
CORNER_NOISE = 0.25  # spacings: noise up to which no corner looks round
WIDE_GAP_RATIO = 1.2  # median over smallest distance of two edges of one gap
TOUCHING_GAP = 6.0  # spacings: largest distance between the edges of sheets in a visible corner
V_AXIS_COSINE = 0.9  # cosine between the axis of a V and the normals of its plates
SEAM_KINDS = ('v', 'butt', 'lap', 'fillet', 'step')  # in the order of preference

Pairs = NDArray[np.intp]
"""Pairs (k, 2) of points on rims that face each other: rows of the cloud."""


@dataclass(frozen=True, eq=False)
class Course:
    """Pairs (k, 2) in order along the seam, at t (k,) (m); others: number of other seams."""

    kind: str
    pairs: Pairs
    t: Array
    others: int


def course(sheets: Sheets, widest: float, up: Array) -> Course:
    """
    Return the rough course of the only seam between sheets.

    widest: largest distance between its edges (m); up: (3,) towards the tool. Raises DataError.
    """
    pairs, spacing = _facing(sheets, widest), sheets.spacing
    of_kind = defaultdict[str, list[Pairs]](list)
    sides = np.sort(sheets.label[pairs], axis=1)
    for two in np.unique(sides, axis=0):
        for part, _ in _connected(sheets, pairs[(sides == two).all(axis=1)]):
            of_kind[_kind(sheets, part, up)].append(part)
    seams = {kind: _connected(sheets, np.concatenate([pairs[:0], *of_kind[kind]]))
             for kind in SEAM_KINDS}
    kind = next((kind for kind in SEAM_KINDS if seams[kind]), '')
    if not kind:
        raise DataError(
            f'no seam: nowhere do two edges face each other within {mm(widest)} (--widest). The '
            f'points are {mm(spacing)} apart, so a gap or step must be larger than '
            f'{mm(NARROWEST_GAP * spacing)} to be seen, and their noise is {mm(sheets.noise)}, '
            f'which must be smaller than {mm(CORNER_NOISE * spacing)} for a corner: scan more '
            'densely, with less noise, or check what was scanned')
    middles = [sheets.points[part].mean(axis=1) for part, _ in seams[kind]]
    if kind == 'step':
        raise DataError(
            f'a step of {mm(_height(sheets, seams[kind][0][0]))} at '
            f'{position_text(middles[0].mean(axis=0))} whose wall is not seen: too high for a '
            'lap, and the root of a T cannot be found without it: scan with the sensor tilted by '
            '30 to 45 degrees towards the wall')
    if len(middles) > 1:
        listed = '; '.join(f'{mm(float(np.linalg.norm(np.ptp(p, axis=0))))} long at '
                           f'{position_text(p.mean(axis=0))}' for p in middles)
        distance = cKDTree(middles[0]).query(np.concatenate(middles[1:]))[0]
        apart = float(distance.min())
        is_wide = widest < apart and np.median(distance) < WIDE_GAP_RATIO * apart
        raise DataError(
            f'{len(middles)} seams ({listed}), {mm(apart)} apart: cut one out with --box; if it '
            'is a single one, ' + ('with a gap between these edges, give a larger --widest'
                                   if is_wide else 'scan again what is not seen of it'))
    return Course(kind, *seams[kind][0], sum(map(len, seams.values())) - 1)


def position_text(point: Array) -> str:
    """Return the position of a point in words."""
    return 'x y z = ' + ' '.join(f'{v * 1e3:.0f}' for v in point) + ' mm'


def _facing(sheets: Sheets, widest: float) -> Pairs:
    """Return the pairs of rims that face each other, the nearest of their sheets."""
    points, label, outward = sheets.points, sheets.label, sheets.outward
    i, j = sheets.rims[cKDTree(points[sheets.rims]).query_pairs(widest, output_type='ndarray')].T
    offset = points[j] - points[i]
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
    threshold = np.where(label[i] == label[j], -AHEAD_COSINE, AHEAD_COSINE) * length
    ahead = (offset * outward[i]).sum(axis=1) > threshold
    ahead &= -(offset * outward[j]).sum(axis=1) > threshold
    alike = np.abs((sheets.normals[i] * sheets.normals[j]).sum(axis=1)) > PARALLEL_COSINE
    opposite = (outward[i] * outward[j]).sum(axis=1) < OPPOSITE_COSINE
    # sheets in contact may meet at an obtuse angle; across a V, a plate faces the other bevel
    ahead &= (alike == opposite) | (~alike & (length < TOUCHING_GAP * sheets.spacing))
    i, j, length = i[ahead], j[ahead], length[ahead]
    # of each point the nearest on each other sheet
    count = label.max(initial=0) + 1
    nearest = [minimum(length, key, key) if len(key) else length
               for key in (i * count + label[j], j * count + label[i])]
    chosen = (length == nearest[0]) | (length == nearest[1])
    chosen &= length <= NEXT_NEAREST * np.minimum(*nearest)
    return np.stack([i[chosen], j[chosen]], axis=1)


def _connected(sheets: Sheets, pairs: Pairs) -> list[tuple[Pairs, Array]]:
    """Return each connected line of sufficient length: its pairs in order, their places (m)."""
    if not len(pairs):
        return []
    middle = sheets.points[pairs].mean(axis=1)
    links = cKDTree(middle).query_pairs(LARGEST_LINK * sheets.spacing, output_type='ndarray')
    length = np.linalg.norm(middle[links[:, 0]] - middle[links[:, 1]], axis=1)
    n = len(middle)
    graph = coo_matrix((np.maximum(length, 1e-9), links.T), shape=(n, n)).tocsr()
    label = connected_components(graph, directed=False)[1]
    chains = []
    for number in np.unique(label):
        rows = np.flatnonzero(label == number)
        inner = graph[rows][:, rows]
        end = int(np.argmax(dijkstra(inner, directed=False, indices=0)))
        along = dijkstra(inner, directed=False, indices=end)
        if along.max() >= SHORTEST_SEAM:
            order = np.argsort(along)
            chains.append((pairs[rows[order]], along[order]))
    return chains


def _kind(sheets: Sheets, pairs: Pairs, up: Array) -> str:
    """Return the kind of a seam between two sheets; none: a convex corner, a ridge."""
    i, j = pairs.T
    normals, outward = sheets.normals, sheets.outward
    alike = (normals[i] * normals[j]).sum(axis=1)
    if np.median(np.abs(alike)) > PARALLEL_COSINE:
        height = _height(sheets, pairs)
        distance = np.linalg.norm(sheets.points[j] - sheets.points[i], axis=1)
        lateral = np.sqrt(max(float(np.median(distance)) ** 2 - height ** 2, 0.0))
        if height > 0.5 * lateral:
            return 'lap' if height <= HIGHEST_LAP else 'step'
        is_gap = lateral > NARROWEST_GAP * sheets.spacing and not _covered(sheets, pairs)
        return 'butt' if is_gap else 'none'
    inward = np.where(normals[i] @ up > normals[j] @ up,  # of an upright wall the normal may be -n
                      (normals[i] * outward[j]).sum(axis=1), (normals[j] * outward[i]).sum(axis=1))
    if np.median(inward) > -INWARD_COSINE:
        return 'none'
    return 'v' if _is_v(sheets, pairs) else 'fillet'


def _height(sheets: Sheets, pairs: Pairs) -> float:
    """Return the median height of a step."""
    offset = sheets.points[pairs[:, 1]] - sheets.points[pairs[:, 0]]
    return float(np.median(np.abs((offset * sheets.normals[pairs[:, 0]]).sum(axis=1))))


def _covered(sheets: Sheets, pairs: Pairs) -> bool:
    """Return whether points in a gap are higher than its edges."""
    ends, spacing = sheets.points[pairs], sheets.spacing
    normal = np.linalg.svd(sheets.normals[pairs].reshape(-1, 3), full_matrices=False)[2][0]
    normal *= np.sign((sheets.normals[pairs] @ normal).sum())
    flat = np.eye(3) - np.outer(normal, normal)
    reach = 0.25 * float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    middle = ends.mean(axis=1)
    distance, neighbours = cKDTree(sheets.points @ flat).query(
        middle @ flat, 8, distance_upper_bound=max(reach, spacing))
    valid = np.isfinite(distance)
    offset = sheets.points[np.where(valid, neighbours, 0)] - middle[:, None]
    return bool(((offset @ normal > NARROWEST_GAP * spacing) & valid).any(axis=1).mean() > 0.5)


def _is_v(sheets: Sheets, pairs: Pairs) -> bool:
    """Return whether both sheets of a concave corner bend outwards at their other ends."""
    axis = -unit(sheets.outward[pairs].sum(axis=(0, 1)))
    label = sheets.label[sheets.rims]
    plates = sheets.rims[np.isin(label, sheets.label[pairs], invert=True)]
    tree = cKDTree(sheets.points[plates])
    for sheet in np.unique(sheets.label[pairs]):
        rims = sheets.rims[label == sheet]
        upper = sheets.points[rims[sheets.outward[rims] @ axis > INWARD_COSINE]]
        distance, nearest = tree.query(upper, distance_upper_bound=LARGEST_LINK * sheets.spacing)
        steep = unit(sheets.normals[pairs[sheets.label[pairs] == sheet]].sum(axis=0))
        joined = rims[np.abs(sheets.normals[rims] @ steep) < PARALLEL_COSINE]  # by the noise
        plate = np.append(plates[nearest[np.isfinite(distance)]], joined)
        if (np.abs(sheets.normals[plate] @ axis) > V_AXIS_COSINE).sum() < len(pairs) / 8:
            return False
    return True
