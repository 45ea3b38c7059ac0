# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Features of a stop (features.py): faces and edges of its profiles, drawn and simulated ones."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import recorded
from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from handeye_ros.profiles.lines import bin_means
from handeye_ros.sampling.features import features_of_stop
import numpy as np
from profiles import (
    COLUMNS,
    drawn,
    face,
    gap_up_to,
    many,
    NOISE,
    step_up_to,
    with_lost,
)
import pytest
from quick import long_run


@pytest.mark.parametrize('other_shape', [
    step_up_to(-0.007), lambda x: step_up_to(0.002)(x) + 0.003,
    lambda x: step_up_to(0.002, tilt=0.25)(x)])
def test_a_profile_that_disagrees_is_outvoted(other_shape: Callable[[Array], Array]) -> None:
    agreeing = many(step_up_to(0.002), 11)
    line, edge = features_of_stop(agreeing, 1)
    line_w, edge_w = features_of_stop([*agreeing, *many(other_shape, 2, 7)], 1)
    assert np.linalg.norm(edge_w.point - edge.point) < edge.std
    for x in (0.005, 0.015):
        heights = [f.centre[1] + f.direction[1] / f.direction[0] * (x - f.centre[0])
                   for f in (line, line_w)]
        assert abs(heights[0] - heights[1]) < 2e-5


def test_an_edge_that_few_profiles_show_is_not_used() -> None:
    def with_two_edges(x: Array) -> Array:
        return np.where(x > 0.012, np.nan, step_up_to(0.002)(x))
    features = features_of_stop([*many(step_up_to(0.002), 8), *many(with_two_edges, 3, 1)], 1)
    assert [f.direction[0] < 0 for f in features if isinstance(f, EdgePoint)] == [True]
    features = features_of_stop([*many(step_up_to(0.002), 3), *many(with_two_edges, 8, 1)], 1)
    assert len([f for f in features if isinstance(f, EdgePoint)]) == 2


@pytest.mark.parametrize('apart', [0.0007, 0.004])
def test_a_stop_that_was_bumped_is_refused_with_a_reason(apart: float) -> None:
    for count in (6, 7):
        halves = [*many(step_up_to(0.002), 7),
                  *many(lambda x: step_up_to(0.002)(x) + apart, count, 1)]
        with pytest.raises(FeatureError, match=f'how high the face is: .* {apart * 1e3:.1f}'):
            features_of_stop(halves, 1)
        halves = [*many(step_up_to(0.002), 7), *many(step_up_to(0.002 + apart), count, 1)]
        with pytest.raises(FeatureError, match='where the edge is'):
            features_of_stop(halves, 1)


@pytest.mark.parametrize(('coarse_count', 'shake'), [(1, 0.0), (4, 5e-5)])
def test_the_finer_lines_are_combined_though_some_profiles_show_fewer_points(
        coarse_count: int, shake: float) -> None:
    shaken = [many(lambda x, by=by: step_up_to(0.002)(x) + by, 1, seed)[0]
              for seed, by in enumerate(np.random.default_rng(0).normal(size=9) * shake)]
    coarse = [(replace(line, bins=bin_means(line.bins, 6)[0]), *edges)
              for line, *edges in shaken[:coarse_count]]
    fine_line = features_of_stop(shaken, 1)[0]
    line = features_of_stop([*coarse, *shaken[coarse_count:]], 1)[0]
    assert len(line.bins) == len(fine_line.bins)
    # those of each profile tell how much a robot shakes
    assert line.std == pytest.approx(fine_line.std, rel=0.1)


@pytest.mark.parametrize(('count', 'white', 'frozen'), [
    (1, NOISE / 6, NOISE), (8, NOISE / 6, NOISE), (8, NOISE, 0.0)])
def test_frozen_speckle_of_a_face_does_not_average_out(
        count: int, white: float, frozen: float) -> None:
    # alike over five columns, the same in every profile while the robot stands
    offsets, shares = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        speckle = np.convolve(rng.normal(size=COLUMNS + 4), np.ones(5) / 5 ** 0.5, 'valid')
        points = [drawn(gap_up_to(-0.005), 100 * seed + k, white) + np.column_stack(
            [np.zeros(COLUMNS), speckle * frozen]) for k in range(count)]
        features = [face_features(with_lost(p), Config()) for p in points]
        line = features_of_stop(features, 1)[0]
        normal = np.array([-np.sin(0.1), np.cos(0.1)])
        offsets.append((line.centre - [0, face(0.0)]) @ normal / line.std)
        shares.append((line.points - [0, face(0.0)]) @ normal / line.points_std)
    assert np.std(offsets) == pytest.approx(1, abs=0.35)
    assert np.std(shares) == pytest.approx(1, abs=0.25)


# -- against the truth of a simulated recording


@pytest.mark.parametrize('name', [
    'plate', *long_run('plate_reflections', 'plate_in_air', 'plate_clutter', 'plate_resampled',
                       'plate_omit', 'plate_x_reversed')])
def test_simulated_edges_are_as_near_to_the_truth_as_they_say(name: str) -> None:
    along, across = [], []
    for seed in range(2):
        recording = recorded(name, seed)
        session = pipeline.gather(recording.profiles, recording.poses, recording.config)
        mirror = np.array([-1.0 if name == 'plate_x_reversed' else 1.0, 1.0])
        for stop in recording.truth.stops:
            sample, = (s for s in session.samples if stop.start <= s.stamp <= stop.end)
            edges = [f for f in sample.features if isinstance(f, EdgePoint)]
            away = min((stop.point * mirror - e.point for e in edges), key=np.linalg.norm)
            edge = min(edges, key=lambda e: np.linalg.norm(stop.point * mirror - e.point))
            normal = np.array([-edge.direction[1], edge.direction[0]])
            along.append(away @ edge.direction / edge.std)
            across.append(away @ normal / edge.std_across)
    z = np.abs([along, across])
    assert (np.median(z, axis=1) < 1.4).all()
    # where half of the profiles of a stop show a reflection, its sample may be wrong
    some = z[:, (z < 6).all(axis=0)]
    assert some.shape[1] >= len(along) - 2
    assert ((some ** 2).mean(axis=1) ** 0.5 < 1.7).all() and ((some ** 2).mean(axis=1) > 0.3).all()
