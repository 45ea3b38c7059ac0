"""Pictures of seams for files."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.data import Array
from handeye_ros.output import figure, save
from handeye_ros.scanning.seam import Seam, ToolFrames
import numpy as np

CLOUD_POINTS = 6000  # of a seam that are drawn
ARROW = 8e-3  # m


def draw_seam(seam: Seam, frames: ToolFrames, path: Path) -> None:
    """
    Write a seam from two sides: cloud, edges, centre line and tool frames.

    Raises NoMatplotlibError, UnwritableError.
    """
    drawing, axes = figure(2, 1)
    centre = seam.curve.sampled(200)[1]
    R, origin = _view(centre, frames)
    near = seam.points[::max(len(seam.points) // CLOUD_POINTS, 1)]
    names = ('along the seam', 'across', 'along the approach')
    for ax, (i, j) in zip(axes, ((0, 1), (0, 2)), strict=True):
        def put(points: Array, style: str, label: str, *, size: float = 1.0,
                ax: object = ax, i: int = i, j: int = j) -> None:
            p = (points - origin) @ R * 1e3
            ax.plot(p[:, i], p[:, j], style, label=label, markersize=size,  # type: ignore
                    linewidth=1.2)
        put(near, '.', 'cloud', size=0.6)
        put(seam.first, '-', 'first edge')
        put(seam.second, '-', 'second edge')
        put(centre, 'k-', f'centre ({seam.curve.kind})')
        starts = (frames.T_base_tool[:, :3, 3] - origin) @ R * 1e3
        ways = frames.T_base_tool[:, :3, 1] @ R * ARROW * 1e3
        ax.quiver(starts[:, i] - ways[:, i], starts[:, j] - ways[:, j], ways[:, i], ways[:, j],
                  angles='xy', scale_units='xy', scale=1, width=2e-3, color='tab:red',
                  label='approach')
        ax.set_xlabel(f'{names[i]} [mm]')
        ax.set_ylabel(f'{names[j]} [mm]')
        ax.set_aspect('equal')
    axes[1].invert_yaxis()  # the tool comes from above
    axes[0].legend(loc='upper right', fontsize=7, ncols=5)
    save(drawing, path)


def _view(centre: Array, frames: ToolFrames) -> tuple[Array, Array]:
    """Return the axes (3, 3) and origin of the view: along, across, approach."""
    along = centre[-1] - centre[0]
    approach = frames.T_base_tool[:, :3, 1].mean(axis=0)
    along = along / np.linalg.norm(along)
    across = np.cross(approach, along)
    across /= np.linalg.norm(across)
    return np.column_stack([along, across, np.cross(along, across)]), centre.mean(axis=0)
