#!/usr/bin/env python3
"""Draws the workshop drawings of docs/targets.md: `.venv/bin/python tools/draw_plans.py`."""
from __future__ import annotations

from pathlib import Path
import sys

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
import numpy as np

INK, FILL, LASER = '0.2', '0.92', '#d62728'


def size(ax, a, b, text, side):
    """Draw a dimension from a to b, side to the left of that direction (mm on the paper)."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    along = (b - a) / np.linalg.norm(b - a)
    off = side * np.array([-along[1], along[0]])
    for end in (a, b):
        ax.plot(*np.array([end, end + 1.1 * off]).T, color=INK, lw=0.5)
    ax.annotate('', a + off, b + off, arrowprops={'arrowstyle': '<->', 'lw': 0.7, 'color': INK,
                                                  'shrinkA': 0, 'shrinkB': 0})
    ax.text(*((a + b) / 2 + 1.55 * off), text, ha='center', va='center', fontsize=8,
            rotation=np.degrees(np.arctan2(along[1], along[0])))


def note(ax, at, place, text):
    ax.annotate(text, at, place, fontsize=8, arrowprops={'arrowstyle': '-', 'lw': 0.6},
                ha='left', va='center')


def plate(ax):
    """Draw the plate from above, and its edge from the side."""
    ax.set_title('Plate (also line and plane)', fontsize=10)
    ax.add_patch(Polygon([(0, 0), (150, 0), (150, 100), (0, 100)], fc=FILL, ec=INK))
    size(ax, (0, 100), (150, 100), '150 (at least 100)', 8)
    size(ax, (150, 100), (150, 0), '100 (at least 80)', 8)
    for a, b in (((40, -18), (40, 25)), ((-18, 60), (25, 60))):
        ax.plot(*np.array([a, b]).T, color=LASER, lw=1.6)
    note(ax, (90, 0), (58, -26), 'both edges of the corner: straight within 0.05,\n'
                                 'at a right angle, burr taken off, bevel under 0.3')
    note(ax, (95, 50), (45, 38), 'flat within 0.1, matt; 5 thick or more,\n'
                                 'or nothing within 10 below')


def wedge(ax):
    """Draw a block from the side."""
    ax.set_title('Wedge: a block, or an angle bar', fontsize=10)
    ax.add_patch(Polygon([(0, 0), (60, 60), (120, 0)], fc=FILL, ec=INK))
    size(ax, (0, 0), (60, 60), '30 or more', 8)
    note(ax, (60, 60), (78, 66), 'edge straight within 0.05 over 100;\n'
                                 'rounded up to 1 does no harm')
    note(ax, (90, 30), (100, 44), 'both faces flat within 0.05,\nmatt; 60 to 120 degrees between')
    ax.plot([15, 60, 105], [15, 60, 15], color=LASER, lw=1.6)


def ball(ax):
    """Draw a ball on its stand."""
    ax.set_title('Sphere: a ball on a ring', fontsize=10)
    ax.add_patch(Polygon([(35, 0), (85, 0), (80, 22), (40, 22)], fc='0.8', ec=INK))
    ax.add_patch(Circle((60, 48), 30, fc=FILL, ec=INK))
    size(ax, (30, 48), (90, 48), 'diameter 40 to 80', 38)
    angle = np.linspace(0.6, np.pi - 0.6, 40)
    ax.plot(60 + 30 * np.cos(angle), 48 + 30 * np.sin(angle), color=LASER, lw=1.6)
    note(ax, (82, 68), (98, 72), 'round within 0.02, matt;\nmeasure the diameter to 0.02')
    note(ax, (60, 12), (98, 14), 'cannot roll: glue, magnet,\nor its own weight in a ring')


def main() -> None:
    """Write the drawing."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path('docs/figures')
    figure = Figure(figsize=(8, 8.4), layout='constrained')
    FigureCanvasSVG(figure)
    axes = figure.subplot_mosaic([['plate', 'plate'], ['wedge', 'ball']],
                                 height_ratios=[1.15, 1])
    for name, draw in (('plate', plate), ('wedge', wedge), ('ball', ball)):
        draw(axes[name])
        axes[name].set_aspect('equal')
        axes[name].axis('off')
        axes[name].autoscale_view()
    axes['plate'].set(xlim=(-30, 185), ylim=(-38, 125))
    axes['wedge'].set(xlim=(-12, 185), ylim=(-12, 85))
    axes['ball'].set(xlim=(15, 175), ylim=(-6, 112))
    figure.text(0.01, 0.005, 'Millimetres. Red: where the laser line goes.', fontsize=8)
    figure.savefig(folder / 'target_plans.svg', metadata={'Date': None})


if __name__ == '__main__':
    main()
