#!/usr/bin/env python3
"""
Draws the rooms of the package from its imports, into docs/figures/architecture.svg.

usage: .venv/bin/python tools/draw_architecture.py [FILE]
"""
from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path
import sys

import matplotlib

matplotlib.use('svg')
from matplotlib import pyplot as plt  # noqa: E402, I100 - the backend first

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'handeye_ros'
GROUND = ('data', 'config', 'errors', 'formats', 'frames', 'least_squares', 'orientations',
          'output', 'se3', 'streams', 'tables', 'units')
LEFT_OUT = {'__init__', '__main__', *GROUND}
SIZE = (1.5, 0.5)  # of a box
STYLE = {'svg.hashsalt': 'architecture', 'svg.fonttype': 'none', 'font.family': 'sans-serif'}


def arrows() -> Counter[tuple[str, str]]:
    """Return how many modules of one room import another."""
    found: Counter[tuple[str, str]] = Counter()
    for file in PACKAGE.rglob('*.py'):
        room = file.relative_to(PACKAGE).with_suffix('').parts[0]
        tree = ast.parse(file.read_text(encoding='utf-8'))
        others = {name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
                  for name in _rooms(node)}
        found.update((room, other) for other in others - {room} - LEFT_OUT
                     if room not in LEFT_OUT)
    return found


def _rooms(node: ast.ImportFrom) -> list[str]:
    """Return the rooms that an import leads to."""
    first, _, rest = (node.module or '').partition('.')
    if first != PACKAGE.name:
        return []
    names = [rest.split('.')[0]] if rest else [alias.name for alias in node.names]
    return [name for name in names if (PACKAGE / name).is_dir()
            or (PACKAGE / f'{name}.py').exists()]


def floors(found: Counter[tuple[str, str]]) -> list[list[str]]:
    """Return the rooms, lowest floor first: each stands above all that it imports."""
    rooms = sorted({room for arrow in found for room in arrow})
    height: dict[str, int] = {}
    while len(height) < len(rooms):
        for room in rooms:
            below = [b for a, b in found if a == room]
            if room not in height and all(b in height for b in below):
                height[room] = 1 + max((height[b] for b in below), default=-1)
    return [[r for r in rooms if height[r] == level] for level in range(max(height.values()) + 1)]


def direct(found: Counter[tuple[str, str]]) -> Counter[tuple[str, str]]:
    """Return the arrows that no chain of others stands for (transitive reduction)."""
    below: dict[str, set[str]] = {}
    for row in floors(found):
        below |= {room: {c for a, b in found if a == room for c in (b, *below[b])} for room in row}
    return Counter({(a, b): count for (a, b), count in found.items()
                    if not any(b in below[c] for x, c in found if x == a)})


def draw(path: Path) -> None:
    """Draw the rooms and the direct arrows between them."""
    found = arrows()
    rows, shown = floors(found), direct(found)
    print(f'{len(found)} arrows between rooms, {len(shown)} of them drawn')
    # every second floor stands a little to the side, so that fewer arrows pass behind a box
    place = {room: (2.4 * (i - (len(row) - 1) / 2) + 0.5 * (-1) ** level, 1.3 * level)
             for level, row in enumerate(rows) for i, room in enumerate(row)}
    with plt.rc_context(STYLE):
        figure, ax = plt.subplots(figsize=(9, 1.15 * len(rows) + 1))
        for (a, b), count in shown.items():
            _arrow(ax, place[a], place[b], count)
        for room, (x, y) in place.items():
            _box(ax, x, y, room, SIZE[0])
        _box(ax, 0.0, -1.2, '   '.join(GROUND) + '   (the ground that all stand on)', 9.0)
        ax.set(xlim=(-5.2, 5.2), ylim=(-1.8, 1.3 * len(rows) - 0.7))
        ax.set_axis_off()
        ax.set_aspect('equal')
        figure.savefig(path, bbox_inches='tight', metadata={'Date': None})


def _box(ax: plt.Axes, x: float, y: float, text: str, width: float) -> None:
    ax.add_patch(plt.Rectangle((x - width / 2, y - SIZE[1] / 2), width, SIZE[1], fc='#eef3f8',
                               ec='#35608a', zorder=3))
    ax.text(x, y, text, ha='center', va='center', fontsize=10, zorder=4)


def _arrow(ax: plt.Axes, start: tuple[float, float], end: tuple[float, float], count: int
           ) -> None:
    ax.annotate('', (end[0], end[1] + SIZE[1] / 2), (start[0], start[1] - SIZE[1] / 2),
                arrowprops={'arrowstyle': '-|>', 'color': '0.55', 'lw': 0.5 + 0.15 * count,
                            'shrinkA': 0, 'shrinkB': 0,
                            'connectionstyle': 'arc3,rad=0.12'})


if __name__ == '__main__':
    draw(Path(sys.argv[1]) if sys.argv[1:] else ROOT / 'docs' / 'figures' / 'architecture.svg')
