# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Faces and edges of the profiles of a station together, drawn ones and simulated ones."""
from __future__ import annotations

from collections.abc import Callable

from cells import config as settings_of
from cells import recorded
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from handeye_ros.sampling.features import combine
from handeye_ros.sampling.session import Session
from handeye_ros.simulate import SCENARIOS
import numpy as np
from profiles import (
    COLUMNS,
    drawn,
    face,
    gap_up_to,
    many,
    marked,
    NOISE,
    PITCH,
    step_up_to,
    with_lost,
)
import pytest


def test_more_profiles_make_the_face_line_better() -> None:
    line, edge = combine(many(step_up_to(0.002), 16))
    single, _ = many(step_up_to(0.002), 1)[0]
    assert line.std == pytest.approx(single.std / 4, rel=0.5)
    assert abs(edge.point[0] - 0.002) < 4 * edge.std
    errors = [combine(many(step_up_to(0.002), 8, s))[0] for s in range(20)]
    offsets = [(f.centre[1] - face(f.centre[0])) * np.cos(0.1) / f.std for f in errors]
    assert np.std(offsets) == pytest.approx(1, abs=0.4)


def test_the_rounding_to_a_column_does_not_average_out() -> None:
    edge = combine(many(step_up_to(0.002), 30))[1]
    assert isinstance(edge, EdgePoint) and edge.std > 0.9 * PITCH / 12 ** 0.5


def test_what_scatters_between_profiles_is_less_certain() -> None:
    rng = np.random.default_rng(1)
    calm = combine(many(step_up_to(0.002)))
    moved = [face_features(marked(step_up_to(0.002)) + [s, 0.05 * s], Config())
             for s in rng.normal(0, 4e-4, 15)]
    shaken = combine(moved)
    assert shaken[1].std > 3 * calm[1].std and shaken[0].std > 2 * calm[0].std


@pytest.mark.parametrize('wrong', [
    step_up_to(-0.007), lambda x: step_up_to(0.002)(x) + 0.003,
    lambda x: step_up_to(0.002, tilt=0.25)(x)])
def test_a_profile_that_disagrees_is_outvoted(wrong: Callable[[Array], Array]) -> None:
    right = many(step_up_to(0.002), 11)
    line, edge = combine(right)
    line_w, edge_w = combine([*right, *many(wrong, 2, 7)])
    assert np.linalg.norm(edge_w.point - edge.point) < edge.std
    for x in (0.005, 0.015):
        heights = [f.centre[1] + f.direction[1] / f.direction[0] * (x - f.centre[0])
                   for f in (line, line_w)]
        assert abs(heights[0] - heights[1]) < 2e-5


def test_an_edge_that_few_profiles_show_is_left_out() -> None:
    def both(x: Array) -> Array:
        return np.where(x > 0.012, np.nan, step_up_to(0.002)(x))
    features = combine([*many(step_up_to(0.002), 8), *many(both, 3, 1)])
    assert [f.direction[0] < 0 for f in features if isinstance(f, EdgePoint)] == [True]
    features = combine([*many(step_up_to(0.002), 3), *many(both, 8, 1)])
    assert len([f for f in features if isinstance(f, EdgePoint)]) == 2


@pytest.mark.parametrize('apart', [0.0007, 0.0019, 0.004])
def test_a_station_that_was_bumped_is_refused_with_a_reason(apart: float) -> None:
    for count in (6, 7):
        halves = [*many(step_up_to(0.002), 7),
                  *many(lambda x: step_up_to(0.002)(x) + apart, count, 1)]
        with pytest.raises(FeatureError, match=f'how high the face is: .* {apart * 1e3:.1f}'):
            combine(halves)
        halves = [*many(step_up_to(0.002), 7), *many(step_up_to(0.002 + apart), count, 1)]
        with pytest.raises(FeatureError, match='where the edge is'):
            combine(halves)


@pytest.mark.parametrize('count', [1, 8])
def test_frozen_speckle_of_a_face_does_not_average_out(count: int) -> None:
    # alike over five columns, the same in every profile while the robot stands
    offsets, shares = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        frozen = np.convolve(rng.normal(size=COLUMNS + 4), np.ones(5) / 5 ** 0.5, 'valid') * NOISE
        points = [drawn(gap_up_to(-0.005), 100 * seed + k, NOISE / 6) + np.column_stack(
            [np.zeros(COLUMNS), frozen]) for k in range(count)]
        found = [face_features(with_lost(p), Config()) for p in points]
        line = combine(found)[0]
        normal = np.array([-np.sin(0.1), np.cos(0.1)])
        offsets.append((line.centre - [0, face(0.0)]) @ normal / line.std)
        shares.append((line.points - [0, face(0.0)]) @ normal / line.points_std)
    assert np.std(offsets) == pytest.approx(1, abs=0.35)
    assert np.std(shares) == pytest.approx(1, abs=0.25)


# -- against the truth of a simulated recording


@pytest.mark.parametrize('name', ['plate', 'plate_in_air', 'plate_clutter', 'plate_resampled',
                                  'plate_reflections', 'plate_omit', 'plate_x_reversed'])
def test_simulated_edges_are_as_near_to_the_truth_as_they_say(name: str) -> None:
    along, across = [], []
    for seed in range(2):
        recording = recorded(name, seed)
        session = Session(recording.config)
        for pose in recording.poses:
            session.add_pose(pose)
        for profile in recording.profiles:
            session.add_profile(profile)
        session.finish()
        mirror = np.array([-1.0 if name == 'plate_x_reversed' else 1.0, 1.0])
        for station in recording.truth.stations:
            sample, = (s for s in session.samples if station.start <= s.stamp <= station.end)
            edges = [f for f in sample.features if isinstance(f, EdgePoint)]
            away = min((station.point * mirror - e.point for e in edges), key=np.linalg.norm)
            edge = min(edges, key=lambda e: np.linalg.norm(station.point * mirror - e.point))
            normal = np.array([-edge.direction[1], edge.direction[0]])
            along.append(away @ edge.direction / edge.std)
            across.append(away @ normal / edge.std_across)
    z = np.abs([along, across])
    assert (np.median(z, axis=1) < 1.4).all()
    # where half of the profiles of a station show a reflection, the station may be wrong
    some = z[:, (z < 6).all(axis=0)]
    assert some.shape[1] >= len(along) - 2
    assert ((some ** 2).mean(axis=1) ** 0.5 < 1.7).all() and ((some ** 2).mean(axis=1) > 0.3).all()


def test_the_settings_of_every_plate_scenario_fit_its_profiles() -> None:
    for name in ('plate_z_up', 'plate_y_along_line', 'plate_inf'):
        recording = recorded(name, 0, rate=3.0, columns=640)
        config = settings_of(SCENARIOS[name])
        found_in = 0
        for profile in recording.profiles:
            try:
                found_in += bool(face_features(profile.points, config))
            except FeatureError:
                continue
        assert found_in > 0.4 * len(recording.profiles)
