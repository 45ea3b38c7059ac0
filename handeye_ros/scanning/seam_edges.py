"""
Where the edges of two sheets face each other: the rough course of a seam, and its kind.

Edges of parallel sheets that look at each other across a gap are a butt seam, above each other a
lap; edges of sheets at an angle that would meet below their own bodies are a fillet, or a V where
both sheets bend outwards above. The partner of a point is the nearest of each kind; borders of
the part have none.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.scanning.errors import (
    HiddenWallError,
    InterruptedSeamError,
    NoSeamError,
    SeveralSeamsError,
)
from handeye_ros.scanning.seam_sheets import Rims
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

PARALLEL = 0.8  # cosine between the normals of the sheets of a gap or a step
OPPOSITE, AHEAD = -0.5, -0.3  # cosines between outlooks, and of an outlook to the partner
INWARDS = 0.3  # cosine between one sheet's normal and the way into the other: a hollow corner
NEXT_NEAREST = 1.15  # times the distance of its nearest partner that a partner may have
LINK = 8.0  # spacings between pairs that belong to one seam
SHORTEST = 0.01  # m of a seam
MINOR = 0.15  # of the longest seam's length: what is shorter is no seam
IN_LINE = 0.85  # cosine of what continues a seam behind an interruption
HIGHEST_LAP = 8e-3  # m: a step that is higher is none of a lap
NARROWEST = 4.0  # spacings of a gap
TOUCHING = 6.0  # spacings between the edges of two sheets whose corner is seen
OUTWARDS = 0.9  # cosine between the axis of a V and the normals of its plates
KINDS = ('v', 'butt', 'lap', 'fillet', 'step')  # one of an earlier kind is taken before others


@dataclass(frozen=True, eq=False)
class Course:
    """Pairs (k, 2) of rows of the rims, in order along the seam; others: seams not taken."""

    kind: str
    pairs: NDArray[np.intp]
    middle: Array
    others: int


def spacing_of(points: Array) -> float:
    """Return the median distance between neighbouring points (n, 3), of an even cloud."""
    some = points[::max(len(points) // 5000, 1)]
    distance = cKDTree(points).query(some, 7)[0]
    # six nearest of n points on an area: n = 6 at pi r^2 / d^2
    return float(np.median(distance[:, 6]) * np.sqrt(np.pi / 6.0))


def course(rims: Rims, points: Array, spacing: float, widest: float, up: Array) -> Course:
    """
    Return the rough course of the only seam between the rims of sheets in points (n, 3).

    widest: largest distance between its edges (m); up: (3,) towards the tool. Raises
    NoSeamError, SeveralSeamsError, InterruptedSeamError, HiddenWallError.
    """
    pairs = _pairs(rims, widest, spacing)
    by_kind: dict[str, list[NDArray[np.intp]]] = {kind: [] for kind in (*KINDS, 'none')}
    sides = np.sort(rims.label[pairs], axis=1)
    for two in np.unique(sides, axis=0):
        between = pairs[(sides == two).all(axis=1)]
        for _, rows in _parts(rims, between, spacing):
            of_two = _kind(rims, between[rows], spacing, up)
            if of_two != 'butt' or not _covered(rims, between[rows], points, spacing):
                by_kind[of_two].append(between[rows])
    found = {kind: _whole(rims, by_kind[kind], spacing) for kind in KINDS}
    longest = max((length for parts in found.values() for length, _ in parts), default=0.0)
    seams = {kind: sorted((p for p in parts if p[0] >= MINOR * longest), key=lambda p: -p[0])
             for kind, parts in found.items()}
    kind = next((kind for kind in KINDS if seams[kind]), None)
    if kind is None:
        raise NoSeamError(spacing, widest)
    middles = [rims.points[pairs].mean(axis=1) for _, pairs in seams[kind]]
    pairs = seams[kind][0][1]
    if kind == 'step':
        raise HiddenWallError(_height(rims, pairs), middles[0].mean(axis=0))
    _require_one(middles, spacing)
    return Course(kind, pairs, middles[0], sum(len(parts) for parts in seams.values()) - 1)


def _whole(rims: Rims, parts: list[NDArray[np.intp]], spacing: float
           ) -> list[tuple[float, NDArray[np.intp]]]:
    """Return length and pairs of the seams that parts of one kind make together."""
    if not parts:
        return []
    pairs = np.concatenate(parts)
    return [(length, pairs[rows]) for length, rows in _parts(rims, pairs, spacing)]


def _pairs(rims: Rims, widest: float, spacing: float) -> NDArray[np.intp]:
    """Return the pairs (k, 2) of rims that look at each other, the nearest of their sheets."""
    i, j = cKDTree(rims.points).query_pairs(widest, output_type='ndarray').T
    way = rims.points[j] - rims.points[i]
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    least = np.where(rims.label[i] == rims.label[j], -AHEAD, AHEAD) * length
    ahead = (way * rims.outlook[i]).sum(axis=1) > least
    ahead &= -(way * rims.outlook[j]).sum(axis=1) > least
    alike = np.abs((rims.normals[i] * rims.normals[j]).sum(axis=1)) > PARALLEL
    opposite = (rims.outlook[i] * rims.outlook[j]).sum(axis=1) < OPPOSITE
    # sheets that touch may meet at an obtuse angle; across a V, a plate faces the other bevel
    ahead &= (alike == opposite) | (~alike & (length < TOUCHING * spacing))
    i, j, length = i[ahead], j[ahead], length[ahead]
    # of each point the nearest on each other sheet
    nearest = []
    for one, other in ((i, j), (j, i)):
        key = np.unique(one * (rims.label.max(initial=0) + 1) + rims.label[other],
                        return_inverse=True)[1]
        least = np.full(len(i), np.inf)
        np.minimum.at(least, key, length)
        nearest.append(least[key])
    chosen = (length == nearest[0]) | (length == nearest[1])
    chosen &= length <= NEXT_NEAREST * np.minimum(*nearest)
    return np.stack([i[chosen], j[chosen]], axis=1)


def _kind(rims: Rims, pairs: NDArray[np.intp], spacing: float, up: Array) -> str:
    """Return the kind of a seam between two sheets; none: their corner stands out."""
    i, j = pairs.T
    normals, outlook = rims.normals, rims.outlook
    alike = (normals[i] * normals[j]).sum(axis=1)
    if np.median(np.abs(alike)) > PARALLEL:
        height = _height(rims, pairs)
        way = np.linalg.norm(rims.points[j] - rims.points[i], axis=1)
        aside = np.sqrt(max(float(np.median(way)) ** 2 - height ** 2, 0.0))
        if height <= max(aside - 2 * spacing, 0.5 * aside):
            return 'butt' if aside > NARROWEST * spacing else 'none'
        return 'lap' if height <= HIGHEST_LAP else 'step'
    into = np.where(normals[i] @ up > normals[j] @ up,  # of an upright wall the normal may be -n
                    (normals[i] * outlook[j]).sum(axis=1), (normals[j] * outlook[i]).sum(axis=1))
    if np.median(into) > -INWARDS:
        return 'none'
    return 'v' if _is_v(rims, pairs, spacing) else 'fillet'


def _covered(rims: Rims, pairs: NDArray[np.intp], points: Array, spacing: float) -> bool:
    """Tell whether something stands in a gap, higher than its edges."""
    ends = rims.points[pairs]
    normal = np.linalg.svd(rims.normals[pairs].reshape(-1, 3), full_matrices=False)[2][0]
    normal *= np.sign((rims.normals[pairs] @ normal).sum())
    flat = np.eye(3) - np.outer(normal, normal)
    reach = 0.25 * float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    middle = ends.mean(axis=1)
    distance, near = cKDTree(points @ flat).query(
        middle @ flat, 8, distance_upper_bound=max(reach, spacing))
    there = np.isfinite(distance)
    above = (points[np.where(there, near, 0)] - middle[:, None]) @ normal > 4 * spacing
    return bool((above & there).any(axis=1).mean() > 0.5)


def _height(rims: Rims, pairs: NDArray[np.intp]) -> float:
    """Return the median height of a step."""
    way = rims.points[pairs[:, 1]] - rims.points[pairs[:, 0]]
    return float(np.median(np.abs((way * rims.normals[pairs[:, 0]]).sum(axis=1))))


def _is_v(rims: Rims, pairs: NDArray[np.intp], spacing: float) -> bool:
    """Tell whether both sheets of a hollow corner bend outwards at their other ends."""
    axis = -rims.outlook[pairs].sum(axis=(0, 1))
    axis /= np.linalg.norm(axis)
    others = np.flatnonzero(np.isin(rims.label, rims.label[pairs], invert=True))
    if not len(others):
        return False
    tree = cKDTree(rims.points[others])
    for sheet in np.unique(rims.label[pairs]):
        own = (rims.label == sheet) & (rims.outlook @ axis > INWARDS)
        distance, near = tree.query(rims.points[own], distance_upper_bound=LINK * spacing)
        plate = others[near[np.isfinite(distance)]]
        if (np.abs(rims.normals[plate] @ axis) > OUTWARDS).sum() < len(pairs) / 8:
            return False
    return True


def _parts(rims: Rims, pairs: NDArray[np.intp], spacing: float
           ) -> list[tuple[float, NDArray[np.intp]]]:
    """Return length and rows of each connected line of pairs that is no crumb, in its order."""
    middle = rims.points[pairs].mean(axis=1)
    links = cKDTree(middle).query_pairs(LINK * spacing, output_type='ndarray')
    length = np.linalg.norm(middle[links[:, 0]] - middle[links[:, 1]], axis=1)
    n = len(middle)
    graph = coo_matrix((np.maximum(length, 1e-9), links.T), shape=(n, n)).tocsr()
    count, label = connected_components(graph, directed=False)
    found = []
    for part in range(count):
        rows = np.flatnonzero(label == part)
        inner = graph[rows][:, rows]
        end = int(np.argmax(dijkstra(inner, directed=False, indices=0)))
        along = dijkstra(inner, directed=False, indices=end)
        if along.max() >= SHORTEST:
            found.append((float(along.max()), rows[np.argsort(along)]))
    return found


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
