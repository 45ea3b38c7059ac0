# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The edge points of drawn profiles (edges.py, edge_rounding.py)."""
from __future__ import annotations

from typing import Any

from handeye_ros.data import Array
import numpy as np
from profiles import (
    assert_edge,
    COLUMNS,
    drawn,
    edge_of,
    face,
    features_of,
    gap_up_to,
    marked,
    NOISE,
    PITCH,
    roof,
    shadow_up_to,
    step_up_to,
    with_lost,
    X,
)
import pytest

EDGES = [(step_up_to, 'step'), (shadow_up_to, 'shadow'), (gap_up_to, 'gap'), (roof, 'roof')]


@pytest.mark.parametrize(('shape', 'kind'), EDGES, ids=[kind for _, kind in EDGES])
@pytest.mark.parametrize('tilt', [-0.4, 0.0, 0.3])
@pytest.mark.parametrize('mirrored', [False, True])
def test_an_edge_is_found(shape: Any, kind: str, tilt: float, mirrored: bool) -> None:
    # of the two faces of a roof the larger one is taken
    for seed, edge in enumerate(np.linspace(-0.008, -0.002 if kind == 'roof' else 0.008, 9)):
        tilt_of_face = tilt if kind != 'roof' else abs(tilt)
        points = marked(shape(edge, tilt_of_face), seed)
        if mirrored:
            points = points * [-1, 1]
        side = 1 if mirrored else -1
        line, (only,) = features_of(points)
        assert_edge(only, -side * edge, face(edge, tilt_of_face), side, kind)
        assert abs(line.direction @ only.direction) == pytest.approx(1)
        assert (only.point - line.centre) @ only.direction > 0, 'the edge leads out of the face'


@pytest.mark.parametrize(('left', 'behind', 'kind'), [(-0.008, np.nan, 'gap'),
                                                      (-0.006, 0.01, 'step')])
def test_both_edges_of_a_profile_are_found(left: float, behind: float, kind: str) -> None:
    def height(x: Array) -> Array:
        return np.where(x > 0.008, np.nan, np.where(x > left, face(x), face(x) + behind))
    line, (first, last) = features_of(marked(height))
    assert_edge(first, left, face(left), -1, kind)
    assert_edge(last, 0.008, face(0.008), 1, 'gap')
    assert line.spread == pytest.approx((0.008 - left) / 12 ** 0.5 / np.cos(0.1), rel=0.02)


def test_lost_points_inside_the_face_are_no_edge() -> None:
    points = marked(gap_up_to(-0.012))
    points[300:340, 1] = np.nan
    points[400:403, 1] = np.inf
    points[::9] = np.nan
    _, (edge,) = features_of(points)
    assert edge.point[0] == pytest.approx(-0.012, abs=3 * PITCH)


def test_outliers_and_speckle_do_not_move_an_edge() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = marked(step_up_to(0.0021), seed)
        is_outlier = rng.random(COLUMNS) < 0.05
        points[is_outlier, 1] += rng.uniform(-5e-3, 5e-3, is_outlier.sum())
        points[:, 1] += np.convolve(rng.normal(size=COLUMNS + 3), np.ones(4) / 2, 'valid') * NOISE
        edges = features_of(points)[1]
        nearest = min(abs(edge.point[0] - 0.0021) for edge in edges)
        assert len(edges) == 1 and nearest < 6 * PITCH


@pytest.mark.parametrize(('mirror', 'step'), [([1, 1], -1), ([-1, 1], 1)])
def test_columns_may_run_backwards_and_a_mirror_mirrors(mirror: list[int], step: int) -> None:
    for shape, kind in EDGES:
        points = marked(shape(0.003))
        line, (edge,) = features_of(points)
        line_m, (edge_m,) = features_of(points[::step] * mirror)
        assert np.allclose(edge.point * mirror, edge_m.point)
        assert edge.ending == edge_m.ending == kind
        assert np.allclose(edge.direction * mirror, edge_m.direction)
        assert np.allclose(line.centre * mirror, line_m.centre)
        assert (line.std, line.spread) == pytest.approx((line_m.std, line_m.spread), rel=0.02)


def test_a_driver_that_leaves_lost_points_out_gives_open_ends() -> None:
    points = marked(gap_up_to(0.0))
    points = points[np.isfinite(points).all(axis=1)]
    _, edges = features_of(points)
    assert [edge.ending for edge in edges] == ['open', 'open'], 'one of them is the border'
    assert edges[0].point[0] == pytest.approx(0, abs=PITCH)


@pytest.mark.parametrize('bow', [-2e-4, -1e-4, 1e-4, 2e-4])  # of a bent laser line, at its end (m)
def test_a_face_that_is_seen_bent_is_a_parabola_up_to_its_edge(bow: float) -> None:
    def height(x: Array) -> Array:
        return np.where(x > -0.012, face(x) + bow * (x / 0.02) ** 2, face(x) + 0.01)
    errors, seeds = [], 40
    for seed in range(seeds):
        line, (edge,) = features_of(marked(height, seed))
        x, z = edge.point
        assert abs(x + 0.012) < 2 * PITCH
        assert abs(z - height(max(x, -0.01199))) < 8 * edge.std_across and not edge.to_lowest.any()
        x, z = line.points.T
        errors.append((z - height(x)) / line.points_std)
    assert np.abs(np.sum(errors, axis=0)).max() < 4 * seeds ** 0.5  # no point of it is biased


def bent(radius: float, wall: float, tilt: float = 0.35) -> Array:
    """Return a face for x > 0 whose end is rounded, a wall below it seen at a slant, a table."""
    turn = np.linspace(0, np.pi / 2, 40)
    corner = radius * np.column_stack([1 - np.sin(turn), 1 - np.cos(turn)])
    outline = np.concatenate([[[0.03, 0.0]], corner, [[0.0, wall]]])
    c, s = np.cos(tilt), np.sin(tilt)
    x, z = (outline @ np.array([[c, s], [-s, c]])).T
    heights = np.interp(X, x[::-1], z[::-1])
    return 0.17 + np.where(x[-1] > X, wall + 0.01, heights)


@pytest.mark.parametrize('radius', [0.0, 3e-4, 1e-3])
@pytest.mark.parametrize('wall', [0.003, 0.008])
def test_a_wall_gives_the_same_edge_whatever_the_corner(radius: float, wall: float) -> None:
    errors = []
    for seed in range(10):
        edge = edge_of(drawn(lambda _: bent(radius, wall), seed))
        assert edge.ending == 'roof' and not edge.to_lowest.any()
        errors.append((edge.point - [0, 0.17]) @ edge.direction)
        assert abs(errors[-1]) < 4 * edge.std
    assert abs(np.mean(errors)) < 0.6 * PITCH


@pytest.mark.parametrize('drop', [0.003, 0.012])
def test_a_smoothed_step_is_cut_at_half_its_height(drop: float) -> None:
    for seed, at in enumerate(np.linspace(-0.003, 0.003, 7)):
        z = drawn(step_up_to(at, drop=drop), seed)[:, 1]
        smooth = np.convolve(np.pad(z, 4, mode='edge'), np.ones(9) / 9, 'valid')
        smooth[[int(seed * 3 + 300), 320]] = np.nan
        edge = edge_of(np.column_stack([X, smooth]))
        assert abs(edge.point[0] - at) < PITCH < 2 * edge.std
        assert edge.ending == 'step'


def test_points_of_one_depth_below_an_edge_are_no_wall() -> None:
    def ledge(x: Array) -> Array:
        z, last = np.where(x > 0, 0.17, np.nan), int(np.searchsorted(x, 0))
        for away, share in ((1, 0.25), (4, 0.48), *((k, 0.7) for k in range(7, 13)), (16, 1.0)):
            z[last - away] = 0.17 + share * 1.5e-3
        return z

    _, (edge, *_) = features_of(with_lost(drawn(ledge, noise=0.0)))
    assert edge.ending == 'gap' and np.isfinite(edge.point).all()
