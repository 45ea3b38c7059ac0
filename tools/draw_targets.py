#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Draws the targets of docs/cell.md: `.venv/bin/python tools/draw_targets.py [FOLDER]`."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import sys

import matplotlib
import numpy as np

matplotlib.use('svg')
from matplotlib import pyplot as plt  # noqa: E402, I100 - the backend first

VIEW = np.array([[0.82, -0.45], [0.32, 0.42], [0.0, 0.9]])  # x, y, z on paper
SOLID, LASER, POINT = {'color': '0.35', 'lw': 1.0}, {'color': '#d62728', 'lw': 2.2}, '#1f77b4'


def flat(points: Sequence[Sequence[float]]) -> np.ndarray:
    """Return points (n, 3) on the paper (n, 2)."""
    return np.asarray(points, dtype=float) @ VIEW


def stroke(ax: plt.Axes, points: Sequence[Sequence[float]], **style: object) -> None:
    """Draw a line through points (n, 3)."""
    ax.plot(*flat(points).T, solid_capstyle='round', **style)


def face(ax: plt.Axes, points: Sequence[Sequence[float]], shade: str = '0.93') -> None:
    """Draw a filled face with the given corners (n, 3)."""
    ax.fill(*flat(points).T, facecolor=shade, edgecolor='0.35', lw=1.0)


def slab(ax: plt.Axes, x: float, y: float, height: float) -> None:
    """Draw a plate with its upper corner in the origin."""
    face(ax, [(0, 0, 0), (x, 0, 0), (x, 0, -height), (0, 0, -height)], '0.85')
    face(ax, [(x, 0, 0), (x, y, 0), (x, y, -height), (x, 0, -height)], '0.80')
    face(ax, [(0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0)])


def dots(ax: plt.Axes, *points: Sequence[float]) -> None:
    """Draw what is measured as points."""
    ax.plot(*flat(points).T, 'o', color=POINT, ms=5)


def fan(ax: plt.Axes, first: Sequence[float], last: Sequence[float], rise: float = 1.3) -> None:
    """Draw the light from the sensor to the ends of the laser line."""
    source = (np.asarray(first, dtype=float) + last) / 2 + [0, 0, rise]
    ax.fill(*flat([source, first, last]).T, color='#d62728', alpha=0.08, lw=0)
    ax.plot(*flat([source]).T, 's', color='0.2', ms=7)


def plate(ax: plt.Axes) -> None:
    """Draw the plate, a laser line across either edge."""
    slab(ax, 2.4, 1.8, 0.25)
    for outer, edge, inner in (((1.5, -0.35, -0.25), (1.5, 0, 0), (1.5, 0.75, 0)),
                               ((-0.35, 1.1, -0.25), (0, 1.1, 0), (0.75, 1.1, 0))):
        fan(ax, outer, inner)
        stroke(ax, [edge, inner], **LASER)
        dots(ax, edge)
    stroke(ax, [(0, 0, 0), (2.4, 0, 0)], color=POINT, lw=2)
    stroke(ax, [(0, 0, 0), (0, 1.8, 0)], color=POINT, lw=2)


def line(ax: plt.Axes) -> None:
    """Draw the straight edge with laser lines across it, from different sides."""
    slab(ax, 2.6, 1.2, 0.25)
    for x, lean in ((0.5, -0.25), (1.3, 0.1), (2.1, 0.3)):
        stroke(ax, [(x, 0, 0), (x + lean, 0.7, 0)], **LASER)
        dots(ax, (x, 0, 0))
    fan(ax, (1.27, -0.3, -0.25), (1.4, 0.7, 0))
    stroke(ax, [(0, 0, 0), (2.6, 0, 0)], color=POINT, lw=2)


def plane(ax: plt.Axes) -> None:
    """Draw the plane with laser lines all over it."""
    face(ax, [(0, 0, 0), (2.6, 0, 0), (2.6, 1.8, 0), (0, 1.8, 0)])
    for ends in (((0.3, 0.4, 0), (1.2, 0.5, 0)), ((1.5, 0.3, 0), (2.2, 0.9, 0)),
                 ((0.7, 1.5, 0), (1.5, 1.0, 0))):
        stroke(ax, ends, **LASER)
    fan(ax, (0.7, 1.5, 0), (1.5, 1.0, 0))


def ridge(ax: plt.Axes, ends: tuple[float, float], height: float, half: float) -> None:
    """Draw two faces that meet in an edge along y, at a height, each so wide."""
    edge = [(0.0, y, height) for y in ends]
    for side, shade in ((-1, '0.93'), (1, '0.82')):
        face(ax, [*edge, (side * half, ends[1], 0.0), (side * half, ends[0], 0.0)], shade)


def wedge(ax: plt.Axes) -> None:
    """Draw the edge of a block with laser lines across both faces."""
    ridge(ax, (0.0, 2.4), 0.9, 0.9)
    for y, lean in ((0.5, -0.2), (1.2, 0.1), (1.9, 0.25)):
        stroke(ax, [(-0.7, y - lean, 0.2), (0, y, 0.9), (0.7, y + lean, 0.2)], **LASER)
    fan(ax, (-0.7, 1.1, 0.2), (0.7, 1.3, 0.2), 1.9)
    stroke(ax, [(0, 0, 0.9), (0, 2.4, 0.9)], color=POINT, lw=2)


def ball(ax: plt.Axes, centre: Sequence[float] = (0, 0, 0), cut: float = 0.35) -> None:
    """Draw a ball of radius 0.8, and the arc that the laser draws on it off its middle."""
    turn = np.linspace(0, 2 * np.pi, 100)
    outline = flat([centre])[0] + 0.85 * np.column_stack([np.cos(turn), np.sin(turn)])
    ax.fill(*outline.T, facecolor='0.93', edgecolor='0.35', lw=1.0)
    radius = (0.8 ** 2 - cut ** 2) ** 0.5
    arc = np.linspace(-1.1, 1.1, 40)
    points = np.asarray(centre) + np.column_stack([radius * np.sin(arc), 0 * arc - cut,
                                                   radius * np.cos(arc)])
    stroke(ax, points, **LASER)
    dots(ax, centre)


def sphere(ax: plt.Axes) -> None:
    """Draw the ball on its stem."""
    stroke(ax, [(0, 0, -0.8), (0, 0, -1.3)], color='0.6', lw=8)
    ball(ax)
    fan(ax, (-0.65, -0.35, 0.3), (0.65, -0.35, 0.3), 1.6)


def points(ax: plt.Axes) -> None:
    """Draw the tip of a tool at several places, in sight of a fixed sensor."""
    places = [(0, 0, 0), (1.2, 0.2, 0.4), (0.5, 1.1, 0.1), (1.7, 1.0, 0.8), (0.6, 0.4, 0.9)]
    for place in places:
        stroke(ax, [place, (place[0] - 0.12, place[1], place[2] + 0.5)], color='0.5', lw=2.5)
    dots(ax, *places)
    ax.plot(*flat([(2.7, 0.0, 1.9)]).T, 's', color='0.2', ms=9)
    for place in places:
        stroke(ax, [(2.7, 0.0, 1.9), place], color='#d62728', lw=0.5, alpha=0.5)


def hand_eye(ax: plt.Axes) -> None:
    """Draw the circle target with its two diameters and the stripe through its centre."""
    face(ax, [(0, 0, 0), (2.2, 0, 0), (2.2, 2.0, 0), (0, 2.0, 0)])
    turn = np.linspace(0, 2 * np.pi, 80)
    stroke(ax, np.column_stack([1.1 + 0.8 * np.cos(turn), 1 + 0.8 * np.sin(turn), 0 * turn]),
           **SOLID)
    stroke(ax, [(0.3, 1, 0), (1.9, 1, 0)], **SOLID)
    stroke(ax, [(1.1, 0.2, 0), (1.1, 1.8, 0)], **SOLID)
    stroke(ax, [(0.6, 0.3, 0), (1.6, 1.7, 0)], **LASER)
    dots(ax, (0.3, 1, 0), (1.9, 1, 0), (1.1, 0.2, 0), (1.1, 1.8, 0), (1.1, 1, 0))
    fan(ax, (0.6, 0.3, 0), (1.6, 1.7, 0))


def tracker(ax: plt.Axes) -> None:
    """Draw ball and block with the swept laser lines, and the reflector's arc and line."""
    ball(ax, (0, -0.3, 0.2), 0.0)
    ridge(ax, (1.2, 3.2), 0.9, 0.9)
    for y in (1.5, 2.0, 2.5, 3.0):
        stroke(ax, [(-0.7, y, 0.2), (0, y, 0.9), (0.7, y, 0.2)], **LASER)
    turn = np.linspace(0.2, 1.5, 12)
    arc = np.column_stack([2.2 + np.cos(turn), 0.3 + np.sin(turn), 0 * turn + 1.6])
    dots(ax, *arc)
    dots(ax, *np.column_stack([np.full(8, 2.4), np.linspace(1.8, 3.2, 8), np.full(8, 1.6)]))


TARGETS: dict[str, Callable[[plt.Axes], None]] = {
    'plate': plate, 'line': line, 'plane': plane, 'sphere': sphere, 'wedge': wedge,
    'points': points, 'hand_eye': hand_eye, 'tracker': tracker}


def main(folder: Path) -> None:
    """Draw every target into the folder."""
    matplotlib.rcParams['svg.hashsalt'] = 'handeye'  # the same file every time
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in TARGETS.items():
        figure, ax = plt.subplots(figsize=(3.2, 2.4))
        draw(ax)
        ax.set_aspect('equal')
        ax.axis('off')
        figure.savefig(folder / f'{name}.svg', bbox_inches='tight', metadata={'Date': None})
        plt.close(figure)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parents[1] / 'docs' / 'figures')
