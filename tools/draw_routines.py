#!/usr/bin/env python3
"""Draws the artefacts of docs/measure.md: `.venv/bin/python tools/draw_routines.py [FOLDER]`."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import sys

import matplotlib
import numpy as np

matplotlib.use('svg')
from matplotlib import pyplot as plt  # noqa: E402, I100 - the backend first

METAL, LASER = {'facecolor': '0.88', 'edgecolor': '0.35'}, {'color': '#d62728', 'lw': 2.0}
VIEW = np.array([[0.85, -0.35], [0.35, 0.40], [0.0, 0.9]])


def flat(points: list[tuple[float, float, float]]) -> np.ndarray:
    return np.asarray(points, dtype=float) @ VIEW


def face(ax: plt.Axes, *points: tuple[float, float, float]) -> None:
    ax.fill(*flat(list(points)).T, **METAL)


def laser(ax: plt.Axes, *points: tuple[float, float, float]) -> None:
    ax.plot(*flat(list(points)).T, **LASER)


def plate(ax: plt.Axes, z: float = 0.0, x: float = 0.0) -> None:
    face(ax, (x, 0, z), (x + 1, 0, z), (x + 1, 1, z), (x, 1, z))


def line(ax: plt.Axes) -> None:
    plate(ax)
    for at in (0.2, 0.5, 0.8):
        laser(ax, (at - 0.1, -0.05, 0), (at, 0.45, 0))


def plane(ax: plt.Axes) -> None:
    plate(ax)
    laser(ax, (0.1, 0.2, 0), (0.6, 0.4, 0))
    laser(ax, (0.4, 0.8, 0), (0.7, 0.3, 0))
    laser(ax, (0.55, 0.9, 0), (0.95, 0.8, 0))


def point(ax: plt.Axes) -> None:
    plate(ax)
    for end in ((0.5, 0.2, 0), (0.35, 0.5, 0), (0.1, 0.6, 0)):
        laser(ax, (0, 0, 0), end)
    ax.plot(*flat([(0, 0, 0)]).T, 'o', color='#1f77b4')


def ball(ax: plt.Axes, x: float, size: float = 0.3) -> None:
    centre = flat([(x, 0.5, 0.4)])[0]
    ax.add_patch(plt.Circle(centre, size, **METAL))
    turn = np.linspace(0.25, 0.75, 30) * np.pi
    for lean in (-0.5, 0.2, 0.8):
        arc = size * np.column_stack([np.cos(turn), 0.95 * np.sin(turn)])
        c, s = np.cos(lean), np.sin(lean)
        ax.plot(*(centre + arc @ np.array([[c, s], [-s, c]])).T, **LASER)


def sphere(ax: plt.Axes) -> None:
    ball(ax, 0.5, 0.4)


def ball_bar(ax: plt.Axes) -> None:
    ends = flat([(0, 0.5, 0.4), (1.3, 0.5, 0.4)])
    ax.plot(*ends.T, color='0.35', lw=4, zorder=0)
    ball(ax, 0.0)
    ball(ax, 1.3)


def step(ax: plt.Axes) -> None:
    for k, z in enumerate((0.0, 0.25, 0.5)):
        x = 0.45 * k
        face(ax, (x, 0, z), (x + 0.45, 0, z), (x + 0.45, 1, z), (x, 1, z))
        face(ax, (x, 0, z), (x + 0.45, 0, z), (x + 0.45, 0, -0.2), (x, 0, -0.2))
        laser(ax, (x + 0.1, 0.2, z), (x + 0.35, 0.4, z))
        laser(ax, (x + 0.1, 0.8, z), (x + 0.3, 0.6, z))


def square(ax: plt.Axes) -> None:
    plate(ax, 0.6)
    face(ax, (0, 0, 0.6), (1, 0, 0.6), (1, 0, -0.2), (0, 0, -0.2))
    laser(ax, (0.2, 0.3, 0.6), (0.6, 0.5, 0.6))
    laser(ax, (0.7, 0.2, 0.6), (0.8, 0.8, 0.6))
    laser(ax, (0.2, 0, 0.4), (0.5, 0, 0.1))
    laser(ax, (0.6, 0, 0.0), (0.85, 0, 0.3))


def tooth(ax: plt.Axes) -> None:
    x = np.array([0, 0.1, 0.2, 0.3, 0.4])
    z = np.array([0, 0, 0.22, 0.22, 0])
    row = [(a + 0.4 * k, b) for k in range(4) for a, b in zip(x, z, strict=True)]
    back = flat([(a, 1, b) for a, b in row])
    front = flat([(a, 0, b) for a, b in row])
    for k in range(len(row) - 1):
        ax.fill(*np.array([front[k], front[k + 1], back[k + 1], back[k]]).T, **METAL)
    for at in (0.3, 0.7):
        laser(ax, *[(a, at, b) for a, b in row])


PANELS: dict[str, Callable[[plt.Axes], None]] = {
    'line': line, 'plane': plane, 'point': point, 'sphere': sphere, 'ball_bar': ball_bar,
    'step': step, 'square': square, 'tooth': tooth}


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else 'docs/figures')
    matplotlib.rcParams['svg.hashsalt'] = 'handeye_ros'
    drawing, axes = plt.subplots(2, 4, figsize=(9, 4))
    for ax, (name, draw) in zip(axes.ravel(), PANELS.items(), strict=True):
        draw(ax)
        ax.set_title(name, fontsize=10)
        ax.set_aspect('equal')
        ax.axis('off')
    drawing.tight_layout()
    drawing.savefig(folder / 'routines.svg', metadata={'Date': None})


if __name__ == '__main__':
    main()
