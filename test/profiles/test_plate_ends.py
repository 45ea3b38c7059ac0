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


@pytest.mark.parametrize('drop', [0.003, 0.012])
def test_a_smoothed_step_is_cut_at_half_its_height(drop: float) -> None:
    for seed, at in enumerate(np.linspace(-0.003, 0.003, 7)):
        z = drawn(step_up_to(at, drop=drop), seed)[:, 1]
        smooth = np.convolve(np.pad(z, 4, mode='edge'), np.ones(9) / 9, 'valid')
        smooth[[int(seed * 3 + 300), 320]] = np.nan
        edge = edge_of(np.column_stack([X, smooth]))
        assert abs(edge.point[0] - at) < PITCH < 2 * edge.std
        assert edge.kind == 'step'


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
