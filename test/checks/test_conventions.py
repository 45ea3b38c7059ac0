# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong conventions are named, and nothing is answered."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import Cell, cell
from handeye_ros import pipeline, se3
from handeye_ros.checks.conventions import orientations_scatter
from handeye_ros.config import with_values
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import SCENARIOS
from handeye_ros.simulate.robot import CONVENTION_ERRORS as SIMULATED
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.thorough

def with_poses(made: Cell, change: Callable[[Array], Array]) -> list[Sample]:
    changed = change(np.array([s.T_base_flange for s in made.samples]))
    return [replace(s, T_base_flange=T) for s, T in zip(made.samples, changed, strict=True)]


def simulated(error: str) -> Callable[[Array], Array]:
    def change(T: Array) -> Array:
        translation, q = SIMULATED[error](T[:, :3, 3], se3.quaternion(T))
        return se3.from_quaternion(translation, q)
    return change


def transposed(T: Array) -> Array:
    return se3.transform(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])


def small_angles(T: Array) -> Array:
    """Read roll, pitch and yaw in radians as degrees."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')
    return se3.transform(Rotation.from_euler('xyz', np.radians(angles)).as_matrix(), T[:, :3, 3])


def extrinsic_for_intrinsic(T: Array) -> Array:
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('XYZ')
    return se3.transform(Rotation.from_euler('xyz', angles).as_matrix(), T[:, :3, 3])


def angles_in_order(order: list[int]) -> Callable[[Array], Array]:
    def change(T: Array) -> Array:
        angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')[:, order]
        return se3.transform(Rotation.from_euler('xyz', angles).as_matrix(), T[:, :3, 3])
    return change


def vectors_as_angles(T: Array) -> Array:
    """Read rotation vectors as roll, pitch, yaw."""
    vectors = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    return se3.transform(Rotation.from_euler('xyz', vectors).as_matrix(), T[:, :3, 3])


def angles_as_vectors(T: Array) -> Array:
    """Read roll, pitch, yaw as rotation vectors."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')
    return se3.transform(Rotation.from_rotvec(angles).as_matrix(), T[:, :3, 3])


def scaled(factor: float) -> Callable[[Array], Array]:
    return lambda T: se3.transform(T[:, :3, :3], T[:, :3, 3] * factor)


@pytest.mark.parametrize(('target', 'change', 'words'), [
    ('plate', simulated('inverted'), 'inverse poses'),
    ('sphere', simulated('inverted'), 'inverse poses'),
    ('plate', simulated('wxyz'), 'w x y z'), ('plate', simulated('intrinsic'), 'intrinsic'),
    ('plate', scaled(1e3), 'positions in millimetres'),
    ('plate', scaled(1e-3), 'a thousand times larger'),
    ('plate', transposed, 'transposed rotations'), ('plate', small_angles, 'angles in radians'),
    ('plate', extrinsic_for_intrinsic, 'intrinsic Euler angles'),
    ('plate', angles_in_order([2, 1, 0]), 'roll and yaw exchanged'),
    ('plate', angles_in_order([1, 0, 2]), 'roll and pitch exchanged'),
    ('plate', angles_in_order([0, 2, 1]), 'pitch and yaw exchanged'),
    ('plate', vectors_as_angles, 'with rotation vectors'),
    ('plate', angles_as_vectors, 'with roll, pitch, yaw')])
def test_convention_errors_are_named(target: str, change: Callable[[Array], Array], words: str
                                     ) -> None:
    made = cell(target, 1)
    with pytest.raises(DataError, match=words):
        pipeline.solve(with_poses(made, change), [], made.config, 'laser')


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_degrees_taken_for_radians_are_named(target: str) -> None:
    made = cell(target, 1)
    with pytest.raises(DataError, match='angles in degrees are read as radians'):
        pipeline.solve(with_poses(made, simulated('degrees')), [], made.config, 'laser')
    assert not orientations_scatter(made.problem.poses)


@pytest.mark.parametrize('name', ['plate_real_robot', 'sphere_real_robot'])
def test_a_robot_worse_than_stated_is_no_convention_error(name: str) -> None:
    for seed in range(2):
        made = cell(name, seed)
        assert pipeline.solve(made.samples, [], made.config, 'laser')


@pytest.mark.parametrize('target', ['plate', 'sphere', 'line', 'plane'])
@pytest.mark.parametrize('right', ['eye_in_hand', 'eye_on_base'])
def test_the_wrong_calibration_type_names_the_key(target: str, right: str) -> None:
    wrong = 'eye_on_base' if right == 'eye_in_hand' else 'eye_in_hand'
    made = cell(replace(SCENARIOS[target], calibration_type=right), 1)
    config = with_values(made.config, {'calibration_type': wrong}, 'test')
    with pytest.raises(DataError, match=f'with calibration_type {right} or inverse'):
        pipeline.solve(made.samples, [], config, 'laser')


def test_poses_of_another_recording_are_refused_with_both_figures() -> None:
    made, other = cell('plate', 1), cell('plate', 2)
    wrong = [replace(a, T_base_flange=b.T_base_flange) for a, b in
             zip(made.samples, other.samples, strict=True)]
    with pytest.raises(DataError) as caught:
        pipeline.solve(wrong, [], made.config, 'laser')
    assert caught.value.reason == 'misfit' and 'contradict' in str(caught.value)
