"""
A seam in a cloud, and the tool frames along it, after Wu 2017.

The two edges are sampled at equal arc lengths, the centre line is midway between the pairs (eq. 6)
and a space curve is fitted to it (eq. 7). n is its tangent, o the normal of the plane through the
k neighbours on the sheets, a = n x o (eq. 15). Beyond the paper: the sheets of a lap are first
moved together by half the step each; the plane is fitted in its own frame, so it may stand
upright; o is made square to n, so that the frames are rotations.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.published import wu2017
from handeye_ros.scanning.curves import arc_length, Curve, spline, through
from handeye_ros.scanning.errors import TooFewPointsError
from handeye_ros.scanning.seam_edges import course, spacing_of
from handeye_ros.scanning.seam_sections import Edges, edges
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

WIDEST = 0.012  # m between the edges of a seam
POINTS = 400_000  # of a cloud that are used, and
FEWEST = 500  # that it must have
SAMPLES_EACH = 1e-3  # m between the pairs of the centre line
PLANE_REACH = 16.0  # spacings: the neighbours that lie so near make the local plane
LEAST_REACH = 4e-3  # m of the same
LAP = 0.7  # of the way between the edges along the normal: they lie above each other


@dataclass(frozen=True, eq=False)
class Seam:
    """
    A seam: its edges (k, 3) in pairs, its centre curve, and the cloud it was found in.

    kind: lap or butt; noise: 1 sigma of the cloud; spacing: of its points; neighbours: how many
    make a local plane. Metres.
    """

    kind: str
    first: Array
    second: Array
    curve: Curve
    points: Array
    noise: float
    spacing: float
    neighbours: int


@dataclass(frozen=True, eq=False)
class ToolFrames:
    """Arc lengths (m,) and T_base_tool (m, 4, 4): columns n (advance), o (approach), n x o."""

    lengths: Array
    T_base_tool: Array


def find_seam(points: Array, widest: float = WIDEST) -> Seam:
    """
    Return the only seam in a cloud (n, 3).

    widest: largest distance between its edges (m). Raises NoSeamError, SeveralSeamsError,
    InterruptedSeamError, NoLineError, TooFewPointsError.
    """
    points = np.unique(points, axis=0)
    points = points[::max(-(-len(points) // POINTS), 1)]
    if len(points) < FEWEST:
        raise TooFewPointsError(len(points), FEWEST)
    spacing = spacing_of(points)
    found = edges(points, course(points, spacing, widest), spacing)
    pairs = _in_pairs(found)
    across = pairs[1] - pairs[0]
    upright = np.abs((across.mean(axis=0) / np.linalg.norm(across.mean(axis=0)))
                     @ found.normals.mean(axis=0))
    reach = max(PLANE_REACH * spacing, LEAST_REACH)
    k = max(int(np.pi * (reach / spacing) ** 2), 12)
    return Seam('lap' if upright > LAP else 'butt', pairs[0], pairs[1],
                through(wu2017.centre_line(pairs[0], pairs[1])), points, found.noise, spacing, k)


def _in_pairs(found: Edges) -> tuple[Array, Array]:
    """Return the smoothed edges, both sampled at so many equal arc lengths."""
    sides = []
    t = arc_length(0.5 * (found.first + found.second))
    t, index = np.unique(t, return_index=True)
    for side in (found.first, found.second):
        curve = spline(t, side[index])
        count = max(int(curve.length / SAMPLES_EACH), 8)
        sides.append((curve, count))
    count = max(count for _, count in sides)
    first, second = (np.array([curve.position(v) for v in curve.by_length(
        np.linspace(0, curve.length, count))]) for curve, _ in sides)
    return first, second


def tool_frames(seam: Seam, pitch: float, towards: Sequence[float] = (0.0, 0.0, -1.0),
                travel: float = 0.0, work: float = 0.0) -> ToolFrames:
    """
    Return frames along the seam.

    pitch: distance between them (m); towards: the approach points this way rather than the other
    (3,). travel: the tool leans back against the advance by so much, about a; work: it leans to
    the side, about n (rad).
    """
    lengths = np.arange(0.0, seam.curve.length + 1e-9, pitch)
    sheet, tree = _on_centre(seam)
    frames = []
    lean = Rotation.from_euler('xz', [work, travel]).as_matrix()
    for t in seam.curve.by_length(lengths):
        place, n = seam.curve.position(t), seam.curve.advance(t)
        near = sheet[tree.query(place, seam.neighbours)[1]]
        o = _approach(near, n)
        o = o if o @ np.asarray(towards) >= 0 else -o
        square = o - (o @ n) * n
        T = wu2017.tool_frame(n, square / np.linalg.norm(square), place)
        frames.append(se3.transform(T[:3, :3] @ lean, place))
    return ToolFrames(lengths, np.array(frames))


def _on_centre(seam: Seam) -> tuple[Array, cKDTree]:
    """Return the sheets beside the seam, each moved so that its edge is on the centre line."""
    centre = wu2017.centre_line(seam.first, seam.second)
    reach = 2 * max(PLANE_REACH * seam.spacing, LEAST_REACH)
    trees = [cKDTree(edge) for edge in (seam.first, seam.second)]
    distance, nearest = zip(*(tree.query(seam.points) for tree in trees), strict=True)
    away = np.array([_beside(seam, side, nearest[side]) for side in (0, 1)])
    side = np.argmin(away, axis=0)
    each = np.arange(len(seam.points))
    index = np.array(nearest)[side, each]
    edge = np.stack([seam.first, seam.second])[side, index]
    moved = seam.points - edge + centre[index]
    kept = np.array(distance)[side, each] < reach
    return moved[kept], cKDTree(moved[kept])


def _beside(seam: Seam, side: int, index: Array) -> Array:
    """Return how far each point lies from the edge of a side (n,) towards the other edge."""
    edge, other = (seam.first, seam.second)[::1 if side == 0 else -1]
    way = (other - edge)[index]
    offset = seam.points - edge[index]
    size = np.linalg.norm(way, axis=1)
    return np.asarray((offset * way).sum(axis=1) / np.maximum(size, 1e-9))


def _approach(neighbours: Array, n: Array) -> Array:
    """Return the normal (3,) of the plane through neighbours (k, 3), whichever way it stands."""
    rough = np.linalg.svd(neighbours - neighbours.mean(axis=0))[2][2]
    frame = np.column_stack([np.cross(rough, n), np.cross(rough, np.cross(rough, n)), rough])
    frame /= np.linalg.norm(frame, axis=0)
    return np.asarray(frame @ wu2017.approach((neighbours - neighbours.mean(axis=0)) @ frame))
