# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Laser profiles drawn by hand, and any array that a driver might send."""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.profiles.faces import face_features
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

CONFIG = Config()
NOISE = 3e-5
COLUMNS = 641
X = np.linspace(-0.02, 0.02, COLUMNS)
PITCH = float(X[1] - X[0])


def drawn(height: Callable[[Array], Array], seed: int = 0, noise: float = NOISE) -> Array:
    """Return a profile (n, 2) of a height, with range noise; NaN stays."""
    z = height(X) + np.random.default_rng(seed).normal(0, 1, len(X)) * noise
    return np.column_stack([X, z])


def with_lost(points: Array) -> Array:
    """Return a profile that shows that its driver marks lost points, and does not omit them."""
    points = points.copy()
    points[[8, -9]] = np.nan
    return points


def marked(height: Callable[[Array], Array], seed: int = 0) -> Array:
    """Return a profile as drawn, of a driver that marks lost points."""
    return with_lost(drawn(height, seed))


def edge_of(points: Array) -> EdgePoint:
    """Return the edge of a profile that shows one."""
    _, edge = face_features(with_lost(points), Config())
    assert isinstance(edge, EdgePoint)
    return edge


def features_of(points: Array, config: Config = CONFIG) -> tuple[FaceLine, list[EdgePoint]]:
    """Return the face line and the edges of a profile, left to right."""
    line, *edges = face_features(points, config)
    assert isinstance(line, FaceLine)
    assert all(isinstance(edge, EdgePoint) for edge in edges)
    return line, sorted(edges, key=lambda edge: edge.point[0])


def assert_edge(edge: EdgePoint, x: float, z: float, side: int, kind: str) -> None:
    """Check an edge at x, z whose face lies on the other side of it than side says."""
    along = edge.direction
    assert edge.ending == kind and np.sign(along[0]) == side
    assert np.linalg.norm(along) == pytest.approx(1)
    away = np.array([x, z]) - edge.point
    assert abs(away @ along) < 4 * edge.std and abs(away @ along) < 2 * PITCH
    assert abs(away @ [-along[1], along[0]]) < 5 * edge.std_across


def many(height: Callable[[Array], Array], count: int = 15, seed: int = 0
         ) -> list[tuple[Feature, ...]]:
    """Return the features of so many profiles of one face."""
    return [face_features(marked(height, seed * 100 + i), Config()) for i in range(count)]


def face(x: Array, tilt: float = 0.1, at: float = 0.17) -> Array:
    return at + np.tan(tilt) * x


def step_up_to(edge: float, tilt: float = 0.1, drop: float = 0.01) -> Callable[[Array], Array]:
    """Return a face for x > edge, and a table further away beyond it."""
    return lambda x: np.where(x > edge, face(x, tilt), face(x, tilt) + drop)


def shadow_up_to(edge: float, tilt: float = 0.1) -> Callable[[Array], Array]:
    """Return a step of which the first 3 mm below it are not seen."""
    step = step_up_to(edge, tilt)
    return lambda x: np.where((x > edge) | (x < edge - 0.003), step(x), np.nan)


def gap_up_to(edge: float, tilt: float = 0.1) -> Callable[[Array], Array]:
    """Return a face for x > edge, and nothing beyond it."""
    return lambda x: np.where(x > edge, face(x, tilt), np.nan)


def roof(edge: float, tilt: float = 0.1, turn: float = -0.8) -> Callable[[Array], Array]:
    """Return a face for x > edge, and another that turns away from the sensor beyond it."""
    return lambda x: np.where(x > edge, face(x, tilt), face(edge, tilt)
                              + np.tan(tilt + turn) * (x - edge))


numbers = st.one_of(
    st.floats(-0.1, 0.1), st.floats(0.1, 0.3), st.just(float('nan')),
    st.sampled_from([0.0, -0.0, 0.17, 1e-300, -1e-12, float('inf'), float('-inf')]),
    st.floats(allow_nan=True, allow_infinity=True, width=32))


@st.composite
def any_points(draw: st.DrawFn) -> Array:
    """
    Return (n, 2) arrays of all kinds.

    Anything at all, or something like a profile with anything mixed in: equal and unsorted
    columns, constant ones, drop-outs, values without any sense.
    """
    n = draw(st.integers(0, 120))
    points = draw(arrays(float, (n, 2), elements=numbers))
    if n and draw(st.booleans()):
        x = np.linspace(-0.02, 0.02, n)
        like = draw(st.sampled_from(['line', 'step', 'roof', 'arc', 'constant', 'column']))
        z = {'line': face(x), 'step': step_up_to(0.002)(x), 'roof': roof(0.003)(x),
             'arc': 0.2 - np.sqrt(0.04 ** 2 - x ** 2), 'constant': np.full(n, 0.17),
             'column': np.linspace(0.15, 0.19, n)}[like]
        x = np.full(n, 0.01) if like == 'column' else x
        use = draw(arrays(bool, n, elements=st.sampled_from([True] * 9 + [False])))
        points = np.where(use[:, None], np.column_stack([x, z]), points)
        points[:, 1] += draw(st.sampled_from([0.0, NOISE])) * np.sin(np.arange(n) * 12.9898)
    if draw(st.booleans()):
        points = points[np.random.default_rng(draw(st.integers(0, 9))).permutation(n)]
    return points
