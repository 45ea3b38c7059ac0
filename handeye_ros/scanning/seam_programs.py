"""
A seam as a program of a robot: KUKA (KRL), ABB (RAPID), Universal Robots (URScript).

Each moves a tool along the frames, in the robot's base: its z axis into the part, x along the
seam. Tool and work object are those that the cell has set; positions only, no process.
"""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros.data import Array
from handeye_ros.scanning.seam import ToolFrames
import numpy as np
from scipy.spatial.transform import Rotation

SPEED = 0.01  # m/s
BLEND = 5e-4  # m from a frame where the robot may leave the line
ACCELERATION = 0.5  # m/s^2, which URScript wants to know


def _poses(frames: ToolFrames) -> list[tuple[Array, Rotation]]:
    """Return position (mm) and rotation of the tool at each frame."""
    T = frames.T_base_tool
    turned = np.stack([T[:, :3, 0], -T[:, :3, 2], T[:, :3, 1]], axis=2)  # n, o x n, o
    return [(1e3 * p, Rotation.from_matrix(R)) for p, R in zip(T[:, :3, 3], turned, strict=True)]


def krl(frames: ToolFrames, frame_id: str) -> str:
    """Return a .src of KRL: mm; A, B, C about z, y', x'' in degrees."""
    lines = ['DEF seam( )', f'; frames in {frame_id}; set $TOOL before: z into the part',
             'BAS(#INITMOV,0)', '$BASE=$NULLFRAME', f'$VEL.CP={SPEED:g}',
             f'$APO.CDIS={1e3 * BLEND:g}']
    poses = _poses(frames)
    for k, (p, R) in enumerate(poses):
        names = zip('XYZABC', [*p, *R.as_euler('ZYX', degrees=True)], strict=True)
        place = ','.join(f'{name} {value:.4f}' for name, value in names)
        lines.append(f'LIN {{{place}}}' + ('' if k in (0, len(poses) - 1) else ' C_DIS'))
    return '\n'.join([*lines, 'END', ''])


def rapid(frames: ToolFrames, frame_id: str) -> str:
    """Return a .mod of RAPID: mm; quaternions w x y z."""
    outer = '[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]'
    poses, lines, moves = _poses(frames), [], []
    for k, (p, R) in enumerate(poses):
        place = ','.join(f'{v:.4f}' for v in p)
        turn = ','.join(f'{v:.8f}' for v in R.as_quat()[[3, 0, 1, 2]])
        lines.append(f'  CONST robtarget seam{k}:=[[{place}],[{turn}],{outer}];')
        zone = 'fine' if k in (0, len(poses) - 1) else 'z0'
        moves.append(f'    MoveL seam{k},v{1e3 * SPEED:g},{zone},tool;')
    return '\n'.join([
        'MODULE SeamPath', f'  ! frames in {frame_id}; tool: z into the part', *lines,
        '  PROC followSeam(PERS tooldata tool)', '    ConfL \\Off;', *moves, '    ConfL \\On;',
        '  ENDPROC', 'ENDMODULE', ''])


def urscript(frames: ToolFrames, frame_id: str) -> str:
    """Return a .script: metres; rotation vectors in radians."""
    lines = ['def seam():', f'  # frames in {frame_id}; set_tcp before: z into the part']
    poses = _poses(frames)
    for k, (p, R) in enumerate(poses):
        place = ', '.join(f'{v:.7f}' for v in [*(1e-3 * p), *R.as_rotvec()])
        blend = '' if k in (0, len(poses) - 1) else f', r={BLEND:g}'
        lines.append(f'  movel(p[{place}], a={ACCELERATION:g}, v={SPEED:g}{blend})')
    return '\n'.join([*lines, 'end', ''])


PROGRAMS: dict[str, tuple[str, Callable[[ToolFrames, str], str]]] = {
    'krl': ('seam.src', krl), 'rapid': ('seam.mod', rapid), 'ur': ('seam.script', urscript)}
