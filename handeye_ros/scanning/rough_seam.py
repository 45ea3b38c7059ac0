# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Roughly the seam between the sheets of a cloud, and its kind.

Rims of parallel sheets that face each other across a gap are a butt seam; one above the other
they are a lap. Rims of sheets at an angle in a hollow corner are a fillet, or a V where both
sheets bend outwards at their upper ends. The partner of a point is the nearest point on the other
sheet; outer rims of the part have none.
"""
from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
import math

from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError
from handeye_ros.scanning.sheets import Sheets
from handeye_ros.se3 import unit
from handeye_ros.words import mm
import numpy as np
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
MAX_LINK = 8.0  # largest distance of neighbouring pairs of one seam, in spacings
MIN_SEAM = 0.01  # m: smallest length of a seam
MAX_LAP_HEIGHT = 8e-3  # m: of a higher step the root cannot be found without its wall
MIN_GAP_WIDTH = 4.0  # spacings: smallest gap
CORNER_NOISE = 0.25  # spacings: noise up to which no corner looks round
TOUCHING_GAP = 6.0  # spacings: largest distance between the rims of sheets in a visible corner
V_AXIS_COSINE = 0.9  # cosine between the axis of a V and the normals of its plates
SEAM_KINDS = ('v', 'butt', 'lap', 'fillet')  # in the order of preference

Pairs = Indices
"""Pairs (k, 2) of points on rims that face each other: rows of the cloud."""


@dataclass(frozen=True, eq=False)
class RoughSeam:
    """
    A seam as the pairs of rim points that face each other, before its edges are found.

    kind: one of SEAM_KINDS
    pairs: (k, 2) indices of points on its two rims that face each other, in order along it
    t: (k,) lengths of the pairs along the seam (m)
    others: kind, length and place of each seam of another kind, in words
    """

    kind: str
    pairs: Pairs
    t: Array
    others: tuple[str, ...]


def rough_seam_of(sheets: Sheets, widest: float, up: Array) -> RoughSeam:
    """
    Return the only seam between sheets, roughly.

    widest: the largest distance between its edges (m)
    up: a direction (3,) towards the tool, as in sheets_of

    Raises DataError where there is no seam, or where there are several.
    """
    pairs, spacing = _facing_pairs(sheets, widest), sheets.spacing
    parts_by_kind = defaultdict[str | None, list[Pairs]](list)
    labels = np.sort(sheets.label[pairs], axis=1)
    for two_sheets in np.unique(labels, axis=0):
        for part, _ in _chains(sheets, pairs[(labels == two_sheets).all(axis=1)]):
            parts_by_kind[_kind(sheets, part, up)].append(part)
    seams = {kind: _chains(sheets, np.concatenate([pairs[:0], *parts_by_kind[kind]]))
             for kind in SEAM_KINDS}
    kind = next((kind for kind in SEAM_KINDS if seams[kind]), None)
    if kind is None:
        raise DataError(
            f'no seam: nowhere do two edges face each other within {mm(widest)} (--widest). The '
            f'points are {mm(spacing)} apart, so a gap or step must be larger than '
            f'{mm(MIN_GAP_WIDTH * spacing)} to be seen, and their noise is {mm(sheets.noise)}, '
            f'which must be smaller than {mm(CORNER_NOISE * spacing)} for a corner: scan more '
            f'densely, with less noise, a step of more than {mm(MAX_LAP_HEIGHT)} with the sensor '
            'tilted by 30 to 45 degrees towards its wall, or check what was scanned')
    middles = {each: [sheets.points[part].mean(axis=1) for part, _ in chains]
               for each, chains in seams.items()}
    if len(seams[kind]) > 1:
        first, *others = middles[kind]
        apart = float(cKDTree(first).query(np.concatenate(others))[0].min())
        raise DataError(
            f'{len(middles[kind])} {kind} seams ({"; ".join(map(_extent_text, middles[kind]))}), '
            f'{mm(apart)} apart: cut one out with --box; if they are the edges of a single one, '
            'give a larger --widest; if they are its parts, scan again what is not seen of it')
    return RoughSeam(kind, *seams[kind][0], tuple(
        f'{other}, {_extent_text(middle)}' for other in SEAM_KINDS if other != kind
        for middle in middles[other]))


def _extent_text(middles: Array) -> str:
    """Return the length and the place of a seam in words; middles: (k, 3) of its pairs."""
    length = float(np.linalg.norm(np.ptp(middles, axis=0)))
    return f'{mm(length)} long at {position_text(middles.mean(axis=0))}'


def position_text(point: Array) -> str:
    """Return the position of a point in words."""
    return 'x y z = ' + ' '.join(f'{v * 1e3:.0f}' for v in point) + ' mm'


def _facing_pairs(sheets: Sheets, widest: float) -> Pairs:
    """
    Return the pairs of points on rims that face each other, of each the nearest of its sheet.

    widest: largest distance (m).
    """
    points, label, outward = sheets.points, sheets.label, sheets.outward
    i, j = sheets.rims[cKDTree(points[sheets.rims]).query_pairs(widest, output_type='ndarray')].T
    offset = points[j] - points[i]
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
    threshold = np.where(label[i] == label[j], -AHEAD_COSINE, AHEAD_COSINE) * length
    facing = (offset * outward[i]).sum(axis=1) > threshold
    facing &= -(offset * outward[j]).sum(axis=1) > threshold
    parallel = np.abs((sheets.normals[i] * sheets.normals[j]).sum(axis=1)) > PARALLEL_COSINE
    opposite = (outward[i] * outward[j]).sum(axis=1) < OPPOSITE_COSINE
    # sheets in contact may meet at an obtuse angle; across a V, a plate faces the other bevel
    facing &= (parallel == opposite) | (~parallel & (length < TOUCHING_GAP * sheets.spacing))
    i, j, length = i[facing], j[facing], length[facing]
    # of each point the nearest on each other sheet
    count = label.max(initial=0) + 1
    nearest = [minimum(length, key, key) if len(key) else length
               for key in (i * count + label[j], j * count + label[i])]
    chosen = (length == nearest[0]) | (length == nearest[1])
    chosen &= length <= NEXT_NEAREST * np.minimum(*nearest)
    return np.stack([i[chosen], j[chosen]], axis=1)


def _chains(sheets: Sheets, pairs: Pairs) -> list[tuple[Pairs, Array]]:
    """Return each chain of neighbouring pairs that is long enough, with the lengths along it."""
    if not len(pairs):
        return []
    middle = sheets.points[pairs].mean(axis=1)
    links = cKDTree(middle).query_pairs(MAX_LINK * sheets.spacing, output_type='ndarray')
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
        if along.max() >= MIN_SEAM:
            order = np.argsort(along)
            chains.append((pairs[rows[order]], along[order]))
    return chains


def _kind(sheets: Sheets, pairs: Pairs, up: Array) -> str | None:
    """
    Return the kind of the seam of pairs between two sheets, None for no seam.

    That is a ridge, a high step whose wall is not seen, a gap too narrow to be sure of, or a rib.
    up: (3,) towards the tool.
    """
    i, j = pairs.T
    normals, outward = sheets.normals, sheets.outward
    if np.median(np.abs((normals[i] * normals[j]).sum(axis=1))) > PARALLEL_COSINE:
        offset = sheets.points[j] - sheets.points[i]
        height = float(np.median(np.abs((offset * normals[i]).sum(axis=1))))
        distance = float(np.median(np.linalg.norm(offset, axis=1)))
        lateral = math.sqrt(max(distance ** 2 - height ** 2, 0.0))
        if height > 0.5 * lateral:
            return 'lap' if height <= MAX_LAP_HEIGHT else None
        if lateral <= MIN_GAP_WIDTH * sheets.spacing:
            return None
        middle, normal = sheets.points[pairs].mean(axis=1), unit(normals[pairs].sum(axis=(0, 1)))
        project = np.eye(3) - np.outer(normal, normal)
        between = sheets.points[cKDTree(sheets.points @ project).query(middle @ project)[1]]
        is_higher = (between - middle) @ normal > MIN_GAP_WIDTH * sheets.spacing
        return None if is_higher.mean() > 0.5 else 'butt'  # what is higher is a rib
    inward = np.where(normals[i] @ up > normals[j] @ up,  # of an upright wall the normal may be -n
                      (normals[i] * outward[j]).sum(axis=1), (normals[j] * outward[i]).sum(axis=1))
    if np.median(inward) > -INWARD_COSINE:
        return None
    return 'v' if _is_v(sheets, pairs) else 'fillet'


def _is_v(sheets: Sheets, pairs: Pairs) -> bool:
    """Return whether both sheets of a concave corner bend outwards at their other ends."""
    axis = -unit(sheets.outward[pairs].sum(axis=(0, 1)))
    label = sheets.label[sheets.rims]
    plates = sheets.rims[np.isin(label, sheets.label[pairs], invert=True)]
    tree = cKDTree(sheets.points[plates])
    for sheet in np.unique(sheets.label[pairs]):
        rims = sheets.rims[label == sheet]
        upper = sheets.points[rims[sheets.outward[rims] @ axis > INWARD_COSINE]]
        distance, nearest = tree.query(upper, distance_upper_bound=MAX_LINK * sheets.spacing)
        steep = unit(sheets.normals[pairs[sheets.label[pairs] == sheet]].sum(axis=0))
        joined = rims[np.abs(sheets.normals[rims] @ steep) < PARALLEL_COSINE]  # by the noise
        plate = np.append(plates[nearest[np.isfinite(distance)]], joined)
        if (np.abs(sheets.normals[plate] @ axis) > V_AXIS_COSINE).sum() < len(pairs) / 8:
            return False
    return True
