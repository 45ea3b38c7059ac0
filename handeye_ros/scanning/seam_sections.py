"""
The two edges of a seam, section by section across its rough course.

On each side a polynomial is laid through the section of the sheet, which ends where it most likely
does (see seam_sheets). The foot of a lap lies on the lower sheet under the rim, whether the wall
hides it or not; the root of a fillet is where the sheets meet, that of a V midway between its
lower edges.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from handeye_ros.data import Array
from handeye_ros.scanning.curves import arc_length, averaged, Curve, spline
from handeye_ros.scanning.errors import InterruptedSeamError, NoLineError
from handeye_ros.scanning.seam_edges import Course
from handeye_ros.scanning.seam_sheets import column_resolution, end_of, Rims, sheet_through, Sheets
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

WIDTH = 24.0  # spacings of sheet beside the seam that are looked at, at least
NARROWEST = 6e-3  # m of the same
MARGIN = 2.5  # spacings beside the seam where no end can lie
BEYOND = 2e-3  # m before the rough edge where the sheet may end
TOLERANCE = 4.0  # sigmas of what lies on the sheet
WIDEST_LINE = 12.0  # spacings across the rough course
MISSING = 5e-3  # m of an edge that may be missing
WINDOW = 5e-3  # m along the seam whose pairs tell the rough edges
OVERHANG = 8e-3  # m beyond the ends of the rough course where the seam may go on
ROOT_GAP = 0.5  # spacings between the lower edges of a V on average: more is a root gap, else
MET = 4.0  # spacings that they may be apart in a section, and meet


@dataclass(frozen=True, eq=False)
class Edges:
    """
    The two edges of a seam, section by section.

    at: (k,) lengths along the rough course; first, second, root: (k, 3); normals: (k, 2, 3) of
    the sheets there, out of the part; noise: 1 sigma about the sheets (m); ends: the lengths
    where the seam begins and ends. resolution: (4,) 1 sigma of first, second, root and centre
    that all sections share (m).
    """

    at: Array
    first: Array
    second: Array
    root: Array
    normals: Array
    noise: float
    ends: tuple[float, float]
    resolution: Array


@dataclass(frozen=True, eq=False)
class _Side:
    """
    A sheet in a section: its end (3,), its way out there (3,), its mean normal (3,).

    noise: 1 sigma about it; span: how far it reaches along the seam; resolution: 1 sigma of the
    end from the distance between columns that follow the seam (m).
    """

    end: Array
    outwards: Array
    normal: Array
    noise: float
    span: tuple[float, float]
    resolution: float


@dataclass(frozen=True, eq=False)
class _Line:
    """The rough course: its curve, and per pair t (k,), the place there (k, 3), its two rims."""

    curve: Curve
    t: Array
    at: Array
    rims: tuple[NDArray[np.intp], NDArray[np.intp]]

    def position(self, t: float) -> tuple[Array, Array]:
        """Return the place and way at t, also a little beyond the ends."""
        inside = float(np.clip(t, self.curve.first, self.curve.last))
        way = self.curve.advance(inside)
        return self.curve.position(inside) + (t - inside) * way, way


def edges(points: Array, tree: cKDTree, sheets: Sheets, rims: Rims, rough: Course,
          spacing: float) -> Edges:
    """
    Return the edges of the seam along a rough course.

    Raises NoLineError, InterruptedSeamError.
    """
    line = _line(rims, rough, spacing)
    step = max(1e-3, 3 * spacing)
    first, last = line.curve.first - OVERHANG, line.curve.last + OVERHANG
    at = np.arange(first + 0.5 * step, last, step)
    degree = 1 if rough.kind in ('v', 'fillet') else 2
    sections: list[tuple[float, _Side, _Side]] = []
    for t in at:
        a, b = (_side(points, tree, sheets, rims, line, side, t, step, spacing, degree)
                for side in (0, 1))
        if a is not None and b is not None:
            sections.append((float(t), a, b))
    whole = np.isin(at, [t for t, _, _ in sections])
    _require_whole(whole, [line.position(float(t))[0].tolist() for t in at], step)
    (t0, a0, b0), (t1, a1, b1) = sections[0], sections[-1]
    filled = [(t, a, b) for t, a, b in sections
              if min(np.ptp(a.span), np.ptp(b.span)) > 0.5 * step - spacing]
    gap = np.median([(a.end - b.end) @ (b.outwards - a.outwards)
                     / np.linalg.norm(b.outwards - a.outwards) for _, a, b in filled])
    meeting = {'fillet': np.inf, 'v': MET * spacing * (gap < ROOT_GAP * spacing)}
    joint = partial(_joint, rough.kind, meeting.get(rough.kind, 0.0))
    rows = np.array([joint(a, b) for _, a, b in filled])
    return Edges(np.array([t for t, _, _ in filled]), rows[:, 0], rows[:, 1], rows[:, 2],
                 rows[:, 3:], float(np.median([s.noise for _, *both in filled for s in both])),
                 (t0 + max(a0.span[0], b0.span[0]), t1 + min(a1.span[1], b1.span[1])),
                 np.median([_shared(joint, a, b) for _, a, b in filled], axis=0))


def _line(rims: Rims, rough: Course, spacing: float) -> _Line:
    """Return a smooth curve along the rough course, and the pairs in order across it."""
    t = arc_length(averaged(rough.middle))
    t, index = np.unique(t, return_index=True)
    points, pairs = rough.middle[index], rough.pairs[index]
    curve = spline(t, points)
    at = curve.position(t)
    away = np.linalg.norm(at - points, axis=1)
    widest = float(np.quantile(away, 0.95))
    if widest > WIDEST_LINE * spacing:
        raise NoLineError(2 * widest, points[int(np.argmax(away))])
    i, j = pairs.T
    up = (-rims.outlook[i] - rims.outlook[j] if rough.kind in ('v', 'fillet')
          else rims.normals[i] + rims.normals[j])
    across = np.cross(up, curve.advance(t))
    turned = ((rims.outlook[i] - rims.outlook[j]) * across).sum(axis=1) < 0
    return _Line(curve, t, at, (np.where(turned, j, i), np.where(turned, i, j)))


def _side(points: Array, tree: cKDTree, sheets: Sheets, rims: Rims, line: _Line, side: int,
          t: float, step: float, spacing: float, degree: int) -> _Side | None:
    """Return one sheet in the section at t."""
    near = np.abs(line.t - np.clip(t, line.t[0], line.t[-1])) <= WINDOW
    own, other = line.rims[side][near], line.rims[1 - side][near]
    if not len(own):
        return None
    place, way = line.position(t)
    inwards, upright = _axes(rims, own, other, way)
    off = np.median(rims.points[own] - line.at[near], axis=0)
    start = place + off - (off @ way) * way  # the two of a pair need not lie abreast
    width = max(WIDTH * spacing, NARROWEST)
    rows = np.array(tree.query_ball_point(start + 0.5 * width * inwards, 0.8 * width), dtype=int)
    labels, counts = np.unique(rims.label[own], return_counts=True)
    rows = rows[np.isin(sheets.label[rows], labels[counts > 0.1 * len(own)])]
    along, b, height = ((points[rows] - start) @ np.column_stack([way, inwards, upright])).T
    limit = BEYOND
    if np.isin(labels, rims.label[other]).any():  # one sheet on both sides
        apart = np.median((rims.points[own] - rims.points[other]) @ inwards)
        limit = min(0.5 * abs(float(apart)), BEYOND)
    resolution = column_resolution(b, spacing, MARGIN)
    slab = (np.abs(along) <= step / 2) & (b <= width) & (b >= -limit)
    along, b, height = along[slab], b[slab], height[slab]
    fitted = sheet_through(b, height, MARGIN * spacing, degree)
    if fitted is None:
        return None
    sheet, noise = fitted
    on_sheet = np.abs(height - np.polyval(sheet, b)) < TOLERANCE * noise
    inner = on_sheet & (b > MARGIN * spacing)
    end = -end_of(-b[on_sheet], noise, inner.sum() / (b[inner].max() - MARGIN * spacing))
    if abs(end) > BEYOND:
        return None
    slope = np.polyval(np.polyder(sheet), end)
    mean = np.polyfit(b[inner], height[inner], 1)[0]
    return _Side(start + end * inwards + np.polyval(sheet, end) * upright,
                 -(inwards + slope * upright) / np.hypot(1, slope),
                 (upright - mean * inwards) / np.hypot(1, mean), noise,
                 (float(along[on_sheet].min()), float(along[on_sheet].max())), resolution)


def _axes(rims: Rims, own: NDArray[np.intp], other: NDArray[np.intp], way: Array
          ) -> tuple[Array, Array]:
    """Return the ways into a sheet and out of its surface (3,), square to the seam's."""
    inwards = -rims.outlook[own].mean(axis=0)
    inwards -= (inwards @ way) * way
    inwards /= np.linalg.norm(inwards)
    upright = np.cross(way, inwards)
    towards = upright @ rims.outlook[other].mean(axis=0)
    if abs(towards) > 0.5:  # of a corner: the other sheet ends on this one
        return inwards, -np.sign(towards) * upright
    return inwards, upright if upright @ rims.normals[own].mean(axis=0) >= 0 else -upright


def _joint(kind: str, meeting: float, a: _Side, b: _Side) -> Array:
    """
    Return the two edges, the root and the two normals (5, 3) of a section.

    meeting: edges of a corner that are nearer are where the sheets meet (m).
    """
    first, second, root = a.end, b.end, 0.5 * (a.end + b.end)
    if kind == 'lap':
        normal = a.normal + b.normal  # the curvature of the sheets cancels
        upper, lower = (a, b) if (a.end - b.end) @ normal > 0 else (b, a)
        across = upper.outwards - (upper.outwards @ normal) / (normal @ normal) * normal
        root = lower.end + lower.outwards * (
            ((upper.end - lower.end) @ across) / (lower.outwards @ across))
        first, second = (first, root) if upper is a else (root, second)
    elif np.linalg.norm(first - second) < meeting:
        ways = np.column_stack([a.outwards, -b.outwards])
        root = a.end + a.outwards * np.linalg.lstsq(ways, b.end - a.end, rcond=None)[0][0]
    return np.array([first, second, root, a.normal, b.normal])


def _shared(joint: Callable[[_Side, _Side], Array], a: _Side, b: _Side) -> Array:
    """Return the resolution (4,) of first, second, root and centre of a section (m)."""
    further = [replace(side, end=side.end + side.resolution * side.outwards) for side in (a, b)]
    change = np.stack([joint(further[0], b), joint(a, further[1])]) - joint(a, b)
    lines = np.concatenate([change[:, :3], change[:, :2].mean(axis=1, keepdims=True)], axis=1)
    return np.asarray(np.sqrt((lines ** 2).sum(axis=(0, 2))))


def _require_whole(whole: NDArray[np.bool_], places: list[list[float]], step: float) -> None:
    """Refuse a seam of which too much is missing between its ends."""
    rows = np.flatnonzero(whole)
    if not len(rows):
        raise InterruptedSeamError(len(whole) * step, places[len(places) // 2])
    gaps = np.diff(rows) - 1
    worst = int(np.argmax(gaps)) if len(gaps) else 0
    if len(gaps) and gaps[worst] * step > MISSING:
        raise InterruptedSeamError(float(gaps[worst] * step),
                                   places[int(rows[worst] + gaps[worst] // 2 + 1)])
