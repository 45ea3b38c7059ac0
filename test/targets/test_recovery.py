# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Without noise every target gives the truth; motion about one axis is refused."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

from cells import cell, exact_cell
from handeye_ros import pipeline, se3
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest


def vector(point: dict[str, float]) -> Array:
    return np.array([point[axis] for axis in 'xyz'])


@pytest.mark.parametrize(('scene', 'values'), [
    ('plate', {}), ('line', {}), ('line', {'target__use_face': True}), ('plane', {}),
    ('wedge', {}), ('groove', {}), ('sphere', {}), ('sphere', {'target__radius': 0.0})])
@pytest.mark.parametrize('where', ['eye_in_hand', 'eye_on_base'])
@pytest.mark.parametrize('seed', range(2))
def test_the_truth_without_noise(scene: str, values: dict[str, Any], where: str, seed: int
                                 ) -> None:
    made = exact_cell(replace(SCENARIOS[scene], calibration_type=where), seed, **values)
    found = pipeline.solve(made.samples, [], made.config, 'laser')
    off = se3.difference(found.T_flange_sensor, made.truth.T_flange_sensor)
    assert np.abs(off).max() < 1e-6
    target, T = found.target, made.truth.T_base_target
    for axis, key in ((0, 'direction'), (2, 'normal')):
        if key in target:
            assert abs(np.array(target[key]) @ T[:3, axis]) == pytest.approx(1.0)
    if 'point' in target:
        away = np.cross(vector(target['point']) - T[:3, 3], T[:3, 0])
        assert np.linalg.norm(away) < 1e-6
    if 'distance' in target:
        assert target['distance'] == pytest.approx(np.array(target['normal']) @ T[:3, 3], abs=1e-6)
    if 'face_angle' in target:
        assert target['face_angle'] == pytest.approx(np.pi / 2, abs=1e-6)
    if 'centre' in target:
        assert np.linalg.norm(vector(target['centre']) - T[:3, 3]) < 1e-6


@pytest.mark.parametrize(('scene', 'motion', 'words'), [
    ('wedge', 'tilt_only', 'share one rotation axis'),
    ('wedge', 'one_orientation', 'share one orientation'),
    ('plane', 'yaw_only', r'one rotation axis.*if it is the normal of the plane \(yaw only\) all '
     'of the position.*tilt the tool by 15 degrees or more about flange')])
def test_motion_that_leaves_something_open_is_refused(scene: str, motion: str, words: str) -> None:
    made = cell(replace(SCENARIOS[scene], motion=motion))
    with pytest.raises(DataError, match=words):
        pipeline.solve(made.samples, [], made.config, 'laser')
