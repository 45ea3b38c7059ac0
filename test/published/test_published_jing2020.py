# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Jing 2020: the chain through the laser tracker, its fits and its errors."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.errors import TooFewError
from handeye_ros.published import jing2020
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracker_session import RADIUS, session, T_flange_sensor


@pytest.mark.parametrize(('seed', 'skew'), [(0, 0.0), (1, 4.0)])
def test_the_truth_without_noise(seed: int, skew: float) -> None:
    """From the sweep's nominal direction, which is 1.2 degrees off; the block may be crooked."""
    found = jing2020.solve(*session(seed, skew=skew))
    assert np.abs(se3.difference(found.T_flange_sensor, T_flange_sensor)).max() < 1e-6
    np.testing.assert_allclose(found.direction, T_flange_sensor[2, :3], atol=1e-6)
    np.testing.assert_allclose(found.angles, np.deg2rad(90.0 + skew), atol=1e-7)
    assert found.radius == pytest.approx(RADIUS, abs=1e-8)


@pytest.mark.parametrize('sense', [1, -1])
def test_arc_has_centre_and_axis_of_its_sense(sense: int) -> None:
    T = se3.transform(Rotation.from_euler('xyz', [20, 40, 5], True).as_matrix(), np.arange(3.0))
    angle = sense * np.linspace(0.2, 1.4, 9)
    points = se3.apply(T, 0.3 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    centre, axis = jing2020.fit_arc(points)
    np.testing.assert_allclose(centre, T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(axis, sense * T[:3, 2], atol=1e-12)


def test_errors_are_those_of_the_axis_the_angle_and_the_place() -> None:
    vector, p = np.deg2rad(89.8) * np.array([0.6, 0.0, 0.8]), np.array([0.01, 0.02, 0.03])
    T, other = (se3.transform(se3.exp_rotation(vector * longer), p + shift) for longer, shift in (
        (1.0, np.zeros(3)), (1.01, np.array([0.0, 0.003, 0.004]))))
    assert jing2020.errors(other, T) == pytest.approx((0.0, np.deg2rad(0.898), 0.005), abs=1e-9)


@pytest.mark.parametrize(('name', 'count', 'what'), [
    ('arc', 2, 'reflector points on the arc'), ('line', 1, 'reflector points on the line'),
    ('face_c', 2, 'points on each face'), ('ball', 5, 'profile points on the ball')])
def test_too_few_points_are_refused(name: str, count: int, what: str) -> None:
    tracker, sweep = session(0)
    if name == 'ball':
        sweep = replace(sweep, ball=sweep.ball[:count])
    else:
        tracker = replace(tracker, **{name: getattr(tracker, name)[:count]})
    with pytest.raises(TooFewError, match=f'{what}, got {count}'):
        jing2020.solve(tracker, sweep)
