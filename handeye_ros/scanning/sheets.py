# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The sheets of a cloud, and where their rims face.

Points whose neighbours lie in a plane are joined to neighbours in the same plane; points near a
rim or a corner belong to the sheet in whose plane they lie. A point lies on the rim of its sheet
where its neighbours on that sheet leave a wide angle free; the middle of this angle is its outward
direction. A surface below a rim or on it is another sheet and hides no rim.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from handeye_ros.data import Array, Indices
from handeye_ros.se3 import unit
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

NEIGHBOUR_COUNT = 32
NEIGHBOUR_RADIUS = 3.5  # spacings: radius of the neighbourhood of a point
LINKED_NEIGHBOURS = 10  # neighbours, near and far, that are compared with a point
FLAT_RATIO = 1.35  # times the median thickness of a neighbourhood: a thicker one is no plane
SAME_PLANE = 4.0  # sigmas from a sheet; 1.5 times that between joined neighbours
SAME_NORMAL = 0.98  # cosine of the angle between neighbouring normals of a sheet
MIN_SHEET = 60  # points of a sheet
FREE_ANGLE = 2.2  # rad without neighbours: a rim
CHUNK_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Sheets:
    """
    The points (n, 3) of a cloud (m), and the sheets that they lie on.

    tree: of the points
    spacing: median distance of neighbouring points (m)
    label: (n,) the number of the sheet, -1 where there is none
    normals: (n, 3) of the sheets, on the side of `up` of sheets_of; of a wall along it on either
    noise: 1 sigma of the points across their sheets (m)
    rims: (k,) indices of points on rims of sheets, one per cube of two spacings
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
    """Return the sheets of points (n, 3) (m); up: (3,) towards the tool, which sees them."""
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
    in_plane, normals = _with_planes_nearby(
        points, in_plane, normals, 2 * NEIGHBOUR_RADIUS * spacing, SAME_PLANE * noise)
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


def _with_planes_nearby(points: Array, in_plane: NDArray[np.bool_], normals: Array, reach: float,
                        tolerance: float) -> tuple[NDArray[np.bool_], Array]:
    """
    Return in_plane (n,) and normals (n, 3) with points that had no plane in that of another.

    That is the nearest one in whose plane they lie; reach: its largest distance; tolerance: from
    its plane (m).
    """
    flat, others = np.flatnonzero(in_plane), np.flatnonzero(~in_plane)
    distance, nearest = cKDTree(points[flat]).query(points[others], 8, distance_upper_bound=reach)
    nearest = np.append(flat, 0)[nearest]  # beyond the reach any point, at an infinite distance
    offset = points[others][:, None] - points[nearest]
    to_plane = np.abs((offset * normals[nearest]).sum(axis=2))
    row, place = np.nonzero(np.isfinite(distance) & (to_plane < tolerance))
    row, first = np.unique(row, return_index=True)
    in_plane, normals = in_plane.copy(), normals.copy()
    in_plane[others[row]], normals[others[row]] = True, normals[nearest[row, place[first]]]
    return in_plane, normals


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
    """Return the indices (k,) of points on rims of sheets, and outward directions (n, 3)."""
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
