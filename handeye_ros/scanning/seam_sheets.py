# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Smooth sheets of a cloud, and their borders.

Points whose neighbours lie in a plane are joined to neighbours in the same plane; points near a
rim or a corner belong to the sheet in whose plane they lie. A point lies on the edge of its sheet
where its neighbours on that sheet leave a wide angle free; the middle of this angle is its outward
direction. A surface below a rim or on it is another sheet and hides no edge.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.scanning.curves import unit
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
SMALLEST_SHEET = 60  # points of a sheet
# spacings: smallest standard deviation across a sheet; less is a single profile
SMALLEST_THICKNESS = 0.25
FREE_ANGLE = 2.2  # rad without neighbours: an edge
CHUNK_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Sheets:
    """
    The points (n, 3) of a cloud, and the sheets that they lie on.

    spacing: median distance of neighbouring points (m)
    label: (n,) of the sheet, -1 where there is none
    normals: (n, 3), up
    noise: 1 sigma of the points across their sheets (m)
    rims: (k,) rows of points on borders, one per cube of two spacings
    outward: (n, 3) directions there
    """

    points: Array
    tree: cKDTree
    spacing: float
    label: NDArray[np.intp]
    normals: Array
    noise: float
    rims: NDArray[np.intp]
    outward: Array


def sheets_of(points: Array, up: Array) -> Sheets:
    """Return the sheets of points (n, 3); up: (3,) the side that is visible."""
    tree = cKDTree(points)
    # six nearest of n points on an area: n = 6 at pi r^2 / d^2
    sixth = tree.query(points[::max(len(points) // 5000, 1)], 7)[0][:, 6]
    spacing = float(np.median(sixth) * np.sqrt(np.pi / 6.0))
    normals, thickness = np.zeros_like(points), np.full(len(points), np.inf)
    linked = np.zeros((len(points), LINKED_NEIGHBOURS), dtype=np.int32)
    for block, neighbours, valid, offset in _neighbours(tree, points, spacing):
        count = np.maximum(valid.sum(axis=1), 1)
        centred = (offset - (offset.sum(axis=1) / count[:, None])[:, None]) * valid[..., None]
        values, axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
        normals[block] = axes[:, :, 0] * np.where(axes[:, :, 0] @ up < 0, -1.0, 1.0)[:, None]
        thickness[block] = np.where(count >= 6, np.sqrt(
            np.maximum(values[:, 0], 0.0) / np.maximum(count - 3, 1)), np.inf)
        linked[block] = neighbours[:, 1:3 * LINKED_NEIGHBOURS:3]
    noise = max(float(np.median(thickness)), 1e-2 * spacing)
    flat = thickness <= FLAT_RATIO * noise
    label = _joined(points, normals, linked, flat, 1.5 * SAME_PLANE * noise)
    _assign_unlabelled(points, label, normals, 2 * NEIGHBOUR_RADIUS * spacing, SAME_PLANE * noise)
    # one displaced profile makes a band that is not flat, but does not divide a sheet
    label = _joined(points, normals, linked, label >= 0, 1.5 * SAME_PLANE * noise)
    _remove_single_profiles(points, label, SMALLEST_THICKNESS * spacing)
    rims, outward = _rims(points, tree, label, normals, spacing)
    return Sheets(points, tree, spacing, label, normals, noise, rims, outward)


def _remove_single_profiles(points: Array, label: NDArray[np.intp], thinnest: float) -> None:
    """
    Take the label (n,) from the points of narrow sheets, which are single profiles.

    A face at a grazing angle is rows of points that are far from each other.
    """
    order = np.argsort(label, kind='stable')
    for rows in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        if np.linalg.eigvalsh(np.cov(points[rows].T, bias=True))[1] < thinnest ** 2:
            label[rows] = -1


def _assign_unlabelled(points: Array, label: NDArray[np.intp], normals: Array, reach: float,
                       tolerance: float) -> None:
    """Write the label and normal of the nearest fitting sheet to points without a label."""
    sheet, others = np.flatnonzero(label >= 0), np.flatnonzero(label < 0)
    distance, nearest = cKDTree(points[sheet]).query(points[others], 8, distance_upper_bound=reach)
    nearest = np.append(sheet, 0)[nearest]  # beyond the reach any point, at an infinite distance
    offset = points[others][:, None] - points[nearest]
    to_plane = np.abs((offset * normals[nearest]).sum(axis=2))
    row, place = np.nonzero(np.isfinite(distance) & (to_plane < tolerance))
    row, first = np.unique(row, return_index=True)
    owner = nearest[row, place[first]]
    label[others[row]], normals[others[row]] = label[owner], normals[owner]


def _joined(points: Array, normals: Array, linked: NDArray[np.int32], flat: NDArray[np.bool_],
            tolerance: float) -> NDArray[np.intp]:
    """Return labels (n,) of connected flat points, -1 for others and for small sheets."""
    i = np.repeat(np.arange(len(points), dtype=np.int32), LINKED_NEIGHBOURS)
    j = linked.ravel()
    both_flat = flat[i] & flat[j] & (i != j)
    i, j = i[both_flat], j[both_flat]
    offset = points[j] - points[i]
    one_sheet = np.abs((normals[i] * normals[j]).sum(axis=1)) > SAME_NORMAL
    one_sheet &= np.abs((offset * normals[i]).sum(axis=1)) < tolerance
    one_sheet &= np.abs((offset * normals[j]).sum(axis=1)) < tolerance
    graph = coo_matrix((np.ones(int(one_sheet.sum()), dtype=bool), (i[one_sheet], j[one_sheet])),
                       shape=(len(points), len(points)))
    label = connected_components(graph, directed=False)[1].astype(np.intp)
    size = np.bincount(label[flat], minlength=len(points) + 1)
    return np.where(flat & (size[label] >= SMALLEST_SHEET), label, -1)


def _rims(points: Array, tree: cKDTree, label: NDArray[np.intp], normals: Array, spacing: float
          ) -> tuple[NDArray[np.intp], Array]:
    """Return the rows (k,) of points on the borders of sheets, and outward directions (n, 3)."""
    free_angle, outward = np.zeros(len(points)), np.zeros_like(points)
    for block, neighbours, valid, offset in _neighbours(tree, points, spacing):
        n = normals[block]
        first = unit(np.cross(n, np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])))
        second = np.cross(n, first)
        along, across = np.moveaxis(offset @ np.stack([first, second], axis=-1), -1, 0)
        free_angle[block], middle = _free_angle(
            np.arctan2(across, along), valid & (label[neighbours] == label[block][:, None]))
        outward[block] = np.cos(middle)[:, None] * first + np.sin(middle)[:, None] * second
    rows = np.flatnonzero((free_angle > FREE_ANGLE) & (label >= 0))
    cell = np.column_stack([np.floor(points[rows] / (2 * spacing)), label[rows]])
    return rows[np.sort(np.unique(cell, axis=0, return_index=True)[1])], outward


def _free_angle(angle: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the widest angle (n,) between the valid directions (n, k), and its middle."""
    rows = np.arange(len(angle))
    one = angle[rows, np.argmax(valid, axis=1)]
    angle = np.sort(np.where(valid, angle, one[:, None]), axis=1)
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    widest = np.argmax(gaps, axis=1)
    free = gaps[rows, widest]
    return np.where(valid.sum(axis=1) >= 6, free, 0.0), angle[rows, widest] + free / 2


def _neighbours(tree: cKDTree, points: Array, spacing: float
                ) -> Iterator[tuple[slice, NDArray[np.intp], NDArray[np.bool_], Array]]:
    """Yield slices of points, rows (m, k) of their neighbours, which are valid, their offsets."""
    for start in range(0, len(points), CHUNK_POINTS):
        block = slice(start, start + CHUNK_POINTS)
        distance, neighbours = tree.query(points[block], NEIGHBOUR_COUNT + 1,
                                          distance_upper_bound=NEIGHBOUR_RADIUS * spacing)
        valid = np.isfinite(distance[:, 1:])
        neighbours = np.where(valid, neighbours[:, 1:], neighbours[:, :1])
        yield block, neighbours, valid, points[neighbours] - points[block][:, None]
