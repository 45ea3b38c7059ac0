# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The sheets of a cloud, and roughly the seam between them: where their edges face, and its kind.

Points whose neighbours lie in a plane are joined to neighbours in the same plane; points near a
rim or a corner belong to the sheet in whose plane they lie. A point lies on the edge of its sheet
where its neighbours on that sheet leave a wide angle free; the middle of this angle is its outward
direction. A surface below a rim or on it is another sheet and hides no edge.

Edges of parallel sheets that face each other across a gap are a butt seam; one above the other
they are a lap. Edges of sheets at an angle in a hollow corner are a fillet, or a V where both
sheets bend outwards at their upper ends. The partner of a point is the nearest point on the other
sheet; borders of the part have none.
"""
from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
import math

from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError
from handeye_ros.se3 import unit
from handeye_ros.words import mm
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

NEIGHBOUR_COUNT = 32
NEIGHBOUR_RADIUS = 3.5  # spacings: radius of the neighbourhood of a point
LINKED_NEIGHBOURS = 10  # neighbours, near and far, that are compared with a point
FLAT_RATIO = 1.35  # times the median thickness of a neighbourhood: a thicker one is no plane
SAME_PLANE = 4.0  # sigmas from a sheet; 1.5 times that between joined neighbours
SAME_NORMAL = 0.98  # cosine of the angle between neighbouring normals of a sheet
MIN_SHEET = 60  # points of a sheet
FREE_ANGLE = 2.2  # rad without neighbours: an edge
CHUNK_POINTS = 20_000

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
TOUCHING_GAP = 6.0  # spacings: largest distance between the edges of sheets in a visible corner
V_AXIS_COSINE = 0.9  # cosine between the axis of a V and the normals of its plates
SEAM_KINDS = ('v', 'butt', 'lap', 'fillet')  # in the order of preference

Pairs = Indices
"""Pairs (k, 2) of points on rims that face each other: rows of the cloud."""


@dataclass(frozen=True, eq=False)
class Sheets:
    """
    The points (n, 3) of a cloud (m), and the sheets that they lie on.

    tree: of the points
    spacing: median distance of neighbouring points (m)
    label: (n,) the number of the sheet, -1 where there is none
    normals: (n, 3) of the sheets, on the visible side
    noise: 1 sigma of the points across their sheets (m)
    rims: (k,) indices of points on borders of sheets, one per cube of two spacings
    outward: (n, 3) directions out of the sheet, valid at the rims
    """

    points: Array
    tree: cKDTree
    spacing: float
    label: Indices
    normals: Array
    noise: float
    rims: Indices
    outward: Array


def sheets_of(points: Array, up: Array) -> Sheets:
    """Return the sheets of points (n, 3) (m); up: (3,) towards the side that is visible."""
    tree = cKDTree(points)
    # six nearest of n points on an area: n = 6 at pi r^2 / d^2
    sixth = tree.query(points[::max(len(points) // 5000, 1)], 7)[0][:, 6]
    spacing = float(np.median(sixth) * np.sqrt(np.pi / 6.0))
    itself = np.arange(len(points), dtype=np.int32)[:, None]
    distance, near = tree.query(points, NEIGHBOUR_COUNT + 1,
                                distance_upper_bound=NEIGHBOUR_RADIUS * spacing)
    near = np.where(np.isfinite(distance), near, itself)[:, 1:].astype(np.int32)
    normals, thickness = np.zeros_like(points), np.full(len(points), np.inf)
    for block, valid, offset in _neighbourhoods(points, near):
        count = np.maximum(valid.sum(axis=1), 1)
        centred = (offset - (offset.sum(axis=1) / count[:, None])[:, None]) * valid[..., None]
        values, axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
        normals[block] = axes[:, :, 0] * np.where(axes[:, :, 0] @ up < 0, -1.0, 1.0)[:, None]
        thickness[block] = np.where(count >= 6, np.sqrt(
            np.maximum(values[:, 0], 0.0) / np.maximum(count - 3, 1)), np.inf)
    noise = max(float(np.median(thickness)), 1e-2 * spacing)
    in_plane = thickness <= FLAT_RATIO * noise
    _assign_planes(points, in_plane, normals, 2 * NEIGHBOUR_RADIUS * spacing, SAME_PLANE * noise)
    label = _sheet_labels(points, normals, near[:, 1:3 * LINKED_NEIGHBOURS:3], in_plane,
                          1.5 * SAME_PLANE * noise)
    rims, outward = _rims(points, near, label, normals, spacing)
    return Sheets(points, tree, spacing, label, normals, noise, rims, outward)


def _neighbourhoods(points: Array, near: NDArray[np.int32]
                    ) -> Iterator[tuple[slice, NDArray[np.bool_], Array]]:
    """
    Yield slices of m points, which of their k neighbours are there (m, k), and their offsets.

    near: (n, k) indices of the neighbours, the point itself in place of missing ones; offsets:
    (m, k, 3) from the point (m).
    """
    for start in range(0, len(points), CHUNK_POINTS):
        block = slice(start, start + CHUNK_POINTS)
        offset = points[near[block]] - points[block][:, None]
        yield block, np.asarray(offset.any(axis=2)), offset


def _assign_planes(points: Array, in_plane: NDArray[np.bool_], normals: Array, reach: float,
                   tolerance: float) -> None:
    """
    Give each point without a plane that of the nearest point in whose plane it lies.

    Changes in_plane (n,) and normals (n, 3); reach: largest distance of that point; tolerance:
    from its plane (m).
    """
    flat, others = np.flatnonzero(in_plane), np.flatnonzero(~in_plane)
    distance, nearest = cKDTree(points[flat]).query(points[others], 8, distance_upper_bound=reach)
    nearest = np.append(flat, 0)[nearest]  # beyond the reach any point, at an infinite distance
    offset = points[others][:, None] - points[nearest]
    to_plane = np.abs((offset * normals[nearest]).sum(axis=2))
    row, place = np.nonzero(np.isfinite(distance) & (to_plane < tolerance))
    row, first = np.unique(row, return_index=True)
    in_plane[others[row]], normals[others[row]] = True, normals[nearest[row, place[first]]]


def _sheet_labels(points: Array, normals: Array, linked: NDArray[np.int32],
                  in_plane: NDArray[np.bool_], tolerance: float) -> Indices:
    """
    Return the sheet (n,) of each point, -1 for points without a plane and in small sheets.

    linked: (n, LINKED_NEIGHBOURS) indices of neighbours; those in one plane are of one sheet.
    """
    i = np.repeat(np.arange(len(points), dtype=np.int32), LINKED_NEIGHBOURS)
    j = linked.ravel()
    both_flat = in_plane[i] & in_plane[j] & (i != j)
    i, j = i[both_flat], j[both_flat]
    offset = points[j] - points[i]
    same_sheet = np.abs((normals[i] * normals[j]).sum(axis=1)) > SAME_NORMAL
    same_sheet &= np.abs((offset * normals[i]).sum(axis=1)) < tolerance
    same_sheet &= np.abs((offset * normals[j]).sum(axis=1)) < tolerance
    graph = coo_matrix((np.ones(int(same_sheet.sum()), dtype=bool),
                        (i[same_sheet], j[same_sheet])), shape=(len(points), len(points)))
    label = connected_components(graph, directed=False)[1].astype(np.intp)
    size = np.bincount(label[in_plane], minlength=len(points) + 1)
    return np.where(in_plane & (size[label] >= MIN_SHEET), label, -1)


def _rims(points: Array, near: NDArray[np.int32], label: Indices, normals: Array,
          spacing: float) -> tuple[Indices, Array]:
    """Return the indices (k,) of points on borders of sheets, and outward directions (n, 3)."""
    free_angle, outward = np.zeros(len(points)), np.zeros_like(points)
    for block, valid, offset in _neighbourhoods(points, near):
        n = normals[block]
        first = unit(np.cross(n, np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])))
        second = np.cross(n, first)
        along, across = np.moveaxis(offset @ np.stack([first, second], axis=-1), -1, 0)
        free_angle[block], middle = _free_angle(
            np.arctan2(across, along), valid & (label[near[block]] == label[block][:, None]))
        outward[block] = np.cos(middle)[:, None] * first + np.sin(middle)[:, None] * second
    rows = np.flatnonzero((free_angle > FREE_ANGLE) & (label >= 0))
    cell = np.column_stack([np.floor(points[rows] / (2 * spacing)), label[rows]])
    return rows[np.sort(np.unique(cell, axis=0, return_index=True)[1])], outward


def _free_angle(angle: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """
    Return the widest angle (n,) that is free of directions, 0 with few of them, and its middle.

    angle: (n, k) of the directions (rad); valid: (n, k) which of them count.
    """
    rows = np.arange(len(angle))
    first_valid = angle[rows, np.argmax(valid, axis=1)]
    angle = np.sort(np.where(valid, angle, first_valid[:, None]), axis=1)
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    widest = np.argmax(gaps, axis=1)
    free = gaps[rows, widest]
    return np.where(valid.sum(axis=1) >= 6, free, 0.0), angle[rows, widest] + free / 2


@dataclass(frozen=True, eq=False)
class RoughSeam:
    """
    A seam as the pairs of rim points that face each other, before its edges are found.

    kind: one of SEAM_KINDS
    pairs: (k, 2) indices of points on its two edges that face each other, in order along it
    t: (k,) lengths of the pairs along the seam (m)
    other_seam_count: number of other seams, of other kinds
    """

    kind: str
    pairs: Pairs
    t: Array
    other_seam_count: int


def rough_seam_of(sheets: Sheets, widest: float, up: Array) -> RoughSeam:
    """
    Return the only seam between sheets, roughly.

    widest: the largest distance between its edges (m)
    up: a direction (3,) towards the tool

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
    if len(seams[kind]) > 1:
        middles = [sheets.points[part].mean(axis=1) for part, _ in seams[kind]]
        listed = '; '.join(f'{mm(float(np.linalg.norm(np.ptp(p, axis=0))))} long at '
                           f'{position_text(p.mean(axis=0))}' for p in middles)
        apart = float(cKDTree(middles[0]).query(np.concatenate(middles[1:]))[0].min())
        raise DataError(
            f'{len(middles)} seams ({listed}), {mm(apart)} apart: cut one out with --box; if they '
            'are the edges of a single one, give a larger --widest; if they are its parts, scan '
            'again what is not seen of it')
    return RoughSeam(kind, *seams[kind][0], sum(map(len, seams.values())) - 1)


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
