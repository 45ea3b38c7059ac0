"""
The two edges of a seam, section by section across its rough course.

On each side of the seam a parabola is laid through the section of the sheet; its end is where the
sheet, seen with noise, most likely ends: for points spread evenly with density q up to an end e,
each off by a Gaussian error of s, the likelihood is largest where
sum phi((e - b) / s) / Phi((e - b) / s) / s = q.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.scanning.curves import arc_length, Curve, spline
from handeye_ros.scanning.errors import InterruptedSeamError, NoLineError
from handeye_ros.scanning.seam_edges import Course
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

WIDTH = 24.0  # spacings of sheet beside the seam that are looked at, at least
NARROWEST = 6e-3  # m of the same
MARGIN = 2.5  # spacings beside the seam where no end can lie
FEWEST = 12  # points of a side of a section
TOLERANCE = 4.0  # sigmas of what lies on the sheet
WIDEST_LINE = 12.0  # spacings across the rough course
MISSING = 5e-3  # m of an edge that may be missing


@dataclass(frozen=True, eq=False)
class Edges:
    """The two edges of a seam: points (k, 3) each, section by section; noise: of the cloud."""

    first: Array
    second: Array
    normals: Array
    noise: float


def edges(points: Array, rough: Course, spacing: float) -> Edges:
    """
    Return the edges of the seam along a rough course.

    Raises NoLineError, InterruptedSeamError.
    """
    middle, lines = _middle(rough, spacing)
    step = max(1e-3, 3 * spacing)
    at = np.arange(0.5 * step, middle.length, step)
    tree, found, noises = cKDTree(points), [], []
    for t in middle.by_length(at):
        place, way = middle.position(t), middle.advance(t)
        normal = lines.normals[np.argmin(((lines.points - place) ** 2).sum(axis=1))]
        normal = normal - (normal @ way) * way
        frame = np.column_stack([way, np.cross(normal, way), normal])
        frame /= np.linalg.norm(frame, axis=0)
        ends = _section(points, tree, place, frame, step, spacing)
        if ends:
            noises.append(ends[1])
            found.append(np.concatenate([place + ends[0] @ frame.T, normal[None]]))
        else:
            found.append(np.full((3, 3), np.nan))
    rows = np.array(found)
    _require_whole(rows, np.array([middle.position(t) for t in middle.by_length(at)]), step)
    rows = rows[np.isfinite(rows).all(axis=(1, 2))]
    return Edges(rows[:, 0], rows[:, 1], rows[:, 2], float(np.median(noises)))


def _middle(rough: Course, spacing: float) -> tuple[Curve, Course]:
    """Return a smooth curve along the rough course, and its points with normals of one side."""
    points = rough.points
    t = arc_length(_averaged(points))
    t, index = np.unique(t, return_index=True)
    curve = spline(t, points[index])
    away = np.linalg.norm(np.array([curve.position(v) for v in t]) - points[index], axis=1)
    widest = float(np.quantile(away, 0.95))
    if widest > WIDEST_LINE * spacing:
        raise NoLineError(2 * widest, points[index][int(np.argmax(away))])
    towards = np.linalg.svd(rough.normals)[2][0]
    normals = rough.normals * np.sign(rough.normals @ towards)[:, None]
    return curve, Course(points, _averaged(normals))


def _averaged(values: Array, reach: int = 10) -> Array:
    """Return the means of neighbouring rows."""
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    index = np.arange(len(values))
    half = np.minimum(np.minimum(index, len(values) - 1 - index), reach)
    return np.asarray((total[index + half + 1] - total[index - half])
                      / (2 * half + 1)[:, None])


def _section(points: Array, tree: cKDTree, place: Array, frame: Array, step: float,
             spacing: float) -> tuple[Array, float] | None:
    """Return the ends of both sides (2, 3) in the section's frame, and the noise."""
    width = max(WIDTH * spacing, NARROWEST)
    near = points[tree.query_ball_point(place, 1.5 * width)]
    along, across, height = ((near - place) @ frame).T
    slab = (np.abs(along) <= step / 2) & (np.abs(across) <= width)
    across, height = across[slab], height[slab]
    sides = [_side(sign * across, height, MARGIN * spacing) for sign in (-1.0, 1.0)]
    if sides[0] is None or sides[1] is None:
        return None
    (left, s_left), (right, s_right) = sides[0], sides[1]
    apart_left = np.abs(height - np.polyval(left, -across))
    apart_right = np.abs(height - np.polyval(right, across))
    on_left = (apart_left < TOLERANCE * s_left) & (
        (across < 0) | (apart_right > 2 * TOLERANCE * s_right))
    on_right = (apart_right < TOLERANCE * s_right) & (
        (across > 0) | (apart_left > 2 * TOLERANCE * s_left))
    ends = []
    for b, sheet, noise in ((-across[on_left], left, s_left),
                            (across[on_right], right, s_right)):
        inner = b > MARGIN * spacing
        density = inner.sum() / (width - MARGIN * spacing)
        end = -_end_of(-b, noise, density)
        ends.append((end, np.polyval(sheet, end)))
    return (np.array([[0.0, -ends[0][0], ends[0][1]], [0.0, *ends[1]]]),
            float(np.hypot(s_left, s_right) / 2 ** 0.5))


def _side(b: Array, height: Array, margin: float) -> tuple[Array, float] | None:
    """Return the parabola through the sheet at b > margin, and the scatter about it."""
    kept: NDArray[np.bool_] = np.asarray(b > margin)
    if kept.sum() < FEWEST:
        return None
    sheet, noise = np.array([0.0, 0.0, 0.0]), np.inf
    for cut in (np.inf, 3.0, 3.0):
        apart = np.abs(height - np.polyval(sheet, b))
        used = kept & (apart <= cut * noise)
        if used.sum() < FEWEST:
            return None
        sheet = np.polyfit(b[used], height[used], 2)
        noise = 1.4826 * float(np.median(np.abs(height[used] - np.polyval(sheet, b[used]))))
        noise = max(noise, 1e-6)
    return sheet, noise


def _end_of(b: Array, noise: float, density: float) -> float:
    """Return the likeliest end of points b (n,) spread evenly below it; see the module."""
    def excess(end: float) -> float:
        scaled = (end - b) / noise
        ratio = np.exp(-0.5 * scaled ** 2 - log_ndtr(scaled)) / np.sqrt(2 * np.pi)
        return float(ratio.sum() / noise - density)

    last = float(b.max())
    low, high = last - 5 * noise, last + 5 * noise + 10 / max(density, 1.0)
    if excess(low) < 0 or excess(high) > 0:
        return last
    return float(brentq(excess, low, high, xtol=1e-8))


def _require_whole(rows: Array, places: Array, step: float) -> None:
    missing = np.logical_not(np.isfinite(rows).all(axis=(1, 2)))
    start = None
    for k, lost in enumerate([*missing, False]):
        if lost and start is None:
            start = k
        elif not lost and start is not None:
            inside = start > 0 and k < len(missing)
            if inside and (k - start) * step > MISSING or k - start == len(missing):
                raise InterruptedSeamError((k - start) * step, places[(start + k) // 2])
            start = None
