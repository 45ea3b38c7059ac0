"""
Files of a seam: CSV, YAML, robot programs; distances from a taught path.

A program of KUKA (KRL), ABB (RAPID) or Universal Robots (URScript) moves a tool along the frames,
in the robot's base: its z axis into the part, x along the seam. The cell defines tool and work
object; the program holds the motion only, not the welding process.
"""
from __future__ import annotations

from collections.abc import Callable
import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.output import write_whole
from handeye_ros.scanning.errors import TaughtPathError
from handeye_ros.scanning.seam import Seam, ToolFrames
import numpy as np
from scipy.spatial.transform import Rotation
import yaml

FORMAT = 'handeye_ros/seam/1'
NAMES = {'v': 'V seam', 'butt': 'butt seam', 'lap': 'lap seam', 'fillet': 'fillet seam'}
COLUMNS = ('length', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'gap', 'mismatch', 'residual', 'std')
NEARBY = 0.01  # m along the seam: sections within it give the residual at a frame
SPEED = 0.01  # m/s, of a program
BLEND = 5e-4  # m: largest blend radius
OVERLAP = 0.45  # largest blend radius, relative to the distance to the next frame
ACCELERATION = 0.5  # m/s^2, needed by URScript
WITHIN = 1e-3  # m: the reported fraction of a taught path is nearer than this


@dataclass(frozen=True)
class Taught:
    """Distances of the points of a taught path from the seam's centre line (m)."""

    count: int
    mean: float
    rms: float
    largest: float
    within_1_mm: float


def against_taught(seam: Seam, taught: Array) -> Taught:
    """
    Return the distances of taught points (n, 3) from the centre line, orthogonal to it.

    Points beyond its ends are not compared.
    """
    t, line = seam.curve.sampled()
    index = np.argmin(((taught[:, None] - line[None]) ** 2).sum(axis=2), axis=1)
    tangent = seam.curve.advance(t)[index]
    offset = taught - line[index]
    along = (offset * tangent).sum(axis=1)
    beside = (index > 0) & (index < len(t) - 1) | (np.abs(along) < WITHIN)
    if not beside.any():
        beside[:] = True
    distance = np.linalg.norm(offset - along[:, None] * tangent, axis=1)[beside]
    return Taught(int(beside.sum()), float(distance.mean()),
                  float(np.sqrt((distance ** 2).mean())), float(distance.max()),
                  float((distance <= WITHIN).mean()))


def read_taught(path: Path) -> Array:
    """Return the points (n, 3) of a CSV file with columns x, y, z; raises TaughtPathError."""
    try:
        with path.open(newline='', encoding='utf-8') as stream:
            rows = list(csv.DictReader(stream, skipinitialspace=True))
        points = np.array([[float(row[axis]) for axis in 'xyz'] for row in rows])
    except OSError as error:
        raise TaughtPathError(path, error.strerror or str(error)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise TaughtPathError(path, f'{type(error).__name__}: {error}') from error
    if not len(points) or not np.isfinite(points).all():
        raise TaughtPathError(path, 'holds no points, or values that are not finite')
    return points


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


def values(seam: Seam, frames: ToolFrames, frame_id: str, taught: Taught | None
           ) -> dict[str, Any]:
    """Return a seam as plain values."""
    content: dict[str, Any] = {
        'format': FORMAT, 'frame': frame_id, 'kind': seam.kind, 'line': seam.line,
        'curve': seam.curve.kind, 'length': seam.curve.length, 'noise': seam.noise,
        'residual': seam.residual, 'spacing': seam.spacing}
    if taught:
        content['taught'] = dict(vars(taught))
    content['frames'] = [
        {'length': float(length), 'position': T[:3, 3].tolist(),
         'quaternion': se3.quaternion(T).tolist(),
         **dict(zip(COLUMNS[-4:], map(float, row), strict=True))}
        for length, T, row in zip(frames.lengths, frames.T_base_tool, measures(seam, frames),
                                  strict=True)]
    return content


def yaml_text(content: dict[str, Any]) -> str:
    """Return the values of a seam as YAML."""
    return yaml.safe_dump(content, sort_keys=False, width=100, default_flow_style=None)


def write(folder: Path, seam: Seam, frames: ToolFrames, frame_id: str, taught: Taught | None
          ) -> None:
    """Write seam.csv and seam.yaml; raises UnwritableError."""
    write_whole(folder / 'seam.csv', csv_text(seam, frames))
    write_whole(folder / 'seam.yaml', yaml_text(values(seam, frames, frame_id, taught)))


def _poses(frames: ToolFrames) -> list[tuple[Array, Rotation]]:
    """Return position (mm) and rotation of the tool at each frame."""
    T = frames.T_base_tool
    turned = np.stack([T[:, :3, 0], -T[:, :3, 2], T[:, :3, 1]], axis=2)  # n, o x n, o
    return [(1e3 * p, Rotation.from_matrix(R)) for p, R in zip(T[:, :3, 3], turned, strict=True)]


def krl(frames: ToolFrames, frame_id: str) -> str:
    """Return a .src of KRL: mm; A, B, C about z, y', x'' in degrees."""
    lines = ['DEF seam( )', 'EXT BAS(BAS_COMMAND :IN,REAL :IN)',
             f'; frames in {frame_id}, which must be $WORLD; start near the first one',
             'BAS(#INITMOV,0)  ; resets $TOOL',
             'BAS(#TOOL,1)  ; put the number of your tool here: its z into the part',
             'BAS(#BASE,0)', f'$VEL.CP={SPEED:g}', f'$APO.CDIS={1e3 * BLEND:g}']
    poses = _poses(frames)
    for k, (p, R) in enumerate(poses):
        names = zip('XYZABC', [*p, *R.as_euler('ZYX', degrees=True)], strict=True)
        position = ','.join(f'{name} {value:.4f}' for name, value in names)
        lines.append(f'LIN {{{position}}}' + ('' if k in (0, len(poses) - 1) else ' C_DIS'))
    return '\n'.join([*lines, 'END', ''])


def rapid(frames: ToolFrames, frame_id: str) -> str:
    """Return a .mod of RAPID: mm; quaternions w x y z."""
    outer = '[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]'
    poses, lines, moves = _poses(frames), [], []
    for k, (p, R) in enumerate(poses):
        position = ','.join(f'{v:.4f}' for v in p)
        turn = ','.join(f'{v:.8f}' for v in R.as_quat()[[3, 0, 1, 2]])
        lines.append(f'  CONST robtarget seam{k}:=[[{position}],[{turn}],{outer}];')
        zone = 'fine' if k in (0, len(poses) - 1) else 'z0'
        moves.append(f'    MoveL seam{k},v{1e3 * SPEED:g},{zone},tool;')
    return '\n'.join([
        'MODULE SeamPath', f'  ! frames in {frame_id}, which must be the world frame (wobj0);',
        '  ! tool: z into the part; start near the first frame', *lines,
        '  PROC followSeam(PERS tooldata tool)', '    ConfL \\Off;', *moves, '    ConfL \\On;',
        '  ENDPROC', 'ENDMODULE', ''])


def urscript(frames: ToolFrames, frame_id: str) -> str:
    """Return a .script: metres; rotation vectors in radians."""
    lines = ['def seam():', f'  # frames in {frame_id}, which must be the base of the robot',
             '  # set_tcp before: z into the part; start near the first frame']
    poses = _poses(frames)
    gaps = np.diff(frames.lengths, prepend=-np.inf, append=np.inf)
    for k, (p, R) in enumerate(poses):
        position = ', '.join(f'{v:.7f}' for v in [*(1e-3 * p), *R.as_rotvec()])
        # blends that overlap are skipped with their frames
        reach = min(BLEND, OVERLAP * min(gaps[k:k + 2]))
        blend = '' if k in (0, len(poses) - 1) else f', r={reach:.6f}'
        lines.append(f'  movel(p[{position}], a={ACCELERATION:g}, v={SPEED:g}{blend})')
    return '\n'.join([*lines, 'end', ''])


PROGRAMS: dict[str, tuple[str, Callable[[ToolFrames, str], str]]] = {
    'krl': ('seam.src', krl), 'rapid': ('seam.mod', rapid), 'ur': ('seam.script', urscript)}


def sentences(seam: Seam, frames: ToolFrames, taught: Taught | None) -> list[str]:
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
    if taught:
        lines.append(f'{taught.count} taught points: mean distance {taught.mean * 1e3:.3f} mm, '
                     f'RMS {taught.rms * 1e3:.3f} mm, largest {taught.largest * 1e3:.3f} mm, '
                     f'{taught.within_1_mm:.0%} within 1 mm')
    return lines
