# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Face lines and edge points of drawn profiles."""
from __future__ import annotations

from typing import Any
import warnings

from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, EdgePoint, FaceLine
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from hypothesis import given
import numpy as np
from profiles import (
    any_points,
    COLUMNS,
    drawn,
    edge_of,
    face,
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

CONFIG = Config()
TOWARDS = with_values(CONFIG, {'profile.range_sign': -1}, 'test')


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


@pytest.mark.parametrize('tilt', [-0.5, 0.0, 0.3])
def test_the_normal_points_of_a_face_are_as_certain_as_they_say(tilt: float) -> None:
    normal = np.array([-np.sin(tilt), np.cos(tilt)])
    single = []
    for seed in range(60):
        line, _ = features_of(marked(gap_up_to(-0.005, tilt), seed))
        single.append((line.points - [0, face(0.0, tilt)]) @ normal / line.points_std)
        ends = (line.points[[0, -1]] - line.centre) @ line.direction / line.spread
        assert np.allclose(np.abs(ends), 5 / 6 * 3 ** 0.5, rtol=0.05), 'shares of one length'
    assert np.shape(single) == (60, 6)
    assert np.std(single) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize('config', [CONFIG, TOWARDS], ids=['away', 'towards'])
def test_of_a_step_the_side_nearer_to_the_sensor_is_the_face(config: Config) -> None:
    sign = config.profile.range_sign
    points = marked(step_up_to(0.002, drop=sign * 0.01))
    line, (edge,) = features_of(points, config)
    assert_edge(edge, 0.002, face(0.002), -1, 'step')
    assert line.centre[0] > 0.002
    line, (edge,) = features_of(marked(step_up_to(0.002, drop=-sign * 0.01)), config)
    assert_edge(edge, 0.002, face(0.002) - sign * 0.01, 1, 'step')
    assert line.centre[0] < 0.002


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


@pytest.mark.parametrize('step', [1, -1])
@pytest.mark.parametrize('gap', [0.004, 0.008, 0.013])
def test_a_face_beside_another_is_whole(gap: float, step: int) -> None:
    # a line that slants through both has more points than either; the nearer one counts if near
    def height(x: Array) -> Array:
        return np.where(x > gap - 0.01, face(x), np.where(x < -0.01, face(x) - 0.001, np.nan))
    for seed in range(10):
        line, (edge,) = features_of(marked(height, seed)[::step] * [step, 1])
        assert line.spread == pytest.approx(0.01 / 12 ** 0.5 / np.cos(0.1), rel=0.06)
        assert edge.point[0] == pytest.approx(-0.01 * step, abs=2 * PITCH)


def test_a_driver_that_leaves_lost_points_out_gives_open_ends() -> None:
    points = marked(gap_up_to(0.0))
    points = points[np.isfinite(points).all(axis=1)]
    _, edges = features_of(points)
    assert [edge.ending for edge in edges] == ['open', 'open'], 'one of them is the border'
    assert edges[0].point[0] == pytest.approx(0, abs=PITCH)


@pytest.mark.parametrize('points', [
    np.empty((0, 2)), np.full((50, 2), np.nan), np.zeros((50, 2)), np.full((50, 2), np.inf),
    np.full((50, 2), 0.17), marked(face)[:10],
    np.random.default_rng(0).uniform(0.15, 0.2, (640, 2))])
def test_what_shows_no_face_is_refused_with_a_reason(points: Array) -> None:
    with pytest.raises(FeatureError, match='face'):
        face_features(points, CONFIG)


@given(any_points())
def test_any_array_gives_finite_features_or_a_reason(points: Array) -> None:
    before = points.copy()
    for config in (CONFIG, TOWARDS):
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            try:
                features = face_features(points, config)
            except FeatureError as error:
                assert str(error)
                continue
        assert len(features) >= 2
        for f in features:
            values = [f.centre, f.direction, f.spread, f.std] if isinstance(f, FaceLine) else [
                f.point, f.direction, f.std, f.std_across]
            assert all(np.isfinite(value).all() for value in values)
            assert np.linalg.norm(f.direction) == pytest.approx(1) and f.std >= 0
    assert np.array_equal(points, before, equal_nan=True)


@pytest.mark.parametrize('slope', [-0.3, 0.0, 0.3])
def test_of_two_surfaces_side_by_side_the_nearer_is_the_face(slope: float) -> None:
    def height(x: Array) -> Array:
        lower = 0.17 + slope * x
        beyond = np.where(x > -0.0065, 0.175 + 4 * (x + 0.0065), lower - 0.003)  # foot, wall, top
        return np.where(x > -0.0065, np.where(x > -0.005, lower, beyond), beyond)
    line, _ = features_of(marked(height))
    assert line.centre[0] < -0.0065, 'the lower one is longer, and ends in a step too'


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
