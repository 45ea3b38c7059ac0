"""
Where two edges face each other in a cloud: the rough course of a seam.

A point whose neighbours leave a wide angle free lies on an edge, and looks out there. Two points
that are nearest to each other with opposite outlooks are a pair across a seam: the rims of a gap,
or the rim and the foot of a step. Borders of the part have no such partner.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.scanning.errors import InterruptedSeamError, NoSeamError, SeveralSeamsError
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

NEIGHBOURS = 32
REACH = 3.5  # of the neighbourhood that tells an edge, in spacings
FREE_ANGLE = 2.2  # rad without neighbours: an edge
OPPOSITE, AHEAD = -0.5, -0.3  # cosines between outlooks, and of an outlook to the partner
RIVAL = 1.4  # times the distance of its nearest partner that a partner may have
LINK = 8.0  # spacings between pairs that belong to one seam
SHORTEST = 0.01  # m of a seam
MINOR = 0.15  # of the longest seam's length: what is shorter is no seam
IN_LINE = 0.85  # cosine of what continues a seam behind an interruption
CHUNK = 20_000


@dataclass(frozen=True, eq=False)
class Course:
    """Midpoints (k, 3) of the pairs, in order along the seam, and unit normals (k, 3) there."""

    points: Array
    normals: Array


def spacing_of(points: Array) -> float:
    """Return the median distance between neighbouring points (n, 3), of an even cloud."""
    some = points[::max(len(points) // 5000, 1)]
    distance = cKDTree(points).query(some, 7)[0]
    # six nearest of n points on an area: n = 6 at pi r^2 / d^2
    return float(np.median(distance[:, 6]) * np.sqrt(np.pi / 6.0))


def course(points: Array, spacing: float, widest: float) -> Course:
    """
    Return the rough course of the only seam in points (n, 3).

    widest: largest distance between its edges (m). Raises NoSeamError, SeveralSeamsError,
    InterruptedSeamError.
    """
    rows, outlook, normals = edge_points(points, spacing)
    pairs = _pairs(points[rows], outlook, widest)
    if len(pairs) < 8:
        raise NoSeamError(spacing, widest)
    first, second = points[rows][pairs[:, 0]], points[rows][pairs[:, 1]]
    middle = 0.5 * (first + second)
    parts = _parts(middle, spacing)
    if not parts:
        raise NoSeamError(spacing, widest)
    _require_one([middle[part] for part in parts], spacing)
    part = parts[0]
    normal = normals[rows][pairs[part, 0]]
    other = normals[rows][pairs[part, 1]]
    normal = normal + other * np.sign((normal * other).sum(axis=1))[:, None]
    return Course(middle[part], normal / np.linalg.norm(normal, axis=1)[:, None])


def edge_points(points: Array, spacing: float) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the rows of points on an edge, their outlooks (k, 3), and normals (n, 3) of all."""
    tree = cKDTree(points)
    outlook, normals = np.zeros_like(points), np.zeros_like(points)
    free = np.zeros(len(points))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        free[part], outlook[part], normals[part] = _surroundings(tree, points[part], spacing)
    rows = np.flatnonzero(free > FREE_ANGLE)
    return rows, outlook[rows], normals


def _surroundings(tree: cKDTree, points: Array, spacing: float) -> tuple[Array, Array, Array]:
    """Return the widest free angle (n,) around points, its middle and the normal (n, 3)."""
    distance, near = tree.query(points, NEIGHBOURS + 1, distance_upper_bound=REACH * spacing)
    there = np.isfinite(distance[:, 1:])
    near = np.where(there, near[:, 1:], near[:, :1])
    offset = tree.data[near] - points[:, None]
    count = np.maximum(there.sum(axis=1), 1)
    mean = offset.sum(axis=1) / count[:, None]
    centred = (offset - mean[:, None]) * there[..., None]
    _, axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    flat = offset @ axes[:, :, 1:]
    angle = np.arctan2(flat[..., 1], flat[..., 0])
    angle = np.sort(np.where(there, angle, np.inf), axis=1)
    angle = np.where(np.isfinite(angle), angle, angle[:, :1] + 2 * np.pi)
    angle = np.where(np.isfinite(angle), angle, 0.0)  # alone
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    widest = np.argmax(gaps, axis=1)
    each = np.arange(len(points))
    free, middle = gaps[each, widest], angle[each, widest] + gaps[each, widest] / 2
    outlook = np.einsum('nij,nj->ni', axes[:, :, 1:], np.stack(
        [np.cos(middle), np.sin(middle)], axis=1))
    return np.where(count >= 6, free, 0.0), outlook, axes[:, :, 0]


def _pairs(edge: Array, outlook: Array, widest: float) -> NDArray[np.intp]:
    """Return the pairs (k, 2) of points that look at each other across a seam."""
    i, j = cKDTree(edge).query_pairs(widest, output_type='ndarray').T
    way = edge[j] - edge[i]
    length = np.linalg.norm(way, axis=1)
    facing = (outlook[i] * outlook[j]).sum(axis=1) < OPPOSITE
    facing &= (way * outlook[i]).sum(axis=1) > AHEAD * length
    facing &= (way * outlook[j]).sum(axis=1) < -AHEAD * length
    i, j, length = i[facing], j[facing], length[facing]
    nearest = np.full(len(edge), np.inf)
    np.minimum.at(nearest, i, length)
    np.minimum.at(nearest, j, length)
    chosen = (length == nearest[i]) | (length == nearest[j])
    chosen &= length <= RIVAL * np.minimum(nearest[i], nearest[j])
    return np.stack([i[chosen], j[chosen]], axis=1)


def _parts(middle: Array, spacing: float) -> list[NDArray[np.intp]]:
    """Return the rows of each connected line of midpoints in its order, the longest first."""
    pairs = cKDTree(middle).query_pairs(LINK * spacing, output_type='ndarray')
    length = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1)
    n = len(middle)
    graph = coo_matrix((np.maximum(length, 1e-9), pairs.T), shape=(n, n)).tocsr()
    count, label = connected_components(graph, directed=False)
    found = []
    for part in range(count):
        rows = np.flatnonzero(label == part)
        inner = graph[rows][:, rows]
        end = int(np.argmax(dijkstra(inner, directed=False, indices=0)))
        along = dijkstra(inner, directed=False, indices=end)
        found.append((float(along.max()), rows[np.argsort(along)]))
    found.sort(key=lambda item: -item[0])
    return [rows for size, rows in found if size >= max(SHORTEST, MINOR * found[0][0])]


def _require_one(parts: list[Array], spacing: float) -> None:
    """Refuse a seam in pieces, and several seams."""
    if len(parts) < 2:
        return
    few = max(int(4 * LINK), 8)
    ends = [(p[:few].mean(axis=0) - p[few:2 * few].mean(axis=0), p[0]) for p in parts if
            len(p) > 2 * few]
    ends += [(p[-few:].mean(axis=0) - p[-2 * few:-few].mean(axis=0), p[-1]) for p in parts if
             len(p) > 2 * few]
    for k, (way, end) in enumerate(ends):
        for other_way, other in ends[k + 1:]:
            across = other - end
            size = float(np.linalg.norm(across))
            if (way @ across > IN_LINE * np.linalg.norm(way) * size
                    and -(other_way @ across) > IN_LINE * np.linalg.norm(other_way) * size):
                raise InterruptedSeamError(size, 0.5 * (end + other))
    raise SeveralSeamsError([float(np.linalg.norm(np.ptp(p, axis=0))) for p in parts],
                            [p.mean(axis=0) for p in parts])
