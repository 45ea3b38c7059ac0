# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong conventions are named, and nothing is answered."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import Cell, cell, recorded
from handeye_ros import pipeline, se3
from handeye_ros.checks.conventions import CONVENTION_ERRORS, orientations_scatter
from handeye_ros.config import with_values
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import SCENARIOS
from handeye_ros.simulate.robot import CONVENTION_ERRORS as SIMULATED
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.thorough

NAMES = {'inverted': 'inverse poses', 'wxyz': 'w x y z', 'intrinsic': 'intrinsic'}


def with_poses(made: Cell, change: Callable[[Array], Array]) -> list[Sample]:
    changed = change(np.array([s.T_base_flange for s in made.samples]))
    return [replace(s, T_base_flange=T) for s, T in zip(made.samples, changed, strict=True)]


def simulated(error: str) -> Callable[[Array], Array]:
    def change(T: Array) -> Array:
        translation, q = SIMULATED[error](T[:, :3, 3], se3.quaternion(T))
        return se3.from_quaternion(translation, q)
    return change


@pytest.mark.parametrize(('target', 'error'), [
    *(('plate', error) for error in NAMES), ('sphere', 'inverted')])
def test_simulated_convention_errors_are_named(target: str, error: str) -> None:
    made = cell(target, 1)
    with pytest.raises(DataError, match=NAMES[error]):
        pipeline.solve(with_poses(made, simulated(error)), [], made.config, 'laser')


def test_the_other_simulated_convention_errors_are_those_that_tests_below_name() -> None:
    assert SIMULATED.keys() - NAMES == {'millimetres', 'degrees'}
    poses = np.array([s.T_base_flange for s in cell('plate', 1).samples])
    assert np.allclose(simulated('millimetres')(poses), scaled(1e3)(poses), rtol=1e-12)


@pytest.mark.parametrize('error', ['inverted', 'millimetres'])
def test_a_recording_with_a_convention_error_says_which(error: str) -> None:
    name = 'inverted_poses' if error == 'inverted' else error
    recording = recorded(replace(SCENARIOS[name], convention_errors=(error,)), columns=640)
    with pytest.raises(DataError) as caught:
        pipeline.calibrate(recording.profiles, recording.poses, recording.config)
    assert NAMES.get(error, 'mm') in str(caught.value)


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


@pytest.mark.parametrize(('change', 'words'), [
    (scaled(1e3), 'positions in millimetres'), (scaled(1e-3), 'a thousand times larger'),
    (transposed, 'transposed rotations'), (small_angles, 'angles in radians'),
    (extrinsic_for_intrinsic, 'intrinsic Euler angles'),
    (angles_in_order([2, 1, 0]), 'roll and yaw exchanged'),
    (angles_in_order([1, 0, 2]), 'roll and pitch exchanged'),
    (angles_in_order([0, 2, 1]), 'pitch and yaw exchanged'),
    (vectors_as_angles, 'with rotation vectors'), (angles_as_vectors, 'with roll, pitch, yaw')],
    ids=['mm', 'km', 'transposed', 'radians', 'extrinsic', 'ypr', 'pry', 'ryp', 'vectors', 'rpy'])
@pytest.mark.parametrize('seed', [1])
def test_further_convention_errors_are_named(
        change: Callable[[Array], Array], words: str, seed: int) -> None:
    made = cell('plate', seed)
    with pytest.raises(DataError) as caught:
        pipeline.solve(with_poses(made, change), [], made.config, 'laser')
    assert words in str(caught.value)


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_degrees_taken_for_radians_are_named(target: str) -> None:
    made = cell(target, 1)
    with pytest.raises(DataError, match='angles in degrees are read as radians'):
        pipeline.solve(with_poses(made, simulated('degrees')), [], made.config, 'laser')
    assert not orientations_scatter(made.problem.poses)


@pytest.mark.parametrize('name', CONVENTION_ERRORS)
def test_undoing_gives_poses_back(name: str) -> None:
    """Every undo is a map of rigid transforms, and none is the identity."""
    rng = np.random.default_rng(3)
    T = se3.from_quaternion(rng.normal(size=(8, 3)), rng.normal(size=(8, 4)))
    undone = CONVENTION_ERRORS[name].undo(T)
    R = undone[:, :3, :3]
    assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3)) and np.allclose(np.linalg.det(R), 1)
    assert not np.allclose(undone, T)
    advice = CONVENTION_ERRORS[name].advice
    assert advice[0].islower() and not advice.endswith('.')


@pytest.mark.parametrize(('error', 'undo'), [
    ('inverted', 'inverse poses'), ('wxyz', 'quaternions read as w x y z'),
    ('millimetres', 'positions in millimetres'), ('intrinsic', 'extrinsic Euler angles')])
def test_undoing_undoes(error: str, undo: str) -> None:
    rng = np.random.default_rng(4)
    T = se3.from_quaternion(rng.normal(size=(20, 3)), rng.normal(size=(20, 4)))
    back = CONVENTION_ERRORS[undo].undo(simulated(error)(T))
    assert np.allclose(back, T, atol=1e-9)


@pytest.mark.parametrize('target', ['plate', 'sphere'])
@pytest.mark.parametrize('where', ['eye_in_hand', 'eye_on_base'])
def test_good_samples_are_no_convention_error(target: str, where: str) -> None:
    for seed in range(2):
        made = cell(replace(SCENARIOS[target], calibration_type=where), seed)
        assert pipeline.solve(made.samples, [], made.config, 'laser').quality.samples_used >= 14


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
    with pytest.raises(DataError, match=f'with calibration_type {right}, '):
        pipeline.solve(made.samples, [], config, 'laser')


def test_poses_of_another_recording_are_refused_with_both_figures() -> None:
    made, other = cell('plate', 1), cell('plate', 2)
    wrong = [replace(a, T_base_flange=b.T_base_flange) for a, b in
             zip(made.samples, other.samples, strict=True)]
    with pytest.raises(DataError) as caught:
        pipeline.solve(wrong, [], made.config, 'laser')
    assert caught.value.reason == 'misfit' and 'contradict' in str(caught.value)


def test_the_limit_of_residuals_is_the_users() -> None:
    made = cell('plate', 1)
    answer = pipeline.solve(made.samples, [], made.config, 'laser')
    strict = with_values(made.config, {'limits.residual': 0.5 * answer.quality.residual_rms}, 't')
    with pytest.raises(DataError, match='limits.residual'):
        pipeline.solve(made.samples, [], strict, 'laser')


def test_a_sphere_of_another_radius_than_stated_is_noticed() -> None:
    for result in (0.0, 0.039, 0.045):
        made = cell('sphere', target__radius=result)
        answer = pipeline.solve(made.samples, [], made.config, 'laser')
        assert answer.target['radius'] == pytest.approx(0.04, abs=5 * answer.target['radius_std'])
        assert answer.target['radius_std'] < 1e-5
        assert ('note' in answer.target) == bool(result)
