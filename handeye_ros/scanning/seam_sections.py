# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The two edges of a seam, by sections across its rough course.

On each side a polynomial is fitted to the section of the sheet; the edge is its most likely end
(_end_of). The foot of a lap lies on the lower sheet under the rim, even where the wall
hides it. The root of a fillet is the intersection of the sheets; that of a V is midway between
its lower edges.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

from handeye_ros.data import Array
from handeye_ros.errors import DataError, mm
from handeye_ros.scanning.curves import arc_length, averaged, Curve, spline
from handeye_ros.scanning.seam_edges import Course, position_text
from handeye_ros.scanning.seam_sheets import Rims, Sheets
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

FEWEST = 12  # points of a side of a section
SHORT = 0.365  # mean bias of the most likely end for few points, times the density
INNER = 15.0  # spacings beside the seam within which the distance of columns is measured
BIN = 0.05  # spacings: width of a bin of the points beside the seam
FREQUENCIES = np.fft.rfftfreq(1024, BIN)  # of columns, per spacing
REGULAR = 0.25  # periodicity of columns, more than random points have
WIDTH = 24.0  # spacings: width of a sheet's section, at least
NARROWEST = 6e-3  # m: the same
MARGIN = 2.5  # spacings: the sheet ends within this distance of the rough edge
BEYOND = 2e-3  # m: largest distance of the end from the rough edge
TOLERANCE = 4.0  # sigmas of points on the sheet
WIDEST_LINE = 12.0  # spacings: largest width of the rough course
MISSING = 5e-3  # m: largest missing part of an edge
WINDOW = 5e-3  # m along the seam: pairs within it give the rough edges
OVERHANG = 8e-3  # m beyond the ends of the rough course where the seam may continue
ROOT_GAP = 0.5  # spacings: a larger mean distance of the lower edges of a V is a root gap
MET = 4.0  # spacings: else they meet in a section if they are nearer


@dataclass(frozen=True, eq=False)
class Edges:
    """
    The two edges of a seam, by sections.

    lengths: (k,) along the rough course; first, second, root: (k, 3); normals: (k, 2, 3) of the
    sheets, out of the part; noise: 1 sigma about the sheets (m); ends: lengths of start and end of
    the seam. resolution: (4,) common 1 sigma of first, second, root and centre (m).
    """

    lengths: Array
    first: Array
    second: Array
    root: Array
    normals: Array
    noise: float
    ends: tuple[float, float]
    resolution: Array

    def reversed(self) -> Edges:
        """Return the same seam from its other end, where first and second change places."""
        start, end = self.ends
        return replace(self, lengths=-self.lengths[::-1], first=self.second[::-1],
                       second=self.first[::-1], root=self.root[::-1],
                       normals=self.normals[::-1, ::-1], ends=(-end, -start),
                       resolution=self.resolution[[1, 0, 2, 3]])


@dataclass(frozen=True, eq=False)
class _Side:
    """
    A sheet in a section: its end (3,), outward direction (3,), mean normal (3,).

    noise: 1 sigma about it; span: its extent along the seam; resolution: 1 sigma of the end from
    the distance between columns that follow the seam (m).
    """

    end: Array
    outwards: Array
    normal: Array
    noise: float
    span: tuple[float, float]
    resolution: float


@dataclass(frozen=True, eq=False)
class _Line:
    """The rough course: its curve, and for each pair t (k,) and the rims (2, k) of the sides."""

    curve: Curve
    t: Array
    rims: NDArray[np.intp]

    @cached_property
    def points(self) -> Array:
        """Return the point (k, 3) of each pair on the curve."""
        return self.curve.position(np.clip(self.t, self.curve.first, self.curve.last))

    def position(self, t: float) -> tuple[Array, Array]:
        """Return position and tangent at t, extrapolated a little beyond the ends."""
        clipped = float(np.clip(t, self.curve.first, self.curve.last))
        tangent = self.curve.advance(clipped)
        return self.curve.position(clipped) + (t - clipped) * tangent, tangent


@dataclass(frozen=True, eq=False)
class _Cloud:
    """The points (n, 3) with their sheets and rims, and the kind of the seam between two."""

    points: Array
    tree: cKDTree
    spacing: float
    sheets: Sheets
    rims: Rims
    kind: str

    @property
    def is_corner(self) -> bool:
        """Return whether the sheets meet at an angle."""
        return self.kind in ('v', 'fillet')


def edges(points: Array, tree: cKDTree, sheets: Sheets, rims: Rims, rough: Course,
          spacing: float) -> Edges:
    """
    Return the edges of the seam along a rough course.

    Raises DataError.
    """
    cloud = _Cloud(points, tree, spacing, sheets, rims, rough.kind)
    line = _line(cloud, rough)
    found = _edges_along(line, cloud)
    if cloud.is_corner:  # out of a corner the rough course may bend at its ends
        line = replace(line, curve=spline(found.lengths, found.root))
        found = _edges_along(line, cloud)
    return found


def _line(cloud: _Cloud, rough: Course) -> _Line:
    """Return a smooth curve along the rough course, and the pairs in its order."""
    rims, middle = cloud.rims, cloud.rims.points[rough.pairs].mean(axis=1)
    t, index = np.unique(arc_length(averaged(middle)), return_index=True)
    points, (i, j) = middle[index], rough.pairs[index].T
    curve = spline(t, points)
    distance = np.linalg.norm(curve.position(t) - points, axis=1)
    widest = float(np.quantile(distance, 0.95))
    if widest > WIDEST_LINE * cloud.spacing:
        place = position_text(points[int(np.argmax(distance))])
        raise DataError(f'what looks like a seam is not a single open line: it is '
                        f'{mm(2 * widest)} wide at {place} (closed, or branching?): cut a part '
                        'out with --box')
    up = (-rims.outward[i] - rims.outward[j] if cloud.is_corner
          else rims.normals[i] + rims.normals[j])
    across = np.cross(up, curve.advance(t))
    turned = ((rims.outward[i] - rims.outward[j]) * across).sum(axis=1) < 0
    return _Line(curve, t, np.where(turned, [j, i], [i, j]))


def _edges_along(line: _Line, cloud: _Cloud) -> Edges:
    """Return the edges by sections across a line; raises DataError."""
    step = max(1e-3, 3 * cloud.spacing)
    first, last = line.t[0] - OVERHANG, line.t[-1] + OVERHANG
    sections: list[tuple[float, _Side, _Side]] = []
    for t in np.arange(first + 0.5 * step, last, step).tolist():
        a, b = (_side(cloud, line, side, t, step) for side in (0, 1))
        if a is not None and b is not None:
            sections.append((t, a, b))
    seen = np.array([t for t, _, _ in sections] or [first, last])
    missing = np.append(np.diff(seen) - step, 0.0)
    worst = int(np.argmax(missing))
    if not sections or missing[worst] > MISSING:
        place = position_text(line.position(0.5 * (seen[worst] + seen[worst + 1]))[0])
        raise DataError(f'the seam is not seen for {mm(float(missing[worst]))} at {place}: scan '
                        'there again, or cut one part out with --box')
    (t0, a0, b0), (t1, a1, b1) = sections[0], sections[-1]
    filled = [(t, a, b) for t, a, b in sections
              if min(np.ptp(a.span), np.ptp(b.span)) > 0.5 * step - cloud.spacing]
    gap = np.median([(a.end - b.end) @ (b.outwards - a.outwards)
                     / np.linalg.norm(b.outwards - a.outwards) for _, a, b in filled])
    meeting = {'fillet': np.inf, 'v': MET * cloud.spacing * (gap < ROOT_GAP * cloud.spacing)}
    joint = partial(_joint, cloud.kind, meeting.get(cloud.kind, 0.0))
    rows = np.array([joint(a, b) for _, a, b in filled])
    return Edges(np.array([t for t, _, _ in filled]), rows[:, 0], rows[:, 1], rows[:, 2],
                 rows[:, 3:], float(np.median([s.noise for _, *sides in filled for s in sides])),
                 (t0 + max(a0.span[0], b0.span[0]), t1 + min(a1.span[1], b1.span[1])),
                 np.median([_resolution(joint, a, b) for _, a, b in filled], axis=0))


def _side(cloud: _Cloud, line: _Line, side: int, t: float, step: float) -> _Side | None:
    """Return one sheet in the section at t, None where it does not end there."""
    rims, spacing, margin = cloud.rims, cloud.spacing, MARGIN * cloud.spacing
    window = np.abs(line.t - np.clip(t, line.t[0], line.t[-1])) <= WINDOW
    own, other = line.rims[side, window], line.rims[1 - side, window]
    if not len(own):
        return None
    position, tangent = line.position(t)
    inwards, upright = _axes(rims, own, other, tangent)
    offset = np.median(rims.points[own] - line.points[window], axis=0)
    # the points of a pair may be displaced along the seam
    start = position + offset - (offset @ tangent) * tangent
    width = max(WIDTH * spacing, NARROWEST)
    rows = np.array(cloud.tree.query_ball_point(start + 0.5 * width * inwards, 0.8 * width),
                    dtype=int)
    labels, counts = np.unique(rims.label[own], return_counts=True)
    rows = rows[np.isin(cloud.sheets.label[rows], labels[counts > 0.1 * len(own)])]
    along, b, height = ((cloud.points[rows] - start)
                        @ np.column_stack([tangent, inwards, upright])).T
    limit = BEYOND
    if np.isin(labels, rims.label[other]).any():  # one sheet on both sides
        separation = np.median((rims.points[own] - rims.points[other]) @ inwards)
        limit = min(0.5 * abs(float(separation)), BEYOND)
    resolution = _column_resolution(b, spacing)
    slab = (np.abs(along) <= step / 2) & (b <= width) & (b >= -limit)
    along, b, height = along[slab], b[slab], height[slab]
    fitted = _sheet_through(b, height, margin, 1 if cloud.is_corner else 2)
    if fitted is None:
        return None
    sheet, noise = fitted
    on_sheet = np.abs(height - np.polyval(sheet, b)) < TOLERANCE * noise
    inner = on_sheet & (b > margin)
    end = -_end_of(-b[on_sheet], noise, inner.sum() / (b[inner].max() - margin))
    if abs(end) > BEYOND:
        return None
    slope = np.polyval(np.polyder(sheet), end)
    mean = np.polyfit(b[inner], height[inner], 1)[0]
    return _Side(start + end * inwards + np.polyval(sheet, end) * upright,
                 -(inwards + slope * upright) / np.hypot(1, slope),
                 (upright - mean * inwards) / np.hypot(1, mean), noise,
                 (float(along[on_sheet].min()), float(along[on_sheet].max())), resolution)


def _axes(rims: Rims, own: NDArray[np.intp], other: NDArray[np.intp], tangent: Array
          ) -> tuple[Array, Array]:
    """Return the directions into a sheet and out of its surface (3,), orthogonal to the seam."""
    inwards = -rims.outward[own].mean(axis=0)
    inwards -= (inwards @ tangent) * tangent
    inwards /= np.linalg.norm(inwards)
    upright = np.cross(tangent, inwards)
    towards = upright @ rims.outward[other].mean(axis=0)
    if abs(towards) > 0.5:  # of a corner: the other sheet ends on this one
        return inwards, -np.sign(towards) * upright
    return inwards, upright if upright @ rims.normals[own].mean(axis=0) >= 0 else -upright


def _sheet_through(b: Array, height: Array, margin: float, degree: int
                   ) -> tuple[Array, float] | None:
    """Return the polynomial through the sheet at b > margin, and the residual scatter."""
    beside: NDArray[np.bool_] = np.asarray(b > margin)
    if beside.sum() < FEWEST or np.ptp(b[beside]) < margin:
        return None
    sheet, noise = np.zeros(3), np.inf
    for cut in (np.inf, 3.0, 3.0):
        distance = np.abs(height - np.polyval(sheet, b))
        used = beside & (distance <= cut * noise)
        if used.sum() < FEWEST:
            return None
        sheet = np.polyfit(b[used], height[used], degree)
        noise = 1.4826 * float(np.median(np.abs(height[used] - np.polyval(sheet, b[used]))))
        noise = max(noise, 1e-6)
    return sheet, noise


def _end_of(b: Array, noise: float, density: float) -> float:
    """
    Return the most likely end of points b (n,), uniform below it with a density (1/m).

    noise: 1 sigma of the points along b (m).
    """
    def excess(end: float) -> float:
        scaled = (end - b) / noise
        ratio = np.exp(-0.5 * scaled ** 2 - log_ndtr(scaled)) / np.sqrt(2 * np.pi)
        return float(ratio.sum() / noise - density)

    last = float(b.max())
    low, high = last - 5 * noise, last + 5 * noise + 10 / max(density, 1.0)
    if excess(low) < 0 or excess(high) > 0:
        return last
    return float(brentq(excess, low, high, xtol=1e-8)) + SHORT / density


def _column_resolution(b: Array, spacing: float) -> float:
    """
    Return 1 sigma (m) of an end anywhere between two columns.

    b: (n,) across the seam from its edge, of the points of many profiles (m). If the columns
    follow the seam, their distance is a period of b; else the position of the end between columns
    differs from profile to profile.
    """
    counts, _ = np.histogram(b / spacing, round((INNER - MARGIN) / BIN), (MARGIN, INNER))
    if counts.sum() < FEWEST:
        return 0.0
    periodic = np.abs(np.fft.rfft(counts, 1024)) / counts.sum()
    periodic[(FREQUENCIES < 0.5) | (FREQUENCIES > 5.0)] = 0.0  # not those of columns
    if periodic.max() < REGULAR:
        return 0.0
    peak = int(np.argmax(periodic > 0.8 * periodic.max()))  # the first, not a multiple of it
    while periodic[peak + 1] > periodic[peak]:
        peak += 1
    return float(spacing / FREQUENCIES[peak] / np.sqrt(12))


def _joint(kind: str, meeting: float, a: _Side, b: _Side) -> Array:
    """
    Return the two edges, the root and the two normals (5, 3) of a section.

    meeting: edges of a corner that are nearer to each other meet (m).
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
        directions = np.column_stack([a.outwards, -b.outwards])
        root = a.end + a.outwards * np.linalg.lstsq(directions, b.end - a.end, rcond=None)[0][0]
    return np.array([first, second, root, a.normal, b.normal])


def _resolution(joint: Callable[[_Side, _Side], Array], a: _Side, b: _Side) -> Array:
    """Return the resolution (4,) of first, second, root and centre of a section (m)."""
    further = [replace(side, end=side.end + side.resolution * side.outwards) for side in (a, b)]
    change = np.stack([joint(further[0], b), joint(a, further[1])]) - joint(a, b)
    lines = np.concatenate([change[:, :3], change[:, :2].mean(axis=1, keepdims=True)], axis=1)
    return np.asarray(np.sqrt((lines ** 2).sum(axis=(0, 2))))
