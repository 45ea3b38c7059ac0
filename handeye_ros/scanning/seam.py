# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A seam in a cloud, the tool frames along it, and their files, after Wu 2017.

The two edges are sampled in pairs, the centre line is midway between them (eq. 6) and a space
curve is fitted to it (eq. 7). n is its tangent, o is opposite to the normals of the sheets,
a = n x o (eq. 15). Beyond the paper: V and fillet seams follow their root; the normal is the mean
of those of the two sheets, each fitted in its own section; o is made orthogonal to n, so that the
frames are rotations.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.output import csv_text, write_atomically, yaml_text
from handeye_ros.scanning import DEFAULT_TOWARDS, DEFAULT_WIDEST
from handeye_ros.scanning.curves import Curve, spline
from handeye_ros.scanning.rough_seam import rough_seam_of
from handeye_ros.scanning.seam_sections import SeamSections, sections_of_seam
from handeye_ros.scanning.sheets import FLAT_RATIO, sheets_of
from handeye_ros.se3 import unit
from handeye_ros.words import count_of, mm
import numpy as np
from scipy.spatial.transform import Rotation

FORMAT = 'handeye_ros/seam/1'
FRAME_COLUMNS = ('length', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'gap', 'mismatch', 'residual',
                 'std')
NEARBY_LENGTH = 0.01  # m along the seam: sections within it give the residual at a frame
MAX_SPACING = 0.012  # m between points: more are of a cloud in mm
MAX_CLOUD_POINTS = 400_000  # largest number of points of a cloud that are used
MIN_POINTS = 500  # smallest number
# largest 1 sigma of position (m) and approach of an end frame
MAX_FRAME_STD = 4e-5, np.deg2rad(0.4)
MAX_LISTED = 3  # seams of other kinds that are named
MAX_SCATTER = 10.0  # largest scatter of the sections, in sigmas of the points, or one spacing


@dataclass(frozen=True, eq=False)
class Seam:
    """
    A seam: its edges by sections, and curves through them over the same parameter t.

    kind: v, butt, lap or fillet
    line: the name of the curve that the path follows
    curves: by name: through the first and the second edge, the root and the centre
    curve: that of the path, a cubic if that is close to it
    normals: through the directions out of the part, the mean of those of the sheets
    distances: (k,) of the measured roots of the sections from their curve (m)
    spacing: of the points of the cloud (m)
    others: kind, length and place of each seam of another kind, in words
    towards: a direction (3,) within 90 degrees of the approach of the tool
    """

    kind: str
    line: str
    sections: SeamSections
    curves: Mapping[str, Curve]
    curve: Curve
    normals: Curve
    distances: Array
    spacing: float
    others: tuple[str, ...]
    towards: Sequence[float]

    @property
    def scatter(self) -> float:
        """Return how much the sections scatter, the RMS of `distances` (m)."""
        return rms(self.distances)

    def std(self, t: Array) -> Array:
        """
        Return 1 sigma (n, 2) of the path (m) and of its approach (rad) at t (n,).

        That of the path has in it how far a cubic is from the curve through the sections.
        """
        line = self.curves[self.line]
        position = np.hypot(np.hypot(line.std(t), self.sections.resolution[self.line]),
                            np.linalg.norm(self.curve.position(t) - line.position(t), axis=1))
        return np.column_stack([position, self.normals.std(t)])

    def normal(self, t: Array) -> Array:
        """Return the directions (n, 3) out of the part at t (n,), not beyond the sections."""
        return self.normals.position(np.clip(t, *self.sections.t[[0, -1]]))


@dataclass(frozen=True, eq=False)
class ToolFrames:
    """
    Frames of a tool along a seam, at arc lengths (k,) from its start (m).

    T_base_tool: (k, 4, 4), its axes n (advance), o (approach), n x o
    measures: (k, 4) gap, mismatch, residual, 1 sigma of the position (m)
    """

    arc_lengths: Array
    T_base_tool: Array
    measures: Array


def find_seam(points: Array, widest: float = DEFAULT_WIDEST,
              towards: Sequence[float] = DEFAULT_TOWARDS, line: str = 'auto',
              start: Sequence[float] | None = None) -> Seam:
    """
    Return the only seam in a cloud of points (n, 3), which are in metres.

    widest: the largest distance between the edges of a seam (m)
    towards: see Seam
    line: the line that the path follows: root, centre, first, second (edge), or auto, the root of
        V and fillet and the centre of butt and lap
    start: a point (3,) near the end where the seam begins

    Raises DataError where there is no seam, where there are several, and where the only one is
    interrupted or not clear.
    """
    points = np.unique(points, axis=0)
    points = points[::max(-(-len(points) // MAX_CLOUD_POINTS), 1)]
    if len(points) < MIN_POINTS:
        raise DataError(f'the cloud has {len(points)} different points, fewer than '
                        f'{MIN_POINTS}: scan more densely, or widen --box')
    up = -np.asarray(towards)
    sheets = sheets_of(points, up)
    if sheets.spacing > MAX_SPACING:
        raise DataError(f'no seam: the points are {sheets.spacing:.3g} m apart, if the cloud is '
                        'in metres: give one in metres, or scan more densely')
    rough_seam = rough_seam_of(sheets, widest, up)
    if start is not None and np.argmin(np.linalg.norm(
            points[rough_seam.pairs[[0, -1], 0]] - start, axis=1)) == 1:
        rough_seam = replace(rough_seam, pairs=rough_seam.pairs[::-1],
                             t=rough_seam.t[-1] - rough_seam.t[::-1])
    sections = sections_of_seam(sheets, rough_seam)
    if line == 'auto':
        line = 'root' if rough_seam.kind in ('v', 'fillet') else 'centre'
    first, last = sections.ends
    curves = {name: replace(spline(sections.t, values), first=first, last=last)
              for name, values in sections.lines.items()}
    off_root = curves['root'].position(sections.t) - sections.lines['root']
    seam = Seam(rough_seam.kind, line, sections, curves, curves[line].simplified(),
                spline(sections.t, sections.normals), np.linalg.norm(off_root, axis=1),
                sheets.spacing, rough_seam.others, towards)
    if seam.scatter > max(MAX_SCATTER * sheets.noise, sheets.spacing):
        raise DataError(f'the sections of the {seam.kind} seam scatter by {mm(seam.scatter)}, and '
                        f'the points by {mm(sheets.noise)}: this is not a uniform seam; cut it '
                        'out with --box, or scan more densely')
    if sections.noise > FLAT_RATIO * sheets.noise:
        raise DataError(f'the sheets beside the {seam.kind} seam are {mm(sections.noise)} thick, '
                        f'and the noise of the points is {mm(sheets.noise)}: they bend, and the '
                        'noise hides where; scan with less noise, or cut the seam out with --box')
    return seam


def tool_frames(seam: Seam, pitch: float, travel: float = 0.0, work: float = 0.0) -> ToolFrames:
    """
    Return frames of a tool along the seam; frames at the ends that are not certain are dropped.

    pitch: distance between two frames (m)
    travel: the travel angle, by which the tool leans against the advance, about n x o (rad)
    work: the work angle, by which it leans to the side, about n (rad)

    Raises DataError where no frame is certain.
    """
    arc_lengths, t = seam.curve.arc
    std = seam.std(t)
    certain = arc_lengths[(std <= MAX_FRAME_STD).all(axis=1)]
    if not len(certain):
        raise DataError('the position of the seam has a standard deviation of '
                        f'{mm(float(np.median(std[:, 0])))}, too much for a path: scan more '
                        'densely, or with less noise')
    arc_lengths = np.append(np.arange(certain[0], certain[-1] - 0.01 * pitch, pitch), certain[-1])
    t = np.interp(arc_lengths, *seam.curve.arc)
    n = seam.curve.tangent(t)
    o = -seam.normal(t)
    o[o @ np.asarray(seam.towards) < 0] *= -1
    o = unit(o - (o * n).sum(axis=1, keepdims=True) * n)
    R = np.stack([n, o, np.cross(n, o)], axis=-1)
    tilt = Rotation.from_euler('xz', [work, travel]).as_matrix()
    return ToolFrames(arc_lengths, se3.transform(R @ tilt, seam.curve.position(t)),
                      _measures(seam, t))


def _measures(seam: Seam, t: Array) -> Array:
    """
    Return gap, mismatch, residual and 1 sigma of the position (k, 4), in metres, at t (k,).

    Gap and mismatch: distance between the edges along and across the sheets; residual: RMS
    distance of the roots of the sections nearby from the curve through all.
    """
    normal, tangent = seam.normal(t), seam.curves['root'].tangent(t)
    across = seam.curves['second'].position(t) - seam.curves['first'].position(t)
    mismatch, advance = ((across * way).sum(axis=1, keepdims=True) for way in (normal, tangent))
    gap = np.linalg.norm(across - mismatch * normal - advance * tangent, axis=1)
    nearby = np.abs(seam.sections.t - t[:, None]) <= NEARBY_LENGTH
    residual = np.sqrt(nearby @ seam.distances ** 2 / nearby.sum(axis=1))
    return np.column_stack([gap, np.abs(mismatch), residual, seam.std(t)[:, 0]])


def write(folder: Path, seam: Seam, frames: ToolFrames, frame_id: str) -> None:
    """
    Write seam.csv and seam.yaml, with arc length, pose and measures of each frame (m).

    frame_id: the frame of the poses. Raises UnwritableError.
    """
    rows = np.column_stack([frames.arc_lengths, frames.T_base_tool[:, :3, 3],
                            se3.quaternion(frames.T_base_tool), frames.measures])
    texts = ([f'{value:.9f}' for value in row] for row in rows)
    write_atomically(folder / 'seam.csv', csv_text(FRAME_COLUMNS, texts))
    content = {
        'format': FORMAT, 'frame': frame_id, 'kind': seam.kind, 'line': seam.line,
        'curve': seam.curve.kind, 'length': seam.curve.length, 'noise': seam.sections.noise,
        'residual': seam.scatter, 'spacing': seam.spacing,
        'frames': [{'length': row[0], 'position': row[1:4], 'quaternion': row[4:8],
                    **dict(zip(FRAME_COLUMNS[8:], row[8:], strict=True))}
                   for row in rows.tolist()]}
    write_atomically(folder / 'seam.yaml', yaml_text(content))


def sentences(seam: Seam, frames: ToolFrames) -> list[str]:
    """Return the sentences that tell the user about a seam and its tool frames."""
    gap, mismatch, _, std = 1e3 * frames.measures.T
    begins, ends = frames.arc_lengths[0], seam.curve.length - frames.arc_lengths[-1]
    lines = [f'{seam.kind} seam of {seam.curve.length * 1e3:.1f} mm, path along its {seam.line}: '
             f'{seam.curve.kind}; {len(frames.arc_lengths)} tool frames',
             f'gap {gap.min():.2f} to {gap.max():.2f} mm, mismatch {mismatch.min():.2f} to '
             f'{mismatch.max():.2f} mm; its sections scatter by {seam.scatter * 1e3:.3f} mm',
             f'the points are {seam.spacing * 1e3:.2f} mm apart, their noise is '
             f'{seam.sections.noise * 1e3:.3f} mm; the path is known to {std.max():.3f} mm '
             '(1 sigma) or better']
    if max(begins, ends) > 1e-6:
        lines.append(f'no frames on the first {begins * 1e3:.1f} mm and the last '
                     f'{ends * 1e3:.1f} mm: the line is too uncertain there')
    if seam.others:
        lines.append(f'beside it {count_of(len(seam.others), "seam")} of another kind '
                     f'({"; ".join(seam.others[:MAX_LISTED])}): cut one out with --box to have it')
    return lines
