# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Which straight pieces of drawn profiles are the face (faces.py, segment.py, lines.py)."""
from __future__ import annotations

import warnings

from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, FaceLine
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from hypothesis import given
import numpy as np
from profiles import (
    any_points,
    assert_edge,
    CONFIG,
    face,
    features_of,
    gap_up_to,
    marked,
    PITCH,
    step_up_to,
)
import pytest

TOWARDS = with_values(CONFIG, {'profile.range_sign': -1}, 'test')


@pytest.mark.parametrize('tilt', [-0.5, 0.0, 0.3])
def test_the_mean_points_of_a_face_are_as_certain_as_they_say(tilt: float) -> None:
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
