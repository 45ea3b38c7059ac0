# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rounded, bevelled, thin and smoothed ends of plates, against where face and wall meet."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

from cells import recorded
from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Sample
from handeye_ros.profiles.edge_rounding import RADII
from handeye_ros.profiles.faces import face_features
from handeye_ros.sampling.edge_shapes import common_shape, with_common_shape
from handeye_ros.simulate.scenario import BASELINE
import numpy as np
from profiles import COLUMNS, drawn, NOISE, PITCH, step_up_to, with_lost, X
import pytest

CONFIG = Config()
LINE = FaceLine(np.array([0.01, 0.17]), np.array([1.0, 0.0]), 0.005, 1e-6)


def edge_of(points: Array) -> EdgePoint:
    _, edge = face_features(with_lost(points), CONFIG)
    assert isinstance(edge, EdgePoint)
    return edge


def bent(radius: float, wall: float, tilt: float = 0.35) -> Array:
    """Return a face for x > 0 whose end is rounded, a wall below it seen at a slant, a table."""
    turn = np.linspace(0, np.pi / 2, 40)
    corner = radius * np.column_stack([1 - np.sin(turn), 1 - np.cos(turn)])
    outline = np.concatenate([[[0.03, 0.0]], corner, [[0.0, wall]]])
    c, s = np.cos(tilt), np.sin(tilt)
    x, z = (outline @ np.array([[c, s], [-s, c]])).T
    seen = np.interp(X, x[::-1], z[::-1])
    return 0.17 + np.where(x[-1] > X, wall + 0.01, seen)


@pytest.mark.parametrize('radius', [0.0, 3e-4, 1e-3])
@pytest.mark.parametrize('wall', [0.003, 0.008])
def test_a_wall_in_sight_gives_the_same_edge_whatever_the_corner(radius: float, wall: float
                                                                 ) -> None:
    errors = []
    for seed in range(10):
        z = bent(radius, wall)
        edge = edge_of(np.column_stack([X, z + np.random.default_rng(seed).normal(
            0, NOISE, COLUMNS)]))
        assert edge.kind == 'roof' and edge.bevel == 0
        errors.append((edge.point - [0, 0.17]) @ edge.direction)
        assert abs(errors[-1]) < 4 * edge.std
    assert abs(np.mean(errors)) < 0.6 * PITCH


def ended(shape: str, size: float, last: float, seed: int = 0) -> EdgePoint:
    """Return where a plate ends whose edge is at x = 0, seen as far as so much before its edge."""
    u = np.maximum(size - X, 0)
    below = size - np.sqrt(np.maximum(size ** 2 - u ** 2, 0)) if shape == 'rounded' else u
    return edge_of(drawn(lambda x: np.where(x > last, 0.17 + below, np.nan), seed))


@pytest.mark.parametrize('shape', ['rounded', 'bevelled'])
@pytest.mark.parametrize('size', [3e-4, 5e-4, 1e-3, 1.5e-3])
def test_a_bent_end_is_set_back_to_its_edge(shape: str, size: float) -> None:
    # where a rounding is too steep to be seen; a bevel of half a right angle never is
    ends = 1 - np.sin(np.radians([45, 60, 75])) if shape == 'rounded' else [0.0] * 3
    samples = [Sample(k, np.eye(4), (LINE, ended(shape, size, size * end, k)))
               for k, end in enumerate([*ends] * 5)]
    found = common_shape(samples)
    assert found.size == pytest.approx(size, rel=3 * found.relative_std)
    assert found.is_round == (shape == 'rounded') or size < 1e-3, 'few points show no shape'
    edges = [s.features[1] for s in with_common_shape(samples)]
    places = np.array([edge.point[0] for edge in edges])
    shared = np.array([edge.shape_std for edge in edges])
    assert abs(places.mean()) < PITCH + shared.mean() and places.std() < 1.5 * PITCH
    assert np.abs(places / np.hypot(shared, [edge.std for edge in edges])).max() < 4


@pytest.mark.parametrize('steepest', [0.0, 0.25, 0.5])
@pytest.mark.parametrize('shape', ['rounded', 'bevelled'])
def test_the_wall_below_the_edge_is_found_however_the_laser_crosses_it(
        shape: str, steepest: float) -> None:
    size, slants, samples = 1e-3, steepest * np.linspace(-1, 1, 9), []
    t = np.linspace(0, 1, 400)
    across, down = (np.sin(t * 1.2), 1 - np.cos(t * 1.2)) if shape == 'rounded' else (t, t)
    below = np.concatenate([[0.0], size * down])
    for seed, slant in enumerate(slants):
        # a slant shears what is seen: deeper points appear further out or in
        seen = np.concatenate([[0.03], size * (1 - across) + slant * size * down])
        z = np.where(seen[-1] > X, np.nan, np.interp(X, seen[::-1], below[::-1]))
        points = np.column_stack([X, 0.17 + z + np.random.default_rng(seed).normal(
            0, NOISE / 3, COLUMNS)])
        samples.append(Sample(seed, np.eye(4), (LINE, edge_of(points))))
    for slant, sample in zip(slants, with_common_shape(samples), strict=True):
        edge = sample.features[1]
        x, z = edge.point + edge.drop
        assert abs(x - slant * (z - 0.17)) < 1.5 * PITCH, 'the wall leads through x = 0'
        assert abs(edge.point[1] - 0.17) < 5 * NOISE, 'the point itself stays on the face line'


@pytest.mark.parametrize('drop', [0.003, 0.012])
def test_a_smoothed_step_is_cut_at_half_its_height(drop: float) -> None:
    for seed, at in enumerate(np.linspace(-0.003, 0.003, 7)):
        z = drawn(step_up_to(at, drop=drop), seed)[:, 1]
        smooth = np.convolve(np.pad(z, 4, mode='edge'), np.ones(9) / 9, 'valid')
        smooth[[int(seed * 3 + 300), 320]] = np.nan
        edge = edge_of(np.column_stack([X, smooth]))
        assert abs(edge.point[0] - at) < PITCH < 2 * edge.std
        assert edge.kind == 'step'


def test_a_foot_in_shadow_is_distinguished_from_one_in_sight() -> None:
    points = drawn(step_up_to(0.0))
    assert edge_of(points).kind == 'step'
    points[(X <= 0) & (X > -0.002)] = np.nan
    assert edge_of(points).kind == 'shadow'


def plates(depths: list[float], kind: str = 'gap', bevelled: bool = False) -> list[Sample]:
    shapes = np.append(-10 * np.abs(np.log(RADII[:, 0] / 5e-4)), 0.0 if bevelled else -20.0)
    edges = [EdgePoint(np.array([0.001, 0.17]), np.array([-1.0, 0]), 1e-5, 1e-6, kind,
                       np.array([0.0, depth]), shapes) for depth in depths]
    return [Sample(k, np.eye(4), (LINE, edge)) for k, edge in enumerate(edges)]


def test_ends_seen_less_far_are_set_back_more_and_walls_are_not() -> None:
    samples = [*plates([5e-4, 2e-4, 1e-4, 0.0]), *plates([0.0, 0.0], 'roof')]
    moved = with_common_shape(samples)
    found = common_shape(samples)
    assert found.size == pytest.approx(5e-4, rel=0.05) and found.is_round
    steps = np.array([0.001 - s.features[1].point[0] for s in moved[:4]])
    assert steps[0] == pytest.approx(0, abs=1e-6)
    assert (np.diff(steps) > 5e-5).all() and 3e-4 < steps[3] < 5e-4
    assert (np.diff([s.features[1].std for s in moved[:4]]) > 0).all()
    assert (np.diff([s.features[1].shape_std for s in moved[:4]]) > 0).all()
    assert [s.features[1] for s in moved[4:]] == [s.features[1] for s in samples[4:]]
    assert all(s.features[0] is LINE for s in moved)


def test_a_bevel_that_is_seen_ends_at_its_edge_and_one_that_is_not_before_it() -> None:
    samples = plates([3e-4, 2.8e-4, 3.3e-4, 0.0], bevelled=True)
    found = common_shape(samples)
    assert found.size == pytest.approx(3e-4) and not found.is_round
    steps = [0.001 - s.features[1].point[0] for s in with_common_shape(samples)]
    assert steps == pytest.approx([0, 0, 0, 3e-4], abs=1e-9)


def test_sharp_ends_stay_where_they_are() -> None:
    for samples in (plates([0.0, 1e-6, 2e-5, 0.0]), plates([5e-4, 5e-4])):
        assert common_shape(samples).size == 0.0, 'of two ends nothing is believed'
        for before, after in zip(samples, with_common_shape(samples), strict=True):
            assert (after.features[1].point == before.features[1].point).all()
            assert after.features[1].std == before.features[1].std and after.features[1].bevel == 0


WORST: list[tuple[str, dict[str, Any], float]] = [
    ('sharp', {}, 3e-5), ('rounded', {'rounding': 5e-4}, 9e-5),
    ('bevelled', {'bevel': 3e-4}, 1e-4), ('thin', {'thickness': 2e-3}, 4e-5)]


@pytest.mark.parametrize(('name', 'values', 'worst'), WORST, ids=[name for name, *_ in WORST])
def test_simulated_ends_are_as_near_to_the_edge_as_they_say(
        name: str, values: dict[str, Any], worst: float) -> None:
    scenario = replace(BASELINE, target=replace(BASELINE.target, **values))
    away, std = [], []
    for seed in range(2):
        made = recorded(scenario, seed, rate=6.0)
        kept = with_common_shape(pipeline.gather(made.profiles, made.poses, made.config).samples)
        for station in made.truth.stations:
            sample, = (s for s in kept if station.start <= s.stamp <= station.end)
            edge, = (f for f in sample.features if isinstance(f, EdgePoint))
            x, z = edge.point + edge.drop  # of the wall, wherever the laser crosses it
            in_target = se3.apply(se3.inverse(made.truth.T_base_target) @ station.T_base_flange
                                  @ made.truth.T_flange_sensor, np.array([[x, 0.0, z]]))[0]
            away.append(in_target[1 if station.label == 'p' else 0])
            std.append(np.hypot(edge.std, edge.shape_std))
    z = np.array(away) / std
    assert np.sqrt(np.mean(np.square(away))) < worst
    assert 0.3 < np.sqrt((z ** 2).mean()) < 1.8 and np.abs(z).max() < 5
