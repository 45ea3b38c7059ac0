"""
A seam in a cloud, and the tool frames along it, after Wu 2017.

The two edges are sampled in pairs, the centre line is midway between them (eq. 6) and a space
curve is fitted to it (eq. 7). n is its tangent, o against the normals of the sheets, a = n x o
(eq. 15). Beyond the paper: V and fillet seams follow their root; the normal is halfway between
those of the two sheets, each fitted in its own section; o is made square to n, so that the frames
are rotations.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.published import wu2017
from handeye_ros.scanning.curves import Curve, spline, through
from handeye_ros.scanning.errors import TooFewPointsError, UncertainSeamError, UnclearSeamError
from handeye_ros.scanning.seam_edges import course, spacing_of
from handeye_ros.scanning.seam_sections import Edges, edges
from handeye_ros.scanning.seam_sheets import rims_of, sheets_of
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

WIDEST = 0.012  # m between the edges of a seam
POINTS = 400_000  # of a cloud that are used, and
FEWEST = 500  # that it must have
SAMPLES_EACH = 1e-3  # m between the pairs of the centre line
UNCERTAIN = 4e-5, np.deg2rad(0.4)  # 1 sigma of the place (m) and approach of an end frame, at most
UNCLEAR = 10.0  # times the points' noise: what sections may scatter by; spacings likewise, 1


@dataclass(frozen=True, eq=False)
class Seam:
    """
    A seam: its edges (k, 3) in pairs, its root (k, 3), its curve, and the cloud it was found in.

    kind: v, butt, lap or fillet; line: which of centre, root, first and second edge the curve is;
    normals: (k, 3), out of the part, halfway between those of the sheets; residuals: (k,) of the
    sections nearest to each pair (m); noise: 1 sigma of the cloud; spacing: of its points;
    others: seams of other kinds that were not taken. std: (k, 2) 1 sigma of the line and of the
    approach (rad). Metres.
    """

    kind: str
    line: str
    first: Array
    second: Array
    root: Array
    normals: Array
    residuals: Array
    curve: Curve
    points: Array
    noise: float
    spacing: float
    others: int
    std: Array

    @property
    def residual(self) -> float:
        """Return the RMS distance of the sections from the line (m)."""
        return float(np.sqrt((self.residuals ** 2).mean()))


@dataclass(frozen=True, eq=False)
class ToolFrames:
    """Arc lengths (m,) and T_base_tool (m, 4, 4): columns n (advance), o (approach), n x o."""

    lengths: Array
    T_base_tool: Array


def find_seam(points: Array, widest: float = WIDEST,
              towards: Sequence[float] = (0.0, 0.0, -1.0), line: str = 'auto',
              start: Sequence[float] | None = None) -> Seam:
    """
    Return the only seam in a cloud (n, 3).

    widest: largest distance between its edges (m); towards: the tool approaches this way rather
    than the other (3,); line: see Seam; start: (3,) a place near the end where the seam begins.
    Raises NoSeamError, SeveralSeamsError, InterruptedSeamError, NoLineError, HiddenWallError,
    UnclearSeamError, TooFewPointsError.
    """
    points = np.unique(points, axis=0)
    points = points[::max(-(-len(points) // POINTS), 1)]
    if len(points) < FEWEST:
        raise TooFewPointsError(len(points), FEWEST)
    spacing, tree, up = spacing_of(points), cKDTree(points), -np.asarray(towards)
    sheets = sheets_of(points, tree, spacing, up)
    rims = rims_of(points, tree, sheets, spacing)
    rough = course(rims, points, spacing, widest, up)
    found = edges(points, tree, sheets, rims, rough, spacing)
    line = line if line != 'auto' else 'root' if rough.kind in ('v', 'fillet') else 'centre'
    first, second, root, normals, residuals, std = _smoothed(found, line)
    spread = float(np.sqrt((residuals ** 2).mean()))
    if max(found.noise, spread) > max(UNCLEAR * sheets.noise, spacing):
        raise UnclearSeamError(max(found.noise, spread), sheets.noise)
    if start is not None and np.argmin(np.linalg.norm(root[[0, -1]] - start, axis=1)) == 1:
        first, second, root, normals, residuals, std = (
            v[::-1] for v in (second, first, root, normals, residuals, std))
    lines = {'first': first, 'second': second, 'root': root,
             'centre': wu2017.centre_line(first, second)}
    return Seam(rough.kind, line, first, second, root, normals, residuals,
                through(lines[line]), points, found.noise, spacing, rough.others, std)


def _smoothed(found: Edges, line: str) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return both edges, root, normals (k, 3), residuals (k,) and std (k, 2), evenly spaced."""
    normals = found.normals.sum(axis=1)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    count = max(int((found.ends[1] - found.ends[0]) / SAMPLES_EACH), 8)
    grid = np.linspace(*found.ends, count)
    curves = {name: spline(found.at, values) for name, values in (
        ('first', found.first), ('second', found.second), ('root', found.root),
        ('centre', wu2017.centre_line(found.first, found.second)))}
    first, second, root, _ = (curve.position(grid) for curve in curves.values())
    turning = spline(found.at, normals)  # not beyond the sections, where it is uncertain
    normals = turning.position(np.clip(grid, found.at[0], found.at[-1]))
    raw = np.array([np.interp(found.at, grid, column) for column in root.T]).T
    away = np.linalg.norm(raw - found.root, axis=1)
    shared = found.resolution[list(curves).index(line)]
    std = np.column_stack([np.hypot(curves[line].std(grid), shared), turning.std(grid)])
    return first, second, root, normals, np.interp(grid, found.at, away), std


def tool_frames(seam: Seam, pitch: float, towards: Sequence[float] = (0.0, 0.0, -1.0),
                travel: float = 0.0, work: float = 0.0) -> ToolFrames:
    """
    Return frames along the seam, the last one at its end, less what is too uncertain at the ends.

    pitch: distance between them (m); towards: the approach points this way rather than the other
    (3,). travel: the tool leans back against the advance by so much, about a; work: it leans to
    the side, about n (rad). Raises UncertainSeamError.
    """
    own = np.linspace(0.0, seam.curve.length, len(seam.normals))
    certain = own[(seam.std <= UNCERTAIN).all(axis=1)]
    if not len(certain):
        raise UncertainSeamError(float(np.median(seam.std[:, 0])))
    lengths = np.append(np.arange(certain[0], certain[-1] - 0.01 * pitch, pitch), certain[-1])
    lean = Rotation.from_euler('xz', [work, travel]).as_matrix()
    frames = []
    for length, t in zip(lengths, seam.curve.by_length(lengths), strict=True):
        place, n = seam.curve.position(t), seam.curve.advance(t)
        o = -np.array([np.interp(length, own, column) for column in seam.normals.T])
        o = o if o @ np.asarray(towards) >= 0 else -o
        square = o - (o @ n) * n
        T = wu2017.tool_frame(n, square / np.linalg.norm(square), place)
        frames.append(se3.transform(T[:3, :3] @ lean, place))
    return ToolFrames(lengths, np.array(frames))
