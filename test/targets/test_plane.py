# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A plane: whole profiles without an edge in sight, and what yaw alone leaves open."""
from __future__ import annotations

from dataclasses import replace

from cells import cell, recorded
from handeye_ros.config import Config
from handeye_ros.data import Array, FaceLine
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features, plane_features
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest

PLANE = SCENARIOS['plane']


def test_a_profile_without_an_edge_is_a_plane_and_no_face() -> None:
    x = np.linspace(-0.02, 0.02, 200)
    points = np.column_stack([x, 0.17 + 0.1 * x + 1e-5 * np.sin(1e5 * x)])
    points[-30:, 1] += 0.05  # something else, 50 mm farther
    line, beside = plane_features(points, Config())
    assert beside.centre[0] > line.centre[0]
    assert isinstance(line, FaceLine)
    np.testing.assert_allclose(line.direction[1] / line.direction[0], 0.1, atol=1e-3)
    assert line.centre[0] < 0
    flat = np.column_stack([x[:-30], 0.17 + 0.1 * x[:-30]])
    at_border = np.vstack([flat, [[0.02, np.nan]]])
    with pytest.raises(FeatureError, match='no edge'):
        face_features(at_border, Config())
    assert plane_features(at_border, Config())
    with pytest.raises(FeatureError, match='no straight piece of 20 points'):
        plane_features(points[:15], Config())


@pytest.mark.thorough
@pytest.mark.parametrize('values', [
    {'table': 0.003}, {'table': 0.010},
    {'table': None, 'clutter': 0.002, 'clutter_gap': 0.003, 'clutter_width': 0.06}])
def test_one_surface_is_chosen_where_others_lie_beside(values: dict[str, float]) -> None:
    plate = SCENARIOS['plate']
    recording = recorded(replace(plate, target=replace(plate.target, **values)), 1, columns=640,
                         target__type='plane')
    calibration = recording.calibrate()
    assert recording.error(calibration.T_flange_sensor) < 3e-4
    note = calibration.target['note']
    assert 'samples show other surfaces too than the plane that was used' in note


@pytest.mark.thorough
@pytest.mark.parametrize('seed', range(4))
def test_a_plane_through_two_near_surfaces_is_no_answer(seed: int) -> None:
    """Of 24 stations some see only a table 3 mm below, and half of the others see it too."""
    plane_cell = cell(replace(PLANE, stops=(24, 0)), seed, noise__robot_smooth=3e-4)
    rng = np.random.default_rng(seed)
    samples = []
    for sample in plane_cell.samples:
        face, = sample.features
        table = below(face, sample.T_base_flange @ plane_cell.truth.T_flange_sensor,
                      plane_cell.truth.T_base_target, 3e-3)
        beside = replace(table, spread=face.spread * rng.uniform(0.5, 2.0))
        lines = (table,) if rng.random() < 0.2 else (face, beside)[:rng.integers(1, 3)]
        samples.append(replace(sample, features=tuple(
            sorted(lines, key=lambda line: -line.spread))))
    calibration = plane_cell.solve(samples)
    assert plane_cell.error(calibration.T_flange_sensor) < 3e-4


def below(face: FaceLine, T_base_sensor: Array, T_base_target: Array, depth: float) -> FaceLine:
    """Return the line of a plane parallel to that of a face, below it."""
    normal = (T_base_sensor[:3, :3].T @ T_base_target[:3, 2])[[0, 2]]
    return replace(face, centre=face.centre - depth * normal / (normal @ normal))
