# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Arcs of a sphere in drawn profiles: exact, noisy, among clutter; any array at all."""
from __future__ import annotations

from collections.abc import Callable
import warnings

from handeye_ros.config import Config, with_values
from handeye_ros.data import Arc, Array
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.arcs import arc_features
from handeye_ros.sampling.features import features_of_stop
from hypothesis import given
import numpy as np
from profiles import any_points, drawn, face, NOISE
import pytest

KNOWN = with_values(Config(), {'target.type': 'sphere', 'target.radius': 0.04}, 'test')
UNKNOWN = with_values(Config(), {'target.type': 'sphere'}, 'test')
CENTRE = np.array([0.003, 0.2])


def ball(x: Array, radius: float = 0.03, centre: Array = CENTRE) -> Array:
    """Return a circle's side towards the sensor, nothing beside it."""
    squares = radius ** 2 - (x - centre[0]) ** 2
    return np.where(squares > 0, centre[1] - np.sqrt(np.maximum(squares, 0)), np.nan)


def wide(height: Callable[[Array], Array], seed: int = 0, noise: float = NOISE) -> Array:
    """Return a profile twice as wide as usual, that the whole ball fits in."""
    return drawn(lambda x: height(2 * x), seed, noise) * [2, 1]


@pytest.mark.parametrize('config', [KNOWN, UNKNOWN], ids=['known', 'unknown'])
@pytest.mark.parametrize('radius', [0.012, 0.03, 0.0395])
def test_an_exact_arc_is_recovered_exactly(config: Config, radius: float) -> None:
    arc, = arc_features(wide(lambda x: ball(x, radius), noise=0.0), config)
    assert np.allclose(arc.centre, CENTRE, atol=1e-9) and arc.radius == pytest.approx(radius)
    assert np.allclose(np.linalg.norm(arc.measured - CENTRE, axis=1), radius)
    # a mean of angles and radii, so the mean points lie on the circle too
    assert np.allclose(np.linalg.norm(arc.points - CENTRE, axis=1), radius)


def test_the_circle_is_as_certain_as_its_points() -> None:
    arcs = [arc_features(wide(ball, seed), KNOWN)[0] for seed in range(40)]
    centres = np.array([arc.centre for arc in arcs])
    assert np.abs(centres.mean(axis=0) - CENTRE).max() < 1e-5
    misfit = [(np.linalg.norm(arc.points - CENTRE, axis=1) - 0.03) / arc.std for arc in arcs]
    assert np.sqrt(np.mean(np.square(np.concatenate(misfit)))) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize('share', [0.1, 0.3])
def test_gross_outliers_do_not_move_an_arc(share: float) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points = wide(ball, seed)
        is_outlier = rng.random(len(points)) < share
        points[is_outlier, 1] += rng.uniform(-8e-3, 8e-3, is_outlier.sum())
        arc, = arc_features(points, KNOWN)
        assert np.linalg.norm(arc.centre - CENTRE) < 1.5e-4
        assert abs(arc.radius - 0.03) < 1.5e-4


def in_clutter(height: Callable[[Array], Array], share: float, noise: float, alike: int,
               seed: int) -> Array:
    """Return a profile 120 mm wide; a share of what is not drawn returns random ranges."""
    rng = np.random.default_rng(seed)
    x = np.linspace(-0.06, 0.06, 2000)
    error = np.convolve(rng.normal(size=len(x) + alike - 1), np.ones(alike), 'valid')
    z = height(x) + noise * error / alike ** 0.5
    random = np.where(rng.random(len(x)) < share, rng.uniform(0.17, 0.22, len(x)), np.nan)
    return np.column_stack([x, np.where(np.isnan(z), random, z)])


def unbroken(x: Array) -> Array:
    return np.where(np.abs(x - 0.003) < 0.0095, ball(x, 0.01, centre=CENTRE), np.nan)


@pytest.mark.parametrize('share', [0.0, 0.3, 0.9])
@pytest.mark.parametrize(('noise', 'alike'), [(2e-5, 1), (8.5e-5, 1), (8.5e-5, 5)])
def test_a_ball_is_found_among_random_ranges(share: float, noise: float, alike: int) -> None:
    # the configured noise is up to four times too small
    config = with_values(KNOWN, {'target.radius': 0.0127, 'noise.sensor': 2e-5}, 'test')
    for seed in range(10):
        arc, = arc_features(in_clutter(unbroken, share, noise, alike, seed), config)
        assert np.linalg.norm(arc.centre - CENTRE) < 5e-5 + noise
        assert len(arc.measured) > 250  # of 317, but for the rims


@pytest.mark.parametrize('share', [0.3, 0.9])
@pytest.mark.parametrize('height', [lambda x: x * np.nan, lambda x: np.where(
    np.abs(x) < 0.01, face(x), np.nan)], ids=['nothing', 'a face'])
def test_random_ranges_are_no_arc(height: Callable[[Array], Array], share: float) -> None:
    config = with_values(KNOWN, {'target.radius': 0.0127, 'noise.sensor': 2e-5}, 'test')
    for seed in range(20):
        with pytest.raises(FeatureError):
            arc_features(in_clutter(height, share, 2e-5, 1, seed), config)


@pytest.mark.parametrize(('points', 'reason'), [
    (np.empty((0, 2)), 'returns'), (np.full((99, 2), np.nan), 'returns'),
    (drawn(face), 'arc'), (wide(lambda x: ball(x, 0.045)), 'arc'),
    (np.random.default_rng(0).uniform(0.15, 0.2, (640, 2)), 'arc'),
    (drawn(lambda x: ball(x, 0.04) + 0 * x)[310:340], 'short|arc')])
def test_what_shows_no_arc_is_refused_with_a_reason(points: Array, reason: str) -> None:
    with pytest.raises(FeatureError, match=reason):
        arc_features(points, KNOWN)


@given(any_points())
def test_any_array_gives_a_finite_arc_or_a_reason(points: Array) -> None:
    before = points.copy()
    for config in (KNOWN, UNKNOWN):
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            try:
                arc, = arc_features(points, config)
            except FeatureError as error:
                assert str(error)
                continue
        for value in (arc.points, arc.std, arc.centre, arc.radius, arc.measured):
            assert np.isfinite(value).all()
        assert (arc.std >= 0).all() and 0 < arc.radius < 0.6
        assert len(arc.points) == len(arc.std) >= 3 and len(arc.measured) >= 20
    assert np.array_equal(points, before, equal_nan=True)


def beside(low: float, high: float, step: float) -> Callable[[Array], Array]:
    """Return a face that something stands beside, and nothing between the two."""
    return lambda x: np.where(x < low, face(x, -0.45), np.where(
        x > high, face(x, -0.45) + step, np.nan))


def beyond(end: float) -> Callable[[Array], Array]:
    """Return a surface up to its end, nothing, and a steep wall and its foot."""
    def height(x: Array) -> Array:
        wall = np.where(x < 0.0065, 0.1825 + 2.1 * (0.0065 - x), 0.1825 + 0.35 * (x - 0.0065))
        return np.where(x < end, 0.2 + 0.4 * (x - end), np.where(x < 0.002, np.nan, wall))
    return height


@pytest.mark.parametrize('radius', [0.0, 0.0127, 0.04])
def test_circles_through_straight_pieces_are_no_arcs(radius: float) -> None:
    config = with_values(Config(), {'target.type': 'sphere', 'target.radius': radius}, 'test')
    drawings = [wide(beyond(end), seed) for end in np.linspace(-0.0195, -0.015, 8)
                for seed in range(3)]
    drawings += [drawn(beside(at, at + width, step)) for at in (-0.004, 0.003)
                 for width in (0.003, 0.005) for step in (0.001, 0.003, -0.002)]
    circles = []
    for k, points in enumerate(drawings):
        try:
            circles.append((k, arc_features(points, config)[0].radius))
        except FeatureError as error:
            assert 'arc' in str(error)
    assert not circles


def test_what_repeats_is_not_averaged_away() -> None:
    # speckle alike over four columns, frozen while the robot stands, and little white noise
    misfits = {1: [], 6: []}  # type: dict[int, list[Array]]
    for seed in range(12):
        rng = np.random.default_rng(seed)
        frozen = np.convolve(rng.normal(size=644), np.ones(4) / 2, 'valid') * 2e-5
        features = []
        for _ in range(6):
            points = wide(ball, noise=0.0)
            points[:, 1] += frozen + rng.normal(0, 4e-6, len(points))
            features.append(arc_features(points, KNOWN))
        for count, misfit in misfits.items():
            arc, = features_of_stop(features[:count], 1)
            assert isinstance(arc, Arc)
            misfit.append((np.linalg.norm(arc.points - CENTRE, axis=1) - 0.03) / arc.std)
    for misfit in misfits.values():
        assert np.sqrt(np.mean(np.square(misfit))) == pytest.approx(1, abs=0.3)


def test_the_profiles_of_a_station_are_one_arc_without_a_stray() -> None:
    features = [arc_features(wide(ball, seed), KNOWN) for seed in range(8)]
    stray = arc_features(wide(lambda x: ball(x, 0.02)), KNOWN)
    arc, = features_of_stop(features, 1)
    with_stray, = features_of_stop([*features, stray], 1)
    assert isinstance(arc, Arc) and isinstance(with_stray, Arc)
    assert np.array_equal(arc.measured, with_stray.measured)
    assert np.median(arc.std) == pytest.approx(np.median(features[0][0].std) / 8 ** 0.5, rel=0.2)


@pytest.mark.parametrize('stated', [0.01, 0.02, 0.2])
def test_a_wrong_radius_is_named_where_an_arc_is_seen(stated: float) -> None:
    config = with_values(UNKNOWN, {'target.radius': stated})
    with pytest.raises(FeatureError, match=r'target\.radius .* mm: correct it|radius of 30\.0 mm'):
        arc_features(wide(ball), config)
    with pytest.raises(FeatureError, match='no arc of the sphere'):
        arc_features(drawn(face), config)


@pytest.mark.parametrize('config', [KNOWN, UNKNOWN], ids=['known', 'unknown'])
def test_a_small_ball_before_a_table_is_found(config: Config) -> None:
    # 7 mm of 80: a table is a circle of a large radius within the noise, and has more points
    values = {'target.radius': config.target.radius / 8, 'noise.sensor': 3.0 * NOISE}
    config_of_ball = with_values(config, values, 'test')
    for seed, x in enumerate(np.linspace(-0.03, 0.03, 8)):
        centre = np.array([x, 0.2])

        def scene(at: Array, centre: Array = centre) -> Array:
            z = ball(at, 0.0045, centre=centre)
            return np.where(np.isnan(z), 0.21 + 0.05 * at, z)
        arc, = arc_features(wide(scene, seed), config_of_ball)
        assert np.linalg.norm(arc.centre - centre) < 1e-4


def test_an_arc_of_few_points_is_found_or_refused() -> None:
    rng, counts = np.random.default_rng(0), set()
    few = with_values(UNKNOWN, {'sampling.min_points': 5}, 'test')
    for _ in range(1000):
        x = np.sort(rng.uniform(-1, 1, rng.integers(5, 15))) * rng.uniform(0.005, 0.038)
        try:
            arc, = arc_features(np.column_stack([x, ball(x, 0.04)]), few)
        except FeatureError:
            continue
        counts.add(len(arc.measured))
    assert min(counts) >= 8 and max(counts) < 15
