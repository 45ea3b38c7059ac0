"""Rounded, bevelled, thin and smoothed ends of plates, against where face and wall meet."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

from cells import recorded
from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Sample
from handeye_ros.profiles.faces import face_features
from handeye_ros.sampling.all_edges import judged_together, typical_bevel, with_bevel
from handeye_ros.simulate.faults import PLATE
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


@pytest.mark.parametrize('shape', ['rounded', 'bevelled'])
def test_how_steeply_a_bent_end_is_seen_matters_little(shape: str) -> None:
    size, places = 5e-4, []
    for end in np.radians([40, 55, 70]):  # where the surface is too steep to be seen
        u = np.maximum(size - X, 0)
        if shape == 'rounded':
            last = size * np.sin(end)
            below = size - np.sqrt(np.maximum(size ** 2 - u ** 2, 0))
        else:
            last, below = size, u
        points = drawn(lambda x, b=below, s=last: np.where(  # type: ignore[misc]
            x > size - s, 0.17 + b, np.nan))
        edge = edge_of(points)
        assert edge.bevel > 5e-5
        places.append(edge.point[0])
    assert np.ptp(places) < 0.15 * size


@pytest.mark.parametrize('drop', [0.003, 0.012])
def test_a_smoothed_step_is_cut_at_half_its_height(drop: float) -> None:
    for seed, at in enumerate(np.linspace(-0.003, 0.003, 7)):
        z = drawn(step_up_to(at, drop=drop), seed)[:, 1]
        smooth = np.convolve(np.pad(z, 4, mode='edge'), np.ones(9) / 9, 'valid')
        smooth[[int(seed * 3 + 300), 320]] = np.nan
        edge = edge_of(np.column_stack([X, smooth]))
        assert abs(edge.point[0] - at) < PITCH < 2 * edge.std
        assert edge.kind == 'step'


def test_a_foot_in_shadow_is_told_from_one_in_sight() -> None:
    points = drawn(step_up_to(0.0))
    assert edge_of(points).kind == 'step'
    points[(X <= 0) & (X > -0.002)] = np.nan
    assert edge_of(points).kind == 'shadow'


def plates(depths: list[float], kind: str = 'gap') -> list[Sample]:
    edges = [EdgePoint(np.array([0.001, 0.17]), np.array([-1.0, 0]), 1e-5, 1e-6, kind, depth)
             for depth in depths]
    return [Sample(k, np.eye(4), (LINE, edge)) for k, edge in enumerate(edges)]


def test_all_ends_are_set_back_alike_and_walls_are_not() -> None:
    samples = [*plates([4e-4, 5e-4, 6e-4]), *plates([0.0, 0.0], 'roof')]
    moved = with_bevel(samples)
    assert typical_bevel(samples) == pytest.approx(5e-4)
    steps = {round(float(s.features[1].point[0] - 0.001), 7) for s in moved[:3]}
    assert len(steps) == 1 and -7e-4 < steps.pop() < -3e-4
    assert all(s.features[1].std > 5e-5 for s in moved[:3])
    assert [s.features[1] for s in moved[3:]] == [s.features[1] for s in samples[3:]]
    assert all(s.features[0] is LINE for s in moved)
    sharp = plates([0.0, 1e-6, 2e-5, 0.0])
    assert with_bevel(sharp) == sharp
    assert typical_bevel(plates([5e-4, 5e-4])) == 0.0, 'of two ends nothing is believed'


WORST: list[tuple[str, dict[str, Any], float]] = [
    ('sharp', {}, 3e-5), ('rounded', {'rounding': 5e-4}, 9e-5),
    ('bevelled', {'bevel': 3e-4}, 1e-4), ('thin', {'thickness': 2e-3}, 4e-5)]


@pytest.mark.parametrize(('name', 'values', 'worst'), WORST, ids=[name for name, *_ in WORST])
def test_simulated_ends_are_as_near_to_the_edge_as_they_say(
        name: str, values: dict[str, Any], worst: float) -> None:
    scenario = replace(PLATE, target=replace(PLATE.target, **values))
    away, std = [], []
    for seed in range(2):
        made = recorded(scenario, seed, rate=6.0)
        kept, _ = judged_together(pipeline.gather(made.profiles, made.poses, made.config).samples)
        for station in made.truth.stations:
            sample, = (s for s in kept if station.start <= s.stamp <= station.end)
            edge, = (f for f in sample.features if isinstance(f, EdgePoint))
            away.append((edge.point - station.point) @ edge.direction)
            std.append(edge.std)
    z = np.array(away) / std
    assert np.sqrt(np.mean(np.square(away))) < worst
    assert 0.3 < np.sqrt((z ** 2).mean()) < 1.8 and np.abs(z).max() < 5
