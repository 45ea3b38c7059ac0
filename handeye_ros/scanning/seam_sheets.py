"""
The smooth sheets of a cloud, and where they end.

Points whose neighbours lie in a plane are joined to those beside them with the same plane; points
near a rim or a corner belong to the sheet whose plane they lie in. A point of a sheet whose
neighbours on that sheet leave a wide angle free lies on its edge, and looks out there. What lies
below a rim, or stands on it, is another sheet and hides no edge.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

FEWEST = 12  # points of a side of a section
SHORT = 0.365  # of 1 / q: what the likeliest end falls short by on average, of few points
INNER = 15.0  # spacings beside the seam up to which the distance of columns is measured
FREQUENCIES = np.linspace(0.5, 5.0, 226)  # of columns, in one spacing
IRREGULAR, REGULAR = 0.15, 0.35  # share of a period in random points at most; in columns at least
NEIGHBOURS = 32
REACH = 3.5  # of the neighbourhood that tells a plane and an edge, in spacings
LINKED = 10  # neighbours, near and far, that are compared with a point
FLAT = 1.35  # times the usual thickness of a neighbourhood: no plane
SAME_PLANE = 4.0  # sigmas from a sheet; neighbours that are joined may differ by 1.5 times that
SAME_NORMAL = 0.98  # cosine of the angle between neighbouring normals of a sheet
SMALLEST = 60  # points of a sheet
THINNEST = 0.25  # spacings across a sheet, as a standard deviation: less is a single profile
FREE_ANGLE = 2.2  # rad without neighbours: an edge
CHUNK = 20_000


def sheet_through(b: Array, height: Array, margin: float, degree: int
                  ) -> tuple[Array, float] | None:
    """Return the polynomial through the sheet at b > margin, and the scatter about it."""
    kept: NDArray[np.bool_] = np.asarray(b > margin)
    if kept.sum() < FEWEST or np.ptp(b[kept]) < margin:
        return None
    sheet, noise = np.zeros(3), np.inf
    for cut in (np.inf, 3.0, 3.0):
        apart = np.abs(height - np.polyval(sheet, b))
        used = kept & (apart <= cut * noise)
        if used.sum() < FEWEST:
            return None
        sheet = np.polyfit(b[used], height[used], degree)
        noise = 1.4826 * float(np.median(np.abs(height[used] - np.polyval(sheet, b[used]))))
        noise = max(noise, 1e-6)
    return sheet, noise


def end_of(b: Array, noise: float, density: float) -> float:
    """Return the likeliest end of points b (n,) spread evenly below it; see the module."""
    def excess(end: float) -> float:
        scaled = (end - b) / noise
        ratio = np.exp(-0.5 * scaled ** 2 - log_ndtr(scaled)) / np.sqrt(2 * np.pi)
        return float(ratio.sum() / noise - density)

    last = float(b.max())
    low, high = last - 5 * noise, last + 5 * noise + 10 / max(density, 1.0)
    if excess(low) < 0 or excess(high) > 0:
        return last
    return float(brentq(excess, low, high, xtol=1e-8)) + SHORT / density


def column_resolution(b: Array, spacing: float, margin: float) -> float:
    """
    Return 1 sigma (m) of an end that lies anywhere between two columns.

    b: (n,) across the seam from its edge, of the points of many profiles (m); those within margin
    spacings are left out. If the columns follow the seam, their distance is a period of b; else an
    end lies at another place between columns in each profile.
    """
    inner = b[(b > margin * spacing) & (b < INNER * spacing)] / spacing
    if len(inner) < FEWEST:
        return 0.0
    periodic = np.abs(np.exp(2j * np.pi * np.outer(FREQUENCIES, inner)).mean(axis=1))
    first = int(np.argmax(periodic > 0.8 * periodic.max()))
    while first + 1 < len(periodic) and periodic[first + 1] > periodic[first]:
        first += 1
    share = np.clip((periodic[first] - IRREGULAR) / (REGULAR - IRREGULAR), 0.0, 1.0)
    return float(share * spacing / FREQUENCIES[first] / np.sqrt(12))


@dataclass(frozen=True, eq=False)
class Sheets:
    """
    The sheets of a cloud of points (n, 3).

    label: (n,) of the sheet, -1 where there is none; normals: (n, 3), up; noise: 1 sigma of the
    points across their sheets (m).
    """

    label: NDArray[np.intp]
    normals: Array
    noise: float


@dataclass(frozen=True, eq=False)
class Rims:
    """Points (k, 3) on the edges of sheets, their outlooks, normals (k, 3) and labels (k,)."""

    points: Array
    outlook: Array
    normals: Array
    label: NDArray[np.intp]


def sheets_of(points: Array, tree: cKDTree, spacing: float, up: Array) -> Sheets:
    """Return the sheets of points (n, 3); up: (3,) the side of them that is seen."""
    normals, thickness = np.zeros_like(points), np.full(len(points), np.inf)
    linked = np.zeros((len(points), LINKED), dtype=np.int32)
    for part, near, there, offset in _neighbours(tree, points, spacing):
        count = np.maximum(there.sum(axis=1), 1)
        centred = (offset - (offset.sum(axis=1) / count[:, None])[:, None]) * there[..., None]
        values, axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
        normals[part] = axes[:, :, 0] * np.where(axes[:, :, 0] @ up < 0, -1.0, 1.0)[:, None]
        thickness[part] = np.where(count >= 6, np.sqrt(
            np.maximum(values[:, 0], 0.0) / np.maximum(count - 3, 1)), np.inf)
        linked[part] = near[:, 1:3 * LINKED:3]
    noise = max(float(np.median(thickness)), 1e-2 * spacing)
    flat = thickness <= FLAT * noise
    label = _joined(points, normals, linked, flat, 1.5 * SAME_PLANE * noise)
    _take_rest(points, label, normals, 2 * REACH * spacing, SAME_PLANE * noise)
    # one displaced profile is a band that is not flat, and must not divide a sheet
    label = _joined(points, normals, linked, label >= 0, 1.5 * SAME_PLANE * noise)
    return Sheets(_without_lines(points, label, THINNEST * spacing), normals, noise)


def _without_lines(points: Array, label: NDArray[np.intp], thinnest: float) -> NDArray[np.intp]:
    """
    Return the labels (n,) less those of sheets that are narrower: single profiles.

    A face seen at a low angle is rows of points that are far from each other.
    """
    kept, own = np.flatnonzero(label >= 0), label.copy()
    names, sheet = np.unique(label[kept], return_inverse=True)
    size = np.bincount(sheet)
    mean = np.stack([np.bincount(sheet, column) for column in points[kept].T], axis=1)
    offset = points[kept] - (mean / size[:, None])[sheet]
    spread = np.array([[np.bincount(sheet, offset[:, i] * offset[:, j]) / size
                        for j in range(3)] for i in range(3)])
    middle = np.linalg.eigvalsh(np.moveaxis(spread, 2, 0))[:, 1]
    own[np.isin(label, names[middle < thinnest ** 2])] = -1
    return own


def _take_rest(points: Array, label: NDArray[np.intp], normals: Array, reach: float, thick: float
               ) -> None:
    """Give points without a label that, and the normal, of the nearest sheet they lie in."""
    sheet, rest = np.flatnonzero(label >= 0), np.flatnonzero(label < 0)
    if not len(sheet) or not len(rest):
        return
    distance, near = cKDTree(points[sheet]).query(points[rest], 8, distance_upper_bound=reach)
    near = sheet[np.minimum(near, len(sheet) - 1)]
    off = np.abs(((points[rest][:, None] - points[near]) * normals[near]).sum(axis=2))
    fits = np.isfinite(distance) & (off < thick)
    owner = near[np.arange(len(rest)), np.argmax(fits, axis=1)]
    taken = fits.any(axis=1)
    label[rest[taken]], normals[rest[taken]] = label[owner[taken]], normals[owner[taken]]


def _joined(points: Array, normals: Array, linked: NDArray[np.int32], flat: NDArray[np.bool_],
            thick: float) -> NDArray[np.intp]:
    """Return labels (n,) of flat points that are joined, -1 of others and of small sheets."""
    i = np.repeat(np.arange(len(points), dtype=np.int32), LINKED)
    j = linked.ravel()
    both = flat[i] & flat[j] & (i != j)
    i, j = i[both], j[both]
    way = points[j] - points[i]
    same = np.abs((normals[i] * normals[j]).sum(axis=1)) > SAME_NORMAL
    same &= np.abs((way * normals[i]).sum(axis=1)) < thick
    same &= np.abs((way * normals[j]).sum(axis=1)) < thick
    graph = coo_matrix((np.ones(int(same.sum()), dtype=bool), (i[same], j[same])),
                       shape=(len(points), len(points)))
    label = connected_components(graph, directed=False)[1].astype(np.intp)
    size = np.bincount(label[flat], minlength=len(points) + 1)
    return np.where(flat & (size[label] >= SMALLEST), label, -1)


def rims_of(points: Array, tree: cKDTree, sheets: Sheets, spacing: float) -> Rims:
    """Return the points on the edges of the sheets, one in each cube of two spacings."""
    free, outlook = np.zeros(len(points)), np.zeros_like(points)
    for part, near, there, offset in _neighbours(tree, points, spacing):
        n = sheets.normals[part]
        own = there & (sheets.label[near] == sheets.label[part][:, None])
        first = np.cross(n, np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
        first /= np.maximum(np.linalg.norm(first, axis=1), 1e-12)[:, None]
        second = np.cross(n, first)
        free[part], middle = _free_angle(np.arctan2(
            np.einsum('nij,nj->ni', offset, second), np.einsum('nij,nj->ni', offset, first)), own)
        outlook[part] = np.cos(middle)[:, None] * first + np.sin(middle)[:, None] * second
    rows = np.flatnonzero((free > FREE_ANGLE) & (sheets.label >= 0))
    cell = np.column_stack([np.floor(points[rows] / (2 * spacing)), sheets.label[rows]])
    rows = rows[np.sort(np.unique(cell, axis=0, return_index=True)[1])]
    return Rims(points[rows], outlook[rows], sheets.normals[rows], sheets.label[rows])


def _free_angle(angle: Array, there: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the widest angle (n,) between the directions (n, k) that are there; its middle."""
    angle = np.sort(np.where(there, angle, np.inf), axis=1)
    angle = np.where(np.isfinite(angle), angle, angle[:, :1] + 2 * np.pi)
    angle = np.where(np.isfinite(angle), angle, 0.0)  # alone
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    widest = np.argmax(gaps, axis=1)
    each = np.arange(len(angle))
    free = gaps[each, widest]
    return (np.where(there.sum(axis=1) >= 6, free, 0.0),
            angle[each, widest] + free / 2)


def _neighbours(tree: cKDTree, points: Array, spacing: float
                ) -> Iterator[tuple[slice, NDArray[np.intp], NDArray[np.bool_], Array]]:
    """Yield slices of points, their neighbours' rows (m, k), which are there, their offsets."""
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        distance, near = tree.query(points[part], NEIGHBOURS + 1,
                                    distance_upper_bound=REACH * spacing)
        there = np.isfinite(distance[:, 1:])
        near = np.where(there, near[:, 1:], near[:, :1])
        yield part, near, there, points[near] - points[part][:, None]
