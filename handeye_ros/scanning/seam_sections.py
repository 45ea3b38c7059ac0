# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The two edges of a seam, by sections across the rough seam.

On each side a polynomial is fitted to the section of the sheet; the edge is where its points end.
The foot of a lap lies on the lower sheet under the rim, even where the wall hides it. The root of
a fillet is the intersection of the sheets; that of a V is midway between its lower edges.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros.arithmetic import robust_std
from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError
from handeye_ros.scanning.curves import Curve, spline, STIFF_ONLY
from handeye_ros.scanning.rough_seam import MIN_GAP_WIDTH, position_text, RoughSeam
from handeye_ros.scanning.sheets import SAME_PLANE, Sheets
from handeye_ros.se3 import unit
from handeye_ros.words import mm
import numpy as np
from scipy.signal import find_peaks

MIN_OF_SIDE = 12  # points of a side of a section
INNER_WIDTH = 15.0  # spacings beside the seam within which the distance of columns is measured
BIN_WIDTH = 0.05  # spacings: width of a bin of the points beside the seam
FREQUENCIES = np.fft.rfftfreq(1024, BIN_WIDTH)  # of columns, per spacing
MIN_PERIODICITY = 0.25  # periodicity of columns, more than random points have
SECTION_WIDTH = 24.0  # spacings: width of a sheet's section, at least
MIN_SECTION_WIDTH = 6e-3  # m: the same
EDGE_MARGIN = 2.5  # spacings: the sheet ends within this distance of its rim
MAX_EDGE_OFFSET = 2e-3  # m: largest distance of the edge from the rim
MAX_LINE_WIDTH = 12.0  # spacings: largest width of the rough seam
MAX_MISSING_EDGE = 5e-3  # m: largest missing part of an edge
RIM_WINDOW = 5e-3  # m along the seam: pairs within it give the rims
OVERHANG = 8e-3  # m beyond the ends of the rough seam where the seam may continue
ROOT_GAP = 0.5  # spacings: a larger mean distance of the lower edges of a V is a root gap

SHEET_EDGE = np.dtype([  # one sheet in a section across the seam
    ('edge', float, 3),  # where it ends at the seam (m)
    ('outwards', float, 3),  # direction out of the sheet there
    ('normal', float, 3),  # mean over the section
    ('noise', float),  # 1 sigma of the points about it (m)
    ('extent', float, 2),  # where its points begin and stop along the seam, from the section (m)
    # 1 sigma of the edge from the distance between columns that follow the seam (m)
    ('resolution', float)])


@dataclass(frozen=True, eq=False)
class SeamSections:
    """
    The two edges of a seam, by k sections across it.

    t: (k,) parameter of the sections along the rough seam (m)
    lines: points (k, 3) by name: first and second edge, root, centre (m)
    resolution: 1 sigma of each line that all its points have in common (m)
    normals: (k, 3) out of the part
    noise: 1 sigma of the points about the sheets (m)
    ends: t of start and end of the seam (m)
    """

    t: Array
    lines: dict[str, Array]
    resolution: dict[str, float]
    normals: Array
    noise: float
    ends: tuple[float, float]


def sections_of_seam(sheets: Sheets, rough_seam: RoughSeam) -> SeamSections:
    """Return the sections of a rough seam; raises DataError where it is not one line."""
    is_corner = rough_seam.kind in ('v', 'fillet')
    middle = sheets.points[rough_seam.pairs].mean(axis=1)
    curve = spline(rough_seam.t, middle, STIFF_ONLY)
    distance = np.linalg.norm(curve.position(rough_seam.t) - middle, axis=1)
    line_half_width = float(np.quantile(distance, 0.95))
    if line_half_width > MAX_LINE_WIDTH * sheets.spacing:
        place = position_text(middle[int(np.argmax(distance))])
        raise DataError(f'what looks like a {rough_seam.kind} seam is not a single open line: it '
                        f'is {mm(2 * line_half_width)} wide at {place} (closed, or branching?): '
                        'cut a part out with --box')
    i, j = rough_seam.pairs.T
    up = (-sheets.outward[i] - sheets.outward[j] if is_corner
          else sheets.normals[i] + sheets.normals[j])
    side = _dot(sheets.outward[i] - sheets.outward[j], np.cross(up, curve.tangent(rough_seam.t)))
    pairs = np.where(side < 0, rough_seam.pairs[:, ::-1], rough_seam.pairs)
    rough_seam = replace(rough_seam, pairs=pairs)
    sections = _sections_along(sheets, rough_seam, curve)
    if is_corner:  # out of it the rough seam may bend at its ends
        stiff = spline(sections.t, sections.lines['root'], STIFF_ONLY)
        sections = _sections_along(sheets, rough_seam, stiff)
    return sections


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products (..., 1) of vectors (..., 3)."""
    return np.asarray((a * b).sum(axis=-1, keepdims=True))


def _sections_along(sheets: Sheets, rough_seam: RoughSeam, curve: Curve) -> SeamSections:
    """
    Return the sections across a curve through the rough seam; raises DataError.

    The first of each pair of the rough seam is on the first side.
    """
    step = max(1e-3, 3 * sheets.spacing)
    first, last = rough_seam.t[0] - OVERHANG, rough_seam.t[-1] + OVERHANG
    count = int((last - first) / step)  # the same sections from the other end
    places = 0.5 * (first + last) + step * (np.arange(count) - 0.5 * (count - 1))
    edges_at = {t: [_sheet_edge(sheets, rough_seam, curve, side, t, step) for side in (0, 1)]
                for t in places.tolist()}
    sections = {t: edges for t, edges in edges_at.items() if None not in edges}
    t = np.array([*sections] or [first, last])
    missing = np.append(np.diff(t) - step, 0.0)
    worst = int(np.argmax(missing))
    if missing[worst] > MAX_MISSING_EDGE:
        place = position_text(curve.extrapolated(t[worst:worst + 2].mean())[0])
        raise DataError(f'the {rough_seam.kind} seam is not seen for {mm(float(missing[worst]))} '
                        f'at {place}: scan there again, or cut one part out with --box')

    sheet_edges = np.array([*sections.values()], SHEET_EDGE)  # (k, 2)
    extent = sheet_edges['extent']
    ends = (t[0] + extent[0, :, 0].max(), t[-1] + extent[-1, :, 1].min())
    # the edges of the sheets in a section of few points are not known well
    filled = np.ptp(extent, axis=2).min(axis=1) > 0.5 * step - sheets.spacing
    sheet_edges = sheet_edges[filled]
    edge, outwards, normals = (sheet_edges[name] for name in ('edge', 'outwards', 'normal'))
    gap = np.median(_dot(np.diff(edge, axis=1), unit(np.diff(-outwards, axis=1))))
    meeting_of_v = MIN_GAP_WIDTH * sheets.spacing * (gap < ROOT_GAP * sheets.spacing)
    meeting = {'lap': np.inf, 'fillet': np.inf, 'v': meeting_of_v, 'butt': 0.0}[rough_seam.kind]
    # by how much the lines move with the edges of one side, and then of the other, 1 sigma further
    shift = outwards * sheet_edges['resolution'][..., None]
    lines, *moved_lines = (
        _lines(rough_seam.kind, meeting, edge + shift * by_side, outwards, normals)
        for by_side in (0.0, [[1.0], [0.0]], [[0.0], [1.0]]))
    resolution = {name: float(np.median(np.linalg.norm(
        [moved[name] - line for moved in moved_lines], axis=(0, 2))))
        for name, line in lines.items()}
    return SeamSections(t[filled], lines, resolution, unit(normals.sum(axis=1)),
                        float(np.median(sheet_edges['noise'])), ends)


def _sheet_edge(sheets: Sheets, rough_seam: RoughSeam, curve: Curve, side: int, t: float,
                step: float) -> tuple[Array | float, ...] | None:
    """
    Return a SHEET_EDGE of the section at t along a curve, None where the sheet does not end there.

    side: 0 or 1, of the pairs of the rough seam; step: width of the section along the seam (m).
    """
    window = np.abs(rough_seam.t - np.clip(t, *rough_seam.t[[0, -1]])) <= RIM_WINDOW
    this_rim, other_rim = rough_seam.pairs[window, side], rough_seam.pairs[window, 1 - side]
    if not len(this_rim):
        return None
    position, tangent = curve.extrapolated(t)
    into_sheet, upright = _axes(sheets, this_rim, other_rim, tangent)
    on_curve = curve.position(np.clip(rough_seam.t[window], curve.first, curve.last))
    offset = np.median(sheets.points[this_rim] - on_curve, axis=0)
    # the points of a pair may be displaced along the seam
    origin = position + offset - (offset @ tangent) * tangent
    points = _points_of_sheet(sheets, this_rim, other_rim, origin,
                              np.stack([tangent, into_sheet, upright]))
    along, inward, height = points[np.abs(points[:, 0]) <= step / 2].T
    margin = EDGE_MARGIN * sheets.spacing
    fit = _sheet_through(inward, height, margin, 1 if rough_seam.kind in ('v', 'fillet') else 2)
    if fit is None:
        return None
    sheet, noise = fit
    on_sheet = np.abs(height - np.polyval(sheet, inward)) < SAME_PLANE * noise
    inner = on_sheet & (inward > margin)
    # half the mean distance of points beyond the last one
    edge = inward[on_sheet].min() - 0.5 * (inward[inner].max() - margin) / inner.sum()
    if abs(edge) > MAX_EDGE_OFFSET:
        return None
    slope = np.polyval(np.polyder(sheet), edge)
    mean_slope = np.polyfit(inward[inner], height[inner], 1)[0]
    return (origin + edge * into_sheet + np.polyval(sheet, edge) * upright,
            -(into_sheet + slope * upright) / np.hypot(1, slope),
            (upright - mean_slope * into_sheet) / np.hypot(1, mean_slope), noise,
            np.quantile(along[on_sheet], [0, 1]), _column_resolution(points[:, 1], sheets.spacing))


def _points_of_sheet(sheets: Sheets, this_rim: Indices, other_rim: Indices,
                     origin: Array, axes: Array) -> Array:
    """
    Return the points (n, 3) near a section of the sheet of a rim, along axes from an origin.

    axes: (3, 3) rows along the seam, into the sheet, out of its surface. None are beyond the
    middle between two rims of one sheet.
    """
    width = max(SECTION_WIDTH * sheets.spacing, MIN_SECTION_WIDTH)
    rows = np.array(sheets.tree.query_ball_point(origin + 0.5 * width * axes[1], 0.8 * width),
                    dtype=int)
    labels, counts = np.unique(sheets.label[this_rim], return_counts=True)
    rows = rows[np.isin(sheets.label[rows], labels[counts > 0.1 * len(this_rim)])]
    points = (sheets.points[rows] - origin) @ axes.T
    beyond = MAX_EDGE_OFFSET
    if np.isin(labels, sheets.label[other_rim]).any():  # one sheet on both sides
        apart = (sheets.points[this_rim] - sheets.points[other_rim]) @ axes[1]
        beyond = min(0.5 * abs(float(np.median(apart))), beyond)
    return np.asarray(points[(points[:, 1] <= width) & (points[:, 1] >= -beyond)])


def _axes(sheets: Sheets, this_rim: Indices, other_rim: Indices,
          tangent: Array) -> tuple[Array, Array]:
    """Return the directions into a sheet and out of its surface (3,), orthogonal to the seam."""
    inwards = -sheets.outward[this_rim].mean(axis=0)
    inwards = unit(inwards - (inwards @ tangent) * tangent)
    upright = np.cross(tangent, inwards)
    sense = -upright @ sheets.outward[other_rim].mean(axis=0)
    if abs(sense) <= 0.5:  # else of a corner: the other sheet ends on this one
        sense = upright @ sheets.normals[this_rim].mean(axis=0)
    return inwards, np.copysign(1.0, sense) * upright


def _sheet_through(inward: Array, height: Array, margin: float, degree: int
                   ) -> tuple[Array, float] | None:
    """
    Return the polynomial through a sheet in a section, and the scatter about it (m).

    inward, height: (n,) of the points (m); only those with inward > margin are used. None where
    these are too few.
    """
    sheet, noise = np.zeros(3), np.inf
    for cut in (np.inf, 3.0, 3.0):
        used = (inward > margin) & (np.abs(height - np.polyval(sheet, inward)) <= cut * noise)
        if used.sum() < MIN_OF_SIDE or np.ptp(inward[used]) < margin:
            return None
        sheet = np.polyfit(inward[used], height[used], degree)
        noise = max(robust_std(height[used] - np.polyval(sheet, inward[used])), 1e-6)
    return sheet, noise


def _column_resolution(inward: Array, spacing: float) -> float:
    """
    Return 1 sigma (m) of an edge anywhere between two columns.

    inward: (n,) across the seam from its edge, of the points of many profiles (m). If the columns
    follow the seam, their distance is a period of inward; else the position of the edge between
    columns differs from profile to profile.
    """
    counts, _ = np.histogram(inward / spacing, round((INNER_WIDTH - EDGE_MARGIN) / BIN_WIDTH),
                             (EDGE_MARGIN, INNER_WIDTH))
    periodic = np.abs(np.fft.rfft(counts, 1024)) / max(counts.sum(), 1)
    periodic[(FREQUENCIES < 0.5) | (FREQUENCIES > 5.0)] = 0.0  # not those of columns
    # the first, not a multiple of it
    peaks, _ = find_peaks(periodic, height=max(MIN_PERIODICITY, 0.8 * periodic.max()))
    if counts.sum() < MIN_OF_SIDE or not len(peaks):
        return 0.0
    return float(spacing / FREQUENCIES[peaks[0]] / np.sqrt(12))


def _lines(kind: str, meeting: float, edges: Array, outwards: Array, normals: Array
           ) -> dict[str, Array]:
    """
    Return the lines of k sections by name: points (k, 3) of first and second edge, root, centre.

    edges, outwards, normals: (k, 2, 3) of both sheets, see SHEET_EDGE; meeting: sheets whose edges
    are nearer to each other than this (m) meet in the root.
    """
    edges, root, lower, along = edges.copy(), edges.mean(axis=1), 0, outwards[:, 1]
    if kind == 'lap':  # the rim of the upper sheet is above the root; their curvature cancels
        along = normals.sum(axis=1)
        lower = int(np.median(_dot(edges[:, 0] - edges[:, 1], along)) > 0)
    if meeting:
        start, direction = edges[:, lower], outwards[:, lower]
        apart = edges[:, 1 - lower] - start
        across = direction - _dot(direction, along) / _dot(along, along) * along
        intersection = start + direction * (_dot(apart, across) / _dot(direction, across))
        root = np.where(np.sqrt(_dot(apart, apart)) < meeting, intersection, root)
    if kind == 'lap':
        edges[:, lower] = root
    return {'first': edges[:, 0], 'second': edges[:, 1], 'root': root,
            'centre': edges.mean(axis=1)}
