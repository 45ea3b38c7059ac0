# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Orientations of robot controllers: the examples of their manuals, and there and back."""
from __future__ import annotations

from handeye_ros import orientations
from handeye_ros.orientations import NOTATIONS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def matrix(name: str, *numbers: float) -> np.ndarray:
    return orientations.of(name).rotation(np.array([numbers]))[0].as_matrix()


def about(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def test_abb_reference_manual_orient() -> None:
    """Example 1: z' = x; example 2: the tool turned by 30 degrees."""
    np.testing.assert_allclose(matrix('abb', 0.5 ** 0.5, 0, 0.5 ** 0.5, 0),
                               np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), atol=1e-12)
    numbers = orientations.of('abb').numbers(Rotation.from_euler('y', [[30]], degrees=True))
    np.testing.assert_allclose(numbers[0], [0.965926, 0, 0.258819, 0], atol=5e-7)


def test_universal_robots_script_manual() -> None:
    """rpy2rotvec([3.14, 1.57, 0]) and rotvec2rpy([3.14, 1.57, 0])."""
    R = Rotation.from_euler('xyz', [[3.14, 1.57, 0]])
    np.testing.assert_allclose(orientations.of('ur').numbers(R)[0],
                               [2.22153, 0.00177, -2.21976], atol=6e-6)
    rpy = Rotation.from_matrix(matrix('ur', 3.14, 1.57, 0)).as_euler('xyz')
    np.testing.assert_allclose(rpy, [-2.80856, -0.16202, 0.9], atol=6e-6)


@pytest.mark.parametrize(('name', 'numbers', 'chain'), [
    ('kuka', (30, 90, 40), (('z', 30), ('y', 90), ('x', 40))),
    ('fanuc', (10, 20, 30), (('z', 30), ('y', 20), ('x', 10))),
    ('staubli', (10, 20, 30), (('x', 10), ('y', 20), ('z', 30))),
    ('yaskawa', (10, 20, 30), (('z', 30), ('y', 20), ('x', 10)))])
def test_angles_are_composed_as_the_manuals_define_them(
        name: str, numbers: tuple[float, ...], chain: tuple[tuple[str, float], ...]) -> None:
    product = np.eye(3)
    for axis, angle in chain:
        product = product @ about(axis, angle)
    np.testing.assert_allclose(matrix(name, *numbers), product, atol=1e-12)


@pytest.mark.parametrize('name', NOTATIONS)
def test_there_and_back(name: str) -> None:
    notation, R = NOTATIONS[name], Rotation.random(50, random_state=1)
    numbers = notation.numbers(R)
    assert numbers.shape == (50, len(notation.labels))
    np.testing.assert_allclose((notation.rotation(numbers).inv() * R).magnitude(), 0, atol=1e-9)
