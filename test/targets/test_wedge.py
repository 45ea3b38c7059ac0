# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A wedge: two faces that meet, block or groove, in every profile; no labels, no edge points."""
from __future__ import annotations

from dataclasses import replace
from itertools import islice

from cells import cell, exact_cell, recorded
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import FaceLine, Sample
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_pair_features
from handeye_ros.simulate import Scenario, SCENARIOS, scenes
from handeye_ros.simulate.solids import box, Solid
from handeye_ros.targets import problem_of_known_poses
from handeye_ros.targets.wedge import WEDGE
import numpy as np
import pytest


def turned_about_z(sample: Sample) -> Sample:
    """Return what a sensor sees that was turned by 180 degrees about its z, x the other way."""
    flip = np.diag([-1.0, 1.0])
    lines = [replace(line, centre=line.centre @ flip, direction=-(line.direction @ flip),
                     points=line.points[::-1] @ flip, points_std=line.points_std[::-1])
             for line in sample.features if isinstance(line, FaceLine)]
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(sample, features=tuple(lines[::-1]),
                   T_base_flange=sample.T_base_flange @ half_turn)


def test_turned_by_half_the_faces_change_sides() -> None:
    """With the sensor in the flange itself, a turned robot sees the same faces the other way."""
    wedge_cell = exact_cell(SCENARIOS['wedge'])
    X = wedge_cell.truth.T_flange_sensor
    in_flange = [replace(s, T_base_flange=s.T_base_flange @ X) for s in wedge_cell.samples]
    mixed = [turned_about_z(s) if i % 2 else s for i, s in enumerate(in_flange)]
    calibration = wedge_cell.solve(mixed)
    assert np.abs(se3.difference(calibration.T_flange_sensor, np.eye(4))).max() < 1e-6


def roof(bevel: float = 0.0, noise: float = 1e-5) -> np.ndarray:
    """Return a profile (600, 2) across a block's edge at x = 0, with a flat bevel so wide."""
    x = np.linspace(-0.02, 0.02, 600)
    z = 0.17 + np.maximum(np.abs(x), bevel / 2)
    return np.column_stack([x, z + noise * np.random.default_rng(0).normal(size=600)])


@pytest.mark.parametrize('bevel', [0.0, 1e-3, 3e-3])
def test_what_lies_between_the_faces_belongs_to_neither(bevel: float) -> None:
    left, right = face_pair_features(roof(bevel), Config())
    for line, slope in ((left, -1.0), (right, 1.0)):
        assert line.direction[1] / line.direction[0] == pytest.approx(slope, abs=1e-3)
        at_edge = line.centre[1] - line.centre[0] * slope
        assert at_edge == pytest.approx(0.17, abs=5e-6)


def test_profiles_without_two_faces_say_so() -> None:
    with pytest.raises(FeatureError, match='both faces of the edge must be in view'):
        face_pair_features(roof()[:300], Config())
    x = np.linspace(-0.02, 0.02, 600)
    step = np.column_stack([x, np.where(x < 0, 0.17, 0.18)])
    with pytest.raises(FeatureError, match='no two of the 2 straight pieces'):
        face_pair_features(step, Config())


def test_a_groove_beside_the_edge_is_another_corner() -> None:
    x = np.linspace(-0.02, 0.02, 800)
    z = 0.17 + np.abs(x)  # a block, whose foot stands on a table at x = 0.008
    foot = x > 0.008
    z[foot] = 0.178 - (x[foot] - 0.008)
    lines = face_pair_features(np.column_stack([x, z]), Config())
    slopes = [round(float(line.direction[1] / line.direction[0]), 3) for line in lines]
    assert sorted(zip(slopes[::2], slopes[1::2], strict=True)) == [(-1.0, 1.0), (1.0, -1.0)]


def table_at(face: FaceLine, end: int) -> FaceLine:
    """Return the table that rises from an end (-1 or 1) of a face, where it has gone on 40 mm."""
    outwards = face.direction * [1, -1]
    return FaceLine(face.centre + end * (0.02 * face.direction + 0.015 * outwards), outwards,
                    0.01, 1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [0, 1])
def test_a_block_on_a_table_is_distinguished_from_the_groove_at_its_foot(seed: int) -> None:
    wedge_cell = cell('wedge', seed)
    rng, samples = np.random.default_rng(seed), []
    for k, sample in enumerate(wedge_cell.samples):
        left, right = sample.features
        block, groove = (left, right), (right, table_at(right, 1))
        pairs = [groove] if k % 5 == 0 else (
            [groove, block] if rng.random() < 0.5 else [block, groove])
        samples.append(replace(sample, features=tuple(line for pair in pairs for line in pair)))
    calibration = wedge_cell.solve(samples)
    assert wedge_cell.error(calibration.T_flange_sensor) < 2e-4


def on_a_table(sample: Sample) -> Sample:
    """Return what a sensor sees of a block whose faces both end at a table."""
    left, right = sample.features
    return replace(sample, features=(
        table_at(left, -1), left, right, table_at(right, 1), left, right))


def test_one_of_the_first_starts_is_the_block_between_two_grooves() -> None:
    """Where an offset of the clocks is looked for, three are tried of each."""
    wedge_cell = cell('wedge', 0)
    problem = problem_of_known_poses([*map(on_a_table, wedge_cell.samples)], wedge_cell.config)
    starts = islice(WEDGE.starts(problem, np.random.default_rng(0)), 3)
    assert min(wedge_cell.error(start.X) for start in starts) < 1e-3


def stepped(scenario: Scenario) -> tuple[Solid, ...]:
    """Return a block with a step of 10 by 3 mm along its edge: a second, parallel edge."""
    length, width = scenario.target.length, 0.05
    return (box((0.0, 0.01, -width), (length, width, 0.0)),
            box((0.0, 0.0, -width), (length, width, -0.003)))


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [3, 5])
def test_a_step_along_the_edge_is_no_edge(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scenes.SCENES, 'stepped', replace(scenes.SCENES['wedge'], solids=stepped))
    recording = recorded(replace(SCENARIOS['wedge'], scene='stepped', stops=(18, 0),
                                 stated=(('target.type', 'wedge'),)), seed)
    calibration = recording.calibrate()
    assert recording.error(calibration.T_flange_sensor) < 3e-4
