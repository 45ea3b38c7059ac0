# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong conventions of the poses are named."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import Cell, cell, refused, settings_of
from handeye_ros import pipeline, se3
from handeye_ros.checks.conventions import orientations_scatter
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import SCENARIOS, simulate
from handeye_ros.simulate.robot import WRONG_CONVENTIONS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

Change = Callable[[Array], Array]  # of poses
THOROUGH = pytest.mark.thorough


def with_poses(cell: Cell, change: Change) -> list[Sample]:
    poses = change(np.array([s.T_base_flange for s in cell.samples]))
    return [replace(s, T_base_flange=T) for s, T in zip(cell.samples, poses, strict=True)]


def simulated(error: str) -> Change:
    """Return what the simulator makes of poses with this error."""
    return lambda T: se3.from_quaternion(*WRONG_CONVENTIONS[error](T[:, :3, 3], se3.quaternion(T)))


def read(change: Callable[[Rotation], Rotation]) -> Change:
    """Return what poses become whose orientations are read wrongly."""
    return lambda T: se3.transform(change(Rotation.from_matrix(T[:, :3, :3])).as_matrix(),
                                   T[:, :3, 3])


def angles(values: Array) -> Rotation:
    """Return orientations of roll, pitch, yaw."""
    return Rotation.from_euler('xyz', values)


@pytest.mark.parametrize(('target', 'change', 'words'), [
    ('plate', simulated('wxyz'), 'w x y z'),
    *(pytest.param('sphere', change, words, marks=THOROUGH) for change, words in (
        (simulated('inverted'), 'inverse poses'),
        (simulated('degrees'), 'angles in degrees are read as radians'))),
    *(pytest.param('plate', change, words, marks=THOROUGH) for change, words in (
        (simulated('inverted'), 'inverse poses'), (simulated('intrinsic'), 'intrinsic'),
        (simulated('millimetres'), 'positions in millimetres'),
        (simulated('degrees'), 'angles in degrees are read as radians'))),
    *(pytest.param('plate', read(change), words, marks=THOROUGH) for change, words in (
        (lambda R: R.inv(), 'transposed rotations'),
        (lambda R: angles(np.radians(R.as_euler('xyz'))), 'angles in radians'),
        (lambda R: angles(R.as_euler('XYZ')), 'intrinsic Euler angles'),
        (lambda R: angles(R.as_euler('xyz')[:, [2, 1, 0]]), 'roll and yaw exchanged'),
        (lambda R: angles(R.as_rotvec()), 'with rotation vectors')))])
def test_convention_errors_are_named(target: str, change: Change, words: str) -> None:
    simulated_cell = cell(target, 1)
    with refused('convention', words):
        simulated_cell.solve(with_poses(simulated_cell, change))
    assert not orientations_scatter(simulated_cell.problem.poses)


@pytest.mark.thorough
def test_convention_errors_are_named_in_a_sweep_whose_clocks_differ() -> None:
    sweep = SCENARIOS['plane_sweep']
    sweep = replace(sweep, sensor=replace(sweep.sensor, rate=10.0, columns=320, delay=-0.02))
    recording = simulate(sweep, np.random.default_rng(1))
    T = se3.inverse(np.array([se3.from_quaternion(p.translation, p.quaternion)
                              for p in recording.poses]))
    poses = [replace(p, translation=translation, quaternion=q) for p, translation, q in zip(
        recording.poses, T[:, :3, 3], se3.quaternion(T), strict=True)]
    with pytest.raises(DataError, match='inverse poses undone, .* samples fit'):
        pipeline.calibrate(recording.profiles, poses, settings_of(sweep, sampling__mode='moving'))


@pytest.mark.parametrize('name', [
    pytest.param('plate_real_robot', marks=THOROUGH), 'sphere_real_robot'])
def test_a_robot_worse_than_stated_is_no_convention_error(name: str) -> None:
    for seed in range(2):
        assert cell(name, seed).solve()


@pytest.mark.parametrize('target', [
    'sphere', *(pytest.param(name, marks=THOROUGH) for name in ('plate', 'line', 'plane'))])
@pytest.mark.parametrize('true_type', [
    'eye_on_base', pytest.param('eye_in_hand', marks=THOROUGH)])
def test_the_wrong_calibration_type_names_the_key(target: str, true_type: str) -> None:
    wrong_type = 'eye_on_base' if true_type == 'eye_in_hand' else 'eye_in_hand'
    simulated_cell = cell(replace(SCENARIOS[target], calibration_type=true_type), 1)
    with pytest.raises(DataError, match=f'with calibration_type {true_type} or inverse'):
        simulated_cell.solve(calibration_type=wrong_type)


def once_horizontal(T: Array) -> Array:
    """Return poses (n, 4, 4) in a base in which the angles of the first are in gimbal lock."""
    first = Rotation.from_euler('y', 90, degrees=True).as_matrix() @ T[0, :3, :3].T
    return se3.transform(first, np.zeros(3)) @ T


@pytest.mark.thorough
@pytest.mark.parametrize(('seed', 'wrong_poses'), [
    (1, lambda T: np.array([s.T_base_flange for s in cell('plate', 2).samples])),
    (3, lambda T: once_horizontal(np.roll(T, 1, axis=0)))],
    ids=['of another recording', 'of another sample'])
@pytest.mark.filterwarnings('error')
def test_poses_that_fit_nothing_name_no_cause(seed: int, wrong_poses: Change) -> None:
    plate_cell = cell('plate', seed)
    with refused('misfit', 'contradict'):
        plate_cell.solve(with_poses(plate_cell, wrong_poses))
