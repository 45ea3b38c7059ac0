# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files of a seam, CSV and YAML, and the sentences on it."""
from __future__ import annotations

from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.output import write_whole
from handeye_ros.scanning.seam import Seam, ToolFrames
import numpy as np
import yaml

FORMAT = 'handeye_ros/seam/1'
NAMES = {'v': 'V seam', 'butt': 'butt seam', 'lap': 'lap seam', 'fillet': 'fillet seam'}
COLUMNS = ('length', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'gap', 'mismatch', 'residual', 'std')
NEARBY = 0.01  # m along the seam: sections within it give the residual at a frame


def measures(seam: Seam, frames: ToolFrames) -> Array:
    """
    Return (m, 4) at each frame: gap, mismatch, residual and 1 sigma of its position (m).

    Gap and mismatch: distance between the edges along and across the sheets; residual: RMS
    distance of the sections nearby from the line.
    """
    positions = np.linspace(0.0, seam.curve.length, len(seam.normals))
    across = seam.second - seam.first
    mismatch = (across * seam.normals).sum(axis=1)
    tangent = np.gradient(seam.root, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    along_sheets = across - mismatch[:, None] * seam.normals
    along_sheets -= (across * tangent).sum(axis=1)[:, None] * tangent
    nearby = np.abs(positions - frames.lengths[:, None]) <= NEARBY
    residual = np.sqrt((nearby * seam.residuals ** 2).sum(axis=1) / nearby.sum(axis=1))
    return np.column_stack([*(np.interp(frames.lengths, positions, v) for v in (
        np.linalg.norm(along_sheets, axis=1), np.abs(mismatch))), residual, np.interp(
            frames.lengths, positions, seam.std[:, 0])])


def csv_text(seam: Seam, frames: ToolFrames) -> str:
    """Return arc length, position, quaternion and measures of each frame, metres, as CSV."""
    rows = np.column_stack([frames.lengths, frames.T_base_tool[:, :3, 3],
                            se3.quaternion(frames.T_base_tool), measures(seam, frames)])
    lines = [','.join(COLUMNS), *(','.join(f'{v:.9f}' for v in row) for row in rows)]
    return '\n'.join(lines) + '\n'


def values(seam: Seam, frames: ToolFrames, frame_id: str) -> dict[str, Any]:
    """Return a seam as plain values."""
    return {
        'format': FORMAT, 'frame': frame_id, 'kind': seam.kind, 'line': seam.line,
        'curve': seam.curve.kind, 'length': seam.curve.length, 'noise': seam.noise,
        'residual': seam.residual, 'spacing': seam.spacing,
        'frames': [
            {'length': float(length), 'position': T[:3, 3].tolist(),
             'quaternion': se3.quaternion(T).tolist(),
             **dict(zip(COLUMNS[-4:], map(float, row), strict=True))}
            for length, T, row in zip(frames.lengths, frames.T_base_tool, measures(seam, frames),
                                      strict=True)]}


def yaml_text(content: dict[str, Any]) -> str:
    """Return the values of a seam as YAML."""
    return yaml.safe_dump(content, sort_keys=False, width=100, default_flow_style=None)


def write(folder: Path, seam: Seam, frames: ToolFrames, frame_id: str) -> None:
    """Write seam.csv and seam.yaml; raises UnwritableError."""
    write_whole(folder / 'seam.csv', csv_text(seam, frames))
    write_whole(folder / 'seam.yaml', yaml_text(values(seam, frames, frame_id)))


def sentences(seam: Seam, frames: ToolFrames) -> list[str]:
    """Return the sentences on a seam."""
    gap, mismatch, _, std = 1e3 * measures(seam, frames).T
    begins, ends = frames.lengths[0], seam.curve.length - frames.lengths[-1]
    lines = [f'{NAMES[seam.kind]} of {seam.curve.length * 1e3:.1f} mm, path along its '
             f'{seam.line}: {seam.curve.kind}; {len(frames.lengths)} tool frames',
             f'gap {gap.min():.2f} to {gap.max():.2f} mm, mismatch {mismatch.min():.2f} to '
             f'{mismatch.max():.2f} mm; its sections scatter by {seam.residual * 1e3:.3f} mm',
             f'the points are {seam.spacing * 1e3:.2f} mm apart, their noise is '
             f'{seam.noise * 1e3:.3f} mm; the path is known to {std.max():.3f} mm (1 sigma) or '
             'better']
    if max(begins, ends) > 1e-6:
        lines.append(f'no frames on the first {begins * 1e3:.1f} mm and the last '
                     f'{ends * 1e3:.1f} mm: the line is too uncertain there')
    if seam.others:
        lines.append(f'{seam.others} other edges that face each other (steps, corners) are not '
                     'taken for the seam; cut one out with --box to have it')
    return lines
