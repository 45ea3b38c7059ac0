#!/usr/bin/env python3
"""
How many profiles show their feature among random ranges, and how many a false arc.

usage: python bench/clutter.py [--seeds N] [--only TEXT]

A profile has 2,000 columns over 120 mm. The feature covers an unbroken run of them; a share of
all other columns returns a uniform random range over 50 mm, the rest nothing. noise.sensor is
2e-5 m throughout: most rows have four times as much, white or alike over 5 columns. A row is
'found' when the circle, or the line of the face, is right within 0.1 mm at the feature; 'points'
is the median share of the feature's points that are used (the rim of an arc is left out).
The last rows hold no ball: what is found there is false.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable

from handeye_ros.config import Config, with_values
from handeye_ros.data import Arc, Array, FaceLine
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.profiles.faces import face_features
from handeye_ros.profiles.lines import corner_features
import numpy as np

COLUMNS, WIDTH, DEPTH = 2000, 0.120, 0.050
X = np.linspace(-WIDTH / 2, WIDTH / 2, COLUMNS)
BALL = 0.0127
RIGHT = 1e-4  # m
CONFIG = with_values(Config(), {'noise.sensor': 2e-5, 'target.radius': BALL}, 'clutter')
Shape = Callable[[np.random.Generator], tuple[Array, Array]]


def ball(radius: float, columns: int) -> Shape:
    """Return what draws an arc: the rows of its columns, and their exact ranges."""
    def drawn(rng: np.random.Generator) -> tuple[Array, Array]:
        first = int(rng.integers(0, COLUMNS - columns))
        rows = np.arange(first, first + columns)
        x = X[rows] - X[rows].mean()
        return rows, 0.2 - np.sqrt(radius ** 2 - x ** 2)
    return drawn


def faces(*slopes: float, columns: int = 400) -> Shape:
    """Return what draws straight pieces of equal length, each beginning where the last ends."""
    def drawn(rng: np.random.Generator) -> tuple[Array, Array]:
        first = int(rng.integers(0, COLUMNS - columns))
        rows = np.arange(first, first + columns)
        slope = np.repeat(slopes, columns // len(slopes))
        return rows, 0.2 + np.cumsum(slope) * (X[1] - X[0])
    return drawn


def nothing(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return no rows: clutter alone."""
    return np.empty(0, int), np.empty(0)


def profile(shape: Shape, noise: float, clutter: float, alike: int, rng: np.random.Generator
            ) -> tuple[Array, Array, Array]:
    """Return points (n, 2) of a profile, the rows of the feature, and its exact points."""
    rows, exact = shape(rng)
    z = np.where(rng.random(COLUMNS) < clutter, 0.2 + DEPTH * (rng.random(COLUMNS) - 0.5), np.nan)
    error = np.convolve(rng.normal(size=len(rows) + alike), np.ones(alike) / alike ** 0.5, 'valid')
    z[rows] = exact + noise * error[:len(rows)]
    return np.column_stack([X, z]), rows, np.column_stack([X[rows], exact])


def is_right(found: object, exact: Array) -> bool:
    """Return whether a feature lies on the exact points (n, 2)."""
    if isinstance(found, Arc):
        away = np.linalg.norm(exact - found.centre, axis=1) - found.radius
        return bool(np.abs(away).max() < RIGHT)
    assert isinstance(found, FaceLine)
    normal = np.array([-found.direction[1], found.direction[0]])
    return bool((np.abs((exact - found.centre) @ normal) < RIGHT).mean() > 0.4)


def row(name: str, shape: Shape, extract: Callable[[Array, Config], tuple[object, ...]],
        seeds: int, noise: float, clutter: float, alike: int = 1) -> str:
    """Return the row of a scene."""
    found, right, used, reasons = 0, 0, [], set()
    for seed in range(seeds):
        points, rows, exact = profile(shape, noise, clutter, alike, np.random.default_rng(seed))
        try:
            feature = extract(points, CONFIG)[0]
        except FeatureError as error:
            reasons.add(str(error)[:50])
            continue
        found += 1
        right += len(rows) > 0 and is_right(feature, exact)
        used += [len(feature.raw) / len(rows)] if isinstance(feature, Arc) and len(rows) else []
    text = f'{np.median(used):6.2f}' if used else '      '
    return (f'{name:34} {noise * 1e3:6.3f} {alike:5} {clutter:7.0%} {right:5}/{found}/{seeds} '
            f'{text} {"; ".join(sorted(reasons))}')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=100)
    parser.add_argument('--only', default='', help='rows whose name holds this text')
    arguments = parser.parse_args()
    print(f'{"feature":34} {"noise":>6} {"alike":>5} {"clutter":>7} right/found/of points')
    scenes = [(f'ball of {r * 1e3:.1f} mm on {n}', ball(r, n), arc_features)
              for r, n in ((0.0095, 300), (0.011, 330), (0.0125, 390))]
    scenes += [('plate', faces(0.1), face_features), ('corner', faces(0.5, -0.5), corner_features)]
    false = [('nothing', nothing), ('a plane', faces(0.1)), ('a corner', faces(0.5, -0.5)),
             ('a blunt corner', faces(0.5, 0.2, -0.2, -0.5)), ('a ridge', faces(1.0, -1.0))]
    for name, shape, extract in scenes:
        for noise, alike in ((2e-5, 1), (8.5e-5, 1), (8.5e-5, 5)):
            for clutter in (0.0, 0.3, 0.6, 0.9, 0.95):
                if arguments.only in name:
                    print(row(name, shape, extract, arguments.seeds, noise, clutter, alike))
    for name, shape in false:
        for noise, alike in ((2e-5, 1), (8.5e-5, 5)):
            for clutter in (0.3, 0.9):
                if arguments.only in f'arcs on {name}':
                    print(row(f'arcs on {name}', shape, arc_features, 3 * arguments.seeds, noise,
                              clutter, alike))


if __name__ == '__main__':
    main()
