"""Arcs of a sphere in drawn profiles: exact, noisy, among clutter; any array at all."""
from __future__ import annotations

import warnings

from handeye_ros.config import Config, with_values
from handeye_ros.data import Arc, Array
from handeye_ros.profiles.arcs import arc_features, fit_circle, NORMAL_POINTS, normal_points
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.sampling.station_features import combine
from hypothesis import given
import numpy as np
from profiles import any_points, drawn, face, NOISE
import pytest

KNOWN = with_values(Config(), {'target.type': 'sphere', 'target.radius': 0.04}, 'test')
UNKNOWN = with_values(Config(), {'target.type': 'sphere'}, 'test')
CENTRE = np.array([0.003, 0.2])


def ball(x: Array, radius: float = 0.03, sign: int = -1, centre: Array = CENTRE) -> Array:
    """Return a circle's side towards the sensor, nothing beside it."""
    inside = np.abs(x - centre[0]) < radius
    return np.where(inside, centre[1] + sign * np.sqrt(
        np.where(inside, radius ** 2 - (x - centre[0]) ** 2, 0)), np.nan)


def wide(height: object, seed: int = 0, noise: float = NOISE) -> Array:
    """Return a profile twice as wide as usual, that the whole ball fits in."""
    points = drawn(lambda x: height(2 * x), seed)  # type: ignore[operator]
    if not noise:
        points[:, 1] = height(2 * points[:, 0])  # type: ignore[operator]
    return points * [2, 1]


@pytest.mark.parametrize('config', [KNOWN, UNKNOWN], ids=['known', 'unknown'])
@pytest.mark.parametrize('radius', [0.012, 0.03, 0.0395])
def test_an_exact_arc_is_recovered_exactly(config: Config, radius: float) -> None:
    arc, = arc_features(wide(lambda x: ball(x, radius), noise=0.0), config)
    assert np.allclose(arc.centre, CENTRE, atol=1e-9) and arc.radius == pytest.approx(radius)
    assert np.allclose(np.linalg.norm(arc.raw - CENTRE, axis=1), radius)
    # a mean of angles and radii, so the normal points lie on the circle too
    assert np.allclose(np.linalg.norm(arc.points - CENTRE, axis=1), radius)


def test_an_arc_that_is_open_upwards_is_one_too() -> None:
    arc, = arc_features(wide(lambda x: ball(x, 0.03, sign=1)), KNOWN)
    assert np.allclose(arc.centre, CENTRE, atol=2e-5)


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
        wrong = rng.random(len(points)) < share
        points[wrong, 1] += rng.uniform(-8e-3, 8e-3, wrong.sum())
        arc, = arc_features(points, KNOWN)
        assert np.linalg.norm(arc.centre - CENTRE) < 1.5e-4
        assert abs(arc.radius - 0.03) < 1.5e-4


def test_clutter_around_the_ball_is_left_out() -> None:
    def scene(x: Array) -> Array:
        z = ball(x, 0.02)
        z = np.where(np.isnan(z), 0.21 + 0.1 * x, z)  # a table
        return np.where(x < -0.03, 0.18, z)  # and a block
    for seed in range(10):
        arc, = arc_features(wide(scene, seed), KNOWN)
        assert np.linalg.norm(arc.centre - CENTRE) < 1e-4
        assert np.abs(np.linalg.norm(arc.raw - CENTRE, axis=1) - 0.02).max() < 6 * NOISE


def test_the_rim_is_left_out() -> None:
    points = wide(ball)
    steep = np.abs(points[:, 0] - CENTRE[0]) > 0.93 * 0.03
    points[steep, 1] += 3e-4  # what a rim looks like
    arc, = arc_features(points, KNOWN)
    assert np.linalg.norm(arc.centre - CENTRE) < 3e-5


def test_lost_points_are_no_matter() -> None:
    points = wide(ball)
    points[::3], points[300:340, 1], points[100, 0] = np.nan, np.inf, -np.inf
    arc, = arc_features(points, KNOWN)
    assert np.linalg.norm(arc.centre - CENTRE) < 3e-5


def test_columns_may_run_backwards() -> None:
    points = wide(ball)
    (arc,), (back,) = arc_features(points, KNOWN), arc_features(points[::-1], KNOWN)
    assert np.allclose(arc.centre, back.centre, atol=1e-6)


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
        for value in (arc.points, arc.std, arc.centre, arc.radius, arc.raw):
            assert np.isfinite(value).all()
        assert (arc.std >= 0).all() and 0 < arc.radius < 0.6
        assert len(arc.points) == len(arc.std) >= 3 and len(arc.raw) >= 20
    assert np.array_equal(points, before, equal_nan=True)


def test_a_circle_through_points_is_the_best_one() -> None:
    rng = np.random.default_rng(1)
    angle = np.linspace(-2.5, -0.7, 200)
    points = CENTRE + 0.03 * np.column_stack([np.cos(angle), np.sin(angle)])
    points += rng.normal(0, 1e-4, points.shape)
    circle = fit_circle(points)

    def cost(c: Array) -> float:
        return float(((np.linalg.norm(points - c[:2], axis=1) - c[2]) ** 2).sum())
    for step in rng.normal(0, 1e-5, (50, 3)):
        assert cost(circle + step) > cost(circle)


def test_normal_points_stand_for_all_points() -> None:
    arc, = arc_features(wide(ball), KNOWN)
    again = normal_points(arc.raw)
    assert len(again.points) == NORMAL_POINTS and np.allclose(again.points, arc.points)
    assert np.allclose(fit_circle(arc.points), fit_circle(arc.raw), atol=5e-6)
    share = len(arc.raw) / NORMAL_POINTS
    assert np.median(arc.std) == pytest.approx(
        np.std(np.linalg.norm(arc.raw - arc.centre, axis=1)) / share ** 0.5, rel=0.1)


def test_the_profiles_of_a_station_are_one_arc_and_a_stray_one_is_left_out() -> None:
    found = [arc_features(wide(ball, seed), KNOWN) for seed in range(8)]
    other = arc_features(wide(lambda x: ball(x, 0.02)), KNOWN)
    arc, = combine(found)
    with_other, = combine([*found, other])
    assert isinstance(arc, Arc) and isinstance(with_other, Arc)
    assert np.array_equal(arc.raw, with_other.raw)
    assert np.median(arc.std) == pytest.approx(np.median(found[0][0].std) / 8 ** 0.5, rel=0.2)


def test_profiles_that_share_no_arc_are_refused() -> None:
    found = [arc_features(wide(lambda x, r=r: ball(x, r)), KNOWN)  # type: ignore[misc]
             for r in (0.018, 0.024, 0.032, 0.039)]
    with pytest.raises(FeatureError, match='agree'):
        combine(found)
