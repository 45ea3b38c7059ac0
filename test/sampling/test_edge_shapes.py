# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Ends of faces that are rounded, bevelled, thin or bent: where their edges are."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

from cells import recorded
from handeye_ros import pipeline, se3
from handeye_ros.data import EdgePoint, FaceLine, Sample
from handeye_ros.sampling.edge_shapes import common_shape, with_common_edge_shape
from handeye_ros.simulate.scenario import BASELINE
import numpy as np
from profiles import drawn, edge_of, PITCH, X
import pytest
from quick import long_run

LINE = FaceLine(np.array([0.01, 0.17]), np.array([1.0, 0.0]), 0.005, 1e-6)


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
    common = common_shape(samples)
    assert common.size == pytest.approx(size, rel=3 * common.relative_std)
    assert common.is_round == (shape == 'rounded') or size < 1e-3, 'few points show no shape'
    moved = with_common_edge_shape(samples)
    edges = [s.features[1] for s in moved]
    assert [s.features[1] for s in with_common_edge_shape(moved)] == edges, 'a second time'
    places = np.array([edge.point[0] for edge in edges])
    shared = np.array([edge.shape_std for edge in edges])
    assert abs(places.mean()) < PITCH + shared.mean() and places.std() < 1.5 * PITCH
    assert np.abs(places / np.hypot(shared, [edge.std for edge in edges])).max() < 4


@pytest.mark.parametrize('length', [2e-3, 4e-3])
def test_a_bend_longer_than_any_rounding_does_not_move_the_edge(length: float) -> None:
    """The sensor's field or the face is bent, by 0.1 mm; the edge is sharp."""
    samples = [Sample(k, np.eye(4), (LINE, edge_of(drawn(lambda x: np.where(
        x > 0, 0.17 + 1e-4 * np.maximum(1 - x / length, 0) ** 2, np.nan), k)))) for k in range(9)]
    assert common_shape(samples).size == 0
    edges = [s.features[1] for s in with_common_edge_shape(samples)]
    assert max(abs(edge.point[0]) for edge in edges) < 1.5 * PITCH


def test_a_few_deep_ends_are_no_bevel_of_all() -> None:
    """A driver that smooths bends the ends of some steps, each down to another depth."""
    sharp = edge_of(drawn(lambda x: np.where(x > 0, 0.17, np.nan), 0))
    depths = [*[0.0] * 6, *[3e-5] * 4, 2.4e-4, 2.5e-4, 3.3e-4, 7e-4]
    samples = [Sample(k, np.eye(4), (LINE, replace(sharp, to_lowest=np.array([0.0, depth]))))
               for k, depth in enumerate(depths)]
    assert common_shape(samples).size == 0
    assert common_shape(samples[-4:]).size > 2e-4


@pytest.mark.parametrize(('values', 'worst'), [
    ({'rounding': 5e-4}, 9e-5), ({'bevel': 3e-4}, 1e-4),
    *long_run(({}, 3e-5), ({'thickness': 2e-3}, 4e-5))])
def test_simulated_ends_are_at_the_edge(values: dict[str, Any], worst: float) -> None:
    scenario = replace(BASELINE, target=replace(BASELINE.target, **values))
    away, std = [], []
    for seed in range(2):
        recording = recorded(scenario, seed, rate=6.0)
        session = pipeline.gather(recording.profiles, recording.poses, recording.config)
        samples, truth = with_common_edge_shape(session.samples), recording.truth
        for stop in truth.stops:
            sample, = (s for s in samples if stop.start <= s.stamp <= stop.end)
            edge, = (f for f in sample.features if isinstance(f, EdgePoint))
            x, z = edge.point + edge.to_lowest  # of the wall, wherever the laser crosses it
            in_target = se3.apply(se3.inverse(truth.T_base_target) @ stop.T_base_flange
                                  @ truth.T_flange_sensor, np.array([[x, 0.0, z]]))[0]
            away.append(in_target[1 if stop.label == 'p' else 0])
            std.append(np.hypot(edge.std, edge.shape_std))
    z = np.array(away) / std
    assert np.sqrt(np.mean(np.square(away))) < worst
    assert 0.3 < np.sqrt((z ** 2).mean()) < 1.8 and np.abs(z).max() < 5
